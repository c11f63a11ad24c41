"""Every setting of the pipeline: one frozen dataclass per stage, three qualities, JSON in and out.

One dial, ``quality``, sets the number of Gaussians, the steps and the resolution; everything else derives from it
and can be overridden. This module imports no torch, so ``toonifygb --help`` stays instant. The attribute
docstrings are the texts of ``--help``.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from toonifygb.errors import InputError

Quality = Literal["draft", "standard", "paper"]
TrackOn = Literal["auto", "original", "stylized"]
Storage = Literal["compact", "full"]
Blendshapes = Literal["full", "reduced"]
Framing = Literal["auto", "full", "crop", "published", "aligned"]


@dataclass(frozen=True)
class StylizeConfig:
    """Stage 1: how each frame is stylised."""

    style: str = "toon"
    """toon, paint, ink or none; a style with weights of its own (arcane, cartoon, pixar, age, hair); or a file: a
    model, .onnx or .ts, or a style that was trained, .safetensors."""
    strength: float = 1.0
    """Blend between the original (0) and the full style (1)."""


@dataclass(frozen=True)
class StyleganexConfig:
    """The styles that run StyleGANEX: arcane, cartoon, pixar, age, hair, and those that were trained."""

    framing: Framing = "auto"
    """What goes through the network: full (the whole frame), crop (the surroundings of the face, blended into the
    frame), auto (full unless the face is so small in the frame that it would take several GB), published (the crop
    of the authors' procedure), or aligned (the upright face alone, frame by frame: the paper's comparison)."""
    codes: Literal["best", "first", "each"] = "best"
    """Frame whose face the style codes are read from: best (frontal, sharp, eyes open), first, or each (only with
    aligned framing)."""
    size: Literal["source", "super"] = "source"
    """source: frames of the clip's size; super: the network's own, larger output, which stage 1 alone can write."""
    own_colors: float = 1.0
    """Codes of colour and texture: this face's own (1), the style's average (0), or between."""
    source_color: float = 0.0
    """How much of the source's broad colours is put back, 0..1."""
    calm: bool = True
    """Take sensor noise out of the source first, which keeps the result from boiling."""
    rounding: Literal["nearest", "truncate"] = "nearest"
    """How the network's colours become bytes; truncate is the authors' and darkens by half a level."""
    edit: float = 1.0
    """How far the styles age and hair go; below 0 they go the other way."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """bfloat16 is about twice as fast on processors that multiply in it, and differs by half a level on average."""
    levels: int | None = None
    """Generator levels run: 8 for an output of 4 times the input's size, 7 for twice, 6 for the same; fewer are
    faster and softer. All that the style was trained with when unset: 8 in published ones."""
    device: str = "auto"
    """Where the network runs: cpu, cuda, or auto (cuda where there is one)."""


PUBLISHED_STYLEGANEX = StyleganexConfig(
    framing="published", codes="first", size="super", calm=False, rounding="truncate"
)
"""The authors' video procedure, for comparison."""


@dataclass(frozen=True)
class FaceConfig:
    """Finding and following one person's face."""

    choose: str = "largest"
    """Which face to follow where several are visible: largest, left, right, centre, or a number counted from
    the left in the first frame that shows a face."""
    min_score: float = 0.5
    """Least face presence 0..1 that counts as found."""
    max_lost_share: float = 0.5
    """Largest share of frames without a face before the clip is refused."""


@dataclass(frozen=True)
class TrackConfig:
    """Fitting the head model to the landmarks of a clip."""

    on: TrackOn = "auto"
    """Video whose landmarks are fitted: original, stylized, or auto (the one whose landmarks are steadier)."""
    n_shape: int = 92
    """Identity coefficients fitted."""
    iterations: int = 25
    """Levenberg-Marquardt iterations at most."""
    photometric: bool = True
    """Fit the head's pose in every frame to the pixels as well, after the landmarks."""


@dataclass(frozen=True)
class TrainConfig:
    """Stage 2: training the Gaussian blendshapes."""

    n_gaussians: int = 16_000
    """Gaussians on the head surface."""
    n_mouth_gaussians: int = 2_000
    """Gaussians of the mouth interior, both sets together."""
    resolution: int = 256
    """Side of the square head crop that is trained on, px."""
    steps: int = 3_000
    """Optimiser steps, one frame each."""
    coarse_share: float = 0.0
    """Share of the steps, the first ones, that compare at half the resolution, where that is even."""
    delta_frames: int = 8
    """Steps to every step of the blendshapes' changes, which are most of the numbers and move slowly."""
    dropout: float = 0.2
    """Share of the Gaussians, chosen at random, that every step does without; it keeps poses beyond the clip's
    clean."""
    sh_degree: int = 1
    """Degree of the view-dependent colour, reached step by step."""
    blendshapes: Blendshapes = "full"
    """full: Gaussians have a change of their own for every blendshape of the head model; reduced: a few learned
    bases for all of them, weighed by a small network."""
    n_bases: int | None = None
    """Learned bases of reduced blendshapes, 20 when unset; expression units kept of full ones, all when unset."""
    crop_scale: float = 2.2
    """Side of the head crop in units of the face box."""
    l1_weight: float = 0.8
    """Weight of the mean absolute colour difference."""
    dssim_weight: float = 0.2
    """Weight of 1 - SSIM."""
    alpha_weight: float = 10.0
    """Weight of the squared difference between rendered opacity and head matte."""
    mouth_weight: float = 100.0
    """Weight of the mouth Gaussians' squared distance outside the mouth volume."""
    densify: bool = False
    """Clone and split Gaussians where the image asks for more, and remove transparent ones."""
    loss: Literal["3dgb", "seed"] = "3dgb"
    """3dgb: the weights above; seed: the paper's printed variant (0.2 L1 + 0.8 D-SSIM, one mean over both
    mouth sets)."""
    storage: Storage = "compact"
    """How the avatar is written: compact (a tenth of the room, for less than 0.1 dB) or full (single precision)."""
    checkpoint_seconds: float = 30.0
    """Time between checkpoints."""
    test_share: float = 0.15
    """Share of the clip held out from training."""
    test_parts: int = 1
    """Where that is: the end of the clip (1, which is 3DGB's), or the ends of so many equal parts of it, which says
    less of poses that were never filmed and more of all others."""
    max_test_frames: int = 350
    """Most frames held out."""
    seed: int = 0
    """Seed of every random choice."""

    def __post_init__(self) -> None:
        """Refuses what no training can do.

        Raises:
            InputError: a share of Gaussians to leave out that leaves none, or no part to hold out.
        """
        if not 0 <= self.dropout < 1:
            raise InputError(f"setting train.dropout is {self.dropout}; expected 0 or more, and less than 1")
        if self.test_parts < 1:
            raise InputError(f"setting train.test_parts is {self.test_parts}; expected 1 or more")


@dataclass(frozen=True)
class StyleTrainConfig:
    """Teaching StyleGANEX a style of one's own: first a generator from pictures, then an encoder from pairs."""

    resolution: Literal[256, 512, 1024] = 1024
    """Side of the pictures that are learnt from, px; frames stylised with fewer than 8 levels need no more."""
    aligned: bool = False
    """The pictures are squares aligned like FFHQ's already: take them as they are, without looking for faces."""
    mirror: bool = True
    """Learn from every picture's mirror image, too."""
    generator_steps: int = 3_000
    """Steps of the first stage, the transfer of the generator to the pictures."""
    generator_batch: int = 4
    """Pictures a step of the first stage."""
    generator_rate: float = 0.002
    """Learning rate of the generator and the discriminator in the first stage."""
    r1_weight: float = 10.0
    """Weight of the discriminator's squared gradient at real pictures in the first stage."""
    path_weight: float = 0.0
    """Weight of path-length regularisation, 2 in StyleGAN2; off because it ties the generator to its old faces."""
    mixing: float = 0.9
    """Share of the first stage's images drawn from two codes, one for the coarse layers, one for the fine ones."""
    ada_target: float = 0.6
    """Adaptive augmentation keeps the mean sign of the discriminator's answers to real pictures at this."""
    ada_images: int = 100_000
    """Real pictures shown while the probability of augmentations goes from 0 to 1 at the most."""
    ema_images: int = 10_000
    """Real pictures over which the averaged generator forgets half, at the most; at first it is quicker."""
    swap: Literal["none", "shape", "texture"] = "none"
    """What comes from the pictures: none (nothing is swapped: everything does), shape (their layers up to
    swap_size, the base's colours and skin beyond), or texture (the base's faces up to swap_size, their colours and
    strokes beyond)."""
    swap_size: int = 32
    """Nominal size of the last swapped layers, px: 4, 8, 16, ... 512."""
    encoder_steps: int = 55_000
    """Steps of the second stage, the encoder and fusion layers."""
    encoder_batch: int = 2
    """Pairs a step of the second stage."""
    encoder_rate: float = 0.0001
    """Learning rate of the encoder and the discriminator in the second stage."""
    truncation: float = 1.0
    """Codes of the pairs: as drawn (1), the average face (0), or between."""
    l2_weight: float = 1.0
    """Weight of the mean squared colour difference."""
    perceptual_weight: float = 0.8
    """Weight of the perceptual distance: LPIPS where its weights are given, else of discriminator features."""
    adversarial_weight: float = 0.1
    """Weight of the discriminator's opinion in the second stage."""
    encoder_r1_weight: float = 1.0
    """Weight of the discriminator's squared gradient in the second stage."""
    flicker_weight: float = 30.0
    """Weight of the difference between a moved input's output and the moved output; grows from 0 in the second
    half of the second stage."""
    lpips: Path | None = None
    """Weights of LPIPS on AlexNet: torch.save(lpips.LPIPS(net="alex").state_dict(), FILE) writes them."""
    checkpoint_seconds: float = 600.0
    """Time between checkpoints, which take up to 5 GB beside the style."""
    preview_steps: int = 250
    """Steps between two pictures of what has been learnt."""
    seed: int = 0
    """Seed of every random choice."""
    device: str = "auto"
    """Where it runs: cpu, cuda, or auto (cuda where there is one)."""


STYLE_TRAIN = StyleTrainConfig()


@dataclass(frozen=True)
class RunConfig:
    """A whole run from clip to avatar."""

    head: str = "open"
    """Head model: open, or one that you added, flame or flame2023 (toonifygb assets add flame)."""
    quality: Quality = "standard"
    """draft: minutes; standard: a coffee; paper: the published regime."""
    stylize: StylizeConfig = field(default_factory=StylizeConfig)
    styleganex: StyleganexConfig = field(default_factory=StyleganexConfig)
    face: FaceConfig = field(default_factory=FaceConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    max_frames: int | None = None
    """Use only the first frames of the clip."""
    backend: str = "auto"
    """Rasteriser: auto, cuda, gsplat, native or reference."""
    threads: int | None = None
    """Threads of the native engine; all cores when unset."""


WHOLE_PICTURE = 100.0
"""A ``crop_scale`` with which the largest square of the picture is taken, whatever the face's size."""
DRAFT = TrainConfig()
STANDARD = TrainConfig(
    n_gaussians=32_000,
    n_mouth_gaussians=4_000,
    resolution=512,
    steps=6_000,
    coarse_share=0.5,
    dropout=0.3,
    l1_weight=0.6,
    dssim_weight=0.4,
)
PAPER = TrainConfig(
    n_gaussians=50_000,
    n_mouth_gaussians=14_000,
    resolution=512,
    steps=40_000,
    sh_degree=3,
    coarse_share=0.5,
    dropout=0.3,
    l1_weight=0.6,
    dssim_weight=0.4,
)
PRESETS: dict[Quality, TrainConfig] = {"draft": DRAFT, "standard": STANDARD, "paper": PAPER}


def to_json(config: Any) -> str:
    """Deterministic JSON text of a config dataclass."""
    return json.dumps(dataclasses.asdict(config), indent=1, sort_keys=True)


def for_quality(quality: Quality) -> RunConfig:
    """Settings of a whole run at one quality."""
    return RunConfig(quality=quality, train=PRESETS[quality])


def override(config: RunConfig, assignment: str) -> RunConfig:
    """Config with one setting changed, for instance ``train.steps=500``.

    Args:
        config: settings to start from.
        assignment: dotted name, ``=``, and the value as JSON or as a bare word.

    Raises:
        InputError: no such setting (the nearest name is offered), or a value of the wrong kind.
    """
    name, separator, text = assignment.partition("=")
    names = _setting_names(config)
    if not separator or name not in names:
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
        raise InputError(
            f"setting '{assignment}' is not of the form NAME=VALUE with a known name", f"nearest: {near[0]}"
        )
    stage, _, key = name.rpartition(".")
    owner = getattr(config, stage) if stage else config
    value = _parse(text, get_type_hints(type(owner))[key], name)
    changed = dataclasses.replace(owner, **{key: value})
    return dataclasses.replace(config, **{stage: changed}) if stage else changed


def _setting_names(config: RunConfig) -> list[str]:
    names = []
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if dataclasses.is_dataclass(value):
            names += [f"{entry.name}.{inner.name}" for inner in dataclasses.fields(value)]
        else:
            names.append(entry.name)
    return names


def _parse(text: str, kind: Any, name: str) -> Any:
    """Value of ``kind`` written as ``text``."""
    try:
        value = json.loads(text)
    except ValueError:
        value = text
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        if value in choices:
            return value
        raise InputError(f"setting {name} is '{text}'; expected one of {', '.join(map(str, choices))}")
    kinds = tuple(k for k in (get_args(kind) or (kind,)))
    if float in kinds and type(value) is int:
        return float(value)
    if type(value) in kinds:
        return value
    expected = " or ".join("null" if k is type(None) else k.__name__ for k in kinds)
    raise InputError(f"setting {name} is '{text}'; expected {expected}")


def from_json(text: str) -> RunConfig:
    """Settings from the text that ``to_json`` made.

    Raises:
        InputError: an unknown setting or a value of the wrong kind.
    """
    data = json.loads(text)
    config = RunConfig()
    for key, value in data.items():
        if isinstance(value, dict):
            for inner, leaf in value.items():
                config = override(config, f"{key}.{inner}={json.dumps(leaf)}")
        else:
            config = override(config, f"{key}={json.dumps(value)}")
    return config
