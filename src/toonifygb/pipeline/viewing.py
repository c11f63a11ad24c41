"""Pictures of an avatar from any view."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from toonifygb import avatar as avatars
from toonifygb.errors import InputError
from toonifygb.geometry import cameras
from toonifygb.structures import Camera, HeadMotion


class AvatarViewer:
    """Pictures of an avatar on a square canvas, from the training camera or turned about the head."""

    def __init__(
        self,
        model: avatars.Avatar,
        size: int,
        background: torch.Tensor | None = None,
        backend: str = "auto",
        threads: int | None = None,
    ) -> None:
        self.model = model
        self._player = avatars.Player(model, backend=backend, threads=threads)
        self.background = background
        self.size = size
        self.look_through(model.camera)

    def look_through(self, camera: Camera) -> None:
        """Takes another camera's square view from now on."""
        self.camera = resized(camera, self.size)

    def frame(self, motion: HeadMotion, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> np.ndarray:
        """uint8 RGB picture of one pose; angles as in ``frames``."""
        return self.frames(motion, [(yaw_deg, pitch_deg)])[0]

    def frames(self, motion: HeadMotion, angles_deg: Sequence[tuple[float, float]]) -> list[np.ndarray]:
        """uint8 RGB pictures of one pose from several views.

        Args:
            motion: expression and pose, no batch axis.
            angles_deg: (yaw, pitch) of each view about the head, degrees: yaw turns it towards the subject's left,
                pitch upwards; (0, 0) is the camera itself.
        """
        views = [self._orbit(motion, *angles) for angles in angles_deg]
        return [to_uint8(image.color) for image in self._player.render(motion, views, background=self.background)]

    def play(self, motion: HeadMotion, angles_deg: Sequence[tuple[float, float]]) -> Iterator[np.ndarray]:
        """uint8 RGB pictures of pose after pose, each from its view.

        Args:
            motion: leading axis = time.
            angles_deg: of each pose, as in ``frames``.
        """
        views = (self._orbit(motion[index], *angles) for index, angles in enumerate(angles_deg))
        for image in self._player.play(motion, views, background=self.background):
            yield to_uint8(image.color)

    def _orbit(self, motion: HeadMotion, yaw_deg: float, pitch_deg: float) -> Camera:
        """The camera turned about the head of one pose."""
        pivot = motion.translation + self.model.rest_joints[0]
        return cameras.orbit(self.camera, pivot, math.radians(yaw_deg), math.radians(pitch_deg))


_JAW_OPEN_RAD = 0.426
"""Jaw rotation that the artist's unit ``jawOpen`` = 1 stands for."""


def posed(model: avatars.Avatar, weights: dict[str, float]) -> HeadMotion:
    """The avatar's mean motion with a calm face, changed by expression weights by name.

    Args:
        model: the avatar.
        weights: expression unit → weight; besides the avatar's own units ``jawOpen`` (a joint) and
            ``eyesClosed`` (both lids).

    Raises:
        InputError: an unknown name.
    """
    motion = model.motion_mean
    names = model.blendshape_names[: model.n_expressions]
    expression, joints = motion.expression.clone(), motion.joints.clone()
    eyelids = motion.eyelids.clone()
    for name, value in weights.items():
        if name == "jawOpen":
            joints[2, 0] = value * _JAW_OPEN_RAD
        elif name == "eyesClosed":
            eyelids[:] = value
        elif name in names:
            expression[names.index(name)] = value
        else:
            known = ", ".join(["jawOpen", "eyesClosed", *names])
            raise InputError(f"expression '{name}' does not exist; this avatar has: {known}")
    return HeadMotion(expression, joints, motion.translation, eyelids)


def to_uint8(color: torch.Tensor) -> np.ndarray:
    """Float image 0..1 as rounded uint8."""
    return (color.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def resized(camera: Camera, size: int) -> Camera:
    """The same square view at another number of pixels."""
    scale = size / camera.width
    K = camera.K.clone()
    K[:2] *= scale
    return Camera(K, camera.world_to_camera, size, round(camera.height * scale))


def parse_color(text: str) -> torch.Tensor:
    """RGB 0..1 of a colour name or ``#rrggbb``.

    Raises:
        InputError: not a colour.
    """
    named = {"black": "#000000", "white": "#ffffff", "grey": "#808080", "gray": "#808080"}
    code = named.get(text.lower(), text)
    try:
        if len(code) != 7 or code[0] != "#":
            raise ValueError
        value = bytes.fromhex(code[1:])
    except ValueError:
        raise InputError(f"background '{text}' is not a colour; expected black, white or #rrggbb") from None
    return torch.tensor(list(value), dtype=torch.float32) / 255
