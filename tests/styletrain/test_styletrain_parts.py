"""The parts of a style's training, each against what it is defined by."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from styletrain_toy import SIDE, TOY, WIDTH, Watcher, make_base, shrink_networks, write_base, write_pictures

from toonifygb.config import StyleTrainConfig
from toonifygb.errors import AssetError, BackendError, InputError
from toonifygb.styletrain import foundation, train_style
from toonifygb.styletrain.augment import INTERVAL, MOST, Controller, augment, hue_and_saturation
from toonifygb.styletrain.discriminator import Discriminator
from toonifygb.styletrain.encode import EDGE, flicker_ramp, move, random_motion
from toonifygb.styletrain.foundation import student, swapped
from toonifygb.styletrain.perceptual import _CONVS, FeatureDistance, Lpips
from toonifygb.styletrain.ranger import LOOK_EVERY, LOOK_SHARE, Ranger
from toonifygb.styletrain.transfer import r1
from toonifygb.stylize.styleganex import PUBLISHED, weights


def test_augmentation_grows_while_the_pictures_are_known_by_heart() -> None:
    controller = Controller(0.6, 1000)
    for _ in range(3 * INTERVAL):
        controller.observe(torch.full((10,), 2.0))
    assert controller.p == pytest.approx(3 * INTERVAL * 10 / 1000)
    grown = controller.p
    for _ in range(INTERVAL):
        controller.observe(torch.tensor([1.0, 1.0, -1.0, -1.0]))
    assert controller.p == pytest.approx(grown - INTERVAL * 4 / 1000)
    for _ in range(100 * INTERVAL):
        controller.observe(torch.full((10,), -1.0))
    assert controller.p == 0
    for _ in range(100 * INTERVAL):
        controller.observe(torch.full((10,), 1.0))
    assert controller.p == MOST


def test_a_controller_goes_on_within_an_interval() -> None:
    one, two = Controller(0.6, 100), Controller(0.6, 100)
    answers = torch.randn(2 * INTERVAL - 1, 4)
    for batch in answers[:INTERVAL]:
        one.observe(batch)
    one.observe(answers[INTERVAL])
    two.restore(one.state())
    for batch in answers[INTERVAL + 1 :]:
        one.observe(batch)
        two.observe(batch)
    assert one.state() == two.state()


def test_augmentations_move_mirror_and_colour() -> None:
    images = torch.rand(64, 3, 16, 16, dtype=torch.float64) * 2 - 1
    assert augment(images, 0.0) is images
    changed = augment(images, 1.0)
    assert changed.shape == images.shape and not torch.equal(changed, images)
    touched = [not torch.equal(a, b) for a, b in zip(augment(images, 0.2), images, strict=True)]
    assert 0.3 < sum(touched) / 64 < 0.95
    # A grey ramp keeps its hue: whatever is done to it moves, mirrors and scales one profile.
    ramp = torch.linspace(-0.5, 0.5, 16, dtype=torch.float64).expand(8, 3, 16, 16)
    done = augment(ramp, 1.0)
    assert (done - done.mean(1, keepdim=True)).abs().max() < 1e-9
    assert (done[:, 0, :1] - done[:, 0]).abs().max() < 1e-9
    slopes = {round(float(s), 6) for s in done[:, 0, 0].diff(dim=1).sign().sum(1).sign()}
    assert slopes == {-1.0, 1.0}, "some are mirrored and some are not"


def test_gradients_pass_through_augmentations() -> None:
    images = torch.rand(1, 3, 8, 8, dtype=torch.float64, requires_grad=True)

    def fixed(x: torch.Tensor) -> torch.Tensor:
        torch.manual_seed(3)
        return augment(x, 1.0)

    assert torch.autograd.gradcheck(fixed, (images,))


def test_hue_turns_about_grey() -> None:
    angle = torch.tensor([0.0, 2 * math.pi / 3, 1.0], dtype=torch.float64)
    matrices = hue_and_saturation(angle, torch.ones(3, dtype=torch.float64))
    assert torch.allclose(matrices[0], torch.eye(3, dtype=torch.float64))
    assert torch.allclose(matrices[1].abs().amax(1), torch.ones(3, dtype=torch.float64)), (
        "120 degrees: RGB permuted"
    )
    assert torch.allclose(matrices @ matrices.mT, torch.eye(3, dtype=torch.float64).expand(3, 3, 3))
    grey = hue_and_saturation(angle[2:], torch.zeros(1, dtype=torch.float64))[0]
    assert torch.allclose(grey, torch.full((3, 3), 1 / 3, dtype=torch.float64))


def test_the_published_discriminator_has_the_published_size() -> None:
    with torch.device("meta"):
        state = Discriminator(1024).state_dict()
    assert sum(t.numel() for key, t in state.items() if not key.endswith("kernel")) == 29_012_513
    assert tuple(state["convs.8.conv2.1.weight"].shape) == (512, 512, 3, 3)
    assert tuple(state["final_conv.0.weight"].shape) == (512, 513, 3, 3)


def test_the_spread_of_a_batch_reaches_the_answer() -> None:
    """A discriminator that could not compare pictures would let a generator draw one face for ever."""
    network = Discriminator(16, WIDTH)
    one, other = torch.rand(2, 3, 16, 16)
    with torch.no_grad():
        alone, among = network(torch.stack([one, one])), network(torch.stack([one, other]))
    assert torch.allclose(alone[0], alone[1]) and not torch.allclose(alone[0], among[0])


def test_r1_is_the_squared_gradient() -> None:
    network = Discriminator(8, WIDTH).double()
    images = torch.rand(1, 3, 8, 8, dtype=torch.float64)
    slopes = torch.zeros(images.numel(), dtype=torch.float64)
    with torch.no_grad():
        for place in range(images.numel()):
            step = torch.zeros_like(slopes)
            step[place] = 1e-6
            ahead, behind = (network(images + sign * step.reshape(images.shape)).sum() for sign in (1, -1))
            slopes[place] = (ahead - behind) / 2e-6
    assert r1(network, images).item() == pytest.approx(slopes.square().sum().item(), rel=1e-4)


def test_ranger_is_centred_rectified_adam_that_looks_back() -> None:
    start, gradients = torch.randn(3, 4), torch.randn(2 * LOOK_EVERY + 1, 3, 4)
    ours, plain = torch.nn.Parameter(start.clone()), torch.nn.Parameter(start.clone())
    ranger = Ranger([ours], 0.01)
    adam = torch.optim.RAdam([plain], lr=0.01, betas=(0.95, 0.999), eps=1e-5)
    slow = start.clone()
    for index, gradient in enumerate(gradients, 1):
        ours.grad, plain.grad = gradient.clone(), gradient - gradient.mean(1, keepdim=True)
        ranger.step()
        adam.step()
        if index % LOOK_EVERY == 0:
            with torch.no_grad():
                slow += LOOK_SHARE * (plain - slow)
                plain.copy_(slow)
        assert torch.allclose(ours, plain, atol=1e-6), index


def test_the_flicker_term_grows_in_the_second_half() -> None:
    assert [flicker_ramp(step, 100) for step in (0, 50, 60, 75, 99)] == pytest.approx([0, 0, 0.4, 1, 1])


def test_moving_there_and_back_is_nothing() -> None:
    motion = random_motion(5).double()
    below = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(5, 1, 3)
    back = torch.linalg.inv(torch.cat((motion, below), 1))[:, :2]
    y, x = torch.meshgrid(*[torch.linspace(0, 3, 64, dtype=torch.float64)] * 2, indexing="ij")
    images = torch.stack((x.sin(), y.cos(), (x + y).sin())).expand(5, 3, 64, 64)
    there, known = move(images, motion)
    again, known_again = move(there, back)
    middle = slice(20, 44)
    assert (again - images)[:, :, middle, middle].abs().max() < 0.01
    assert (there - images)[:, :, middle, middle].abs().max() > 0.05
    assert known[:, 32, 32].all() and not known.all()
    still = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)[None]
    rim = math.ceil(EDGE * 32)
    assert move(images[:1], still)[1][0, rim:-rim, rim:-rim].all() and not known_again.all()


def test_layers_are_swapped_where_asked() -> None:
    base, taught = make_base(0).decoder, make_base(1).decoder
    ours, theirs = taught.state_dict(), base.state_dict()
    trained = [key for key in ours if key.endswith("weight") and not torch.equal(ours[key], theirs[key])]
    fine = {key for key in trained if key.startswith(("convs.8.", "convs.15.", "to_rgbs.4."))}
    coarse = {key for key in trained if key.startswith(("conv1.", "convs.7.", "to_rgbs.3.", "style."))}
    assert fine and coarse
    for kind, from_taught, from_base in (("shape", coarse, fine), ("texture", fine, coarse)):
        result = swapped(base, taught, kind, 64).state_dict()
        assert all(torch.equal(result[key], ours[key]) for key in from_taught), kind
        assert all(torch.equal(result[key], theirs[key]) for key in from_base), kind
    whole = swapped(base, taught, "none", 64).state_dict()
    assert all(torch.equal(whole[key], ours[key]) for key in ours)


def test_a_student_begins_as_the_bases_inversion() -> None:
    """New fusion layers hand on what they are given, so the first picture is the base's own."""
    base = make_base()
    network = student(base, base.decoder, 0)
    frame = torch.rand(1, 3, 32, 40) * 2 - 1
    with torch.no_grad():
        assert (network(frame) - base(frame)).abs().max() < 1e-5
    assert network.variant == dataclasses.replace(PUBLISHED["toonify"], width=WIDTH)


def test_feature_distances_are_distances() -> None:
    distance = FeatureDistance(Discriminator(32, 8))
    one, two = torch.rand(2, 2, 3, 32, 32)
    near = one + 0.1 * (two - one)
    assert float(distance(one, one)) == 0 < float(distance(one, near)) < float(distance(one, two))
    assert float(distance(one, two)) == pytest.approx(float(distance(two, one)))
    # Equal pictures have a gradient, too, and black ones.
    image = torch.zeros(1, 3, 32, 32, requires_grad=True)
    distance(image, image.detach()).backward()
    assert image.grad is not None and image.grad.isfinite().all()


def lpips_file(path: Path) -> dict[str, torch.Tensor]:
    """Random weights under the names of the lpips package."""
    state = {"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}
    for index, (number, n_in, n_out, side, *_) in enumerate(_CONVS):
        fan = math.sqrt(n_in * side * side)
        state[f"net.slice{index + 1}.{number}.weight"] = torch.randn(n_out, n_in, side, side) / fan
        state[f"net.slice{index + 1}.{number}.bias"] = 0.1 * torch.randn(n_out)
        state[f"lin{index}.model.1.weight"] = torch.rand(1, n_out, 1, 1)
    if path.suffix == ".safetensors":
        save_file(state, path)
    else:
        torch.save(state, path)
    return state


@pytest.mark.parametrize("name", ["lpips.pt", "lpips.safetensors"])
def test_lpips_is_its_formula(name: str, tmp_path: Path) -> None:
    state = lpips_file(tmp_path / name)
    one, two = torch.rand(2, 1, 3, 256, 256) * 2 - 1

    def maps(x: torch.Tensor) -> list[torch.Tensor]:
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = (x - shift[:, None, None]) / scale[:, None, None]
        found = []
        for index, (number, _, _, _, stride, padding) in enumerate(_CONVS):
            x = F.max_pool2d(x, 3, 2) if index in (1, 2) else x
            weight, bias = (state[f"net.slice{index + 1}.{number}.{part}"] for part in ("weight", "bias"))
            x = F.relu(F.conv2d(x, weight, bias, stride, padding))
            found.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return found

    expected = sum(
        (F.conv2d((a - b) ** 2, state[f"lin{index}.model.1.weight"])).mean()
        for index, (a, b) in enumerate(zip(maps(one), maps(two), strict=True))
    )
    assert float(Lpips.read(tmp_path / name)(one, two)) == pytest.approx(float(expected), rel=1e-5)


def test_other_weights_are_no_lpips(tmp_path: Path) -> None:
    torch.save({"classifier.weight": torch.ones(2)}, tmp_path / "alexnet.pt")
    with pytest.raises(AssetError, match=r"no weights of LPIPS on AlexNet: net.slice1.0.weight is missing"):
        Lpips.read(tmp_path / "alexnet.pt")


def authors_checkpoint(folder: Path, discriminator: object) -> Path:
    base = make_base()
    entries = {"state_dict": base.state_dict(), "opts": {"use_skip": False}, "latent_avg": base.latent_avg}
    torch.save(entries | {"discriminator": discriminator}, folder / "inversion.pt")
    return folder / "inversion.pt"


def test_a_checkpoint_of_the_authors_brings_its_discriminator(tmp_path: Path) -> None:
    stored = Discriminator(64, WIDTH).state_dict()
    path = authors_checkpoint(tmp_path, stored)
    found = foundation.open_foundation(str(path), tmp_path)
    assert found.discriminator is not None and found.discriminator.keys() == stored.keys()
    assert all(torch.equal(value, stored[key]) for key, value in found.discriminator.items())
    ours, theirs = found.network.state_dict(), make_base().state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
    assert foundation.open_foundation(str(authors_checkpoint(tmp_path, None)), tmp_path).discriminator is None


@pytest.mark.parametrize(
    ("stored", "sentence"),
    [
        (None, "the base holds no discriminator; a new one is trained"),
        (Discriminator(128, WIDTH).state_dict(), f"the base's discriminator is not one for {SIDE} px"),
        (Discriminator(SIDE, WIDTH).state_dict(), "the base's discriminator is trained on"),
    ],
)
def test_it_is_said_which_discriminator_is_used(
    stored: object, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shrink_networks(monkeypatch)
    watcher = Watcher("generator", 1, KeyboardInterrupt())
    base, pictures = authors_checkpoint(tmp_path, stored), write_pictures(tmp_path / "pictures")
    with pytest.raises(KeyboardInterrupt):
        train_style(pictures, str(base), tmp_path / "style.safetensors", TOY, watcher)
    assert any(note.startswith(sentence) for note in watcher.notes), watcher.notes


def test_bases_that_cannot_draw_faces_are_refused(tmp_path: Path) -> None:
    toon = student(make_base(), make_base().decoder, 0)
    weights.save(toon, tmp_path / "toon.safetensors")
    with pytest.raises(AssetError, match="is a toonify network"):
        foundation.open_foundation(str(tmp_path / "toon.safetensors"), tmp_path)
    bare = make_base()
    for parameter in bare.decoder.style.parameters():
        parameter.zero_()
    weights.save(bare, tmp_path / "bare.safetensors")
    with pytest.raises(AssetError, match=r"lacks the layers that draw faces .*decoder.style"):
        foundation.open_foundation(str(tmp_path / "bare.safetensors"), tmp_path)
    with pytest.raises(InputError, match="base network styleganex-inversoin does not exist"):
        foundation.open_foundation("styleganex-inversoin", tmp_path)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"generator_batch": 0}, "setting generator_batch is 0; expected 1 or more"),
        ({"preview_steps": 0}, "setting preview_steps is 0"),
        ({"resolution": 300}, "setting resolution is 300; expected one of 256, 512, 1024"),
        ({"swap_size": 33}, "setting swap_size is 33; expected one of 4, 8, 16"),
    ],
)
def test_settings_out_of_range_are_named(settings: dict, sentence: str, tmp_path: Path) -> None:
    config = dataclasses.replace(StyleTrainConfig(device="cpu"), **settings)
    with pytest.raises(InputError, match=sentence):
        train_style(tmp_path, str(write_base(tmp_path)), tmp_path / "style.safetensors", config, Watcher())
    assert not (tmp_path / "style.training").exists()


def test_an_unknown_device_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="device 'tpu9' cannot be used here"):
        train_style(tmp_path, "x", tmp_path / "style.safetensors", StyleTrainConfig(device="tpu9"), Watcher())
