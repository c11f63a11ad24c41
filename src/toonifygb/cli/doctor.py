"""``toonifygb doctor``: what this machine has, what will be used, what is wrong."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shutil
from pathlib import Path

from toonifygb import __version__
from toonifygb.errors import ToonifyError

_PACKAGES = ("torch", "numpy", "av", "opencv-python-headless", "safetensors", "tyro", "jaxtyping")


def report() -> str:
    """Lines of ``what: finding``; a line that needs action begins with ``!``."""
    lines = [
        f"  toonifygb {__version__}, Python {platform.python_version()}, {platform.platform()}",
        f"  {os.cpu_count()} processors, {_memory()}",
        f"  {shutil.disk_usage(Path.cwd()).free / 1e9:.0f} GB free here",
    ]
    lines += [_package(name) for name in _PACKAGES]
    lines += [_renderer(), _gpu(), _encoder(), _head(), _face()]
    return "\n".join(lines)


def _memory() -> str:
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, AttributeError, OSError):
        return "memory unknown"
    return f"{total / 1e9:.0f} GB memory"


def _package(name: str) -> str:
    try:
        return f"  {name} {importlib.metadata.version(name)}"
    except importlib.metadata.PackageNotFoundError:
        return f"! {name} is not installed: pip install {name}"


def _renderer() -> str:
    from toonifygb import render

    try:
        native = render.get("native")
    except ToonifyError as error:
        return f"! rasteriser: the readable reference (slow); {error}"
    return f"  rasteriser: {native.name}, {getattr(native, 'description', 'native CPU engine')}"


def _gpu() -> str:
    import torch

    from toonifygb.render import cuda

    if torch.cuda.is_available():
        reason = cuda.unavailable()
        return f"  GPU: {torch.cuda.get_device_name()}" if reason is None else f"! GPU: not used, because {reason}"
    return "  GPU: none; everything runs on the processor"


def _encoder() -> str:
    from toonifygb import video

    return (
        "  video: H.264 encoder found"
        if video.has_encoder()
        else "! video: this build of PyAV has no H.264 encoder"
    )


def _head() -> str:
    from toonifygb import head

    try:
        model = head.load("open")
    except ToonifyError as error:
        return f"! head model: {error}"
    return (
        f"  head model: {model.name}, {model.template.shape[0]} vertices, {len(model.expression_names)} expressions"
    )


def _face() -> str:
    from toonifygb.face.networks import DATA, SHA256

    wrong = [
        name
        for name, expected in SHA256.items()
        if hashlib.sha256((DATA / f"{name}.safetensors").read_bytes()).hexdigest() != expected
    ]
    if wrong:
        return f"! face networks: {', '.join(wrong)} differ from the released files: install toonifygb again"
    return f"  face networks: {len(SHA256)}, checksums right"
