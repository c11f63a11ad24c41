"""Which pictures a foreign dataset has, and what says where the head is in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from toonifygb import video
from toonifygb.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, UInt8

    from toonifygb.structures import TrackedSequence

LAYOUTS = ("insta", "flashavatar", "tracker", "vhap")
"""INSTA and 3D Gaussian Blendshapes; FlashAvatar; metrical-tracker's own output; VHAP and GaussianAvatars."""
CHECKPOINTS = ("checkpoint", "checkpoints")
CLOTH = 90
"""Clothes in the red channel of INSTA's segmentation."""
HELD_OUT = 350
"""Frames at the end that the field tests on, unless a dataset says otherwise."""


@dataclass(frozen=True)
class Picture:
    """One frame's image and what makes its matte."""

    image: Path
    alpha: Path | None = None
    """File whose alpha channel is the matte; may be the image itself."""
    masks: tuple[Path, ...] = ()
    """Grey images that the matte is multiplied by."""
    parsing: Path | None = None
    """Segmentation whose clothes are cut out of the matte."""

    @property
    def has_matte(self) -> bool:
        """Whether the dataset says where the head is."""
        return self.alpha is not None or bool(self.masks)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that makes the picture, once."""
        parts = (self.image, self.alpha, *self.masks, self.parsing)
        return tuple(dict.fromkeys(part for part in parts if part is not None))


@dataclass(frozen=True)
class ForeignFolder:
    """A dataset that was recognised, its frames in order."""

    layout: str
    path: Path
    ids: tuple[int, ...]
    """Frame numbers in the dataset's own count."""
    pictures: tuple[Picture, ...]
    parameters: tuple[Path, ...]
    """Files that hold the track."""
    n_test: int
    """Frames at the end that are held out."""
    head: str
    """Head model of the track, as ``head.load`` names it."""

    def first(self, n_frames: int | None) -> ForeignFolder:
        """The dataset's first frames; all of them for ``None``."""
        if n_frames is None or n_frames >= len(self.ids):
            return self
        each = len(self.parameters) == len(self.ids)
        return replace(
            self,
            ids=self.ids[:n_frames],
            pictures=self.pictures[:n_frames],
            parameters=self.parameters[:n_frames] if each else self.parameters,
            n_test=held_out(self.n_test, n_frames),
        )


@dataclass(frozen=True)
class ForeignTrack:
    """A dataset's track in our world."""

    sequence: TrackedSequence
    problems: tuple[str, ...]
    """One sentence each."""


def read_picture(picture: Picture) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None]:
    """Colours, not darkened by the matte, and the matte 0..1 where there is one.

    Raises:
        InputError: a file cannot be read, or sizes differ.
    """
    image = video.load_rgba(picture.image)
    if not picture.has_matte:
        return np.ascontiguousarray(image[..., :3]), None
    matte = np.ones(image.shape[:2], np.float32)
    if picture.alpha is not None:
        layer = image if picture.alpha == picture.image else video.load_rgba(picture.alpha)
        matte = matte * _same_size(layer, image, picture.alpha)[..., 3] / np.float32(255)
    for path in picture.masks:
        # JPEG's noise around 0 and 255 must not become a veil over the whole picture.
        value = _same_size(video.load_rgba(path), image, path)[..., 0].astype(np.float32)
        matte = matte * ((value - 8) / 239).clip(0, 1)
    if picture.parsing is not None:
        matte = matte * (_same_size(video.load_rgba(picture.parsing), image, picture.parsing)[..., 0] != CLOTH)
    return np.ascontiguousarray(image[..., :3]), matte.astype(np.float32)


def _same_size(layer: np.ndarray, image: np.ndarray, path: Path) -> np.ndarray:
    if layer.shape[:2] != image.shape[:2]:
        size, wanted = (f"{a.shape[1]}x{a.shape[0]}" for a in (layer, image))
        raise InputError(f"{path} is {size} px, its picture is {wanted} px", "make the dataset again")
    return layer


def find_insta(path: Path) -> ForeignFolder | None:
    """INSTA's and 3DGB's layout: ``images/%05d.png`` with ``checkpoint/%05d.frame``."""
    frames = _checkpoints(path)
    if not frames or not (path / "images").is_dir():
        return None

    opening = next((image for number in sorted(frames) if (image := _existing(path / "images", number))), None)
    transparent = opening is not None and video.load_rgba(opening)[..., 3].min() < 255

    def picture(number: int) -> Picture | None:
        image = _existing(path / "images", number)
        if image is None or transparent:
            return image and Picture(image, alpha=image)
        matted = _existing(path / "matted", number)
        parsing = _existing(path / "seg_mask", number) or _existing(path / "parsing", number)
        return Picture(image, alpha=matted, parsing=parsing if matted else None)

    return _folder("insta", path, frames, picture, HELD_OUT)


def find_flashavatar(path: Path) -> ForeignFolder | None:
    """FlashAvatar's layout: ``imgs``, ``alpha`` and ``parsing`` count from 1, the tracker from 0."""
    frames = _checkpoints(path)
    if not frames or not (path / "imgs").is_dir():
        return None

    def picture(number: int) -> Picture | None:
        image = _existing(path / "imgs", number + 1)
        parts = (_existing(path / "alpha", number + 1), _existing(path / "parsing", number + 1, "_neckhead"))
        return image and Picture(image, masks=tuple(part for part in parts if part))

    return _folder("flashavatar", path, frames, picture, 500)


def find_tracker(path: Path) -> ForeignFolder | None:
    """metrical-tracker's output: ``input/%05d.png`` with ``checkpoint/%05d.frame``; no mattes."""
    frames = _checkpoints(path)
    if not frames or not (path / "input").is_dir():
        return None

    def picture(number: int) -> Picture | None:
        image = _existing(path / "input", number)
        return image and Picture(image)

    return _folder("tracker", path, frames, picture, HELD_OUT)


def held_out(n_test: int, n_frames: int) -> int:
    """Held-out frames of a dataset, never more than half of it."""
    return min(n_test, n_frames // 2)


def _folder(
    layout: str, path: Path, frames: dict[int, Path], picture: Callable[[int], Picture | None], n_test: int
) -> ForeignFolder:
    found = [(number, picture(number)) for number in sorted(frames)]
    kept = [(number, shown) for number, shown in found if shown]
    if not kept:
        raise InputError(
            f"{path} has {len(frames)} tracked frames and no picture of any of them", "copy its images as well"
        )
    return ForeignFolder(
        layout=layout,
        path=path,
        ids=tuple(number for number, _ in kept),
        pictures=tuple(shown for _, shown in kept),
        parameters=tuple(frames[number] for number, _ in kept),
        n_test=held_out(n_test, len(kept)),
        head="flame",
    )


def _checkpoints(path: Path) -> dict[int, Path]:
    """The tracker's files by frame number."""
    for name in CHECKPOINTS:
        files = [file for file in (path / name).glob("*.frame") if file.stem.isdecimal()]
        if files:
            return {int(file.stem): file for file in files}
    return {}


def _existing(folder: Path, number: int, ending: str = "") -> Path | None:
    """The image of that number."""
    for suffix in (".png", ".jpg", ".jpeg"):
        path = folder / f"{number:05d}{ending}{suffix}"
        if path.is_file():
            return path
    return None
