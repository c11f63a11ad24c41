"""The open head: the model that ships with the package, made from CC0 data by ``tools/build_open_head.py``.

``data/open_head.safetensors`` keeps lengths in float16 (relative error 5e-4, so under 0.01 mm in any basis),
masks and skinning weights as fractions of 255 and 65535, and of expressions and pose correctives only what moves.
"""

from __future__ import annotations

import hashlib
import json
from importlib import resources
from typing import TYPE_CHECKING

import torch
from safetensors import safe_open

from toonifygb.errors import AssetError
from toonifygb.head.base import HeadModel

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import Float, Int
    from torch import Tensor

SHA256 = "b8197bb7c11d9b9d73fcb9e6dc9f2eedb91d76d31d24813f569e2cbeabc9ebe8"
"""Of the shipped file; the builder prints the same."""
FACE_MODES = 72
"""The first so many identity coefficients explain the face, ears and skull following by regression; the others
move only ears, skull and neck. A fit to landmarks leaves those at zero."""


def load_open_head() -> HeadModel:
    """The head model that ships with the package.

    Raises:
        AssetError: the file in the installed package is not the one this version was released with.
    """
    with resources.as_file(resources.files("toonifygb.head") / "data" / "open_head.safetensors") as path:
        verify(path)
        return decode(path)


def verify(path: Path) -> None:
    """Compare the file with the recorded checksum.

    Raises:
        AssetError: they differ.
    """
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != SHA256:
        raise AssetError(
            f"{path.name} has sha256 {found[:12]}…, this version expects {SHA256[:12]}…",
            "reinstall toonifygb; the file was damaged or replaced",
        )


def decode(path: Path) -> HeadModel:
    """Head model from the compact file."""
    with safe_open(path, framework="pt") as file:
        notes = json.loads(file.metadata()["head"])
        stored = {key: file.get_tensor(key) for key in file.keys()}

    def real(key: str) -> Float[Tensor, "*n"]:
        return stored[key].to(torch.float32)

    def whole(key: str) -> Int[Tensor, "*n"]:
        return stored[key].to(torch.int64)

    def scattered(key: str, n_columns: int) -> Float[Tensor, "v 3 k"]:
        basis = torch.zeros(stored["template"].shape[0], 3, n_columns)
        basis[whole(f"{key}_rows"), :, whole(f"{key}_columns")] = real(key)
        return basis

    n_expression = len(notes["expression_names"])
    weights = real("skin_weights")
    regions = real("regions") / 255
    return HeadModel(
        name="open",
        template=real("template"),
        faces=whole("faces"),
        shape_basis=real("shape_basis"),
        expression_basis=scattered("expression_basis", n_expression),
        expression_names=tuple(notes["expression_names"]),
        expression_sigma=real("expression_sigma"),
        expression_lower=torch.zeros(n_expression),
        expression_upper=torch.ones(n_expression),
        eyelid_basis=scattered("eyelid_basis", 2),
        pose_basis=scattered("pose_basis", stored["pose_features"].shape[0]).movedim(-1, 0).contiguous(),
        pose_features=whole("pose_features"),
        rest_joints=real("rest_joints"),
        joint_shape_basis=real("joint_shape_basis"),
        joint_expression_basis=torch.zeros(5, 3, n_expression),
        skin_weights=weights / weights.sum(-1, keepdim=True),
        part=whole("part"),
        regions={name: regions[:, column].contiguous() for column, name in enumerate(notes["regions"])},
        landmark_faces=whole("landmark_faces"),
        landmark_bary=real("landmark_bary"),
        landmark_offset=real("landmark_offset"),
        landmark_sigma=real("landmark_sigma"),
        landmark_mirror=whole("landmark_mirror"),
        uv=real("uv"),
    )
