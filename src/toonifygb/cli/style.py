"""``toonifygb style``: styles of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from toonifygb.cli.progress import Terminal
from toonifygb.config import STYLE_TRAIN, StyleTrainConfig


def style(
    action: Literal["train"],
    /,
    images: Path,
    base: str,
    out: Path,
    config: StyleTrainConfig = STYLE_TRAIN,
    quiet: bool = False,
) -> None:
    """Train a style of your own from 10 to 300 pictures: a StyleGANEX network. The same line resumes a stopped run.

    A GPU is needed for anything but a try. What the base was published under holds for what is made from it.

    Args:
        action: train learns a style and writes it to a file for --style.
        images: Folder of JPEG or PNG pictures, each with one face in the style.
        base: Network to start from, whose generator draws photographs of faces: styleganex-inversion (once added:
            toonifygb assets get styleganex-inversion), or a file.
        out: The style file to write (.safetensors); what is needed to go on lies beside it in a folder .training.
        config: Settings.
        quiet: Say nothing but errors.
    """
    from toonifygb.styletrain import train_style

    terminal = Terminal(quiet)
    terminal.listen()
    train_style(images, base, out, config, terminal)
    terminal.say(f"done: toonifygb stylize CLIP --out OUT.mp4 --style {out}")
