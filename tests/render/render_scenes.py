"""Small scenes for the renderer tests."""

from __future__ import annotations

import torch
from torch import Tensor

from toonifygb.structures import Camera, Rendering, Splats

FIELDS = ("means", "quats", "scales", "opacities", "sh", "sh_frames")


def camera(width: int = 48, height: int = 40, focal: float = 50.0, dtype: torch.dtype = torch.float64) -> Camera:
    """Camera 2 m in front of the origin, slightly turned, principal point off the centre."""
    K = torch.tensor([[focal, 0, width / 2 + 0.3], [0, 1.1 * focal, height / 2 - 0.6], [0, 0, 1]], dtype=dtype)
    angle = torch.tensor(0.2, dtype=dtype)
    transform = torch.eye(4, dtype=dtype)
    transform[0, 0] = transform[2, 2] = angle.cos()
    transform[0, 2], transform[2, 0] = angle.sin(), -angle.sin()
    transform[:3, 3] = torch.tensor([0.05, -0.02, 2.0], dtype=dtype)
    return Camera(K, transform, width, height)


def splats(n: int = 150, degree: int = 3, *, seed: int = 0, frames: bool = False, size: float = 0.08) -> Splats:
    """Random Gaussians about the origin: thin to round, faint to opaque, quaternions not normalised; float64."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random, dtype=torch.float64)

    rotations = torch.linalg.qr(normal(n, 3, 3)).Q
    rotations = rotations * rotations.det()[:, None, None]
    return Splats(
        means=0.35 * normal(n, 3),
        quats=torch.nn.functional.normalize(normal(n, 4), dim=-1) * (0.9 + 0.2 * uniform(n, 1)),
        scales=size * torch.exp(0.6 * normal(n, 3)),
        opacities=0.02 + 0.97 * uniform(n),
        sh=normal(n, (degree + 1) ** 2, 3) * 0.4,
        sh_frames=rotations if frames else None,
    )


def one(opacity: float = 0.8, size: float = 0.1, mean: tuple[float, float, float] = (0, 0, 0)) -> Splats:
    """One round white Gaussian of constant colour; float64."""
    return Splats(
        means=torch.tensor([mean], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        scales=torch.full((1, 3), size, dtype=torch.float64),
        opacities=torch.tensor([opacity], dtype=torch.float64),
        sh=torch.full((1, 1, 3), 0.5 / 0.28209479177387814, dtype=torch.float64),
    )


def join(*parts: Splats) -> Splats:
    """All Gaussians of the parts, in order."""
    tensors = {name: [getattr(part, name) for part in parts] for name in FIELDS}
    return Splats(**{name: None if values[0] is None else torch.cat(values) for name, values in tensors.items()})


def variables(scene: Splats) -> tuple[Splats, list[Tensor]]:
    """The scene with leaves that collect gradients, and those leaves."""
    leaves = scene.map(lambda tensor: tensor.detach().clone().requires_grad_())
    return leaves, [getattr(leaves, name) for name in FIELDS if getattr(leaves, name) is not None]


def gradients(rendering: Rendering, leaves: list[Tensor], seed: int = 1) -> list[Tensor]:
    """Gradients of a random linear function of colour and alpha."""
    random = torch.Generator().manual_seed(seed)
    weights = [
        torch.randn(image.shape, generator=random, dtype=torch.float64)
        for image in (rendering.color, rendering.alpha)
    ]
    loss = (rendering.color * weights[0].to(rendering.color)).sum() + (
        rendering.alpha * weights[1].to(rendering.alpha)
    ).sum()
    return list(torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True))


def relative_errors(found: Tensor, expected: Tensor) -> Tensor:
    """Error of each Gaussian's gradient relative to its length, for Gaussians that have one."""
    found, expected = (tensor.double().reshape(len(tensor), -1) for tensor in (found, expected))
    length = expected.norm(dim=1)
    return ((found - expected).norm(dim=1) / length)[length > 1e-9 * length.max()]
