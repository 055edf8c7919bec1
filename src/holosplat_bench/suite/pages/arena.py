"""The page of the arena: tables per case and overall, Pareto fronts, and the time line by commit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from holosplat.report.page import Headline
from holosplat.report.style import CYCLE, WIDTH, letter, new_figure, styled

from ..arena.contest import TRACKS, Track
from ..arena.history import Change, Entry, changes, mean, previous
from .page import Entry as Cell
from .page import Page, Picture, ScoreTable, Sheet, write_page
from .plots import MARKERS, draw_front, log_ticks, pareto_front

MEASURES = {
    "kernels": ("error", "adjoint"),
    "steps": ("error",),
    "retrieval": ("error",),
    "tomography": ("error", "dice", "ssim"),
    "jobs": ("error", "dice", "ssim"),
}
"""Numbers of each track, the one of the Pareto front first."""
CALLED = {
    ("kernels", "error"): "error of the projection",
    ("kernels", "adjoint"): "error of the adjoint",
    ("steps", "error"): "error of the gradient",
    ("retrieval", "error"): "error of the phase",
    ("tomography", "error"): "error of δ",
    ("jobs", "error"): "error of δ",
    "dice": "Dice",
    "ssim": "SSIM, held-out views",
    "seconds": "processor time (s)",
}
"""Numbers in words."""
PROTOCOL = (
    "A sealed case is drawn from the seed alone. Its frames are made by a second program (suite/multislice.py: "
    "rays, slabs, the angular spectrum, in float64), which shares no code with holosplat or any contestant; the "
    "frames for training get Poisson noise. No contestant sees the truth or the held-out frames. All know the "
    "geometry, the photon energy and δ/β, and nothing else.",
    "Every contestant computes every case in a process of its own, with one thread. Time is that of the processor "
    "(user and system, with children), from the end of imports and set-up to the answer; of kernels and steps the "
    "fastest of three calls counts, elsewhere the first. Memory is the peak of the process, with its libraries.",
    "Errors are relative root mean squares: of δ in the volume, of the phase in the training views, and of a "
    "projection or gradient against exact strips in float64. The error of an adjoint is |⟨Ax, y⟩ − ⟨x, Aᵀy⟩| / "
    "|⟨Ax, y⟩|. Tomographies all get the phase that holosplat's Tikhonov retrieves. SSIM is that of held-out "
    "views, predicted by the same wave optics from all volumes. A linear projector differs from strips by its "
    "model, which is no mistake.",
    "The best pair of peers is chosen in hindsight, with the truth, for every case: this favours the peers. Peers "
    "run with options of their examples, or chosen on one scene of a seed below 100; their authors could tune "
    "them better.",
)
"""How the numbers came about."""


def write_arena(entry: Entry, history: Sequence[Entry], folder: Path) -> tuple[Path, Path]:
    """Write arena.html (self-contained) and arena.md with pictures in `folder`/report; returns both pages' paths."""
    images = folder / "report"
    images.mkdir(exist_ok=True)
    tracks: list[Track] = [track for track in TRACKS if any(row["track"] == track for row in entry.rows)]
    sheets = [*(_track(entry, track, images) for track in tracks), _time_line(entry, history)]
    sheets += [_case(entry, case) for case in dict.fromkeys(row["case"] for row in entry.rows)]
    sheets.append(Sheet("protocol", "Protocol", PROTOCOL, [_record(entry)]))
    return write_page(Page("Arena", _headline(entry), _said(entry), sheets), folder / "arena.html", folder / "arena.md")


def overall(entry: Entry, track: str) -> dict[str, dict[str, float]]:
    """Contestant → its numbers and seconds, means over the cases that all who have a result have in common."""
    found = {key[1:]: numbers for key, numbers in entry.results().items() if key[0] == track}
    names = list(dict.fromkeys(name for name, _ in found))
    cases = [{case for one, case in found if one == name} for name in names]
    common = set.intersection(*cases) if cases else set()
    table = {}
    for name in names:
        values = {n: mean([found[name, c].get(n) for c in sorted(common)], n) for n in (*MEASURES[track], "seconds")}
        table[name] = {n: value for n, value in values.items() if value is not None}
    return {name: numbers for name, numbers in table.items() if numbers}


def front(table: dict[str, dict[str, float]]) -> set[str]:
    """The contestants that none other beats in both error and time."""
    points = {name: (numbers["seconds"], numbers["error"]) for name, numbers in table.items()}
    on = set(pareto_front(list(points.values())))
    return {name for name, point in points.items() if point in on}


def _headline(entry: Entry) -> Headline:
    words = []
    for track in ("tomography", "jobs"):
        table = overall(entry, track)
        if table:
            best = min(table, key=lambda name: table[name]["error"])
            words.append(f"{track.capitalize()}: {best} has the least error of δ, {table[best]['error']:.3f}.")
    return Headline("Quality and processor time, side by side", None, tuple(words))


def _said(entry: Entry) -> str:
    cases, failed = {row["case"] for row in entry.rows}, [row for row in entry.rows if row["status"] != "done"]
    text = f"{len(cases)} sealed cases of {entry.size} × {entry.size} pixels, seed {entry.seed}. Of {len(entry.rows)} "
    text += f"rows {len(failed)} have no result. "
    text += f"Not installed: {', '.join(entry.absent)}." if entry.absent else "Every peer is installed."
    return text


def shown(number: str, value: float | None) -> str:
    """A number as tables show it; a dash where there is none."""
    if value is None:
        return "–"
    digits = {"dice": ".3f", "ssim": ".3f", "memory": ".0f"}
    return format(value, digits.get(number, ".3g"))


def _table(track: str, table: dict[str, dict[str, float]], said: dict[str, str], caption: str) -> ScoreTable:
    best, rows = front(table), []
    for name, words in said.items():
        numbers = table.get(name, {})
        cells = [Cell(shown(n, numbers.get(n))) for n in (*MEASURES[track], "seconds", "memory")]
        rows.append((Cell(name), *cells, Cell("on it" if name in best else "", name in best), Cell(words)))
    heads = [CALLED.get((track, n)) or CALLED[n] for n in MEASURES[track]]
    head = ("contestant", *heads, CALLED["seconds"], "memory (MB)", "Pareto front", "what it is")
    return ScoreTable(head, rows, caption)


def _track(entry: Entry, track: Track, images: Path) -> Sheet:
    table, rows = overall(entry, track), [row for row in entry.rows if row["track"] == track]
    for name in table:
        memory = [row["memory_bytes"] for row in rows if row["contestant"] == name and row["memory_bytes"]]
        table[name]["memory"] = max(memory, default=0) / 1e6
    said = {row["contestant"]: row["summary"].partition(":")[0] for row in rows}
    cases = {row["case"] for row in rows}
    whole = all(sum(r["status"] == "done" for r in rows if r["contestant"] == name) == len(cases) for name in table)
    which = f"all {len(cases)} cases" if whole else "the cases that all who have results have in common"
    caption = f"Means over {which}: geometric of errors and times, arithmetic of Dice and SSIM; most memory"
    remarks = _failures(rows)
    pictures = []
    if table:
        text = "Down and to the left is better; axes are logarithmic. Grey steps join those that none beats in both."
        figure = pareto_figure(track, table)
        pictures = [Picture.of(figure, images / f"{track}.png", f"Pareto front of {track}.", text)]
    return Sheet(
        track,
        track.capitalize(),
        [f"Contest: {TRACKS[track]}."],
        [_table(track, table, said, caption)],
        remarks,
        pictures,
    )


def _failures(rows: Sequence[dict]) -> list[str]:
    reasons: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row["status"] != "done":
            reasons.setdefault((row["contestant"], row["reason"]), []).append(row["case"])
    return [f"{name}: no result on {', '.join(cases)}: {reason}" for (name, reason), cases in reasons.items()]


def _case(entry: Entry, case: str) -> Sheet:
    tables, rows = [], [row for row in entry.rows if row["case"] == case]
    for track in dict.fromkeys(row["track"] for row in rows):
        mine = [row for row in rows if row["track"] == track]
        table = {
            row["contestant"]: {**row["numbers"], "seconds": row["seconds"], "memory": (row["memory_bytes"] or 0) / 1e6}
            for row in mine
            if row["status"] == "done"
        }
        tables.append(_table(track, table, {row["contestant"]: row["summary"] for row in mine}, track.capitalize()))
    return Sheet(case, f"Case {case}", (), tables, _failures(rows))


def _time_line(entry: Entry, history: Sequence[Entry]) -> Sheet:
    others = [one for one in history if one.kind == entry.kind and one.file != entry.file]
    line = sorted([*others, entry], key=lambda one: one.when)
    found = [(one, changes(one, previous(one, line))) for one in line]
    rows = []
    for key in dict.fromkeys((c.track, c.contestant, c.number) for _, each in found for c in each):
        own = [{(c.track, c.contestant, c.number): c for c in each}.get(key) for _, each in found]
        if key[1].startswith("holosplat"):
            called = CALLED.get((key[0], key[2])) or CALLED[key[2]]
            rows.append((Cell(f"{key[0]}, {key[1]}: {called}"), *(_change(change) for change in own)))
    head = ("number", *(f"{one.commit[:9]}, {one.when[:10]}" for one in line))
    caption = "holosplat by commit, on this machine; red: worse than in the entry before by 3 % or more"
    text = "Means over the cases that an entry shares with the one before, of one machine, seed and size."
    if len(line) == 1:
        text += " This is the first entry: there is none to compare it with."
    return Sheet("time-line", "Time line", [text], [ScoreTable(head, rows, caption)])


def _change(change: Change | None) -> Cell:
    if change is None:
        return Cell("–")
    said = shown(change.number, change.value)
    if change.worse and change.factor is not None:
        return Cell(f"{said} (worse by {100 * (change.factor - 1):.0f} %)", worse=True)
    return Cell(said)


def _record(entry: Entry) -> ScoreTable:
    said = [("commit", entry.commit or "not a git checkout"), ("run until", entry.when), ("seed", str(entry.seed))]
    said += [*entry.machine.items(), *entry.versions.items()]
    return ScoreTable.of(("record", "value"), said, "Record")


@styled
def pareto_figure(track: str, table: dict[str, dict[str, float]]) -> Figure:
    """Errors of a track's contestants over their processor seconds, logarithmic; holosplat's markers are filled."""
    figure = new_figure(WIDTH, 3.2)
    axes = figure.subplots(1, 1)
    handles, points = [], []
    for n, (name, numbers) in enumerate(table.items()):
        point = (numbers["seconds"], max(numbers["error"], 1e-12))
        colour, marker = CYCLE[n % len(CYCLE)], MARKERS[n % len(MARKERS)]
        style = {"marker": marker, "mec": colour, "mfc": colour if name.startswith("holosplat") else "none", "ms": 5.5}
        axes.plot(*point, ls="none", zorder=3, **style)
        handles.append(Line2D([], [], ls="none", label=name, **style))
        points.append(point)
    axes.set(xscale="log", yscale="log")
    draw_front(axes, points, (1.6, 1.4), lw=0.8)
    axes.set(xlabel="processor time (s)", ylabel=CALLED[track, "error"])
    log_ticks(axes.xaxis)
    log_ticks(axes.yaxis)
    letter(axes, 0, track.capitalize())
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure
