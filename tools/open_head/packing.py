"""Writes the open head in the compact form that ``toonifygb.head.open_head`` reads."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING

import numpy as np
from safetensors.numpy import save

from open_head.landmarks import load_offsets

if TYPE_CHECKING:
    from pathlib import Path

    from open_head.identity import Identity
    from open_head.landmarks import Embedding
    from open_head.motion import Motion
    from open_head.surface import Surface

STILL = 2e-6
"""Where an expression or pose moves a vertex by less than this, it is left out, m."""
EXPRESSION_SIGMA = {"tongueOut": 0.1, "mouthClose": 0.2}
"""Usual size of rare units; of all others ½."""


def pack(
    path: Path,
    surface: Surface,
    motion: Motion,
    identity: Identity,
    embedding: Embedding,
    rest_joints: np.ndarray,
    regions: dict[str, np.ndarray],
) -> str:
    """Write the file; returns its sha256."""
    tensors = {
        "template": surface.template.astype(np.float32),
        "faces": surface.faces.astype(np.int16),
        "part": surface.part.astype(np.int8),
        "uv": surface.uv.astype(np.float16),
        "shape_basis": identity.shape_basis.astype(np.float16),
        "rest_joints": rest_joints.astype(np.float32),
        "joint_shape_basis": identity.joint_basis.astype(np.float32),
        "skin_weights": np.rint(motion.skin_weights * 65535).astype(np.uint16),
        "pose_features": np.array(motion.pose_features, np.int16),
        "expression_sigma": np.array([EXPRESSION_SIGMA.get(n, 0.5) for n in motion.expression_names], np.float32),
        "regions": np.rint(np.stack(list(regions.values()), 1) * 255).astype(np.uint8),
        "landmark_faces": embedding.faces.astype(np.int16),
        "landmark_bary": embedding.bary.astype(np.float32),
        "landmark_sigma": embedding.sigma.astype(np.float32),
        "landmark_mirror": embedding.mirror.astype(np.int16),
        "landmark_offset": load_offsets().astype(np.float32),
    }
    bases = (
        ("expression_basis", motion.expression_basis),
        ("eyelid_basis", motion.eyelid_basis),
        ("pose_basis", np.moveaxis(motion.pose_basis, 0, -1)),
    )
    for name, basis in bases:
        rows, columns = np.nonzero(np.abs(basis).max(axis=1) > STILL)
        tensors[name] = basis[rows, :, columns].astype(np.float16)
        tensors[f"{name}_rows"] = rows.astype(np.int16)
        tensors[f"{name}_columns"] = columns.astype(np.int8)
    notes = json.dumps({"expression_names": motion.expression_names, "regions": list(regions)})
    content = save({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}, {"head": notes})
    path.write_bytes(content)
    return hashlib.sha256(content).hexdigest()
