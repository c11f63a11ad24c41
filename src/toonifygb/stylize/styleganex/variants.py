"""Which StyleGANEX a checkpoint is: the published configurations, and how to tell them apart by their tensors."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from toonifygb.errors import AssetError

if TYPE_CHECKING:
    from collections.abc import Mapping

N_CODES = 18
"""Style codes of w+ that a 1024 px StyleGAN2 reads."""
STYLE_WIDTH = 512
"""Length of one style code in the published networks."""
MAX_FUSION = 7
LABEL_BLOCKS = 2
"""Residual blocks of the label input layer in the published networks."""


@dataclass(frozen=True)
class Variant:
    """Everything that decides the shapes and the arithmetic of a network."""

    input_channels: int = 3
    """3 for RGB; 1 (sketch) and 19 (parsing map) enter through a small network of their own."""
    n_fusion: int = MAX_FUSION
    """Levels of the decoder that mix in a skip feature, 0..7."""
    fuse_rgb: bool = True
    """Whether fusion corrects the RGB image, too, and not the features alone."""
    attention: int = 0
    """Hidden layers of the map from editing vector to attention; 0 for none."""
    label_blocks: int = LABEL_BLOCKS
    max_pooling: bool = False
    """Whether style heads take the largest value of a map instead of its mean."""
    width: int = 1
    """All channel counts are divided by this: 1 as published, more for small networks of the same code."""

    def channels(self, published: int) -> int:
        """Channel count of this network where the published ones have ``published``."""
        return max(published // self.width, 1)

    @property
    def name(self) -> str:
        """Name in ``PUBLISHED``, or ``custom``."""
        return next((name for name, variant in PUBLISHED.items() if variant == self), "custom")


PUBLISHED: dict[str, Variant] = {
    "toonify": Variant(),
    "toonify_notorgb": Variant(fuse_rgb=False),
    "edit": Variant(attention=1),
    "inversion": Variant(n_fusion=0),
    "sketch2face": Variant(input_channels=1, n_fusion=1),
    "mask2face": Variant(input_channels=19, n_fusion=2),
    "sr32": Variant(n_fusion=4),
    "sr": Variant(n_fusion=2),
}
"""The published networks. The training commands suggest ``toonify_notorgb`` for the toonify files, the code's own
defaults ``toonify``; ``infer_variant`` reads the truth off a file.
"""

_FUSION = re.compile(r"encoder\.fusion\.(\d+)\.fusion_out\.weight")
_HIDDEN = re.compile(r"encoder\.fusion\.0\.linear\.\d+\.weight")
_BLOCK = re.compile(r"encoder\.input_label_layer\.model\.\d+\.conv_block\.0\.weight")
_STEM = "decoder.conv1.conv.weight"
_LABELS = "encoder.input_label_layer.model.0.weight"


def infer_variant(shapes: Mapping[str, tuple[int, ...]], *, max_pooling: bool = False) -> Variant:
    """The variant whose network these tensors belong to.

    Args:
        shapes: shape of every tensor by its state-dict key.
        max_pooling: the one property that leaves no trace in the tensors.

    Raises:
        AssetError: the tensors are not those of a StyleGANEX.
    """
    stem = shapes.get(_STEM)
    if stem is None or len(stem) != 5 or not 0 < stem[1] <= STYLE_WIDTH or STYLE_WIDTH % stem[1]:
        found = "absent" if stem is None else f"of shape {list(stem)}"
        raise AssetError(
            f"these tensors are no StyleGANEX network: {_STEM} is {found}; expected [1, 512, 512, 3, 3]",
            "give one of the styleganex_*.pt files of the authors",
        )
    n_fusion = sum(bool(_FUSION.fullmatch(key)) for key in shapes)
    if n_fusion > MAX_FUSION:
        raise AssetError(f"these tensors have {n_fusion} fusion layers; a StyleGANEX has at most {MAX_FUSION}")
    labels = shapes.get(_LABELS)
    return Variant(
        input_channels=labels[1] if labels and len(labels) == 4 else 3,
        n_fusion=n_fusion,
        fuse_rgb=n_fusion == 0 or "encoder.fusion.0.fusion_skip.weight" in shapes,
        attention=max(sum(bool(_HIDDEN.fullmatch(key)) for key in shapes) - 1, 0),
        label_blocks=sum(bool(_BLOCK.fullmatch(key)) for key in shapes) if labels else LABEL_BLOCKS,
        max_pooling=max_pooling,
        width=STYLE_WIDTH // stem[1],
    )
