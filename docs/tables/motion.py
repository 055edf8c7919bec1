"""Tables of what moves, from docs/data alone: bodies that are tracked, forecasts, matter, and cells that flow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import Decimal

from .benchmark import Row, markdown, read, rounded, table

FORECAST = "python benchmarks/forecast.py DATA --write"

TRACKED = "python benchmarks/motion.py DATA --write"

BEAMS = {"flow4": "4 over 180°", "flow3": "3 at 0°, 30°, 48°", "flow2": "2 at 0°, 90°", "flow2n": "2 at 0°, 23.8°"}
"""The cases of benchmarks/motion.py, without what their names say of the bodies, in the order of the table."""
KNOWN, UNLEARNED = "-body", "-tomography"
"""Ends of names of cases in which the bodies' shape is known, and in which no network is asked."""
LEFT_OUT = {
    "none": "nothing",
    "acceleration": "acceleration",
    "volume_kept": "volume kept",
    "area_kept": "area kept",
    "apart": "no overlap",
    "bending": "bending",
    "curvature": "smooth shapes",
    "stiffness": "stiff steps",
}
"""What rows of an ablation leave out, and how the page calls it."""
FORECASTS = {"splines": "splines of vertices"} | {name: name for name in ("rigid", "paths", "dynamics", "hybrid")}
"""Ways in which paths go on, and how the page calls them."""
FLOWS = {"fast": "0.12 m/s", "stiff": "cells of 20 µN/m", "dense": "7 % of cells"}
"""Cases of benchmarks/forecast.py that were grown, and what the network did not learn from."""
ALONE = {
    "dynamics alone": "modulus found",
    "wrong shear": "wrong modulus, 50 µN/m",
    "wrong viscosity": "wrong viscosity, 12 mPa s",
    "wrong walls": "walls half as far again, 48 × 36 µm",
}
"""Those without a flow beside each cell."""
NONE = dict.fromkeys(("normal_um", "band_um", "ssim"), "")
"""A row that is not there: dashes."""


# --- bodies that are tracked --------------------------------------------------------------------------------


@table("tracked", f"{TRACKED} --cases flow4 flow3 …", "an hour", "motion.csv")
def tracked() -> str:
    """Beams, and what is known of the bodies, at the first sixteen times."""
    rows = {row["case"]: row for row in read("motion.csv") if (_window(row), row["times"]) == ((0, 1), "16")}
    lines = []
    for end in ("", KNOWN):
        for case, beams in BEAMS.items():
            if (row := rows.get(case + end)) is not None:
                name = f"{beams}, `--body red-cell`" if end else beams
                lines.append([name, *_scores(row, of=True), f"{rounded(row['cpu_seconds'], 0)} s"])
    head = ("beams", *COLUMNS, "processor time")
    return markdown(head, lines)


COLUMNS = (
    "Dice, mean (worst time)",
    "error of occupancy",
    "cells followed",
    "bodies found",
    "centres, median",
    "volume over time",
)


@table("tracked-windows", TRACKED, "half an hour", "motion.csv", "motion_ablation.csv")
def windows() -> str:
    """Four beams at other times; the last columns are errors over standard errors."""
    rows = [row for row in read("motion.csv") if row["case"] == "flow4"]
    rows += [row for row in read("motion_ablation.csv") if row["case"] == "flow4" and row["without"] == "none"]
    lines = []
    for row in sorted(rows, key=lambda row: (_window(row)[1], _window(row)[0])):
        first, every = _window(row)
        last = first + every * (int(row["times"]) - 1)
        shown = f"{first} … {last}" if every == 1 else f"{first}, {first + every} … {last}"
        errors = [_or_nothing(row[f"{name}_over_error"], 2) for name in ("centre", "volume")]
        lines.append([shown, *_scores(row, of=False), *errors])
    return _tight(markdown(("snapshots", *COLUMNS, "centres", "volumes"), lines))


@table("tracked-others", f"{TRACKED} --cases flow2-body --first 8", "an hour", "motion.csv")
def others() -> str:
    """Fewer than four beams at other times; the last columns are errors over standard errors."""
    cases = [case + end for end in ("", KNOWN) for case in BEAMS if case != "flow4"]
    rows = [row for row in read("motion.csv") if row["case"] in cases and row["first"] != "0"]
    lines = []
    for row in sorted(rows, key=lambda row: (cases.index(row["case"]), int(row["first"]))):
        first, _ = _window(row)
        errors = [_or_nothing(row[f"{name}_over_error"], 2) for name in ("centre", "volume")]
        beams, last = BEAMS[row["case"].removesuffix(KNOWN)], first + int(row["times"]) - 1
        shape = ", `--body`" if row["case"].endswith(KNOWN) else ""
        lines.append([beams + shape, f"{first} … {last}", *_scores(row, of=False), *errors])
    return markdown(("beams", "snapshots", *COLUMNS, "centres", "volumes"), lines)


@table("tracked-ablation", f"{TRACKED} --ablation", "an hour", "motion_ablation.csv")
def ablation() -> str:
    """One prior left out at a time."""
    rows = {row["without"]: row for row in read("motion_ablation.csv")}
    lines = []
    for name, said in ((name, said) for name, said in LEFT_OUT.items() if name in rows):
        row = rows[name]
        lines.append(
            [
                said,
                f"{rounded(row['dice'], 4)} ({rounded(row['least_dice'], 4)})",
                _significant(row["error"], 3),
                f"{rounded(row['centre_um'], 4)} µm",
                f"{_percent(row['volume_error'])} %",
                f"± {_percent(row['volume_spread'])} %",
                f"± {_percent(row['area_spread'])} %",
            ]
        )
    head = ("without", *COLUMNS[:2], COLUMNS[4], "volume, error", "volume over time", "area over time")
    return markdown(head, lines)


@table("filter", "python benchmarks/filter.py DATA --cases flow3 flow2n --first 26 --write", "an hour", "filter.csv")
def after_a_forecast() -> str:
    """A window alone, and with the forecast of the window before as prior."""
    rows = sorted(read("filter.csv"), key=lambda row: (list(BEAMS).index(row["case"]), int(row["first"])))
    lines = []
    for row in rows:
        first = int(row["first"]) + int(row["before"])
        errors = [_or_nothing(row[f"{name}_over_error"], 2) for name in ("centre", "volume")]
        lines.append(
            [
                BEAMS[row["case"]],
                f"{first} … {first + int(row['times']) - 1}",
                row["way"],
                f"{rounded(row['dice'], 3)} ({rounded(row['least_dice'], 3)})",
                f"{row['followed']} of {row['cells']}",
                f"{_significant(row['centre_um'], 2)} µm",
                *errors,
                _or_nothing(row["moved"], 1),
                f"{rounded(row['cpu_seconds'], 0)} s",
            ]
        )
    head = ("beams", "snapshots", "by", COLUMNS[0], *COLUMNS[2:5:2], "centres", "volumes", "moved", "processor time")
    return markdown(head, lines)


def _window(row: Row) -> tuple[int, int]:
    return int(row["first"]), int(row["every"])


def _scores(row: Row, of: bool) -> list[str]:
    """The columns of `COLUMNS`; of: whether the number of bodies that there are stands beside those found."""
    return [
        f"{rounded(row['dice'], 3)} ({rounded(row['least_dice'], 3)})",
        _significant(row["error"], 2),
        f"{row['followed']} of {row['cells']}",
        f"{row['bodies']} of 16" if of else row["bodies"],
        f"{_significant(row['centre_um'], 2)} µm",
        f"± {_percent(row['volume_spread'])} %",
    ]


@table("flow-forecast", "python benchmarks/flow_forecast.py", "20 minutes", "flow_forecast.csv")
def matter_ahead() -> str:
    """Matter in motion after the last frames, by each way."""
    named = {"stir4": "stirred", "drift4": "drifting"}
    rows = {(row["case"], int(row["ahead"]), row["way"]): row for row in read("flow_forecast.csv")}
    lines = []
    for case, ahead in sorted({key[:2] for key in rows}, key=lambda key: (list(named).index(key[0]), key[1])):
        ways = [rows[case, ahead, way] for way in ("still", "steady", "inertia", "auto")]
        errors, places = ([rounded(row[name], 3) for row in ways] for name in ("error", "places_since"))
        lines.append([named[case], str(ahead), *errors, f"{places[-1]} µm", f"{rounded(ways[-1]['band'], 3)} µm"])
    head = ("matter", "times ahead", "no change", "steady", "inertia", "auto", "places, auto", "stated")
    return markdown(head, lines)


# --- forecasts ----------------------------------------------------------------------------------------------


@table("forecast", FORECAST, "an hour", "forecast.csv")
def forecast() -> str:
    """How far surfaces are off ahead, by how paths go on; and SSIM of the frames; of each case that was run."""
    rows = read("forecast.csv")
    cases = list(dict.fromkeys(row["case"] for row in rows if row["case"] not in FLOWS))
    cases.sort(key=lambda case: case != "flow4")
    parts = []
    for case in cases:
        found = _by_model(rows, case)
        models = [model for model in FORECASTS if model in found]
        lines = []
        for ahead in _aheads(found):
            ssim = ", ".join(rounded(found[m].get(ahead, NONE)["ssim"], 3) for m in SEEN if m in found)
            lines.append([ahead, *(_miss(found[model].get(ahead, NONE)) for model in models), ssim])
        head = ("times ahead", *(FORECASTS[m] for m in models), f"SSIM of {', '.join(m for m in SEEN if m in found)}")
        parts.append(("" if case == "flow4" else f"*{_named(case)}*\n\n") + markdown(head, lines))
    return "\n\n".join(parts)


SEEN = ("splines", "paths", "hybrid")
"""Ways whose frames are scored in the table."""


@table("forecast-learned", FORECAST, "an hour", "forecast.csv")
def learned_forecasts() -> str:
    """What was learnt beside paths and mechanics, of each case in which the network was asked."""
    rows, parts = read("forecast.csv"), []
    for case in dict.fromkeys(row["case"] for row in rows if row["model"] == "graph" and row["case"] not in FLOWS):
        found = _by_model(rows, case)
        models = [model for model in LEARNED if model in found]
        lines = [[ahead, *(_miss(found[m].get(ahead, NONE)) for m in models)] for ahead in _aheads(found)]
        parts.append(f"*{_named(case)}*\n\n" + markdown(("times ahead", *(LEARNED[m] for m in models)), lines))
    return "\n\n".join(parts)


LEARNED = {
    "splines": "splines of vertices",
    "paths": "paths",
    "dynamics": "mechanics",
    "graph": "graph network",
    "hybrid": "hybrid",
    "dmd": "DMD",
    "sindy": "SINDy",
}


@table("forecast-flows", "python benchmarks/forecast.py --case fast --keep FOLDER --write", "minutes", "forecast.csv")
def flows() -> str:
    """Cells in flows that the network did not learn from, begun with themselves, at two times ahead."""
    rows, lines = read("forecast.csv"), []
    models = [model for model in LEARNED if model not in ("dmd", "sindy")]
    for case, said in FLOWS.items():
        found = _by_model(rows, case)
        for ahead in ("10", "25"):
            held = ", ".join(rounded(found[m].get(ahead, NONE)["held"], 2) for m in ("dynamics", "graph", "hybrid"))
            lines.append([said, ahead, *(_miss(found[m].get(ahead, NONE)) for m in models), held])
    head = ("flow", "times ahead", *(LEARNED[m] for m in models), "held by 90 %: mechanics, network, hybrid")
    return markdown(head, lines)


@table("forecast-mechanics", FORECAST, "an hour", "forecast.csv")
def mechanics() -> str:
    """The modulus found, and a wrong one, without a flow beside each cell."""
    found = _by_model(read("forecast.csv"), "flow4")
    aheads = _aheads(found)
    lines = [["times ahead", *aheads]]
    for model, said in ALONE.items():
        numbers = dict(part.split("=") for part in found[model][aheads[0]]["found"].split())
        shear = f" ({1e6 * float(numbers['shear_n_m']):.1f} µN/m)"
        name = said + (shear if model == "dynamics alone" else "")
        lines.append([name, *(_miss(found[model][ahead]) for ahead in aheads)])
    head = ("without a flow beside each cell", *[""] * len(aheads))
    return _tight(markdown(head, lines))


def _by_model(rows: Sequence[Row], case: str) -> dict[str, dict[str, Row]]:
    """Rows of a case by model and times ahead."""
    found: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row["case"] == case:
            found.setdefault(row["model"], {})[row["ahead"]] = row
    return found


def _aheads(found: dict[str, dict[str, Row]]) -> list[str]:
    return sorted({ahead for rows in found.values() for ahead in rows}, key=int)


def _miss(row: Row) -> str:
    """The distance, and the standard error that was said, where one was [µm]."""
    band = row["band_um"]
    return rounded(row["normal_um"], 3) + ("" if band in ("", "nan") else f" / {rounded(band, 3)}")


def _named(case: str) -> str:
    if case == "true":
        return "Begun with the cells themselves, nothing tracked"
    beams = BEAMS[case.removesuffix(KNOWN).removesuffix(UNLEARNED)]
    return f"{beams}, `--body red-cell`" if case.endswith(KNOWN) else beams


# --- matter -------------------------------------------------------------------------------------------------

SERIES = {"stir4": "stirred blob", "foam4": "collapsing foam", "burst4": "burst", "fade4": "stirred blob that fades"}
FADING = "all times in one, fading"
WAYS = ("all times in one", "each time by itself", "mean", "one time of all photons")


@table("moving-matter", "python benchmarks/moving_matter.py --write", "ten minutes", "moving_matter.csv")
def moving_matter() -> str:
    """Relative errors of δ, mean (worst time)."""
    rows = {(row["case"], row["method"]): row for row in read("moving_matter.csv")}
    lines = []
    for case, said in SERIES.items():
        cells = [_error(rows.get((case, way))) for way in (WAYS[0], FADING, *WAYS[1:])]
        still = rows[case, WAYS[0]]["said"] == "nothing moves"
        seconds = rounded(rows[case, WAYS[0]]["cpu_seconds"], 0)
        lines.append([said + (", found to stand still" if still else ""), *cells, f"{seconds} s"])
    head = ("series", WAYS[0], "`--fading 0.3`", WAYS[1], "mean of all times", WAYS[3], "processor time")
    return _tight(markdown(head, lines))


def _error(row: Row | None) -> str:
    if row is None:
        return ""
    mean, worst = rounded(row["error"], 3), rounded(row["worst"], 3)
    return mean if row["method"] == WAYS[3] else f"{mean} ({worst})"


# --- cells that flow ----------------------------------------------------------------------------------------


@table("espresso", "python benchmarks/espresso_flow.py DATA", "minutes", "espresso_flow.csv")
def espresso() -> str:
    """Sixteen cells beside ESPResSo's: drift, shape, elongation, volume and area."""
    rows = read("espresso_flow.csv")

    def line(said: str, names: str, shown: Callable[[list[float]], str], factor: float = 1.0) -> list[str]:
        """Both programs' values of columns `names`, cell by cell, times `factor`."""
        found = []
        for who in ("espresso", "here"):
            found.append(shown([factor * float(row[f"{who}_{name}"]) for name in names.split() for row in rows]))
        return [said, *found]

    share = lambda v: f"{min(v):+.2f} %, {max(v):+.2f} %"  # noqa: E731
    mean = lambda digits: lambda v: f"{sum(v) / len(v):.{digits}f}"  # noqa: E731
    most = lambda digits: lambda v: f"{max(v):.{digits}f}"  # noqa: E731
    lines = [
        line("drift speed, mean over cells / mm/s", "drift_m_s", mean(2), 1e3),
        line("drift speed, slowest and fastest cell / mm/s", "drift_m_s", lambda v: f"{min(v):.1f}, {max(v):.1f}", 1e3),
        line("shape change since the start at the end, mean over cells / µm", "shape_change_m", mean(2), 1e6),
        line("shape change, mean over cells and time / µm", "mean_shape_change_m", mean(2), 1e6),
        line("shape change, greatest / µm", "greatest_shape_change_m", most(2), 1e6),
        line("elongation, mean over cells and time", "elongation", mean(3)),
        line("elongation, greatest", "greatest_elongation", most(3)),
        line("volume against rest, least and greatest", "least_volume greatest_volume", share, 100),
        line("area against rest, least and greatest", "least_area greatest_area", share, 100),
    ]
    return _tight(markdown(("", "ESPResSo", "here"), lines))


# --- numbers ------------------------------------------------------------------------------------------------


def _significant(value: str, digits: int) -> str:
    """A number with so many significant digits, not in powers of ten."""
    number = Decimal(value)
    return rounded(value, max(0, digits - 1 - number.adjusted()))


def _percent(share: str) -> str:
    """A share in per cent: two decimals, one where it is above one."""
    text = f"{100 * float(share):.10f}"
    return rounded(text, 2 if float(text) < 1 else 1)


def _or_nothing(value: str, digits: int) -> str:
    return "" if value in ("", "nan") else rounded(value, digits)


def _tight(table: str) -> str:
    """Empty cells of one blank, as the pages have them."""
    while "|  |" in table:
        table = table.replace("|  |", "| |")
    return table
