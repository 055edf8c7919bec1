"""Small charts of numbers over the times of a series, as SVG: drawn in milliseconds, for pages that keep changing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from markupsafe import Markup

from ...report.style import superscript
from ...units import plain

WIDTH, HEIGHT = 460, 190
LEFT, RIGHT, TOP, BOTTOM = 76, 10, 12, 26
"""The sheet, and what labels take of it [px]."""
MOST_LABELS = 5


@dataclass(frozen=True)
class Point:
    """A number at the time numbered x; error: its standard error; marked: drawn open, for it is not to be trusted."""

    x: float
    y: float
    error: float = 0.0
    marked: bool = False


def chart(points: Sequence[Point], title: str, floor: float | None = None) -> Markup:
    """The `points` with error bars; floor: a number that the axis reaches down to. Nothing without finite points."""
    seen = [p for p in points if math.isfinite(p.y) and math.isfinite(p.error)]
    if not seen:
        return Markup("")
    low = min([p.y - p.error for p in seen] + ([] if floor is None else [floor]))
    high = max(p.y + p.error for p in seen)
    if high <= low:
        low, high = low - 0.5 * (abs(low) or 1.0), high + 0.5 * (abs(high) or 1.0)
    ys, xs = labels(low, high), labels(seen[0].x, max(seen[-1].x, seen[0].x + 1))
    low, high = min(low, ys[0]), max(high, ys[-1])
    across = _scale(seen[0].x, max(seen[-1].x, seen[0].x + 1), LEFT, WIDTH - RIGHT)
    up = _scale(low, high, HEIGHT - BOTTOM, TOP)
    parts = [f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{up(y):.1f}" y2="{up(y):.1f}"/>' for y in ys]
    parts += [
        f'<text x="{LEFT - 6}" y="{up(y) + 4:.1f}" text-anchor="end">{text}</text>' for y, text in zip(ys, _texts(ys))
    ]
    parts += [
        f'<text x="{across(x):.1f}" y="{HEIGHT - 8}" text-anchor="middle">{_texts([x])[0]}</text>'
        for x in xs
        if x == round(x)
    ]
    for p in seen:
        if p.error > 0:
            x, ends = f"{across(p.x):.1f}", f'y1="{up(p.y - p.error):.1f}" y2="{up(p.y + p.error):.1f}"'
            parts.append(f'<line class="error" x1="{x}" x2="{x}" {ends}/>')
    path = " ".join(f"{across(p.x):.1f},{up(p.y):.1f}" for p in seen)
    parts.append(f'<polyline points="{path}"/>')
    for p in seen:
        kind = ' class="open"' if p.marked else ""
        said = f"<title>time {p.x:g}: {p.y:.4g}</title>"
        parts.append(f'<circle{kind} cx="{across(p.x):.1f}" cy="{up(p.y):.1f}" r="3">{said}</circle>')
    label = escape(title)
    return Markup(
        f'<figure class="chart"><figcaption>{label}</figcaption><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{label}">{"".join(parts)}</svg></figure>'
    )


def labels(low: float, high: float) -> list[float]:
    """Round numbers from `low` to `high`, at most `MOST_LABELS` of them, two at least."""
    step = 10.0 ** math.floor(math.log10((high - low) / MOST_LABELS))
    for factor in (1, 2, 2.5, 5, 10, 20):
        first, last = math.ceil(low / (factor * step) - 1e-9), math.floor(high / (factor * step) + 1e-9)
        if last - first < MOST_LABELS:
            found = [factor * step * n for n in range(first, last + 1)]
            return found if len(found) > 1 else [low, high]
    return [low, high]


def _scale(low: float, high: float, first: float, last: float) -> Callable[[float], float]:
    """The straight line that takes `low` to `first` and `high` to `last`."""
    return lambda value: first + (last - first) * (value - low) / (high - low)


def _texts(values: Sequence[float]) -> list[str]:
    """The numbers of an axis, with as many digits as tell them apart."""
    for digits in range(4, 16):
        texts = [_text(value, digits) for value in values]
        if len(set(texts)) == len(set(values)):
            break
    return texts


def _text(value: float, digits: int) -> str:
    """A number of an axis: 5.8e-22 → 5.8·10⁻²²."""
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return plain(value, digits).replace("-", "−")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{float(mantissa):.{digits}g}·10{superscript(int(exponent))}".replace("-", "−")
