"""The network specialised to one clip: same results, a fraction of the work.

Within a clip w+ does not change, so kernels are modulated once and become those of ordinary convolutions. Further:

* √2·lrelu(Kx + b) = lrelu((√2K)x + √2b): the activation's gain goes into kernel and bias;
* batch normalisation after a convolution goes into it exactly. Before a zero-padded one it stays, because its shift
  does not reach the padding;
* filters are depthwise convolutions; after a transposed one they carry the bias;
* the trunk ends where the last feature is read, and the style heads (72 % of the weights) are not kept;
* maps lie in memory as ``n h w c``.

``StyleGANEX`` is the definition: in float32 the difference is rounding, at most about 1e-5.
"""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from toonifygb.errors import BackendError, InputError
from toonifygb.stylize.styleganex.folded import FoldedFeatures, FoldedFusion, FoldedLevel, fold_styled, fold_to_rgb
from toonifygb.stylize.styleganex.generator import N_LEVELS, scale_of
from toonifygb.stylize.styleganex.network import StyleGANEX, check_image
from toonifygb.stylize.styleganex.variants import N_CODES

if TYPE_CHECKING:
    from jaxtyping import Float

    from toonifygb.stylize.styleganex.fusion import Fusion
    from toonifygb.stylize.styleganex.layers import StyledConv, ToRGB

PRECISIONS = (torch.float32, torch.bfloat16)


def compile_clip(
    network: StyleGANEX,
    w_plus: Float[Tensor, "1 18 512"],
    *,
    dtype: torch.dtype = torch.float32,
    levels: int = N_LEVELS,
    edit: Float[Tensor, "1 18 512"] | None = None,
    compiled: bool = False,
) -> ClipNetwork:
    """The network for all frames of a clip: ``clip_network(x1)`` is ``network.synthesize`` of its features.

    Args:
        network: where the weights come from; nothing of it is kept or changed.
        w_plus: the clip's style codes.
        dtype: ``float32``, or ``bfloat16`` (some 52 dB against it): over twice as fast where the processor
            multiplies in it (AMX, AVX-512 BF16), and twice as slow where it does not.
        levels: 8 for an output of 4 times the input's size, 7 for 2 times, 6 for the same size.
        edit: editing vector, as in ``synthesize``.
        compiled: have torch compile the whole, which takes 20 s to minutes for each new size of frame. Worth trying
            on long clips with bfloat16; in float32 the convolutions are all that is left, and they stay the same.

    Raises:
        InputError: codes for other than one clip, or a precision or level that does not exist.
        BackendError: compilation was asked for and there is no C++ compiler.
    """
    code = network.latent_avg.shape[-1]
    if tuple(w_plus.shape) != (1, N_CODES, code):
        raise InputError(f"style codes have shape {list(w_plus.shape)}; expected [1, {N_CODES}, {code}]")
    if dtype not in PRECISIONS:
        raise InputError(f"precision {dtype} is not offered; expected torch.float32 or torch.bfloat16")
    if compiled and not any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "clang++")):
        raise BackendError("compiling the network needs a C++ compiler and none was found", "leave it uncompiled")
    with torch.no_grad():
        return ClipNetwork(network, w_plus, dtype=dtype, levels=levels, edit=edit, compiled=compiled)


class ClipNetwork(nn.Module):
    """Frames in, stylised frames out; made by ``compile_clip``."""

    scale: int
    """Output pixels per input pixel."""

    def __init__(
        self,
        network: StyleGANEX,
        w_plus: Tensor,
        *,
        dtype: torch.dtype,
        levels: int,
        edit: Tensor | None,
        compiled: bool,
    ) -> None:
        super().__init__()
        self.scale, self.dtype, self.channels = scale_of(levels), dtype, network.variant.input_channels
        codes = (w_plus if edit is None else w_plus + edit).unbind(1)
        encoder, decoder = network.encoder, network.decoder
        self.features = FoldedFeatures(encoder)
        self.stem = fold_styled(decoder.conv1, codes[0])
        self.stem_rgb = fold_to_rgb(decoder.to_rgb1, codes[1])
        self.levels = nn.ModuleList()
        for level in range(levels):
            first = 1 + 2 * level
            fusion = None
            if level < network.variant.n_fusion:
                vector = None if edit is None else edit[:, first]
                fusion = FoldedFusion(cast("Fusion", encoder.fusion[level]), vector)
            first_conv = fold_styled(cast("StyledConv", decoder.convs[2 * level]), codes[first])
            second_conv = fold_styled(cast("StyledConv", decoder.convs[2 * level + 1]), codes[first + 1])
            rgb = decoder.to_rgbs[level]
            self.levels.append(FoldedLevel(fusion, first_conv, second_conv, cast("ToRGB", rgb), codes[first + 2]))
        self.to(dtype).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.eval().requires_grad_(False)
        self._step = torch.compile(self._run, dynamic=False, options={"freezing": True}) if compiled else self._run

    @torch.inference_mode()
    def forward(self, x1: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 3 h2 w2"]:
        """Stylised frames, float32, from about -1 to 1 and not clamped.

        Args:
            x1: frames in -1..1, sides multiples of 8; a batch gives what single frames give, up to rounding.
        """
        check_image(x1, self.channels)
        return self._step(x1.to(self.dtype, memory_format=torch.channels_last)).float()

    def _run(self, x: Tensor) -> Tensor:
        feature, skips = self.features(x)
        out = self.stem(feature)
        rgb = self.stem_rgb(out)
        for index, level in enumerate(self.levels):
            out, rgb = level(out, rgb, skips[index] if index < len(skips) else None)
        return rgb
