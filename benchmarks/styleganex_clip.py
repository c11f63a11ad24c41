"""StyleGANEX over a clip of 300 frames of 512 x 512 px: what a user waits, whether memory stays flat, and whether a
run that is killed once ends with the same frames.

``toonifygb stylize`` runs in processes of their own, two at a time: one to the end; the other until it has begun
its third segment of 64 frames, when it is killed with signal 9, and again to the end. The network has full width,
weights from a seed, and stops at its input's size (``styleganex.levels=6``), here 160 x 160 px: the clip is a
close-up, a square of ``d9.mp4`` in the folder named by ``TOONIFYGB_VIDEOS``, so that it takes no hours.

Runs only when named, takes about half an hour of two cores, and needs Linux, whose ``/proc`` is read.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from benchmarks.harness import ROOT, Figure
from benchmarks.styleganex import seeded_network
from toonifygb import video
from toonifygb.stylize.styleganex import weights

if TYPE_CHECKING:
    from collections.abc import Iterator

FRAMES, SIDE = 300, 512
LEFT, TOP, CUT = 104, 84, 300
"""The square of the source clip that is brought to ``SIDE``, px."""
SETTINGS = ("styleganex.levels=6",)
EVERY_S = 3.0
"""Time between looks at a process."""
MIDDLE = 2
"""Finished segments at which the second process is killed."""
TICKS = os.sysconf("SC_CLK_TCK")
FOLDER_VARIABLE = "TOONIFYGB_BENCH_FOLDER"
"""Where the clips are kept; a folder that is removed at the end when unset."""


def run() -> list[Figure]:
    """Seconds per frame, GB, and frames that differ."""
    kept = os.environ.get(FOLDER_VARIABLE)
    if kept:
        Path(kept).mkdir(parents=True, exist_ok=True)
        return measured(Path(kept))
    with tempfile.TemporaryDirectory() as folder:
        return measured(Path(folder))


def measured(folder: Path) -> list[Figure]:
    """All figures, with the files in ``folder``."""
    clip, style = folder / "clip.mp4", folder / "style.safetensors"
    make_clip(clip)
    weights.save(seeded_network(), style)
    whole, halved = folder / "whole.mp4", folder / "killed.mp4"
    with ThreadPoolExecutor(1) as beside:
        running = beside.submit(watched, clip, style, whole)
        first = watched(clip, style, halved, kill=True)
        second = watched(clip, style, halved)
        alone = running.result()
    early, late = alone.memory_gb(0.1, 0.2), alone.memory_gb(0.9, 1.0)
    same_bytes = whole.read_bytes() == halved.read_bytes()
    return [
        Figure("frames", float(FRAMES), ""),
        Figure("processor time per frame, all told", alone.seconds / FRAMES, "s"),
        Figure("wall time per frame, all told", alone.wall / FRAMES, "s"),
        Figure("most memory in use", max(alone.peak_gb, second.peak_gb), "GB"),
        Figure("memory from 10 to 20 % of the run", early, "GB"),
        Figure("memory in its last tenth", late, "GB", baseline=early),
        Figure("processor time until killed", first.seconds, "s"),
        Figure("processor time after that", second.seconds, "s"),
        Figure("frames that differ after being killed", float(differing(whole, halved)), ""),
        Figure("files are the same bytes (1: yes)", float(same_bytes), ""),
    ]


def make_clip(path: Path) -> None:
    """The frames of ``squares`` as a video."""
    with video.Writer(path, SIDE, SIDE, video.probe(source_clip()).fps) as writer:
        for frame in squares():
            writer.write(frame)


def squares() -> Iterator[np.ndarray]:
    """A square of the source clip's frames at ``SIDE`` px."""
    for frame in video.read(source_clip(), max_frames=FRAMES):
        square = np.ascontiguousarray(frame[TOP : TOP + CUT, LEFT : LEFT + CUT])
        yield cv2.resize(square, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)


def source_clip() -> Path:
    """The clip that the square is cut from."""
    return Path(os.environ.get("TOONIFYGB_VIDEOS", ROOT / "../shared/data/videos")) / "d9.mp4"


@dataclass
class Observation:
    """A process, looked at while it ran."""

    wall: float = 0.0
    """Time it took, s."""
    seconds: float = 0.0
    """Processor time of all its threads."""
    peak_gb: float = 0.0
    """Most memory in use at any time, by the kernel's account."""
    samples: list[tuple[float, float]] = field(default_factory=list)
    """Processor time so far and memory in use, s and GB."""

    def memory_gb(self, start: float, end: float) -> float:
        """Most memory in use between two shares of the run."""
        return max(gb for seconds, gb in self.samples if start <= seconds / self.seconds <= end)


def watched(clip: Path, style: Path, out: Path, *, kill: bool = False) -> Observation:
    """``toonifygb stylize`` in a process of its own.

    Args:
        clip: to stylise.
        style: weights.
        out: video to write.
        kill: at the second look after the last segment before the middle was finished.

    Raises:
        RuntimeError: it failed, or ended before it could be killed.
    """
    command = [sys.executable, "-m", "toonifygb", "stylize", str(clip), "--out", str(out)]
    command += ["--style", str(style), "--quiet", "--settings", *SETTINGS]
    seen = Observation()
    begin = time.perf_counter()
    process = subprocess.Popen(command)
    late = 0
    for seconds, now_gb, peak_gb in looks(process.pid):
        seen.seconds, seen.peak_gb = seconds, max(seen.peak_gb, peak_gb)
        seen.samples.append((seconds, now_gb))
        late += (out.with_suffix(".parts") / f"{MIDDLE - 1:06d}.mp4").exists()
        if kill and late > 1:
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(EVERY_S)
    code = process.wait()
    seen.wall = time.perf_counter() - begin
    if code != (-signal.SIGKILL if kill else 0):
        raise RuntimeError(f"toonifygb stylize ended with code {code}")
    return seen


def looks(pid: int) -> Iterator[tuple[float, float, float]]:
    """Processor time in s, memory now and most memory in GB, as often as asked until the process has ended."""
    while True:
        # after the name in brackets: state, then numbers, of which the 12th and 13th are user and system ticks
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        status = Path(f"/proc/{pid}/status").read_text()
        lines = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
        if "VmRSS" not in lines:  # it has ended and waits to be asked for its exit code
            return
        now_gb, peak_gb = (1024e-9 * int(lines[name].split()[0]) for name in ("VmRSS", "VmHWM"))
        yield (int(fields[11]) + int(fields[12])) / TICKS, now_gb, peak_gb


def differing(a: Path, b: Path) -> int:
    """Number of frames in which two clips differ, bit for bit."""
    return sum(not np.array_equal(x, y) for x, y in zip(video.read(a), video.read(b), strict=True))
