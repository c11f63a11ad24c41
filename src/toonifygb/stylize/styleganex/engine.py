"""The network as the stylizers use it: bytes in, bytes out, loaded at its first use, specialised once per clip."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from toonifygb.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, UInt8
    from torch import Tensor

    from toonifygb.config import StyleganexConfig

    Codes = Float[np.ndarray, "18 512"]
    Images = UInt8[np.ndarray, "n h w 3"]

log = logging.getLogger(__name__)

FIRST_COLOR_CODE = 7
"""Codes from this one on colour and texture the face; those before shape it."""
BYTES_PER_PIXEL = {"float32": 10_000, "bfloat16": 5_500}
"""Memory the network takes per px of its input at all levels (measured at 352 and 512 px square)."""
_MAX_BATCH = 8
_MEMORY_SHARE = 0.5
"""Of a GPU's free memory, for a batch."""


class Network(Protocol):
    """What a network has to offer; ``network.StyleGANEX`` does."""

    latent_avg: Float[Tensor, "18 512"]
    editing_w: Float[Tensor, "k 18 512"]

    def codes(self, x2: Float[Tensor, "n 3 256 256"]) -> Float[Tensor, "n 18 512"]:
        """Style codes of aligned faces in -1..1."""
        ...

    def to(self, device: Any) -> Any:
        """The network on another device."""
        ...


class Engine:
    """A network with its settings.

    Args:
        load: reads the network, on the CPU.
        compile_clip: ``fast.compile_clip`` or its equal: specialises a network to the codes of a clip.
        config: precision, levels, device, and how colours become bytes.
        trained_levels: levels that the network was trained with, for settings that name none.
    """

    def __init__(
        self,
        load: Callable[[], Network],
        compile_clip: Callable[..., Callable],
        config: StyleganexConfig,
        trained_levels: int = 8,
    ) -> None:
        if config.levels not in (None, 6, 7, 8):
            raise InputError(f"setting styleganex.levels is {config.levels}; expected 6, 7 or 8")
        self.config = config
        self.levels = trained_levels if config.levels is None else config.levels
        """Generator levels run."""
        self.magnification = 2 ** (self.levels - 6)
        """Output px per input px."""
        self._load, self._compile = load, compile_clip
        self._network: Network | None = None
        self._clip: tuple[bytes, Callable] | None = None
        self._n_batch: int | None = None

    def codes(self, face: UInt8[np.ndarray, "256 256 3"]) -> Codes:
        """Style codes of an aligned face, with the colours the settings ask for."""
        network = self._loaded()
        with torch.inference_mode():
            codes = network.codes(to_network(face[None]).to(self._device))[0].float()
            average = network.latent_avg.to(codes)
        share = float(np.clip(self.config.own_colors, 0.0, 1.0))
        shape, color = codes[:FIRST_COLOR_CODE], average[FIRST_COLOR_CODE:].lerp(codes[FIRST_COLOR_CODE:], share)
        return torch.cat([shape, color]).cpu().numpy()

    def run(self, images: Images, codes: Codes) -> Images:
        """The network's output for each image, ``magnification`` times as large.

        Batches have one size, a last one is filled up: the bits of an image must not depend on its company.
        """
        clip = self._specialised(codes)
        size = self._batch_size(images.shape[1] * images.shape[2])
        done = []
        for start in range(0, len(images), size):
            batch = images[start : start + size]
            missing = size - len(batch)
            filled = np.concatenate([batch, batch[-1:].repeat(missing, 0)]) if missing else batch
            with torch.inference_mode():
                output = clip(to_network(filled).to(self._device))[: len(batch)]
                done.append(to_bytes(output, self.config.rounding).cpu().numpy())
        return np.concatenate(done)

    @property
    def _device(self) -> str:
        if self.config.device != "auto":
            return self.config.device
        return "cuda" if torch.cuda.is_available() else "cpu"

    def _loaded(self) -> Network:
        if self._network is not None:
            return self._network
        log.info("StyleGANEX runs on %s in %s", self._device, self.config.precision)
        network: Network = self._load().to(self._device)
        self._network = network
        return network

    def _specialised(self, codes: Codes) -> Callable:
        """The network of these codes; the latest is kept."""
        key = codes.tobytes()
        if self._clip is None or self._clip[0] != key:
            w_plus = torch.from_numpy(codes)[None].to(self._device)
            dtype = getattr(torch, self.config.precision)
            network = self._loaded()
            # As published, of several editing vectors the first one counts.
            edit = {"edit": self.config.edit * network.editing_w[:1]} if len(network.editing_w) else {}
            self._clip = key, self._compile(network, w_plus, dtype=dtype, levels=self.levels, **edit)
            if self.config.codes != "each":
                self._network = None  # 1.3 GB that the frames of a clip do not need
        return self._clip[1]

    def _batch_size(self, pixels: int) -> int:
        """Images at once: one on the CPU, where more gain nothing; what fits on a GPU."""
        if torch.device(self._device).type != "cuda":
            return 1
        if self._n_batch is None:
            free, _ = torch.cuda.mem_get_info(self._device)
            fitting = int(_MEMORY_SHARE * free / (pixels * BYTES_PER_PIXEL[self.config.precision]))
            self._n_batch = min(max(fitting, 1), _MAX_BATCH)
        return self._n_batch


def to_network(images: Images) -> Float[Tensor, "n 3 h w"]:
    """Bytes to -1..1, in the published order of operations."""
    unit = torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2).float() / 255.0
    return ((unit - 0.5) / 0.5).contiguous()


def to_bytes(images: Float[Tensor, "n 3 h w"], rounding: str) -> UInt8[Tensor, "n h w 3"]:
    """Colours in -1..1 to bytes.

    Args:
        images: clamped here.
        rounding: ``nearest``, or ``truncate`` as published.
    """
    levels = (images.clamp(-1.0, 1.0) + 1.0) * 127.5
    if rounding == "nearest":
        levels = levels.round()
    return levels.to(torch.uint8).permute(0, 2, 3, 1).contiguous()
