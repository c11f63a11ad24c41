"""The fast step against a plain one, resuming, and learning on a tiny synthetic clip."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from make import TINY, tiny_avatar, tiny_head, tiny_sequence

from toonifygb import render
from toonifygb.avatar import Avatar, MouthVolume
from toonifygb.avatar.bases import Mixer
from toonifygb.avatar.fields import FIELDS, join
from toonifygb.avatar.skinning import activate, scale_deltas
from toonifygb.errors import InputError
from toonifygb.progress import Stopped
from toonifygb.structures import Camera, GaussianParams, Rendering, Splats, TrackedSequence
from toonifygb.train import Dataset, build_dataset, evaluate, first_avatar, train
from toonifygb.train.densify import DensifyRules
from toonifygb.train.losses import LossWeights, image_loss, mouth_gradients, mouth_loss
from toonifygb.train.optim import (
    BASIS_EPS,
    DELTA_EPS,
    DELTA_RATES,
    DRIVER_TRAVEL,
    FULL_STEPS,
    LEARNED,
    MIXER_EPS,
    MIXER_RATE,
    NEUTRAL_RATES,
    NEUTRAL_TRAVEL,
    means_decay,
    mixer_gradient,
    settling,
)
from toonifygb.train.state import Seen, TrainState, read_checkpoint, write_checkpoint
from toonifygb.train.step import Stepper

if TYPE_CHECKING:
    from pathlib import Path

    from toonifygb.config import TrainConfig

REDUCED = replace(TINY, blendshapes="reduced", n_bases=4)
SLOW = replace(TINY, delta_frames=4, coarse_share=0.3)
REDUCED_SLOW = replace(REDUCED, delta_frames=4)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, TrackedSequence]:
    """Renders of a random avatar on the tiny head, cut into a training set."""
    sequence, truth = tiny_sequence(20, 64), tiny_avatar(n=400, seed=7)
    truth = replace(truth, neutral=replace(truth.neutral, opacity_logits=truth.neutral.opacity_logits + 2))
    renderer = render.get("auto", 1)

    def pairs():
        with torch.no_grad():
            for index in range(sequence.n_frames):
                image = renderer.render(truth.pose(sequence.motion[index]), sequence.camera)
                color = image.color / image.alpha.clamp_min(1e-3)[..., None]
                yield (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy(), image.alpha.clamp(0, 1).numpy()

    folder = tmp_path_factory.mktemp("clip")
    return build_dataset(pairs(), sequence, tiny_head(), TINY, folder), sequence


def same(a: Avatar, b: Avatar) -> bool:
    names = ("neutral", "deltas", "mouth_upper", "mouth_lower")
    records = [(getattr(a, n), getattr(b, n), FIELDS) for n in names]
    assert (a.mixer is None) == (b.mixer is None)
    records += [] if a.mixer is None else [(a.mixer, b.mixer, LEARNED)]
    return all(torch.equal(getattr(left, f), getattr(right, f)) for left, right, parts in records for f in parts)


class PlainTraining:
    """The training written with autograd, ``Avatar.pose`` and ``torch.optim.Adam``."""

    def __init__(self, template: Avatar, config: TrainConfig) -> None:
        self.frames = delta_frames = config.delta_frames
        self.dropout = config.dropout
        self.state = TrainState.start(template, TINY.seed)
        self.template = template
        self.scale = torch.ones(len(template.deltas.means), self.state.counts.face)
        self.scale[: template.n_bases] = 0.0
        self.scale[: template.n_bases, : self.state.counts.moved] = self.state.scale
        sets = [template.neutral, template.mouth_upper, template.mouth_lower]
        self.sets = [part.map(lambda t: t.clone().requires_grad_()) for part in sets]
        self.parts = [slice(0, template.n_bases), slice(template.n_bases, None)]
        self.trained = [
            template.deltas.map(lambda t, rows=rows: torch.zeros_like(t[rows]).requires_grad_())
            for rows in self.parts
        ]
        self.groups, self.delta_groups = [], []
        for name in FIELDS:
            key = "sh_dc" if name == "sh" else name
            faster = FULL_STEPS / TINY.steps if name in {"means", "opacity_logits"} else 1
            farther = NEUTRAL_TRAVEL if name == "means" else 1  # a training of few steps
            rate = NEUTRAL_RATES[key] * farther
            self.add([getattr(part, name) for part in self.sets], rate, name != "means", 1e-15)
            own, driver = (getattr(part, name) for part in self.trained)
            own_eps, rate = DELTA_EPS if template.mixer is None else BASIS_EPS, DELTA_RATES[key] * faster
            for tensor, lr, eps in (
                (own, rate, own_eps),
                (driver, DRIVER_TRAVEL[key] / TINY.steps, DELTA_EPS),
            ):
                self.delta_groups.append({"params": [tensor], "lr": delta_frames * lr, "settles": True, "eps": eps})
        self.mixer = None if template.mixer is None else template.mixer.map(lambda t: t.clone().requires_grad_())
        if self.mixer is not None:
            self.add([getattr(self.mixer, name) for name in LEARNED], MIXER_RATE, True, MIXER_EPS)
        self.adam = torch.optim.Adam([dict(group) for group in self.groups])
        self.delta_adam = torch.optim.Adam([dict(group) for group in self.delta_groups])
        self.volume = MouthVolume.around(join([template.mouth_upper, template.mouth_lower]).means)

    def add(self, tensors: list[torch.Tensor], rate: float, settles: bool, eps: float) -> None:
        self.groups.append({"params": tensors, "lr": rate, "settles": settles, "eps": eps})

    def deltas(self) -> GaussianParams:
        fixed, trained = self.template.deltas, join(self.trained)
        return GaussianParams(**{name: getattr(fixed, name) + getattr(trained, name) for name in FIELDS})

    def damped_step(self) -> None:
        """Adam's step of the deltas, which take the share of it that blendshape consistency allows."""
        before = [part.map(lambda t: t.detach().clone()) for part in self.trained]
        self.delta_adam.step()
        self.delta_adam.zero_grad()
        with torch.no_grad():
            for part, old, rows in zip(self.trained, before, self.parts, strict=True):
                change = GaussianParams(**{name: getattr(part, name) - getattr(old, name) for name in FIELDS})
                damped = scale_deltas(change, self.scale[rows])
                for name in FIELDS:
                    getattr(part, name).copy_(getattr(old, name) + getattr(damped, name))

    def step(self, dataset: Dataset, sequence: TrackedSequence) -> None:
        index = self.state.next_frame(dataset.split.train)
        background = self.state.next_background()
        self.state.step += 1
        neutral, upper, lower = self.sets
        sets = {"neutral": neutral, "mouth_upper": upper, "mouth_lower": lower, "deltas": self.deltas()}
        avatar = replace(self.template, **sets, mixer=self.mixer)
        splats = avatar.pose(sequence.motion[index])
        if self.dropout:
            drawn = torch.rand(splats.means.shape[0], generator=self.state.generator)
            lit = torch.where(drawn < self.dropout, 0.0, splats.opacities / (1 - self.dropout))
            splats = replace(splats, opacities=lit)
        image = render.get("auto", 1).render(splats, dataset.camera(index), background=background, sh_degree=0)
        weights = LossWeights.of(TINY)
        color, matte = dataset.target(index)
        loss = image_loss(image, color + (1 - matte)[..., None] * background, matte, weights)
        loss = loss + mouth_loss(upper.means, lower.means, self.volume, weights)
        self.adam.zero_grad()
        loss.backward()
        share = self.state.step / TINY.steps
        for adam, groups in ((self.adam, self.groups), (self.delta_adam, self.delta_groups)):
            for group, first in zip(adam.param_groups, groups, strict=True):
                group["lr"] = first["lr"] * (settling(share) if group["settles"] else means_decay(share))
        self.adam.step()
        if self.state.step % self.frames == 0:  # until then the gradients of the deltas add up
            self.damped_step()


class DegreeZero(Stepper):
    """A stepper whose view-dependent colour never grows: then only the DC coefficients have gradients."""

    sh_degree = 0  # type: ignore[assignment]


@pytest.mark.parametrize(
    "config",
    [TINY, replace(TINY, delta_frames=2), replace(TINY, dropout=0.0), REDUCED],
    ids=["full", "two frames", "nothing left out", "reduced"],
)
def test_fast_step_equals_the_plain_one(clip: tuple[Dataset, TrackedSequence], config: TrainConfig) -> None:
    """Two steps of the deltas, every parameter."""
    dataset, sequence = clip
    template = first_avatar(dataset, sequence, tiny_head(), config)
    # Round Gaussians have no gradient for their rotation, and unturned ones none for w, but rounding noise, of
    # which Adam keeps the sign.
    stretched = template.neutral.log_scales + torch.tensor([0.4, 0.0, -0.4])
    turned = template.neutral.quats + torch.tensor([0.3, 0.5, -0.4, 0.2])
    template = replace(template, neutral=replace(template.neutral, log_scales=stretched, quats=turned))
    state, plain = TrainState.start(template, TINY.seed), PlainTraining(template, config)
    first = join([template.neutral, template.mouth_upper, template.mouth_lower])
    backends = render.get("auto", 1), render.kernels("auto", 1)
    stepper = DegreeZero(state, template, dataset, sequence, config, *backends)
    for _ in range(2 * config.delta_frames):
        stepper.step()
        plain.step(dataset, sequence)
    n_face, n_expression = state.counts.face, template.n_bases
    wanted, applied = join(plain.sets), plain.deltas()
    groups = {
        "neutral": (state.neutral.values, wanted, first, n_face),
        "driver": (
            state.driver.values,
            applied.map(lambda t: t[n_expression:]),
            template.deltas.map(lambda t: t[n_expression:]),
            None,
        ),
        "expression": (
            state.expression.values,
            applied.map(lambda t: t[:n_expression, : state.counts.moved]),
            template.deltas.map(lambda t: t[:n_expression, : state.counts.moved]),
            None,
        ),
    }
    for group, (ours, theirs, start, n) in groups.items():
        for name in FIELDS:
            origin = getattr(start, name)[:n]
            moved, expected = ((getattr(p, name)[:n] - origin).detach() for p in (ours, theirs))
            # A step is ± the rate, so where the gradient is nearly 0 float32 may choose the other sign.
            wrong = ((moved - expected).abs() > 0.02 * expected.abs().max()).float().mean()
            assert wrong < 0.02, (group, name, float(wrong))
            assert (expected != 0).any(), (group, name)
    if state.mixer is None or plain.mixer is None:
        assert config is not REDUCED
        return
    for name in LEARNED:
        mixers = (template.mixer, state.mixer.values, plain.mixer)
        origin, ours, theirs = (getattr(mixer, name).detach() for mixer in mixers)
        # Adam's first steps are ± the rate: where a gradient is nearly 0, float32 may choose the other sign.
        wrong = ((ours - theirs).abs() > 0.05 * MIXER_RATE).float().mean()
        assert wrong < 0.05, (name, float(wrong))
        assert not torch.equal(origin, ours), name


def test_slope_of_the_network_equals_autograd() -> None:
    """Random weights, coefficients and slopes, in double precision."""
    generator = torch.Generator().manual_seed(2)
    sizes = {"scale": (6,), "linear": (4, 5), "hidden": (8, 6), "bias": (8,), "out": (4, 8)}
    values = {
        name: torch.rand(size, generator=generator, dtype=torch.float64) + 0.1 for name, size in sizes.items()
    }
    psi, by_weight = torch.randn(2, 9, generator=generator, dtype=torch.float64)
    by_weight = by_weight[:4]
    mixer = Mixer(**{name: value.requires_grad_(name in LEARNED) for name, value in values.items()})
    wanted = torch.autograd.grad(mixer(psi), [getattr(mixer, name) for name in LEARNED], by_weight)
    found = mixer_gradient(mixer.detach(), psi, by_weight)
    assert tuple(found) == LEARNED
    for (name, slope), expected in zip(found.items(), wanted, strict=True):
        assert torch.allclose(slope, expected), name


@pytest.mark.parametrize(
    ("grow", "base"), [(False, TINY), (True, TINY), (True, REDUCED), (True, SLOW), (False, REDUCED_SLOW)]
)
def test_resumed_training_equals_a_straight_one(
    clip: tuple[Dataset, TrackedSequence],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    grow: bool,
    base: TrainConfig,
) -> None:
    dataset, sequence = clip
    # A new generation every three steps, one of them between the checkpoint and its resumption.
    eager = DensifyRules(first=0.1, last=0.9, every=3, face_threshold=1e-5, mouth_threshold=1e-5)
    monkeypatch.setattr("toonifygb.train.densify.DensifyRules", lambda: eager)
    config = replace(base, steps=20, densify=grow)

    class StopAt:
        def __init__(self, step: int) -> None:
            self.step = step

        def update(self, done: int, total: int | None, **figures: float) -> None:
            if done == self.step:
                raise Stopped

    def run(folder: Path, stop: int | None = None) -> Avatar | None:
        progress = StopAt(stop or -1)
        return train(dataset, sequence, tiny_head(), config, folder, threads=2, progress=progress)

    straight = run(tmp_path / "straight")
    assert straight is not None
    assert (straight.neutral.n > TINY.n_gaussians) == grow
    for stop in (1, 10):
        with pytest.raises(Stopped):
            run(tmp_path / "paused", stop)
    paused = run(tmp_path / "paused")
    assert paused is not None
    assert same(straight, paused)
    finished_again = run(tmp_path / "paused")
    assert finished_again is not None and same(straight, finished_again)


def test_first_steps_look_at_half_the_resolution(clip: tuple[Dataset, TrackedSequence]) -> None:
    dataset, sequence = clip
    config = replace(TINY, steps=4, coarse_share=0.5)
    template, sizes = first_avatar(dataset, sequence, tiny_head(), config), []

    class Watched(type(render.get("auto", 1))):
        def render(self, splats: Splats, camera: Camera, **options: Any) -> Rendering:
            sizes.append((camera.width, camera.height))
            return super().render(splats, camera, **options)

    state = TrainState.start(template, 0)
    stepper = Stepper(state, template, dataset, sequence, config, Watched(), render.kernels("auto", 1))
    for _ in range(config.steps):
        stepper.step()
    full = dataset.size
    assert sizes == [(full // 2, full // 2)] * 2 + [(full, full)] * 2


@pytest.mark.parametrize("joint", [False, True])
def test_slopes_of_the_mouth_equal_autograd(joint: bool) -> None:
    points = (0.02 * torch.randn(60, 3, dtype=torch.float64)).requires_grad_()
    volume = MouthVolume(torch.tensor([0.001, 0.002, -0.003]).double(), 0.02, 0.015)
    weights = LossWeights(0.8, 0.2, 10.0, 100.0, joint_mouth_mean=joint)
    loss = mouth_loss(points[:25], points[25:], volume, weights)
    (wanted,) = torch.autograd.grad(loss, points)
    found, slopes = mouth_gradients(points.detach(), 25, volume, weights)
    assert found == pytest.approx(loss.item())
    torch.testing.assert_close(slopes, wanted)
    outside = (wanted != 0).any(-1)
    assert 0 < outside.sum() < len(points)


def test_checkpoint_round_trip_and_damage(clip: tuple[Dataset, TrackedSequence], tmp_path: Path) -> None:
    dataset, sequence = clip
    state = TrainState.start(first_avatar(dataset, sequence, tiny_head(), TINY), 5)
    state.next_frame(dataset.split.train)
    gradient = state.neutral.values.map(lambda tensor: tensor[: state.counts.face])
    psi = torch.rand(48)
    state.seen = [
        Seen(psi[:40], psi[40:], gradient)
    ] * 2  # one frame at the end of an epoch and at the next one's start
    path = tmp_path / "checkpoint.safetensors"
    write_checkpoint(state, path, {"fingerprint": "x"}, {"more": torch.arange(3)})
    again, facts, beside = read_checkpoint(path)
    assert facts["fingerprint"] == "x"
    assert list(beside) == ["more"] and torch.equal(beside["more"], torch.arange(3))
    assert len(again.seen) == 2
    for frame in again.seen:
        assert torch.equal(frame.expression, psi[:40]) and torch.equal(frame.driver, psi[40:])
        assert torch.equal(frame.gradient.sh, gradient.sh)
    frames = [[s.next_frame(dataset.split.train) for _ in range(40)] for s in (state, again)]
    assert frames[0] == frames[1]
    assert torch.equal(state.expression.values.sh, again.expression.values.sh)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="damaged"):
        read_checkpoint(path)


def test_another_training_does_not_continue_a_checkpoint(
    clip: tuple[Dataset, TrackedSequence], tmp_path: Path
) -> None:
    dataset, sequence = clip
    short = replace(TINY, steps=3)
    train(dataset, sequence, tiny_head(), short, tmp_path)
    other = train(dataset, sequence, tiny_head(), replace(short, seed=1), tmp_path)
    fresh = train(dataset, sequence, tiny_head(), replace(short, seed=1), tmp_path / "fresh")
    assert same(other, fresh)


def test_every_epoch_takes_each_frame_once(clip: tuple[Dataset, TrackedSequence]) -> None:
    dataset, sequence = clip
    state = TrainState.start(first_avatar(dataset, sequence, tiny_head(), TINY), 0)
    frames = dataset.split.train
    epochs = [[state.next_frame(frames) for _ in frames] for _ in range(3)]
    assert all(sorted(epoch) == sorted(frames) for epoch in epochs)
    assert epochs[0] != epochs[1]


def test_a_share_is_left_out_and_the_others_stand_in(clip: tuple[Dataset, TrackedSequence]) -> None:
    """Other Gaussians every step; who is left out neither shows nor learns colour in it."""
    dataset, sequence = clip
    config = replace(TINY, dropout=0.3, steps=1)
    template = first_avatar(dataset, sequence, tiny_head(), config)
    state = TrainState.start(template, 0)
    drawn = torch.stack([kept for _ in range(200) if (kept := state.next_kept(0.3)) is not None])
    assert len(drawn) == 200 and drawn.unique().tolist() == pytest.approx([0.0, 1 / 0.7])
    assert abs(drawn.mean() - 1) < 0.01 and drawn.mean(0).std() < 0.06
    assert state.next_kept(0.0) is None

    ahead = TrainState.start(template, 0)
    ahead.next_frame(dataset.split.train)
    ahead.next_background()
    kept = ahead.next_kept(0.3)
    assert kept is not None
    before = TrainState.start(template, 0).neutral.values.sh.clone()
    state = TrainState.start(template, 0)
    Stepper(state, template, dataset, sequence, config, render.get("auto", 1), render.kernels("auto", 1)).step()
    learnt = (state.neutral.values.sh != before).any(-1).any(-1)
    assert not learnt[kept == 0].any()
    assert learnt[kept > 0].any()


@pytest.mark.parametrize("config", [TINY, REDUCED], ids=["full", "reduced"])
def test_training_learns(clip: tuple[Dataset, TrackedSequence], tmp_path: Path, config: TrainConfig) -> None:
    """The loss falls and the score on frames never trained on rises by several decibels."""
    dataset, sequence = clip
    before = first_avatar(dataset, sequence, tiny_head(), config)
    after = train(dataset, sequence, tiny_head(), replace(config, steps=250), tmp_path)
    scores = [evaluate(a, dataset, sequence, dataset.split.test) for a in (before, after)]
    assert scores[1]["psnr"] > scores[0]["psnr"] + 4
    assert scores[1]["ssim"] > scores[0]["ssim"] + 0.05
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [50, 100, 150, 200, 250]
    assert lines[-1]["loss"] < 0.5 * lines[0]["loss"]


def test_scores_are_jsonable_and_complete(clip: tuple[Dataset, TrackedSequence]) -> None:
    dataset, sequence = clip
    avatar = first_avatar(dataset, sequence, tiny_head(), TINY)
    scores = json.loads(json.dumps(evaluate(avatar, dataset, sequence, dataset.split.test)))
    assert scores["lpips"] is None
    assert scores["frames"] == list(dataset.split.test)
    assert len(scores["psnr_per_frame"]) == len(dataset.split.test)
    assert abs(np.mean(scores["psnr_per_frame"]) - scores["psnr"]) < 1e-3
    assert abs(scores["psnr_per_channel"] - scores["psnr"]) < 1
    assert activate(avatar.neutral).opacities.max() < 0.2
