"""Tables of measured data in the docs, from docs/data/real_data.csv alone."""

from __future__ import annotations

from .benchmark import markdown, read, rounded, table

REAL = "python benchmarks/real_data.py --data FOLDER"

Values = dict[tuple[str, str, str], str]
"""(case, method, measure) → value; the last row of a file counts."""
CERTAIN = "capsule dome, light taken as certain"
SCORES = ("held-out SSIM", "correlation", "slope")
FIVE = ("paganin-fbp", "paganin-sirt-nonneg", "paganin-tv-nonneg", "holographic-tv", "volume")


def values() -> Values:
    """All numbers."""
    return {(r["case"], r["method"], r["measure"]): r["value"] for r in read("real_data.csv")}


def three(found: Values, case: str, method: str, measure: str) -> str:
    """A number to three digits."""
    return rounded(found[case, method, measure], 3)


@table("dome", REAL, "half an hour", "real_data.csv")
def dome() -> str:
    """The dome of the capsule, in light found anew and taken as certain; the best of five in bold."""
    found = values()
    first = three(found, "capsule dome", "4 neighbours", "held-out SSIM")
    every = three(found, "capsule dome", "FBP of all", "held-out SSIM")
    dash = ["–"] * 5
    lines = [["mean of 4 neighbouring frames", first, *dash]]
    lines.append(["FBP of all 91, this frame too", every, "1", "1", *dash[2:]])
    for method in FIVE:
        cells = [three(found, case, method, m) for case in ("capsule dome", CERTAIN) for m in SCORES]
        lines.append([f"`{method}`", *cells])
    for column in (1, 5):
        best = max(lines[2:], key=lambda line: float(line[column]))
        best[column] = f"**{best[column]}**"
    head = ("method", "held-out SSIM", "correlation with FBP of all", "slope of µ")
    return markdown((*head, "the same, light taken as certain", "", ""), lines).replace("|  |  |", "| | |", 1)


@table("whole", REAL, "half an hour", "real_data.csv")
def whole() -> str:
    """The whole capsule."""
    found, lines = values(), []
    for method in FIVE:
        ssim, r, slope, r_dome, slope_dome = (
            three(found, "whole capsule", method, m) for m in (*SCORES, "correlation, dome", "slope, dome")
        )
        lines.append([f"`{method}`", ssim, f"{r}, {slope}", f"{r_dome}, {slope_dome}"])
    return markdown(("method", "held-out SSIM", "correlation, slope of µ", "of the dome alone"), lines)


@table("tooth", REAL, "half an hour", "real_data.csv")
def tooth() -> str:
    """Two rows of a tooth."""
    rows = [r for r in read("real_data.csv") if r["case"] == "tooth"]
    found, lines = values(), []
    for method in FIVE[:4]:
        seconds = next(float(r["seconds"]) for r in rows if r["method"] == method)
        lines.append([f"`{method}`", *(three(found, "tooth", method, m) for m in SCORES), f"{seconds:.0f}"])
    return markdown(("method", "held-out SSIM", "correlation with FBP of all", "slope of µ", "time / s"), lines)


@table("hair", REAL, "half an hour", "real_data.csv")
def hair() -> str:
    """One hologram of a spider hair."""
    rows = [r for r in read("real_data.csv") if r["case"] == "spider hair"]
    found, lines = values(), []
    for method in ("paganin", "ctf", "tikhonov", "admm"):
        seconds = next(float(r["seconds"]) for r in rows if r["method"] == method)
        numbers = (three(found, "spider hair", method, m) for m in ("least phase", "at column 400", "background"))
        lines.append([f"`{method}`", *numbers, f"{seconds:.0f}"])
    head = ("method", "least phase (rad)", "across the hair at column 400 (rad)", "background (rad)", "time / s")
    return markdown(head, lines)


@table("bed", "python benchmarks/packed_bed.py --data FOLDER --work FOLDER", "an hour", "real_data.csv")
def bed() -> str:
    """A packed bed, of 8, 4 and 2 views."""
    found, lines = values(), []
    called = {"SIRT in [0, 1]": "SIRT in [0, 1]", "TV in [0, 1]": "total variation in [0, 1]"}
    called["and still light"] = "total variation in [0, 1], and still light"
    for method, label in called.items():
        cells = []
        for views in (8, 4, 2):
            dice, placed = (three(found, f"packed bed, {views} views", method, m) for m in ("Dice", "Dice, placed"))
            cells.append(f"**{dice}** ({placed})" if method == "and still light" else f"{dice} ({placed})")
        lines.append([label, *cells])
    quoted = "non-negative SART in [0, 1], as quoted for these data, options not recorded"
    lines.append([quoted, "0.848", "0.813", "0.767"])
    head = "Dice at half, of the segmentation as published (moved to where frames show it)"
    return markdown((head, "8 views", "4 views", "2 views"), lines)


@table("compact-series", "python benchmarks/compact_series.py NAME RUNS --write", "minutes", "compact_series.csv")
def compact_series() -> str:
    """Objects of several times, in files of their own and in one."""
    lines = list[list[str]]()
    for row in read("compact_series.csv"):
        sizes = (f"{float(row[key]) / 1e3:.0f} kB" for key in ("plain_bytes", "alone_bytes", "series_bytes"))
        lines.append([row["name"], *sizes])
    return markdown(("objects", "as runs hold them", "compact, each by itself", "in one file"), lines)


@table("thick-cell", "python benchmarks/thick_cell.py DATA", "15 minutes", "thick_cell.csv")
def thick_cell() -> str:
    """Straight rays and multislice on the fields of a measured cell."""
    lines = list[list[str]]()
    for row in read("thick_cell.csv"):
        errors = (f"{100 * float(row[name]):.2f} %" for name in ("field", "phase", "fitted"))
        lines.append([row["model"], row["sense"], f"{1e6 * float(row['focus']):.1f}", *errors])
    return markdown(("waves", "sense", "focus / µm", "unseen fields", "unseen phases", "fitted fields"), lines)


@table("cell", "python benchmarks/measured_cell.py --data FOLDER", "a quarter of an hour", "measured_cell.csv")
def cell() -> str:
    """The living cell by default."""
    lines = []
    for row in read("measured_cell.csv"):
        views, distance, photons, *unknown = row["case"].split("-")
        errors = (row[name] for name in ("phase", "mass", "hologram", "seconds"))
        lines.append([views, distance, photons if photons != "0" else "–", "nothing" if unknown else "δ/β", *errors])
    head = ("views", "λz / pixel²", "photons", "told", "held-out phase", "total phase", "held-out hologram")
    return markdown((*head, "processor / s"), lines)


NULLS = {"largest": ("1f58925", "9741492"), "usual": ("15fa4ce", "15fa4ce-dirty"), "one start": ("72147ec",)}
"""Commits by δ/β of the null of first volumes, the second dirty in a file of tests; and with the usual one as the null,
where all fits of the likelihood begin with one volume."""


@table("nothing-told", "python benchmarks/nothing_told.py --data FOLDER", "half an hour", "nothing_told.csv")
def nothing_told() -> str:
    """Scenes of which nothing is told, with the largest and with the usual δ/β as the null, and with one start."""
    found = {(r["family"], int(r["seed"]), r["commit"]): r for r in read("nothing_told.csv")}
    lines = list[list[str]]()
    for (family, seed, _), row in found.items():
        if row["commit"] not in NULLS["usual"]:
            continue
        each = [next((found[family, seed, k] for k in n if (family, seed, k) in found), None) for n in NULLS.values()]
        true = rounded(row["true"], 0) if row["true"] != "nan" else "two"
        ratios = ("–" if r is None else rounded(r["found"], 0) if r["found"] != "nan" else "two" for r in each)
        errors = ("–" if r is None else rounded(r["error"], 3) for r in each)
        seconds = ("–" if r is None else rounded(r["seconds"], 0) for r in each[1:])
        lines.append([family, str(seed), row["use"], true, *ratios, *errors, *seconds])
    columns = [f"{what}, {one}" for what in ("δ/β", "error") for one in NULLS]
    head = ("family", "seed", "made on", "true δ/β", *columns, *(f"processor / s, {one}" for one in list(NULLS)[1:]))
    return markdown(head, sorted(lines, key=lambda one: (one[1] == "106" or one[:2] == ["HL60", "2"], one[2])))


@table("gpu", "python benchmarks/gpu.py --csv docs/data/gpu.csv", "a minute, with a GPU", "gpu.csv")
def gpu() -> str:
    """Kernels, and steps of a fit, on a GPU."""
    lines = list[list[str]]()
    for row in read("gpu.csv"):
        rate = f"{float(row['pairs_per_s']) / 1e9:.0f}" if row["pairs_per_s"] else "–"
        error = f"{float(row['error']):.1e}" if row["error"] else "–"
        lines.append([row["what"], row["way"], rounded(row["ms"], 2), rate, error])
    return markdown(("what", "way", "time / ms", "1e9 pairs/s", "error"), lines)


@table(
    "gpu-runs",
    "python benchmarks/sizes.py --pixels 256 512 --method auto --backend cuda --csv docs/data/gpu_runs.csv, and 256 "
    "pixels with --backend cpu",
    "a minute, with a GPU",
    "gpu_runs.csv",
)
def gpu_runs() -> str:
    """Whole runs by a GPU and by processors of the same machine."""
    lines = list[list[str]]()
    for row in read("gpu_runs.csv"):
        scores = [rounded(row[name], 4) for name in ("ssim", "frcm", "dice", "relative_error_delta")]
        lines.append([row["pixels"], row["machine"], *scores, row["seconds"], row["cpu_seconds"]])
    head = ("pixels", "machine", "SSIM", "FRCM", "Dice", "error of δ", "time / s", "of processors / s")
    return markdown(head, lines)


@table("droplets", "python benchmarks/droplets.py --data FILE", "half an hour", "droplets_forecast.csv")
def droplets() -> str:
    """Forecasts of measured droplets, the nearest to the frame's middle first."""
    rows = sorted(read("droplets_forecast.csv"), key=lambda r: max(abs(float(r["x_px"])), abs(float(r["y_px"]))))
    head = ("x, y (pixels)", "z (mm)", "radius (µm)", "speed (mm/s)", "sightings, later", "missed, at most (pixels)")
    lines = [
        [
            f"{float(r['x_px']):.0f}, {float(r['y_px']):.0f}",
            *(f"{float(r[name]):.1f}" for name in ("z_mm", "radius_um", "speed_mm_s")),
            f"{r['known']}, {r['later']}",
            f"{float(r['missed_px']):.2f}",
            f"{float(r['missed_z_mm']):.2f}",
        ]
        for r in rows
    ]
    return markdown((*head, "missed depth, at most (mm)"), lines)


CELLS = "python benchmarks/red_cells.py FOLDER"
QUANTITIES = {"distance_um": "distance [µm]", "diameter_um": "diameter [µm]", "volume_um3": "volume [µm³]"}
QUANTITIES |= {"optical_volume_um3": "index × volume [µm³]", "dry_mass_pg": "dry mass [pg]"}


@table("red_cells", CELLS, "10 minutes", "red_cells.csv")
def red_cells() -> str:
    """Single cells by their shape at rest: likeliest values, 95 % intervals, and residuals."""
    rows = [r for r in read("red_cells.csv") if r["row"] == "cell"]
    found = {(r["cell"], r["quantity"]): r for r in rows}
    lines = []
    for cell in ("Hypertonic", "Isotonic", "Hypotonic"):
        intervals = []
        for quantity in QUANTITIES:
            one = found[cell, quantity]
            middle, low, high = (f"{float(one[name]):.3g}" for name in ("value", "low", "high"))
            intervals.append(f"{middle} ({low} to {high})")
        left, noise = (rounded(found[cell, name]["value"], 3) for name in ("misfit_rms", "noise_rms"))
        lines.append([cell.lower(), *intervals, f"{left}, {noise}"])
    return markdown(("medium", *QUANTITIES.values(), "residual, noise"), lines)
