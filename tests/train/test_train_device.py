"""Rendering, training, posing and scoring on a GPU: nothing may be left on the processor, or meet it by accident.

The GPU is pretended (``pretend_gpu``), compositing and kernels are the reference's, so results must be the same.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pretend_gpu
import pytest
import torch
from make import TINY, tiny_avatar, tiny_head, tiny_sequence
from pretend_gpu import DEVICE, OnDevice, PretendGpu

from toonifygb import render
from toonifygb.avatar import Poser
from toonifygb.avatar.fields import FIELDS
from toonifygb.render import RenderInfo, cuda, reference
from toonifygb.render.fused import ReferenceKernels
from toonifygb.structures import Camera, Splats, TrackedSequence
from toonifygb.train import Dataset, build_dataset, evaluate, train
from toonifygb.train.densify import Densifier, DensifyRules
from toonifygb.train.optim import LEARNED
from toonifygb.train.photometric import _above_chin, carried
from toonifygb.train.state import TrainState
from toonifygb.train.step import Stepper

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from torch import Tensor

    from toonifygb.config import Blendshapes


class TorchCompositing(cuda.CudaRenderer):
    """The CUDA renderer with everything but its kernels."""

    def _composite(
        self, view: cuda.View, projected: reference.Projected, background: Tensor
    ) -> tuple[Tensor, Tensor]:
        image = reference._composite(projected, view.camera, view.constants)
        color = image[..., :3] + image[..., 3:] * background
        return cuda._watched(color, projected.centres, view), 1 - image[..., 3]


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The backend ``cuda`` on the pretended device."""
    monkeypatch.setattr(cuda, "unavailable", lambda name="cuda": None)
    monkeypatch.setattr(cuda, "device", lambda: DEVICE)
    get, kernels = render.get, render.kernels
    monkeypatch.setattr(
        render,
        "get",
        lambda name="auto", threads=None: TorchCompositing() if name == "cuda" else get(name, threads),
    )
    monkeypatch.setattr(
        render,
        "kernels",
        lambda name="auto", threads=None: ReferenceKernels(DEVICE) if name == "cuda" else kernels(name, threads),
    )
    monkeypatch.setattr(torch, "tensor", pretend_gpu.tensor)
    with PretendGpu():
        yield


@pytest.fixture
def clip(tmp_path: Path) -> tuple[Dataset, TrackedSequence]:
    """A few renders of a random avatar."""
    sequence, truth = tiny_sequence(6, 48), tiny_avatar(n=200, seed=7)
    renderer = reference.ReferenceRenderer()

    def pairs():
        with torch.no_grad():
            for index in range(sequence.n_frames):
                image = renderer.render(truth.pose(sequence.motion[index]), sequence.camera)
                yield (
                    (image.color.clamp(0, 1) * 255).round().to(torch.uint8).numpy(),
                    image.alpha.clamp(0, 1).numpy(),
                )

    return build_dataset(pairs(), sequence, tiny_head(), replace(TINY, resolution=32), tmp_path / "clip"), sequence


def scene() -> tuple[Splats, Camera]:
    """A posed avatar."""
    sequence = tiny_sequence(4, 32)
    return tiny_avatar(n=120).pose(sequence.motion[1]).detach(), sequence.camera


@pytest.mark.parametrize("home", ["cpu", DEVICE])
@pytest.mark.usefixtures("gpu")
def test_images_come_back_to_the_splats(home: torch.device | str) -> None:
    splats, camera = scene()
    results = []
    for name, place in (("reference", "cpu"), ("cuda", home)):
        leaf = splats.means.to(place).detach().requires_grad_()
        info = RenderInfo()
        shown = render.get(name).render(
            replace(splats.to(place), means=leaf), camera, background=torch.tensor([0.1, 0.2, 0.3]), info=info
        )
        (pull,) = torch.autograd.grad(shown.color.square().sum() + shown.alpha.sum(), leaf)
        found = (shown.color, shown.alpha, pull, info.radii, info.mean2d_gradient)
        assert all(isinstance(tensor, OnDevice) == (place == DEVICE) for tensor in found)
        results.append([tensor.detach().cpu() for tensor in found])
    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("blendshapes", ["full", "reduced"])
@pytest.mark.usefixtures("gpu")
def test_training_is_the_same_there(
    clip: tuple[Dataset, TrackedSequence], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blendshapes: Blendshapes
) -> None:
    dataset, sequence = clip
    monkeypatch.setattr("toonifygb.train.loop.Densifier", _eager_densifier)
    config = replace(TINY, n_gaussians=60, n_mouth_gaussians=12, resolution=32, steps=5, densify=True)
    config = replace(config, checkpoint_seconds=0.0, blendshapes=blendshapes)  # a checkpoint after every step
    trained = []
    for name in ("reference", "cuda"):
        trained.append(train(dataset, sequence, tiny_head(), config, tmp_path / name, backend=name))
    plain, moved = trained
    assert moved.n != config.n_gaussians + config.n_mouth_gaussians, "densification was not reached"
    for part in ("neutral", "deltas", "mouth_upper", "mouth_lower"):
        for field in FIELDS:
            found, expected = (getattr(getattr(avatar, part), field) for avatar in (moved, plain))
            assert not isinstance(found, OnDevice) and found.shape == expected.shape
            torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
    for field in LEARNED if blendshapes == "reduced" else ():
        found, expected = (getattr(avatar.mixer, field) for avatar in (moved, plain))
        assert not isinstance(found, OnDevice)
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)


def _eager_densifier(*arguments) -> Densifier:
    """One that makes new generations in so short a training."""
    rules = DensifyRules(first=0.1, last=0.9, every=3, face_threshold=1e-6, mouth_threshold=1e-6)
    return Densifier(*arguments, rules)


@pytest.mark.usefixtures("gpu")
def test_posing_and_scoring(clip: tuple[Dataset, TrackedSequence]) -> None:
    dataset, sequence = clip
    avatar = tiny_avatar(n=100)
    posed = [Poser(avatar, backend=name)(sequence.motion[2]) for name in ("reference", "cuda")]
    for field in ("means", "quats", "scales", "opacities", "sh", "sh_frames"):
        plain, moved = (getattr(splats, field) for splats in posed)
        assert isinstance(moved, OnDevice) and torch.equal(moved.cpu(), plain)
    scores = [evaluate(avatar, dataset, sequence, [1, 2], backend=name)["psnr"] for name in ("reference", "cuda")]
    assert scores[0] == pytest.approx(scores[1], abs=1e-3)


@pytest.mark.usefixtures("gpu")
def test_what_refining_the_track_looks_at_is_on_the_processor(clip: tuple[Dataset, TrackedSequence]) -> None:
    dataset, sequence = clip
    state = TrainState.start(tiny_avatar(n=100), 0).to(DEVICE)
    stepper = Stepper(
        state, tiny_avatar(n=100), dataset, sequence, TINY, render.get("cuda"), render.kernels("cuda")
    )
    stepper.step()
    splats, rigid = stepper.splats(1), _above_chin(state, sequence, tiny_head())
    turned = carried(splats, torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.01]), sequence.motion.translation[1], rigid)
    assert not isinstance(turned.means, OnDevice) and turned.means.isfinite().all()
