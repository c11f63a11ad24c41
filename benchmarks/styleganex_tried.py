"""What was tried to make StyleGANEX's convolutions cheaper on a processor, and left out: Winograd's and int8.

Both stand in for ``folded.FixedConv`` in a network of full width with seeded weights that stops at its input's
size. ``docs/decisions/033`` says what came out. Runs only when named.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.harness import Figure
from benchmarks.styleganex import decibels, seeded_network, smooth_image
from toonifygb.stylize.styleganex.fast import compile_clip
from toonifygb.stylize.styleganex.folded import FixedConv
from toonifygb.threads import one_torch_thread

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, UInt8


SIDE, LEVELS, REPEATS = 352, 6, 3
OUT, TAPS = 4, 3
IN = OUT + TAPS - 1
"""Sides of Winograd's tiles: of the outputs, of the kernel, and of the inputs."""
POINTS = (0.0, 0.75, -0.75, 1.5, -1.5)
"""Where his polynomials are evaluated, besides infinity. Rounding is half of that at 0, ±1, ±2."""
BLOCK = 1 << 22
"""Transformed values held at a time: 16 MB, about a cache of the third level."""
MIN_PAIRS, MIN_CHANNELS = 256 * 512, 32
"""Least input times output channels for Winograd, least channels on a side for int8."""

LARGEST = 63
"""Of int8 kernels: without VNNI, sums of two products are cut off at 16 bits, and 127 would get there."""


@dataclass(frozen=True)
class Attempt:
    """A stand-in and where it may stand."""

    name: str
    make: Callable[[FixedConv], nn.Module]
    suits: Callable[[str, FixedConv], bool]


def run() -> list[Figure]:
    """Seconds of one core per frame beside the network as it is, and dB between the two."""
    with one_torch_thread():
        return measured()


def measured() -> list[Figure]:
    """All figures."""
    network = seeded_network()
    rng = torch.Generator().manual_seed(1)
    with torch.inference_mode():
        w_plus, frame = network.codes(smooth_image(256, rng)), smooth_image(SIDE, rng)
        figures = []
        for attempt in attempts():
            plain, other = (compile_clip(network, w_plus, levels=LEVELS) for _ in range(2))
            replace_convolutions(other, attempt)
            before, after = timed(plain, frame), timed(other, frame)
            figures += [
                Figure(attempt.name, after.seconds, "s", baseline=before.seconds),
                Figure(f"{attempt.name}, against float32", decibels(after.image, before.image), "dB"),
            ]
    return figures


def attempts() -> list[Attempt]:
    """Winograd where there are many channels; int8 in all 3x3 convolutions, in the later levels, in the last."""

    def small(conv: FixedConv) -> bool:
        return conv.weight.shape[2:] == (TAPS, TAPS) and conv.groups == 1 and not conv.transposed

    def winograd(_: str, conv: FixedConv) -> bool:
        pairs = conv.weight.shape[0] * conv.weight.shape[1]
        return small(conv) and conv.stride == conv.dilation == 1 and pairs >= MIN_PAIRS

    def int8_from(level: int) -> Callable[[str, FixedConv], bool]:
        def suits(name: str, conv: FixedConv) -> bool:
            late = name.startswith("levels.") and int(name.split(".")[1]) >= level
            return small(conv) and min(conv.weight.shape[:2]) >= MIN_CHANNELS and (late or level == 0)

        return suits

    return [
        Attempt("Winograd", WinogradConv, winograd),
        Attempt("int8", Int8Conv, int8_from(0)),
        Attempt("int8 from the fourth level on", Int8Conv, int8_from(3)),
        Attempt("int8 from the sixth level on", Int8Conv, int8_from(5)),
    ]


def replace_convolutions(module: nn.Module, attempt: Attempt, path: str = "") -> None:
    """Puts the attempt's stand-in where it suits."""
    for name, child in module.named_children():
        if isinstance(child, FixedConv) and attempt.suits(path + name, child):
            setattr(module, name, attempt.make(child))
        else:
            replace_convolutions(child, attempt, f"{path}{name}.")


@dataclass(frozen=True)
class Timed:
    """The output for a frame and the processor time it took."""

    image: Tensor
    seconds: float


def timed(clip: Callable[[Tensor], Tensor], frame: Tensor) -> Timed:
    """The quickest of ``REPEATS`` runs."""
    runs = []
    for _ in range(REPEATS):
        start = time.process_time()
        image = clip(frame)
        runs.append(Timed(image, time.process_time() - start))
    return min(runs, key=lambda each: each.seconds)


def winograd_matrices() -> tuple[Float[Tensor, "4 6"], Float[Tensor, "6 3"], Float[Tensor, "6 6"]]:
    """Aᵀ, G and Bᵀ of Aᵀ[(GgGᵀ) ⊙ (BᵀdB)]A (Lavin & Gray 2016) by the construction of Cook and Toom, in float64.

    A product of polynomials follows from its values at the points; that map transposed is the correlation. Row i of
    Bᵀ is scaled by the denominator Π(a_i - a_j) of Lagrange's polynomial, and G's by its inverse.
    """
    points = torch.tensor(POINTS, dtype=torch.float64)

    def values(n_coefficients: int) -> Tensor:
        """Values of a polynomial at the points, and its leading coefficient for infinity, from its coefficients."""
        powers = points[:, None] ** torch.arange(n_coefficients)
        return torch.cat([powers, torch.eye(n_coefficients, dtype=torch.float64)[-1:]])

    distances = points[:, None] - points + torch.eye(len(points), dtype=torch.float64)
    scale = torch.cat([distances.prod(1), torch.ones(1, dtype=torch.float64)])[:, None]
    return values(OUT).T, values(TAPS) / scale, torch.linalg.inv(values(IN)).T * scale


class WinogradConv(nn.Module):
    """36 products per tile of 4x4 outputs in place of 144: over all channels, 36 matrix products."""

    def __init__(self, conv: FixedConv) -> None:
        super().__init__()
        from_products, of_kernel, of_input = winograd_matrices()
        spread = torch.einsum("ab,oibc,dc->adio", of_kernel, conv.weight.double(), of_kernel)
        self.kernel = spread.flatten(0, 1).float().contiguous()
        self.inwards = torch.kron(of_input, of_input).float()
        self.outwards = torch.kron(from_products, from_products).float()
        self.bias, self.slope, self.padding = conv.bias, conv.slope, conv.padding

    def forward(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h2 w2"]:
        """The activated map, in ``n h w c`` order in memory."""
        maps = torch.stack([self._one(image) for image in x.permute(0, 2, 3, 1)]).permute(0, 3, 1, 2)
        return maps if self.slope is None else F.leaky_relu_(maps, self.slope)

    def _one(self, image: Float[Tensor, "h w i"]) -> Float[Tensor, "h2 w2 o"]:
        """One map, a block of rows of tiles after the other."""
        n_in, n_out = self.kernel.shape[1:]
        height, width = (side + 2 * (self.padding - 1) for side in image.shape[:2])
        down, across = (-(-side // OUT) for side in (height, width))
        below, right = (
            OUT * n + 2 - self.padding - side for n, side in zip((down, across), image.shape, strict=False)
        )
        padded = F.pad(image, (0, 0, self.padding, right, self.padding, below)).contiguous()
        y, x, channel = padded.stride()
        result = image.new_empty(down, OUT, across, OUT, n_out)
        rows = max(1, BLOCK // (IN * IN * across * (n_in + n_out)))
        for first in range(0, down, rows):
            n_rows = min(rows, down - first)
            shape, strides = (IN, IN, n_rows, across, n_in), (y, x, OUT * y, OUT * x, channel)
            tiles = padded[OUT * first :].as_strided(shape, strides)
            spread = self.inwards @ tiles.reshape(IN * IN, -1)
            products = torch.bmm(spread.view(IN * IN, -1, n_in), self.kernel)
            outputs = (self.outwards @ products.view(IN * IN, -1)).view(OUT, OUT, n_rows, across, n_out)
            if self.bias is not None:
                outputs += self.bias
            result[first : first + n_rows] = outputs.permute(2, 0, 3, 1, 4)
        return result.view(down * OUT, across * OUT, n_out)[:height, :width]


class Int8Conv(nn.Module):
    """Kernels rounded once per output channel, maps per tensor as they come; float32 out."""

    def __init__(self, conv: FixedConv) -> None:
        super().__init__()
        self.bias, self.slope = conv.bias, conv.slope
        self.places = [conv.stride] * 2, [conv.padding] * 2, [conv.dilation] * 2, 1
        self.scale = conv.weight.abs().amax((1, 2, 3)) / LARGEST
        rounded = (conv.weight.contiguous() / self.scale[:, None, None, None]).round().to(torch.int8)
        self.zeros = torch.zeros(len(rounded), dtype=torch.int32)
        self.kernel = torch.ops.onednn.qconv_prepack(rounded, self.scale, 1.0, 128, *self.places, None)

    def forward(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h2 w2"]:
        """The activated map."""
        low, high = (float(end) for end in torch.aminmax(x))
        step = (max(high, 0.0) - min(low, 0.0)) / 255
        zero = round(-min(low, 0.0) / step)
        small: UInt8[Tensor, "n i h w"] = torch.quantize_per_tensor(x, step, zero, torch.quint8).int_repr()
        kernel = self.kernel, self.scale, self.zeros, self.bias
        y = torch.ops.onednn.qconv2d_pointwise(
            small, step, zero, *kernel, *self.places, 1.0, 0, torch.float32, "none", [], ""
        )
        return y if self.slope is None else F.leaky_relu_(y, self.slope)
