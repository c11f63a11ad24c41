"""StyleGANEX at a sixteenth of its width: the same code, at a speed fit for tests."""

from __future__ import annotations

import dataclasses
import os
import shutil
from typing import TYPE_CHECKING

import pytest
import torch
from styleganex_weights import NARROW, make_network

from toonifygb.errors import AssetError, BackendError, InputError
from toonifygb.stylize.styleganex import PUBLISHED, StyleGANEX, Variant, infer_variant, layers
from toonifygb.stylize.styleganex.encoder import StyleHead
from toonifygb.stylize.styleganex.fast import compile_clip

if TYPE_CHECKING:
    from torch import Tensor

NARROW_VARIANTS = {name: dataclasses.replace(variant, width=NARROW) for name, variant in PUBLISHED.items()}
RELATIVE = 1e-4
"""Folding changes the order of float32 sums, no more."""


def picture(network: StyleGANEX, n: int = 1, height: int = 40, width: int = 56) -> Tensor:
    """Noise in -1..1 as the network wants it."""
    return torch.rand(n, network.variant.input_channels, height, width) * 2 - 1


@pytest.fixture(scope="module")
def toonify() -> StyleGANEX:
    """The network for most tests."""
    return make_network(NARROW_VARIANTS["toonify"])


@pytest.mark.parametrize("variant", NARROW_VARIANTS.values(), ids=NARROW_VARIANTS)
def test_the_clip_network_equals_the_plain_one(variant: Variant) -> None:
    network = make_network(variant)
    frames = picture(network, 2, 24, 40)
    with torch.no_grad():
        w_plus = network.codes(picture(network, 1, 64, 64))
        for levels, edit in ((8, None), (7, network.editing_w), (6, None)):
            plain = network(frames, w_plus, edit, levels=levels)
            fast = compile_clip(network, w_plus, levels=levels, edit=edit)
            assert plain.shape[2] == fast.scale * 24 == 24 * 2 ** (levels - 6)
            assert (fast(frames) - plain).abs().max() <= RELATIVE * plain.abs().max()
        half = compile_clip(network, w_plus, levels=levels, edit=edit, dtype=torch.bfloat16)(frames)
    assert half.dtype == torch.float32
    assert ((half - plain).square().mean() / plain.square().mean()).sqrt() < 0.03  # 8 bits, some 40 layers


@pytest.mark.parametrize("size", [(8, 8), (8, 40), (72, 24)])
def test_any_multiple_of_eight_is_a_size(toonify: StyleGANEX, size: tuple[int, int]) -> None:
    frame = picture(toonify, 1, *size)
    with torch.no_grad():
        w_plus = toonify.codes(picture(toonify, 1, 64, 64))
        plain = toonify(frame, w_plus)
        assert plain.shape == (1, 3, 4 * size[0], 4 * size[1])
        assert (compile_clip(toonify, w_plus)(frame) - plain).abs().max() <= RELATIVE * plain.abs().max()


@pytest.mark.parametrize("shape", [(1, 3, 44, 56), (1, 1, 40, 56), (3, 40, 56)])
def test_other_sizes_are_refused_in_a_sentence(toonify: StyleGANEX, shape: tuple[int, ...]) -> None:
    with torch.no_grad():
        clip = compile_clip(toonify, toonify.codes(picture(toonify)))
    for reader in (toonify.codes, toonify.features, clip):
        with pytest.raises(InputError, match="multiples of 8"):
            reader(torch.zeros(shape))


def test_what_a_clip_network_cannot_be_made_for(toonify: StyleGANEX) -> None:
    w_plus = toonify.latent_avg[None]
    with pytest.raises(InputError, match="shape"):
        compile_clip(toonify, w_plus.repeat(2, 1, 1))
    with pytest.raises(InputError, match="precision"):
        compile_clip(toonify, w_plus, dtype=torch.float16)
    with pytest.raises(InputError, match="levels"):
        compile_clip(toonify, w_plus, levels=5)


def test_frames_of_a_batch_do_not_see_each_other(toonify: StyleGANEX) -> None:
    frames, faces = picture(toonify, 3), picture(toonify, 3, 64, 64)
    with torch.no_grad():
        together = toonify(frames, faces)
        alone = torch.cat([toonify(frames[i : i + 1], faces[i : i + 1]) for i in range(3)])
        assert torch.allclose(together, alone, atol=1e-5)
        clip = compile_clip(toonify, toonify.codes(faces[:1]))
        assert torch.allclose(clip(frames), torch.cat([clip(frame[None]) for frame in frames]), atol=1e-5)


def test_codes_are_taken_from_the_frame_the_face_or_given(toonify: StyleGANEX) -> None:
    frame, face = picture(toonify), picture(toonify, 1, 64, 64)
    with torch.no_grad():
        assert torch.equal(toonify(frame), toonify(frame, frame))
        assert torch.equal(toonify(frame, face), toonify(frame, toonify.codes(face)))
        average = toonify.codes(face) - toonify.encoder.codes(face)
    assert torch.allclose(average[0], toonify.latent_avg, atol=1e-6)


def test_gradients_reach_every_part_that_makes_the_image() -> None:
    network = make_network(NARROW_VARIANTS["edit"])
    frame = picture(network).requires_grad_()
    network(frame, picture(network, 1, 64, 64), network.editing_w, noise="fixed").square().mean().backward()
    assert frame.grad is not None and frame.grad.abs().sum() > 0
    unused = ("decoder.style.", "decoder.input.", "encoder.skiplayer.")
    # What lies before a rectifier that happens to be shut gets none: attention, gates of a single hidden channel.
    shut = (".linear.", ".norm.", ".conv.", ".res_layer.5.")
    silent = [
        name
        for name, parameter in network.named_parameters()
        if not name.startswith(unused) and (parameter.grad is None or not parameter.grad.abs().sum() > 0)
    ]
    assert all(any(part in name for part in shut) for name in silent), silent
    assert not any(name.startswith("decoder.") for name in silent)


def test_noise_zero_is_none_fixed_repeats_and_random_does_not(toonify: StyleGANEX) -> None:
    frame = picture(toonify)
    with torch.no_grad():
        images = {mode: toonify(frame, noise=mode) for mode in ("zero", "fixed", "random")}
        assert torch.equal(toonify(frame, noise="fixed"), images["fixed"])
        assert not torch.equal(toonify(frame, noise="random"), images["random"])
        assert not torch.equal(images["zero"], images["fixed"])


def test_an_editing_vector_moves_the_codes_and_steers_attention() -> None:
    toonify, edit = (make_network(NARROW_VARIANTS[name]) for name in ("toonify", "edit"))
    frame = picture(toonify)
    with torch.no_grad():
        codes = toonify.codes(frame)
        assert torch.allclose(toonify(frame, codes, toonify.editing_w), toonify(frame, codes + toonify.editing_w))
        codes = edit.codes(frame)
        steered, moved = edit(frame, codes, edit.editing_w), edit(frame, codes + edit.editing_w)
    assert (steered - moved).abs().max() > 1e-3


def test_images_from_random_codes_need_no_input(toonify: StyleGANEX) -> None:
    with torch.no_grad():
        w = toonify.decoder.style(torch.randn(2, 32))
        image = toonify.synthesize(None, (), w[:, None].expand(-1, 18, -1), levels=6)
    assert image.shape == (2, 3, 256, 256) and image.std() > 0.01


def test_the_clip_network_keeps_no_head_and_outlives_the_plain_one(toonify: StyleGANEX) -> None:
    with torch.no_grad():
        w_plus = toonify.codes(picture(toonify))
    network = make_network(toonify.variant)
    clip, frame = compile_clip(network, w_plus), picture(network)
    expected = clip(frame)
    for parameter in network.parameters():
        parameter.data.zero_()
    assert torch.equal(clip(frame), expected)
    kept = sum(buffer.numel() for buffer in clip.buffers())
    assert kept < 0.4 * sum(parameter.numel() for parameter in network.parameters())


def test_compiling_needs_a_compiler(toonify: StyleGANEX, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(BackendError, match=r"needs a C\+\+ compiler"):
        compile_clip(toonify, toonify.latent_avg[None], compiled=True)


@pytest.mark.slow
def test_compiled_is_the_same_network(toonify: StyleGANEX) -> None:
    if not os.environ.get("TOONIFYGB_TEST_COMPILE"):
        pytest.skip("compiling takes minutes; set TOONIFYGB_TEST_COMPILE=1 to run it")
    if not shutil.which("g++"):
        pytest.skip("no C++ compiler (g++)")
    frame = picture(toonify)
    with torch.no_grad():
        w_plus = toonify.codes(frame)
        plain = toonify(frame, w_plus)
    found = compile_clip(toonify, w_plus, compiled=True)(frame)
    assert (found - plain).abs().max() <= RELATIVE * plain.abs().max()


@pytest.mark.parametrize("name", PUBLISHED)
def test_variants_are_read_off_their_tensors(name: str) -> None:
    for variant in (PUBLISHED[name], NARROW_VARIANTS[name], dataclasses.replace(PUBLISHED[name], max_pooling=True)):
        with torch.device("meta"):
            state = StyleGANEX(variant).state_dict()
        shapes = {key: tuple(tensor.shape) for key, tensor in state.items()}
        assert infer_variant(shapes, max_pooling=variant.max_pooling) == variant
    assert PUBLISHED[name].name == name and NARROW_VARIANTS[name].name == "custom"


def test_other_tensors_are_no_variant() -> None:
    with pytest.raises(AssetError, match="absent"):
        infer_variant({"generator.conv1.weight": (1, 512, 512, 3, 3)})
    with pytest.raises(AssetError, match="of shape"):
        infer_variant({"decoder.conv1.conv.weight": (1, 500, 500, 3, 3)})


def test_heads_take_the_mean_or_the_largest_value() -> None:
    mean, largest = (StyleHead(4, 1, max_pooling=pooled) for pooled in (False, True))
    largest.load_state_dict(mean.state_dict())
    mean.linear.weight.data = largest.linear.weight.data = 2 * torch.eye(4)  # equalised: divided by √4
    feature = torch.randn(2, 4, 16, 16)
    with torch.no_grad():
        after = mean.convs(feature)
        assert torch.allclose(mean(feature), after.mean((2, 3)), atol=1e-6)
        assert torch.allclose(largest(feature), after.amax((2, 3)), atol=1e-6)


def test_demodulated_kernels_have_unit_norm() -> None:
    conv = layers.ModulatedConv(6, 5, 3, 7)
    kernels = conv.kernels(torch.randn(2, 7))
    assert torch.allclose(kernels.square().sum((2, 3, 4)), torch.ones(2, 5), atol=1e-5)


def test_a_simulated_level_is_a_doubling_seen_through_a_sieve() -> None:
    """On a smooth map both kinds of up-convolution answer the same, up to where their samples lie."""
    double, simulated = (
        layers.ModulatedConv(1, 1, 3, 4, kind=kind, dilation=2) for kind in ("double", "simulated")
    )
    simulated.load_state_dict(simulated.state_dict() | double.state_dict())
    x = torch.ones(1, 1, 16, 16)
    with torch.no_grad():
        style = torch.randn(1, 4)
        wide, same = double(x, style), simulated(x, style)
    assert wide.shape[2] == 32 and same.shape == x.shape
    assert torch.allclose(wide[0, 0, 10:22, 10:22], same[0, 0, 8, 8].expand(12, 12), atol=1e-5)


def test_doubling_the_image_is_bilinear_inside() -> None:
    image = torch.rand(1, 3, 9, 11)
    found = layers.double_size(image, layers.fir_kernel())
    expected = torch.nn.functional.interpolate(image, scale_factor=2, mode="bilinear")
    assert torch.allclose(found[:, :, 1:-1, 1:-1], expected[:, :, 1:-1, 1:-1], atol=1e-6)
    assert (found[:, :, 0] <= expected[:, :, 0] + 1e-6).all()  # darker at the rim: outside counts as zero


def test_channels_are_filtered_one_by_one() -> None:
    x, kernel = torch.randn(1, 2, 7, 9), layers.binomial_kernel()[0, 0]
    found = layers.filter_channels(x, kernel, padding=1)
    padded = torch.nn.functional.pad(x, (1, 1, 1, 1))
    for row, column in ((0, 0), (3, 4), (6, 8)):
        expected = (padded[0, :, row : row + 3, column : column + 3] * kernel).sum((1, 2))
        assert torch.allclose(found[0, :, row, column], expected, atol=1e-6)
