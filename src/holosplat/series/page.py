"""The page of a series: results of every time, charts, and phase maps; `watch` updates it."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from PIL import Image

from ..checks import InputError, require, require_regular
from ..io.atomic import atomic_path
from ..io.guard import read_array
from ..report.page import Headline, template
from ..report.style import bar_length, format_length, in_print, palette, scientific, superscript
from ..units import in_percent, two_digits
from ..units import plain as in_digits
from ..workflows.next_step import next_step
from ..workflows.run_folder import RunFolder
from ..workflows.verdict import Verdict, some
from .folder import Row, plain

MOST_PICTURES = 160
"""Times whose phase map a page holds, at most: evenly chosen, about 8 kB each."""
MOST_ROWS = 2000
"""Times in its table, at most, the last ones."""
MOST_EVENTS = 200
"""Events that it lists, at most, the first ones; events.csv has all."""


@dataclass(frozen=True)
class Frame:
    """A time that is done: its row, its time [s], the file of its phase map, its run relative to the page, and the
    names of its bodies."""

    row: Row
    time: float
    phase: Path
    run: str
    names: tuple[int, ...] = ()


@dataclass(frozen=True)
class SeriesPage:
    """Content of a page. failed: reasons by what failed; events: a line each; refresh: seconds after which a browser
    reads it again; 0: never; begun: a time that is in work, of which there is a picture already."""

    title: str
    headline: Headline
    summary: str
    frames: tuple[Frame, ...]
    failed: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    refresh: float = 0.0
    events: tuple[str, ...] = ()
    begun: Frame | None = None


def write_page(path: Path, page: SeriesPage) -> None:
    """Write the page as one self-contained HTML file, whole or not at all."""
    text = render_page(page)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def render_page(page: SeriesPage) -> str:
    """The page as HTML."""
    shown = [*(page.frames[i] for i in _evenly(len(page.frames))), *filter(None, [page.begun])]
    kept, unread = _maps(shown)
    told = not any(frame.row.quantity == "β" for frame in shown)
    kept = kept if told else [(frame, -2 * phase) for frame, phase in kept]  # -k∫β, which stands for the phase then
    values = [m[np.isfinite(m)] for m in ([phase for _, phase in kept])]
    low = min((float(v.min()) for v in values if v.size), default=-1.0)
    high = max((float(v.max()) for v in values if v.size), default=0.0)
    low, high = (low, high) if high > low else (low - 1.0, low)
    ends = [f"{value + 0.0:.3g}{' rad' * told}".replace("-", "−") for value in (low, high)]  # −0 is 0
    pictures = [
        {
            "number": frame.row.number,
            "label": f"time {frame.row.number}: {frame.time:.6g} s of {Path(frame.row.scan).name}"
            + ", in work" * (frame is page.begun),
            "image": _png(phase, low, high),
        }
        for frame, phase in kept
    ]
    return template("series.html", __package__ or "").render(
        title=page.title,
        headline=page.headline,
        summary=page.summary,
        key_figures=key_figures(page.frames),
        pictures=pictures,
        told=told,
        ends=ends if abs(high) > abs(low) else ends[::-1],
        colours=[f"rgb{tuple(colour)}" for colour in palette()[::51].tolist()],
        bar=next(filter(None, (_scale_bar(frame) for frame, _ in reversed(kept))), None),
        charts=_charts(page.frames),
        rows=[_cells(frame) for frame in page.frames[-MOST_ROWS:]],
        failed=page.failed,
        notes=(*page.notes, *unread),
        events=page.events[:MOST_EVENTS],
        refresh=int(1000 * page.refresh),
    )


def headline(state: str, frames: Sequence[Frame]) -> Headline:
    """Whether the frames of all times are explained, or why not and what to try next; `state`: what is done."""
    bad = [frame for frame in frames if frame.row.good is False]
    if not bad:
        good = sum(frame.row.good is True for frame in frames)
        said = f"The frames of {good} of {len(frames)} times are explained"
        return Headline(said, True, (state,)) if good else Headline(state, None, ())
    numbers = some([frame.row.number for frame in bad])
    said = f"The frames of {len(bad)} are not explained: {numbers}."
    text = f"Do not trust {len(bad)} of {len(frames)} times: their frames are not explained"
    verdict = _summary(bad[0]).get("verdict")
    first = f"Time {bad[0].row.number}: {in_print(bad[0].row.words)}"
    if not verdict:
        return Headline(text, False, (state, said, first))
    found = Verdict.from_dict(verdict)
    why = tuple(in_print(reason) for reason in found.reasons)
    return Headline(text, False, (state, said, first, *why), next_step(found.cause, plain(bad[0].row.scan)))


def _summary(frame: Frame) -> dict[str, Any]:
    """What summary.json of the run of a time says; empty where there is none."""
    try:
        return RunFolder(frame.phase.parent).read_summary()
    except (InputError, OSError):
        return {}


def _scale_bar(frame: Frame) -> tuple[float, str] | None:
    """Per cent of the width of a picture, and the length that it stands for."""
    detector = _summary(frame).get("detector")
    if not detector:
        return None
    width = detector["columns"] * detector["pixel_size_m"]
    return 100 * bar_length(width) / width, format_length(bar_length(width))


def key_figures(frames: Sequence[Frame]) -> list[tuple[str, str, str]]:
    """Name, value and remark of a few numbers."""
    rows = [frame.row for frame in frames]
    if not rows:
        return []
    warm = [row.seconds for row in rows if row.begun == "warm"]
    alone = [row.seconds for row in rows if row.begun != "warm"]
    found = [("Times", str(len(rows)), f"{len(warm)} begun warm")]
    found += [("A warm time", f"{two_digits(float(np.median(warm)))} s", "median")] if warm else []
    found += [("A time by itself", f"{two_digits(float(np.median(alone)))} s", "median")] if alone else []
    if rows[-1].total is not None:
        error = rows[-1].total_error
        remark = "" if error is None else f"± {in_percent(error / abs(rows[-1].total or 1))}"
        found.append(
            (f"Total {rows[-1].quantity}, m³", scientific(rows[-1].total), f"of the last time {remark}".strip())
        )
    if rows[-1].bodies:
        found.append(("Bodies", str(len(rows[-1].bodies)), "at the last time"))
    return found


def _charts(frames: Sequence[Frame]) -> list[Markup]:
    rows = [frame.row for frame in frames]
    totals = [Point(r.number, r.total, r.total_error or 0.0, r.good is False) for r in rows if r.total is not None]
    left = [Point(r.number, 100 * r.unexplained, marked=r.good is False) for r in rows if r.unexplained is not None]
    part = "test" if any(row.test for row in rows) else "train"
    scores = [
        Point(r.number, float(value), marked=r.good is False)
        for r in rows
        if isinstance(value := getattr(r, part).get("ssim"), int | float)
    ]
    seconds = [Point(r.number, r.seconds) for r in rows]
    quantity = rows[-1].quantity if rows else "δ"
    drawn = [
        chart(totals, f"Total {quantity} [m³] over the number of the time"),
        chart(left, "Matter that training frames leave unexplained [%]", 0.0),
        chart(scores, f"SSIM of the {'held-out' if part == 'test' else 'training'} frames"),
        chart(seconds, "Seconds a time", 0.0),
    ]
    return [one for one in drawn if one]


def _cells(frame: Frame) -> dict[str, object]:
    row = frame.row
    part = row.test or row.train
    scores = [f"{float(v):.4f}" if isinstance(v := part.get(name), int | float) else "" for name in ("ssim", "frcm")]
    total = "" if row.total is None else scientific(row.total)
    error = f" ± {scientific(row.total_error, 2)}" if row.total is not None and row.total_error is not None else ""
    explained = {True: "yes", False: "no", None: ""}[row.good]
    left = "" if row.unexplained is None else in_percent(row.unexplained)
    bodies = str(len(row.bodies)) if row.bodies else ""
    cells = [
        f"{frame.time:.6g}",
        row.begun,
        row.size,
        explained,
        left,
        *scores,
        total + error,
        bodies,
        f"{row.seconds:.1f}",
        in_print(row.words),
    ]
    return {"number": row.number, "run": frame.run, "cells": cells, "scan": Path(row.scan).name}


def _evenly(count: int) -> list[int]:
    if count <= MOST_PICTURES:
        return list(range(count))
    return sorted(set(np.linspace(0, count - 1, MOST_PICTURES).round().astype(int).tolist()))


def _maps(frames: Sequence[Frame]) -> tuple[list[tuple[Frame, np.ndarray]], list[str]]:
    """The phase maps that exist, each with its time, and messages about those that cannot be read."""
    kept, unread = list[tuple[Frame, np.ndarray]](), list[str]()
    for frame in frames:
        if not frame.phase.exists():
            continue
        try:
            kept.append((frame, _read(frame.phase)))
        except InputError as error:
            unread.append(f"time {frame.row.number} has no picture: {error}")
    return kept, unread


def _read(path: Path) -> np.ndarray:
    """A phase map; `InputError` where it is none."""
    require_regular(path, "a phase map")
    found = read_array(path, "a phase map")
    sound = found.ndim == 2 and found.dtype.kind == "f" and found.size > 0
    require(sound, f"{path} must be a phase map of numbers [H, W], but it is {found.dtype} of the shape {found.shape}.")
    return found.astype(np.float32)


def _png(phase: np.ndarray, low: float, high: float) -> str:
    """A phase map as a `data:` URI, black where it is zero and bright where it is largest."""
    bright = (phase - low) / (high - low) if abs(high) > abs(low) else (high - phase) / (high - low)
    image = Image.fromarray(np.rint(255 * np.clip(np.nan_to_num(bright), 0, 1)).astype(np.uint8))
    image.putpalette(palette().ravel().tolist())
    content = io.BytesIO()
    image.save(content, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(content.getvalue()).decode()}"


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
        return in_digits(value, digits).replace("-", "−")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{float(mantissa):.{digits}g}·10{superscript(int(exponent))}".replace("-", "−")
