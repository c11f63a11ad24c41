"""``report.html``: one self-contained page that shows a run to a person.

Pictures are embedded, curves are inline SVG, nothing is fetched. The page is made from a ``Report`` record; what
the record holds is decided in ``outcome.py``.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources

_STYLE_FILE = "report.css"


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    jpeg: bytes
    caption: str


@dataclass(frozen=True)
class Curve:
    """A curve: ``xs`` ascending, ``ys`` finite."""

    title: str
    xs: Sequence[float]
    ys: Sequence[float]


@dataclass(frozen=True)
class Report:
    """What the page shows, top to bottom."""

    title: str
    lead: str
    scores: Sequence[tuple[str, str]]
    """Label and value of each tile."""
    pictures: Sequence[Picture]
    curves: Sequence[Curve]
    stages: Sequence[tuple[str, float]]
    """Name and wall seconds."""
    problems: Sequence[str]
    facts: Sequence[tuple[str, str]] = field(default_factory=tuple)


def render_report(report: Report) -> str:
    """The page as HTML text."""
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width, initial-scale=1">',
        f"<title>{_text(report.title)}</title><style>{_style()}</style>",
        f"<h1>{_text(report.title)}</h1><p class=lead>{_text(report.lead)}</p>",
        "<div class=tiles>" + "".join(_tile(*score) for score in report.scores) + "</div>",
        "<h2>Preview</h2><figure><video src=preview.mp4 controls loop muted autoplay playsinline></video>",
        "<figcaption>Input · stylised · avatar at the same pose · avatar from a moving view</figcaption></figure>",
    ]
    parts += [_picture(picture) for picture in report.pictures]
    if report.curves:
        parts.append("<h2>Curves</h2><div class=two>" + "".join(map(_curve, report.curves)) + "</div>")
    parts.append("<h2>Problems found in the clip</h2>")
    if report.problems:
        parts.append("<ul class=problems>" + "".join(f"<li>{_text(p)}</li>" for p in report.problems) + "</ul>")
    else:
        parts.append("<p>None.</p>")
    stages = [(name, f"{seconds:.1f} s") for name, seconds in report.stages]
    stages.append(("all", f"{sum(seconds for _, seconds in report.stages):.1f} s"))
    parts.append(
        f"<div class=two><div><h2>Time</h2>{_table(stages)}</div>"
        f"<div><h2>Facts</h2>{_table(report.facts)}</div></div>"
    )
    return "\n".join(parts) + "\n</html>\n"


def _style() -> str:
    return resources.files("toonifygb.pipeline").joinpath(_STYLE_FILE).read_text()


def _text(value: str) -> str:
    return html.escape(value)


def _tile(label: str, value: str) -> str:
    return f"<div class=tile><b>{_text(value)}</b><span>{_text(label)}</span></div>"


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.jpeg).decode()
    caption = _text(picture.caption)
    image = f'<img alt="{caption}" src="data:image/jpeg;base64,{data}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _table(rows: Sequence[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><th>{_text(key)}</th><td class=n>{_text(value)}</td></tr>" for key, value in rows)
    return f"<table>{cells}</table>"


def _curve(curve: Curve) -> str:
    """Line chart with the extremes written at the axes."""
    width, height, left, bottom = 520.0, 180.0, 48.0, 22.0
    low, high = min(curve.ys), max(curve.ys)
    span_y = (high - low) or 1.0
    span_x = (curve.xs[-1] - curve.xs[0]) or 1.0
    points = " ".join(
        f"{left + (x - curve.xs[0]) / span_x * (width - left - 6):.1f},"
        f"{8 + (high - y) / span_y * (height - bottom - 16):.1f}"
        for x, y in zip(curve.xs, curve.ys, strict=True)
    )
    floor = height - bottom
    return (
        f'<figure><svg viewBox="0 0 {width:.0f} {height:.0f}" role=img aria-label="{_text(curve.title)}">'
        f'<path class=axis d="M{left} 4V{floor}H{width}"/><polyline class=curve points="{points}"/>'
        f'<text x="2" y="14">{high:.4g}</text><text x="2" y="{floor - 4}">{low:.4g}</text>'
        f'<text x="{left}" y="{height - 6}">{curve.xs[0]:.4g}</text>'
        f'<text x="{width - 4}" y="{height - 6}" text-anchor="end">{curve.xs[-1]:.4g}</text></svg>'
        f"<figcaption>{_text(curve.title)}</figcaption></figure>"
    )
