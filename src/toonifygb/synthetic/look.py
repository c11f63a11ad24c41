"""What a synthetic subject looks like, in a handful of numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float32

Rgb = tuple[int, int, int]
HairStyle = Literal["short", "bob", "curly", "swept"]


@dataclass(frozen=True)
class Look:
    """Colours (sRGB 0..255) and proportions of one subject."""

    skin: Rgb
    lips: Rgb
    hair: Rgb
    iris: Rgb
    cloth: Rgb
    wall: Rgb
    """Colour of the room behind."""
    style: HairStyle
    shape_seed: int
    """Seed of the identity coefficients."""
    shape_spread: float = 0.55
    """Standard deviation of the identity coefficients; 1 is as varied as the head model's own sample."""
    shoulders: float = 0.205
    """Half the width of the shoulders, m."""
    brow_fullness: float = 1.0
    stubble: float = 0.0
    """0 clean-shaven .. 1 three days old."""
    freckles: float = 0.0
    lip_tint: float = 0.75
    """How strongly the lips take their colour, 0..1."""


LOOKS = (
    Look(
        skin=(224, 172, 145),
        lips=(190, 96, 92),
        hair=(92, 58, 36),
        iris=(82, 112, 96),
        cloth=(46, 84, 104),
        wall=(196, 186, 172),
        style="bob",
        shape_seed=10,
        shoulders=0.192,
        brow_fullness=0.85,
        freckles=0.35,
        lip_tint=0.85,
    ),
    Look(
        skin=(132, 86, 62),
        lips=(132, 70, 66),
        hair=(26, 20, 18),
        iris=(66, 40, 24),
        cloth=(214, 168, 72),
        wall=(150, 168, 176),
        style="curly",
        shape_seed=3,
        stubble=0.55,
        lip_tint=0.6,
    ),
    Look(
        skin=(236, 196, 174),
        lips=(196, 112, 106),
        hair=(182, 138, 84),
        iris=(84, 120, 156),
        cloth=(120, 54, 58),
        wall=(168, 174, 160),
        style="short",
        shape_seed=4,
        stubble=0.35,
        lip_tint=0.6,
    ),
    Look(
        skin=(212, 160, 124),
        lips=(176, 84, 80),
        hair=(34, 26, 26),
        iris=(74, 50, 34),
        cloth=(208, 204, 196),
        wall=(178, 164, 170),
        style="swept",
        shape_seed=6,
        shoulders=0.195,
        brow_fullness=0.95,
        lip_tint=0.85,
    ),
)
"""Four people; every further seed is one of them with other features and colours."""


def make_look(seed: int) -> Look:
    """The look of a seed: the four of ``LOOKS`` themselves, then variations of them."""
    look = LOOKS[seed % len(LOOKS)]
    if seed < len(LOOKS):
        return look
    rng = np.random.Generator(np.random.Philox(seed))

    def vary(color: Rgb, amount: float) -> Rgb:
        brightness = 1 + amount * rng.uniform(-1, 1)
        tint = 1 + 0.4 * amount * rng.uniform(-1, 1, 3)
        red, green, blue = np.clip(np.array(color) * brightness * tint, 8, 246).astype(int)
        return int(red), int(green), int(blue)

    return replace(
        look,
        skin=vary(look.skin, 0.10),
        lips=vary(look.lips, 0.10),
        hair=vary(look.hair, 0.35),
        iris=vary(look.iris, 0.30),
        cloth=vary(look.cloth, 0.40),
        wall=vary(look.wall, 0.12),
        shape_seed=seed,
        freckles=float(rng.uniform(0, 0.5)) * (rng.random() < 0.4),
    )


def linear(color: Rgb) -> Float32[np.ndarray, " 3"]:
    """Linear light 0..1 of an sRGB colour, with the exponent 2.2 that ``light.display`` undoes."""
    return (np.array(color, np.float32) / 255) ** 2.2
