"""Tables of alignment in the docs, from docs/data/alignment.csv and few_views.csv alone."""

from __future__ import annotations

from .benchmark import markdown, read, table

ALIGN = "python benchmarks/alignment.py"

Row = dict[str, str]
ERRORS = {
    "1 px, 0.6°": "1 px, 0.6°, 2 %; 12 views",
    "1 px, 0.6°, other errors": "the same, other errors",
    "1 px, 0.6°, 4 views": "the same, 4 views",
    "5 px, 1°, 2000 photons": "5 px, 1°, 5 %, 2000 photons a pixel; 12 views",
    "fine pixels": "1 px, 0.6°, 2 %, first fringe of 2.5 pixels (64 × 64 of 1 µm); 12 views",
    "fine pixels, 2000 photons": "the same, 2000 photons a pixel",
    "soft cells": "1 px, 0.6°, 2 %, soft cells; 12 views",
    "perfect": "none; 12 views",
}
"""Cases and what the docs call them."""
MAGNIFIED = {
    "1 px, 0.6°, 1 % magnification": "1 px, 0.6°, 1 %",
    "1 px, 0.6°, 0.5 % magnification": "1 px, 0.6°, 0.5 %",
    "perfect, magnification free": "none, magnification free",
}
SERIES = {
    "series, 3 beams": "3 beams (`xmpi_3beam`)",
    "series, 3 beams, other errors": "3 beams, other errors",
    "series, 3 beams, third errors": "3 beams, third errors",
    "series, 3 beams, fourth errors": "3 beams, fourth errors",
    "series, 3 beams, 2000 photons": "3 beams, 2000 photons a pixel",
    "series, 3 beams, 2000 photons, other errors": "3 beams, 2000 photons a pixel, other errors",
    "series, 3 beams, drift of 1 px": "3 beams, drifting by about 1 px (before the volumes)",
    "series, 3 beams, perfect": "3 beams, perfect plan",
    "series, 2 beams": "2 beams (`xmpi_2beam`)",
    "series, 2 beams, other errors": "2 beams, other errors",
}
VOLUMES = {
    "volume 12": "12",
    "volume 12, other errors": "12, other errors",
    "volume 4": "4",
    "volume 4, other errors": "4, other errors",
    "perfect, 12 views": "12, plan without errors",
    "perfect, 4 views": "4, plan without errors",
}
MOMENTS = {"planned": "as planned", "aligned": "`align`", "refined": "`--refine`", "true": "known geometry"}


def _rows(case: str, views: str) -> dict[str, Row]:
    """The rows of a case, by moment."""
    return {r["moment"]: r for r in read("alignment.csv") if r["case"] == case and r["views"] == views}


def _change(rows: dict[str, Row], key: str, digits: int, unit: str = "", scale: float = 1.0) -> str:
    """Planned → found."""
    before, after = (f"{scale * float(rows[moment][key]):.{digits}f}" for moment in ("planned", "aligned"))
    return f"{before}{unit} → {after}{unit}" if float(before) else "0 (kept)"


@table("align-errors", ALIGN, "ten minutes", "alignment.csv")
def errors() -> str:
    """Errors of what `align` finds of all views, planned → found."""
    lines = list[list[str]]()
    for case, called in ERRORS.items():
        rows = _rows(case, "all")
        numbers = [_change(rows, "shift_px", 4), _change(rows, "across_deg", 3, "°"), _change(rows, "roll_deg", 3, "°")]
        numbers += [_change(rows, "distance", 1, " %", 100.0), rows["aligned"]["cpu_seconds"]]
        lines.append([called, *numbers])
    head = ("errors of the plan", "shifts (px)", "turns across the beam", "roll", "distances", "processor time / s")
    return markdown(head, lines)


@table("align-magnified", ALIGN, "ten minutes", "alignment.csv")
def magnified() -> str:
    """The same where the magnification is wrong, too."""
    lines = list[list[str]]()
    for case, called in MAGNIFIED.items():
        rows = _rows(case, "all")
        share = f"{100 * float(rows['aligned']['magnification']):.3f} %"
        numbers = [
            _change(rows, key, 3, unit) for key, unit in (("shift_px", ""), ("across_deg", "°"), ("roll_deg", "°"))
        ]
        lines.append([called, share, *numbers])
    return markdown(("errors of the plan", "magnification", "shifts (px)", "turns across the beam", "roll"), lines)


@table("align-volumes", f"{ALIGN} --moments planned aligned refined true", "an hour", "alignment.csv")
def volumes() -> str:
    """Error of δ and Dice of volumes, by where the frames were taken to be."""
    lines = list[list[str]]()
    for case, called in VOLUMES.items():
        rows = [r for r in read("alignment.csv") if r["case"] == case and r["views"] == "volume"]
        for method in dict.fromkeys(r["method"].split()[0] for r in rows):
            found = {r["moment"]: r for r in rows if r["method"].split()[0] == method}
            cells = [_scores(found[moment]) if moment in found else "–" for moment in MOMENTS]
            lines.append([called, method, *cells])
    return markdown(("training views", "method", *MOMENTS.values()), lines)


def _scores(row: Row) -> str:
    return f"{float(row['error_delta']):.3f}, {float(row['dice']):.3f}"


@table("align-series", "python benchmarks/series_alignment.py", "half an hour", "alignment.csv")
def series() -> str:
    """Series of two and three beams."""
    lines = list[list[str]]()
    for case, called in SERIES.items():
        rows = _rows(case, "all")
        numbers = [_change(rows, "shift_px", 3), _change(rows, "roll_deg", 2, "°"), rows["aligned"]["seconds"]]
        lines.append([called, *numbers])
    return markdown(("series", "shifts (px)", "roll", "time / s"), lines)


@table("align-series-volumes", "python benchmarks/series_alignment.py", "an hour", "alignment.csv")
def series_volumes() -> str:
    """Dice of volumes of three times of a series."""
    draws = {"3 beams": "", "other errors": ", other errors", "third errors": ", third errors"}
    draws["fourth errors"] = ", fourth errors"
    lines, moments = list[list[str]](), ("planned", "aligned", "true")
    for called, more in draws.items():
        rows = _rows(f"series, 3 beams{more}", "volume")
        lines.append([called, *(f"{float(rows[m]['dice']):.3f}" if m in rows else "–" for m in moments)])
    columns = list(zip(*(line[1:] for line in lines)))
    means = (f"{sum(map(float, column)) / len(column):.3f}" if "–" not in column else "–" for column in columns)
    lines.append(["mean", *means])
    return markdown(("Dice", "as planned", "`align`", "known geometry"), lines)


@table("few-views", "python benchmarks/few_views.py", "ten minutes", "few_views.csv")
def few_views() -> str:
    """Few views that judge themselves: planned → found ± as said."""
    lines = list[list[str]]()
    for row in read("few_views.csv"):
        numbers = list[str]()
        for kind, digits in (("shift_px", 3), ("across_deg", 2), ("roll_deg", 2)):
            planned, found, said = (float(row[f"{which}_{kind}"]) for which in ("planned", "found", "said"))
            numbers.append(f"{planned:.{digits}f} → {found:.{digits}f} ± {said:.{digits}f}")
        kept = ", ".join(row["as_planned"].split())
        lines.append([row["case"], *numbers, kept])
    return markdown(("frames", "shifts (px)", "turns across the beam (°)", "roll (°)", "as planned"), lines)


@table("calibration", "python benchmarks/calibration.py", "minutes", "calibration.csv")
def calibration() -> str:
    """What a known body leaves of the errors of a plan."""
    lines = list[list[str]]()
    for row in read("calibration.csv"):
        if row["moment"] == "calibrated":
            angles = (f"{float(row[key]):.3f}°" for key in ("across_deg", "roll_deg"))
            lines.append([row["case"], f"{float(row['shift_px']):.4f}", *angles, f"{float(row['distance']):.2%}"])
    for line in lines:
        line[-1] = line[-1].replace("%", " %")
    return markdown(("body", "shifts (px)", "turns across the beam", "roll", "distance"), lines)
