"""What a training builds on: a StyleGANEX whose generator draws photographs of faces, and what is made of it."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from toonifygb.assets import manifest, store
from toonifygb.assets.convert import StoredTensor, read_checkpoint
from toonifygb.errors import AssetError, InputError
from toonifygb.stylize.styleganex import weights
from toonifygb.stylize.styleganex.fusion import Fusion
from toonifygb.stylize.styleganex.network import StyleGANEX
from toonifygb.stylize.styleganex.variants import MAX_FUSION, N_CODES

if TYPE_CHECKING:
    from jaxtyping import Float

    from toonifygb.stylize.styleganex.generator import Generator
    from toonifygb.stylize.styleganex.layers import Noise

CHECKPOINTS = (".pt", ".pth")
LEVELS = {256: 6, 512: 7, 1024: 8}
"""Levels of the generator by the side of the picture they give."""
SIZES = tuple(4 * 2**index for index in range(8))
"""Sides of StyleGAN2's maps at which two generators can be joined: 4 px is the stem, 8 level 0, and so on."""
_NEED = "use styleganex-inversion (toonifygb assets get styleganex-inversion)"


@dataclass(frozen=True)
class Foundation:
    """The network a training starts from."""

    network: StyleGANEX
    discriminator: dict[str, Tensor] | None
    """State dict of the discriminator stored beside it; None where there is none."""
    sha256: str
    """Of the file."""


def open_foundation(base: str, folder: Path) -> Foundation:
    """The base network.

    Args:
        base: a converted file (``.safetensors``), a checkpoint of the authors (``.pt``), or the name of an asset
            that was added.
        folder: where a converted checkpoint is kept.

    Raises:
        InputError: no such file or asset.
        AssetError: the file is damaged, or its generator cannot draw faces from random codes.
    """
    path = Path(base)
    if not path.suffix and base in manifest.manifest():
        path = store.model_path(base)
    if not path.is_file():
        raise InputError(f"base network {base} does not exist; expected a file or the name of an asset", _NEED)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    discriminator = None
    source = path
    if path.suffix.lower() in CHECKPOINTS:
        source = folder / f"base-{digest[:12]}.safetensors"
        if not source.is_file():
            weights.convert_checkpoint(path, source)
        discriminator = _stored_discriminator(path)
    network = weights.load(source)
    _check(network, path)
    return Foundation(network, discriminator, digest)


def _stored_discriminator(path: Path) -> dict[str, Tensor] | None:
    """The discriminator of an authors' checkpoint."""
    state = read_checkpoint(path).values.get("discriminator")
    if not isinstance(state, dict) or not all(isinstance(value, StoredTensor) for value in state.values()):
        return None
    return {str(key): torch.from_numpy(value.array().copy()) for key, value in state.items()}


def _check(network: StyleGANEX, path: Path) -> None:
    variant = network.variant
    if variant.input_channels != 3:
        raise AssetError(
            f"{path} reads {variant.input_channels} channels; a style needs a base that reads RGB", _NEED
        )
    if variant.n_fusion == MAX_FUSION and not variant.attention:
        raise AssetError(
            f"{path} is a toonify network, whose generator draws that style's faces; expected photographic ones",
            _NEED,
        )
    decoder = network.decoder
    if not all(
        bool(tensor.any()) for tensor in (*decoder.style.parameters(), decoder.input.input) if tensor.ndim > 1
    ):
        raise AssetError(f"{path} lacks the layers that draw faces from random codes (decoder.style, input)", _NEED)


def codes_of(
    decoder: Generator, z: Float[Tensor, "n c"], average: Float[Tensor, "18 c"], truncation: float = 1.0
) -> Float[Tensor, "n 18 c"]:
    """Style codes of random points, drawn towards the average by what is missing of ``truncation`` to 1."""
    codes = decoder.style(z)[:, None].expand(-1, N_CODES, -1)
    return codes if truncation == 1 else average + truncation * (codes - average)


def draw(
    decoder: Generator, codes: Float[Tensor, "n 18 c"], *, levels: int, noise: Noise = "zero"
) -> Float[Tensor, "n 3 s s"]:
    """The generator's pictures of style codes alone, from about -1 to 1."""
    return decoder(decoder.start(len(codes)), codes, _unfused, noise=noise, levels=levels)


def _unfused(level: int, out: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
    return out, rgb


def swapped(base: Generator, taught: Generator, kind: str, size: int) -> Generator:
    """A generator whose coarse layers are those of one network and whose fine layers those of another.

    Args:
        base: the base's generator.
        taught: the generator transferred to the pictures.
        kind: ``none`` takes all of ``taught``; ``shape`` its layers up to ``size``; ``texture`` those beyond.
        size: nominal side of the last coarse level, px; one of ``SIZES``.
    """
    result = copy.deepcopy(taught)
    if kind == "none":
        return result
    ours, theirs = result.state_dict(), base.state_dict()
    from_base = [key for key in ours if (_nominal_size(key) > size) == (kind == "shape")]
    result.load_state_dict(ours | {key: theirs[key] for key in from_base})
    return result


def _nominal_size(key: str) -> int:
    """Side in StyleGAN2 of the map a decoder's tensor belongs to, px; 4 for what comes before the levels."""
    part, _, rest = key.partition(".")
    if part == "convs":
        return 8 * 2 ** (int(rest.split(".")[0]) // 2)
    return 8 * 2 ** int(rest.split(".")[0]) if part == "to_rgbs" else 4


def student(base: StyleGANEX, decoder: Generator, seed: int) -> StyleGANEX:
    """The network that is to learn the style: the base's encoder, the style's generator, new fusion layers.

    The fusion layers begin by handing on what the generator gives them, so the network begins as the base's
    inversion does, with the style's generator.
    """
    variant = dataclasses.replace(base.variant, n_fusion=MAX_FUSION, fuse_rgb=True, attention=0)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        fusion = nn.ModuleList([Fusion(level, variant) for level in range(MAX_FUSION)])
    for layer in fusion:
        _pass_through(cast("Fusion", layer))
    encoder = {key: value for key, value in base.encoder.state_dict().items() if not key.startswith("fusion.")}
    state = {f"encoder.{key}": value.clone() for key, value in encoder.items()}
    state |= {f"encoder.fusion.{key}": value for key, value in fusion.state_dict().items()}
    state |= {f"decoder.{key}": value.clone() for key, value in decoder.state_dict().items()}
    return weights.assembled(variant, state, base.latent_avg, None, Path("the new network"))


def _pass_through(layer: Fusion) -> None:
    for conv in (layer.fusion_out, layer.fusion_skip):
        nn.init.zeros_(conv.weight)
        nn.init.zeros_(cast("Tensor", conv.bias))
        channels = range(conv.out_channels)
        with torch.no_grad():
            conv.weight[channels, channels, 1, 1] = 1.0
