"""Playback on the processor: an avatar's neutral Gaussians and deltas to an image in one call of the native engine.

What is posed never leaves the processor's cache: the deltas of one block of Gaussians are blended, skinned and
projected before the next block is read. The slow twin is ``Renderer.render`` on the splats of ``Avatar.pose``.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.render import library
from toonifygb.render.base import DEFAULT_CONSTANTS, RasterConstants
from toonifygb.render.native import available_threads, native_camera
from toonifygb.structures import Camera, Rendering

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

BLOCK = 64
"""Gaussians that lie together; a multiple of every vector width."""
MAX_ROWS = 1024


@dataclass(frozen=True)
class PlaybackDeltas:
    """Deltas of neighbouring channels, as whole levels times a step, without the blocks in which a row is zero."""

    first: int
    """The first channel."""
    begin: Int[Tensor, " b+1"]
    """Entries (block, row) before each block; int32."""
    row: Int[Tensor, " e"]
    """Row of each entry, ascending within a block; int32."""
    steps: Float[Tensor, "w r"]
    """Value of one level, per channel and row."""
    levels: Int[Tensor, " l"]
    """int8 or int16; block by block (channel, entry of the block, Gaussian of the block)."""


@dataclass(frozen=True)
class PlaybackModel:
    """What the engine reads of an avatar, all of it on the CPU.

    Channels of a Gaussian: position 3 (m), quaternion 4 (w, x, y, z), log scale 3, opacity logit, then harmonics,
    coefficient by coefficient, r g b. The last block is filled up.
    """

    n: int
    rows: int
    sh_degree: int
    neutral: Float[Tensor, "b c 64"]
    weights: Float[Tensor, "b 5 64"]
    deltas: tuple[PlaybackDeltas, PlaybackDeltas, PlaybackDeltas]

    def __post_init__(self) -> None:
        blocks, channels = -(-self.n // BLOCK), 11 + 3 * (self.sh_degree + 1) ** 2
        expected = ((blocks, channels, BLOCK), (blocks, 5, BLOCK))
        found = (tuple(self.neutral.shape), tuple(self.weights.shape))
        if found != expected or not 0 < self.rows <= MAX_ROWS:
            raise ValueError(
                f"neutral, weights are {found}, expected {expected}; {self.rows} rows of 1..{MAX_ROWS}"
            )
        if sum(len(group.steps) for group in self.deltas) != channels:
            raise ValueError(f"the deltas do not have the {channels} channels")
        for group in self.deltas:
            entries, width = int(group.begin[-1]), len(group.steps)
            fits = len(group.begin) == blocks + 1 and len(group.row) == entries
            if not fits or group.levels.numel() != entries * width * BLOCK or group.steps.shape[1] != self.rows:
                raise ValueError(f"the deltas from channel {group.first} on do not fit together")


class NativePlayback:
    """Draws one avatar many times.

    Args:
        model: is kept, not copied.
        threads: of the engine; all available processors when ``None``.

    Raises:
        BackendError: the engine is not built or cannot be loaded.
    """

    def __init__(self, model: PlaybackModel, threads: int | None = None) -> None:
        self._engine, self._model = library.load(), model
        self.threads = threads or available_threads()
        self._native = library.Playback(
            n=model.n,
            rows=model.rows,
            sh_degree=model.sh_degree,
            neutral=library.pointer(model.neutral),
            weights=library.pointer(model.weights),
        )
        for group, native in zip(model.deltas, self._native.groups, strict=True):
            native.first, native.width, native.bytes = group.first, len(group.steps), group.levels.element_size()
            for name in ("begin", "row", "steps", "levels"):
                setattr(native, name, library.pointer(getattr(group, name)))

    def render(
        self,
        psi: Float[Tensor, " r"],
        transforms: Float[Tensor, "5 4 4"],
        camera: Camera,
        *,
        background: Float[Tensor, " 3"] | None = None,
        constants: RasterConstants = DEFAULT_CONSTANTS,
    ) -> Rendering:
        """Image of one pose.

        Args:
            psi: what the rows of the deltas are multiplied with.
            transforms: of the joints, rest to world, m.
            camera: looks at it.
            background: linear mix behind it, 0..1; black when ``None``.
            constants: of the rasteriser.
        """
        if psi.shape != (self._model.rows,) or transforms.shape != (5, 4, 4):
            raise ValueError(
                f"psi, transforms are {tuple(psi.shape)}, {tuple(transforms.shape)}, expected "
                f"{(self._model.rows,)}, (5, 4, 4)"
            )
        psi, transforms = (tensor.to("cpu", torch.float32).contiguous() for tensor in (psi, transforms))
        scene = library.Scene(
            camera=native_camera(camera), constants=library.Constants(*astuple(constants)), threads=self.threads
        )
        scene.splats.sh_degree = self._model.sh_degree
        if background is not None:
            scene.background[:] = background.tolist()
        color = torch.empty(camera.height, camera.width, 3)
        alpha = torch.empty(camera.height, camera.width)
        if not self._engine.tgb_play(
            self._native, psi.data_ptr(), transforms.data_ptr(), scene, color.data_ptr(), alpha.data_ptr(), None
        ):
            raise MemoryError("the native renderer ran out of memory")
        return Rendering(color=color, alpha=alpha)
