"""The page: figures, captions and tables in `template.html`, written as one self-contained file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import jinja2
import numpy as np

from ..io.atomic import atomic_path
from ..units import XRAYS_KEV, beam_named, in_percent, number_of
from ..workflows.certainty import NULL
from ..workflows.next_step import Step, next_step
from ..workflows.rehearsal import Rehearsal
from .blocks import make_blocks
from .content import Moving, ReportContent, flatten
from .style import format_length, in_print, scientific

LIGHT_DELTA = "1 − n/n of the medium: below 0 where the refractive index is the larger one"
"""What δ is of light."""


@dataclass(frozen=True)
class Table:
    """A table: caption, column heads (may be empty), and rows of texts whose first one names the row; folded: shown
    when it is asked for."""

    caption: str
    rows: list[tuple[str, ...]]
    head: tuple[str, ...] = ()
    folded: bool = False


@dataclass(frozen=True)
class Headline:
    """What stands over the page. text: in one line; trusted: whether frames are explained, None where none were judged;
    words: one sentence each: what was found, and why; step: what to try next, None where nothing is wrong."""

    text: str
    trusted: bool | None
    words: tuple[str, ...]
    step: Step | None = None


def headline(content: ReportContent) -> Headline:
    """The verdict on the training frames, or on the held-out ones where these alone are not explained; with the
    scores."""
    held_out, scores = content.held_out, verdict(content)
    found, named = content.explained, "frames"
    unseen = None if held_out is None else held_out.explained
    if unseen is not None and not unseen.good and (found is None or found.good):
        found, named = unseen, "held-out frames"
    if found is None:
        return Headline(content.title, None, (scores,))
    words = in_print(found.words.replace("The frames", f"The {named}"))
    text, _, rest = re.sub("[:;] ", "\n", words, count=1).partition("\n")
    text, details = text.rstrip("."), tuple(filter(None, (rest[:1].upper() + rest[1:],)))
    if content.rehearsal is not None and found is content.explained:
        return _rehearsed(content.rehearsal, (words, scores), content.scan)
    unrehearsed = (NOT_REHEARSED,) * content.at_rest
    if found.good:
        return Headline(text, True, (*details, scores, *unrehearsed))
    text = f"Do not trust this volume: {text[0].lower()}{text[1:]}"
    reasons = (*(in_print(reason) for reason in found.reasons), *unrehearsed)
    return Headline(text, False, (*details, *reasons, scores), next_step(found.cause, content.scan))


NOT_REHEARSED = (
    "No rehearsal was made: how much of the residual the method leaves anyway, and how far off the numbers may be, is "
    "unknown (holosplat rehearse)."
)
VERDICTS = {
    "consistent": "Consistent: the frames are explained",
    "limited": "Limited: as good as this method gets with these views",
    "wrong": "Do not trust this volume: the method would explain the frames better if scan and material were right",
}


def _rehearsed(found: Rehearsal, more: tuple[str, ...], scan: str) -> Headline:
    """The verdict by rehearsals, with the number that decided."""
    cause = found.cause.choice if found.cause is not None and found.cause.choice != NULL else found.explained.cause
    reasons = () if found.word != "wrong" else tuple(in_print(each) for each in found.explained.reasons)
    first = found.said
    said = (in_print(first[0].upper() + first[1:]), *reasons, *more)
    trusted = {"consistent": True, "limited": None, "wrong": False}[found.word]
    return Headline(VERDICTS[found.word], trusted, said, next_step(cause, scan) if found.word == "wrong" else None)


def verdict(content: ReportContent) -> str:
    """The result in one sentence, with the numbers that carry it."""
    parts = []
    if content.held_out is not None:
        mean, count = content.held_out.scores.mean, len(content.held_out.labels)
        views = "one held-out view" if count == 1 else f"{count} held-out views"
        parts.append(f"predicts {views} with a mean SSIM of {mean['ssim']:.3f} and FRCM of {mean['frcm']:.3f}")
    if content.volume_scores is not None:
        scores, symbol = content.volume_scores, content.quantity.symbol
        size = percent(abs(scores.delta_deviation)).lstrip("+")
        side = "above" if scores.delta_deviation > 0 else "below"
        parts.append(
            f"overlaps the truth with a Dice coefficient of {scores.dice:.3f}, "
            f"its mean {symbol} {size} {side} the true one"
        )
    if content.moving is not None:
        parts.insert(0, _followed(content.moving))
    if not parts:
        return "No view was held out and no truth is known: this page shows the reconstruction without a score."
    return f"The reconstruction {' and '.join(parts)}."


def _followed(moving: Moving) -> str:
    count, times = moving.bodies.count, moving.times
    what = f"follows {number_of(count, 'body')} through {number_of(len(times), 'time')}"
    if not moving.whole.any():
        return f"{what}, none of them ever whole in the field of view"
    spread = float(np.nanmedian(moving.spread("volume_m3") / moving.mean("volume_m3")))
    return f"{what}, whose volumes keep to ±{in_percent(spread)} over time in the median"


def key_figures(content: ReportContent) -> list[tuple[str, str, str]]:
    """Name, value and explanation of the numbers at the head of the page."""
    figures = []
    if (moving := content.moving) is not None:
        whole, span = int(moving.whole.any(0).sum()), 1e6 * float(np.ptp(moving.times))
        figures += [
            ("Bodies", str(moving.bodies.count), f"{whole} of them whole at times"),
            ("Times", str(len(moving.times)), f"over {span:.4g} µs"),
        ]
    if content.held_out is not None:
        mean = content.held_out.scores.mean
        figures += [
            ("SSIM", f"{mean['ssim']:.3f}", "held-out views"),
            ("FRCM", f"{mean['frcm']:.3f}", "held-out views"),
            ("PSNR", f"{scientific(mean['psnr'], 3)} dB", "held-out views"),
            ("L1", scientific(mean["l1"], 2), "held-out views"),
        ]
    if content.volume_scores is not None:
        figures += [
            ("Dice", f"{content.volume_scores.dice:.3f}", f"at half of the {content.quantity.symbol}"),
            (f"Mean {content.quantity.symbol}", percent(content.volume_scores.delta_deviation), "against the truth"),
        ]
    if content.seconds:  # none of a forecast
        figures.append(("Time", duration(content.seconds), "of the reconstruction"))
    return figures


def score_tables(content: ReportContent) -> list[Table]:
    """The total δ, the scores of the volume and of each held-out view, and the geometry, as far as there are any."""
    tables = (
        _bodies_table(content),
        _total_table(content),
        _rehearsal_table(content),
        _volume_table(content),
        _views_table(content),
        _geometry_table(content),
        _decisions_table(content),
    )
    return [table for table in tables if table is not None]


def record_tables(content: ReportContent) -> list[Table]:
    """Records that make the run repeatable: input, settings, versions, machine and timing."""
    shape, edges = content.reconstruction.grid.shape[::-1], content.reconstruction.grid.voxel_size
    data = [
        beam_named(content.energy_kev),
        *([("δ", LIGHT_DELTA)] if content.energy_kev < XRAYS_KEV[0] else []),
        ("pixel size", format_length(content.pixel_size, 4)),
        ("voxels (x × y × z)", " × ".join(str(n) for n in shape)),
        (
            "voxel size",
            " × ".join(format_length(d, 4) for d in (edges if len(set(edges)) > 1 else edges[:1])),
        ),
        ("input hash", content.input_hash or "not recorded"),
    ]
    named = {"Timing": content.timing, "Machine": content.machine, "Versions": content.versions}
    tables = [Table("Input", data)]
    tables += [Table(name, list(flatten(entries).items())) for name, entries in named.items() if entries]
    settings, usual = flatten(content.settings), flatten(content.usual)
    told = [(name, value) for name, value in settings.items() if usual.get(name) != value]
    tables += [Table("Settings other than the usual ones" if usual else "Settings", told)] if told else []
    if usual and settings:
        tables.append(
            Table(f"All {len(settings)} settings, of stages that were not run, too", list(settings.items()), (), True)
        )
    return tables


def _bodies_table(content: ReportContent) -> Table | None:
    """Each body, averaged over the times at which it is whole in the field, with standard errors where known."""
    moving = content.moving
    if moving is None:
        return None
    speed = np.linalg.norm([moving.mean(f"v{axis}_m_s") for axis in "xyz"], axis=0)
    rows = []
    for k in range(moving.bodies.count):
        shown = [
            _with_error(moving, name, k, factor, digits)
            for name, factor, digits in (("volume_m3", 1e18, 2), ("area_m2", 1e12, 1), ("deformation", 1.0, 3))
        ]
        fast = f"{1e3 * speed[k]:.4g}" if np.isfinite(speed[k]) else "–"
        rows.append((str(k), str(int(moving.whole[:, k].sum())), fast, *shown))
    head = ("body", "times whole", "speed (mm/s)", "volume (µm³)", "area (µm²)", "deformation")
    return Table("Bodies, means over the times at which they are whole in the field", rows, head)


def _with_error(moving: Moving, name: str, body: int, factor: float, digits: int) -> str:
    value, whole = float(moving.mean(name)[body]), moving.whole[:, body]
    if not np.isfinite(value):
        return "–"
    text = f"{factor * value:.{digits}f}"
    if name in moving.errors:
        text += f" ± {factor * float(moving.errors[name][whole, body].mean()):.{digits}f}"
    return text


def _total_table(content: ReportContent) -> Table | None:
    total = content.total
    if total is None:
        return None
    if total.value is None or total.error is None:
        return Table("Total", [("by the frames", in_print(total.words))])
    rows = [
        (f"total {total.quantity} by the frames", f"{scientific(total.value)} m³"),
        ("its standard error", f"{scientific(total.error, 2)} m³"),
        ("what the volume holds", f"{scientific(total.held)} m³"),
        ("in words", in_print(total.words)),
    ]
    return Table("Total", rows)


def _rehearsal_table(content: ReportContent) -> Table | None:
    if content.rehearsal is None:
        return None
    first, *intervals = content.rehearsal.intervals()
    return Table(
        first[0].upper() + first[1:].rstrip(":"), [tuple(map(in_print, each.split(": ", 1))) for each in intervals]
    )


def _volume_table(content: ReportContent) -> Table | None:
    scores, shown = content.volume_scores, content.quantity
    if scores is None:
        return None
    rows = [
        (f"mean {shown.symbol} in the matter", shown.text(scores.mean_delta), shown.text(scores.true_mean_delta)),
        ("mean β in the matter", scientific(scores.mean_beta), scientific(scores.true_mean_beta)),
        ("mean δ / mean β", scientific(scores.ratio, 4), scientific(scores.true_ratio, 4)),
        (f"relative error of {shown.symbol}", scientific(scores.relative_error_delta), ""),
        ("relative error of β", scientific(scores.relative_error_beta), ""),
        ("Dice coefficient", f"{scores.dice:.4f}", ""),
        ("resolution, ½-bit", resolved(scores.resolution_half_bit, scores.pitch), ""),
        ("resolution, FSC 0.143", resolved(scores.resolution_fixed, scores.pitch), ""),
    ]
    if not content.delta_told:  # δ stands for β: the same numbers would be told twice
        rows = [row for row in rows if "δ" not in row[0] and not row[0].startswith(("mean β", "relative error of β"))]
    deviations = [scores.delta_deviation, scores.beta_deviation, scores.ratio_deviation]
    deviations = deviations if content.delta_told else deviations[:1]
    last = [percent(d) for d in deviations] + [""] * (len(rows) - len(deviations))
    head = ("volume", "found", "truth", "deviation")
    return Table("Volume against the truth", [(*row, end) for row, end in zip(rows, last)], head)


def _views_table(content: ReportContent) -> Table | None:
    if content.held_out is None:
        return None
    s, labels = content.held_out.scores, content.held_out.labels
    mean = s.mean
    rows = [
        (label, f"{s.ssim[i]:.4f}", f"{s.frcm[i]:.4f}", f"{s.psnr[i]:.2f}", f"{s.l1[i]:.4f}")
        for i, label in enumerate(labels)
    ]
    means = (f"{mean['ssim']:.4f}", f"{mean['frcm']:.4f}", f"{mean['psnr']:.2f}", f"{mean['l1']:.4f}")
    head = ("view", "SSIM", "FRCM", "PSNR (dB)", "L1")
    return Table("Held-out views", [*rows, ("mean", *means)], head)


def _decisions_table(content: ReportContent) -> Table | None:
    """What was decided, and by how much smaller each candidate's residual is than that of what stood before it."""
    if not content.decisions:
        return None
    rows = []
    for each in content.decisions:
        tried = (f"{one.name}: {percent(one.gain)} ± {100 * one.error:.1f} %" for one in each.compared)
        rows.append((each.name, each.choice, each.by, "; ".join(tried), f"{each.seconds:.1f}\u00a0s"))
    head = ("decision", "choice", "by", "smaller residual", "time")
    return Table("Decisions", rows, head)


def _geometry_table(content: ReportContent) -> Table | None:
    """Changes of the pose of each frame from the plan, and its residuals before and after."""
    found = content.geometry
    if found is None:
        return None
    rows = []
    for v, (change, error) in enumerate(zip(found.changes, found.errors)):
        numbers = [f"{change[k]:+.2f} ± {error[k]:.2f}" for k in (0, 1)]
        numbers += [f"{change[k]:+.3f} ± {error[k]:.3f}" for k in (2, 3, 4)]
        name = f"{v} (held out)" if found.held_out[v] else str(v)
        left = f"{found.before[v]:.3f} → {found.after[v]:.3f}"
        rows.append((name, *(n.replace("-", "−") for n in numbers), percent(change[5]), percent(change[6]), left))
    names = ("shift x (px)", "shift y (px)", "turn x (°)", "turn y (°)", "roll (°)", "distance", "magnification")
    return Table("Geometry beside the plan", rows, ("frame", *names, "unexplained"))


def resolved(length: float | None, pitch: float) -> str:
    """A resolution in words; None: not before the sampling limit of voxels of `pitch` [m]."""
    if length is None:
        return f"≤ {format_length(2 * pitch)} (sampling limit)"
    return "not resolved" if length == float("inf") else format_length(length)


def percent(value: float | None) -> str:
    """A relative deviation in per cent with its sign: -0.0123 → "−1.2 %"; None → "–"."""
    if value is None:
        return "–"
    digits = 2 if abs(value) < 0.00995 else 1
    rounded = round(100 * value, digits)
    return f"{rounded:+.{digits}f} %".replace("-", "−") if rounded else "0 %"


def duration(seconds: float) -> str:
    """A time for people: 54.2 → "54 s", 3700 → "1 h 02 min"."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 120:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def write_report(content: ReportContent, path: str | Path) -> Path:
    """Write `content` as one self-contained HTML file at `path`, atomically: no reader ever sees half of it.

    Returns the path. Raises `InputError` when it cannot be written.
    """
    page = render_page(content)
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(path)


def render_page(content: ReportContent) -> str:
    """`content` as HTML; equal content gives equal text."""
    return template("template.html").render(
        title=content.title,
        run=content.run,
        summary=content.summary,
        headline=headline(content),
        key_figures=key_figures(content),
        blocks=make_blocks(content),
        scores=score_tables(content),
        records=record_tables(content),
    )


def template(name: str, package: str = "") -> jinja2.Template:
    """The page template `name` of this room or of another `package`; all extend this room's `template.html`."""
    folders = [jinja2.PackageLoader(folder, "") for folder in (package, __package__ or "") if folder]
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(folders),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["zip"] = zip
    return environment.get_template(name)
