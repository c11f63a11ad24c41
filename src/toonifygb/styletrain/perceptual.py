"""How different two pictures look: a distance of what networks see in them rather than of their colours.

StyleGANEX was trained with LPIPS, whose weights nobody may be made to download. Where the user has them, ``Lpips``
reads them; else ``FeatureDistance`` compares the features of the first stage's discriminator, which has learnt what
makes up the style. Both are the same formula on other features.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from toonifygb.assets.convert import StoredTensor, read_checkpoint
from toonifygb.errors import AssetError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jaxtyping import Float

    from toonifygb.styletrain.discriminator import Discriminator

    Images = Float[Tensor, "n 3 s s"]

LPIPS_SIZE = 256
"""Side at which LPIPS compares pictures, px."""
EPSILON = 1e-10
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and deviation of ImageNet's colours in -1..1."""
_CONVS = ((0, 3, 64, 11, 4, 2), (3, 64, 192, 5, 1, 2), (6, 192, 384, 3, 1, 1), (8, 384, 256, 3, 1, 1))
_CONVS += ((10, 256, 256, 3, 1, 1),)
"""AlexNet's convolutions: number in its list of layers, channels in and out, side, stride, padding."""
_POOLED_BEFORE = (1, 2)
"""Convolutions with a maximum over 3x3 of stride 2 before them."""
_WRITE = 'write it with torch.save(lpips.LPIPS(net="alex").state_dict(), FILE)'


class Perceptual(Protocol):
    """A distance of pictures."""

    description: str
    """What it is, for the log."""

    def __call__(self, one: Images, two: Images) -> Tensor:
        """The mean distance, 0 for equal pictures; both in -1..1."""
        ...


def feature_distance(
    one: Sequence[Tensor], two: Sequence[Tensor], weights: Sequence[Float[Tensor, " c"]] | None = None
) -> Tensor:
    """Σ over maps of the mean over px of Σ_c weight_c·(â_c - b̂_c)², â and b̂ of unit length (LPIPS, Eq. 1).

    Args:
        one: feature maps ``n c h w`` of the first pictures.
        two: those of the second.
        weights: by map and channel; 1 when unset.
    """
    total = one[0].new_zeros(())
    for index, (a, b) in enumerate(zip(one, two, strict=True)):
        difference = (_unit(a) - _unit(b)).square()
        if weights is not None:
            difference = difference * weights[index][:, None, None]
        total = total + difference.sum(1).mean()
    return total


def _unit(features: Tensor) -> Tensor:
    # The root's gradient at 0 is infinite; ε² under it leaves the values as they are.
    length = (features.square().sum(1, keepdim=True) + EPSILON**2).sqrt()
    return features / (length + EPSILON)


class FeatureDistance:
    """Distance of a discriminator's features.

    Args:
        discriminator: of the first stage; is not trained through this.
    """

    description = "features of the first stage's discriminator (no LPIPS weights were given)"

    def __init__(self, discriminator: Discriminator) -> None:
        self._discriminator = discriminator.requires_grad_(False)

    def __call__(self, one: Images, two: Images) -> Tensor:
        """The distance, a mean over maps."""
        maps_one, maps_two = self._discriminator.features(one), self._discriminator.features(two)
        return feature_distance(maps_one, maps_two) / len(maps_one)


class Lpips(nn.Module):
    """LPIPS 0.1 (Zhang et al. 2018) on AlexNet, with weights from a file."""

    description = "LPIPS (AlexNet) from the given file"

    def __init__(self) -> None:
        super().__init__()
        self.convs = nn.ModuleList([nn.Conv2d(i, o, k, s, p) for _, i, o, k, s, p in _CONVS])
        self.weights = nn.ParameterList([nn.Parameter(torch.zeros(o)) for _, _, o, *_ in _CONVS])
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None])
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None])
        self.requires_grad_(False)

    @classmethod
    def read(cls, path: Path) -> Lpips:
        """The distance with the weights of a file, ``.safetensors`` or as of torch.

        Raises:
            AssetError: the file is absent, damaged, or holds other weights.
        """
        tensors = _tensors(path)
        network = cls()
        state = network.state_dict()
        for index, (number, *_) in enumerate(_CONVS):
            names = {
                f"convs.{index}.weight": f"net.slice{index + 1}.{number}.weight",
                f"convs.{index}.bias": f"net.slice{index + 1}.{number}.bias",
                f"weights.{index}": f"lin{index}.model.1.weight",
            }
            for ours, theirs in names.items():
                found = tensors.get(theirs)
                if found is None or found.numel() != state[ours].numel():
                    raise AssetError(f"{path} holds no weights of LPIPS on AlexNet: {theirs} is missing", _WRITE)
                state[ours] = found.reshape(state[ours].shape)
        network.load_state_dict(state)
        return network

    def features(self, images: Images) -> list[Tensor]:
        """The five maps that are compared."""
        x = (images - self.get_buffer("shift")) / self.get_buffer("scale")
        maps = []
        for index, conv in enumerate(self.convs):
            if index in _POOLED_BEFORE:
                x = F.max_pool2d(x, 3, 2)
            x = torch.relu(conv(x))
            maps.append(x)
        return maps

    def forward(self, one: Images, two: Images) -> Tensor:
        """The distance of the pictures at ``LPIPS_SIZE``."""
        maps_one, maps_two = (self.features(F.adaptive_avg_pool2d(images, LPIPS_SIZE)) for images in (one, two))
        return feature_distance(maps_one, maps_two, list(self.weights))


def _tensors(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        try:
            return load_file(path)
        except (SafetensorError, OSError) as error:
            raise AssetError(f"{path} cannot be read ({error})", _WRITE) from error
    values = read_checkpoint(path).values
    return {
        key: torch.from_numpy(value.array().copy())
        for key, value in values.items()
        if isinstance(value, StoredTensor)
    }
