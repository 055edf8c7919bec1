"""Tables of what is learnt, and of families of methods beside each other, from docs/data alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from .benchmark import Row, markdown, read, rounded, table

STARTS = {"The run began with the": "guess", "The run began with phase": "phase", "The frames contradict": "refused"}
STARTS |= {"The run began with red cells": "red cells"}
STARTS |= {"start: network": "guess", "start: phase": "phase", "start: red cells": "red cells"}
"""What a run of this or an earlier version says of its start, by its first words, and what the table says."""
TAKEN = tuple(first for first, word in STARTS.items() if word in ("guess", "red cells"))
"""First words of runs that began with the guess, or with cells of its size."""
SCORES = ("dice", "ssim", "frcm")
"""Scores of which more is better."""


@table("learned", "python benchmarks/learned.py DATA --write", "half an hour", "learned.csv")
def learned() -> str:
    """Runs with and without a learned start, and the guess itself, by case, scene and number of views."""
    lines = []
    for (case, scene, views), rows in sorted(_learned().items()):
        fitted = [[rounded(r[name], 3) for name in ("dice", "error", "frcm")] for r in (rows["phase"], rows["learned"])]
        said = rows["learned"]["begun"]
        begun = next((word for first, word in STARTS.items() if said.startswith(first)), "not asked")
        lines.append(
            [f"{case}, {scene}", str(views), rounded(rows["guess"]["dice"], 3), *map(" / ".join, fitted), begun]
        )
    columns = (
        "scene",
        "views",
        "Dice of the guess",
        "without: Dice / error of δ / FRCM",
        "with `--start learned`",
        "begun with",
    )
    return markdown(columns, lines)


@table("ellipsoids", "python benchmarks/ellipsoids.py --write", "hours", "ellipsoids.csv")
def ellipsoids() -> str:
    """PSNR, SSIM of the volume and SSIM of held-out frames, by kind of scene, method and number of views."""
    rows = read("ellipsoids.csv")
    found = {(r["kind"], r["method"], r["views"], r["seed"]): r for r in rows}
    kinds, methods = (list(dict.fromkeys(r[name] for r in rows)) for name in ("kind", "method"))
    lines = []
    for kind in kinds:
        empty = {r["seed"]: float(r["empty"]) for r in rows if r["kind"] == kind}
        lines.append([kind, "an empty volume", *[rounded(f"{sum(empty.values()) / len(empty):.6f}", 1)] * 3])
        for method in methods:
            cells = list[str]()
            for views in ("4", "7", "9"):
                own = [found[key] for key in sorted(found) if key[:3] == (kind, method, views)]
                means = [f"{sum(float(r[n]) for r in own) / len(own):.6f}" for n in ("psnr", "ssim", "held_out") if own]
                said = " / ".join(rounded(v, d) for v, d in zip(means, (1, 3, 3)))
                cells.append(f"{said} ({len(own)})" if own else "–")
            if any(cell != "–" for cell in cells):
                lines.append([kind, f"`{method}`", *cells])
    return markdown(("scenes", "method", "4 views", "7 views", "9 views"), lines)


@table("learned_change", "python benchmarks/learned.py DATA --write", "half an hour", "learned.csv")
def learned_change() -> str:
    """By what scores of runs with a learned start differ from those without, by case."""
    found: dict[str, list[dict[str, dict[str, str]]]] = {}
    for (case, _, _), rows in sorted(_learned().items()):
        found.setdefault(case, []).append(rows)
    lines = []
    for case, each in found.items():
        changes = [[float(r["learned"][name]) - float(r["phase"][name]) for r in each] for name in (*SCORES, "error")]
        spans = [f"{min(values):+.3f} to {max(values):+.3f}".replace("-", "−") for values in changes]
        taken = sum(r["learned"]["begun"].startswith(TAKEN) for r in each)
        lines.append([case, str(len(each)), str(taken), *spans])
    columns = ("bodies", "runs", "began with the guess, or cells of its size", "Dice", "SSIM", "FRCM", "error of δ")
    return markdown(columns, lines)


def _learned() -> dict[tuple[str, int, int], dict[str, dict[str, str]]]:
    """Rows by case, scene and number of views, and then by start; of those that were run to their end."""
    found: dict[tuple[str, int, int], dict[str, dict[str, str]]] = {}
    for row in read("learned.csv"):
        found.setdefault((row["case"], int(row["scene"]), int(row["views"])), {})[row["start"]] = row
    return {key: rows for key, rows in found.items() if len(rows) == 3}


@table("aligned-inference", "python benchmarks/aligned_inference.py --write", "a minute", "aligned_inference.csv")
def aligned_inference() -> str:
    """Seconds in which a pixel-aligned field says its values, as fits do and without gradients."""
    lines = []
    for row in read("aligned_inference.csv"):
        first, second = float(row["forward"]), float(row["told"])
        voxels = f"{row['where']}: {int(row['voxels']):,}".replace(",", " ")
        lines.append([row["views"], voxels, f"{first:.2f}", f"{second:.2f}", f"{first / second:.1f}", row["apart"]])
    columns = ("views", "voxels", "before / s", "now / s", "times faster", "largest difference over the spread")
    return markdown(columns, lines)


SEEN = ("nothing", "frames", "frames, adversary 0.1")
"""What weights of `onix` were learnt from, in the order of the table."""


@table("onix-scenes", "python benchmarks/onix_scenes.py FOLDER --write", "an hour", "onix_scenes.csv")
def onix_scenes() -> str:
    """Scores of `onix` on scenes that it has not seen, each scene, by what it learnt from and number of views."""
    rows = read("onix_scenes.csv")
    lines = []
    for views in sorted({r["views"] for r in rows}):
        for weights in SEEN:
            for fitted in sorted({r["fitted"] for r in rows}, key=int):
                own = [r for r in rows if (r["views"], r["weights"], r["fitted"]) == (views, weights, fitted)]
                own.sort(key=lambda r: (int(r["scene"]), int(r["seed"])))
                if own:
                    scores = (", ".join(rounded(r[n], 3) for r in own) for n in ("dice", "error", "ssim", "frcm"))
                    lines.append([views, weights, fitted, *scores])
    columns = ("views", "learnt from", "steps on the scan", "Dice", "error of δ", "SSIM", "FRCM")
    return markdown(columns, lines)


FEW = {
    "paganin-fbp": "Paganin, FBP",
    "paganin-tv": "Paganin, TV in the box",
    "tikhonov-tv": "nonlinear Tikhonov, TV in the box",
    "holographic-tv": "holographic TV",
    "alpha-3dgs": "opaque splats, as photographs",
    "nerf": "NeRF, as photographs",
    "neural-field": "neural field",
    "onix": "`onix`, of this scan alone",
    "gaussians": "Gaussians",
    "surfaces": "surfaces, from Gaussians",
    "phase": "`auto`",
    "learned": "`auto --start learned`",
}
"""What the table of few views shows: methods of few_families.csv and of the benchmark, then starts of learned.csv."""
FEW_VIEWS, FEW_CASE, FEW_SCENE = ("2", "3", "4"), "espresso", "5"
SCORED = ("dice", "error", "frcm")
OF_SUITE = {"dice": "dice", "error": "relative_error_delta", "frcm": "frcm"}
"""Names of these scores in rows of the benchmark."""


@table(
    "few-families",
    "python benchmarks/few_families.py DATA --write, python benchmarks/learned.py DATA --write",
    "half an hour",
    "few_families.csv",
    "learned.csv",
    "photographs.csv",
    "families.csv",
    "benchmark.csv",
)
def few_families() -> str:
    """Families of methods in two, three and four views of one scene, and in four of one of the suite."""
    suite = {
        r["method"]: {name: r[column] for name, column in OF_SUITE.items()}
        for file in ("photographs.csv", "families.csv", "benchmark.csv")
        for r in read(file)
        if (r["case"], r["seed"]) == ("cells4", "101")
    }
    found = {(r["method"], r["views"]): r for r in read("few_families.csv") if r["scene"] == FEW_SCENE}
    for row in read("learned.csv"):
        if (row["case"], row["scene"]) == (FEW_CASE, FEW_SCENE):
            found[row["start"], row["views"]] = row
    lines = []
    for method, label in FEW.items():
        own = [*(found.get((method, views)) for views in FEW_VIEWS), suite.get(method)]
        lines.append([label, *("not run" if row is None else _scores(row) for row in own)])
    return markdown(("method", *(f"{views} views" for views in FEW_VIEWS), "4 views, `cells4`"), lines)


def _scores(row: Row) -> str:
    return " / ".join(rounded(row[name], 3) for name in SCORED).replace("-0.000", "0.000").replace("-", "−")


@table(
    "moving-families",
    "python benchmarks/motion.py DATA --write, and pinn.py and moving_matter.py with --write",
    "hours",
    "motion.csv",
    "pinn.csv",
    "moving_matter.csv",
)
def moving_families() -> str:
    """What joins times: Dice and error of δ, means over times and seeds, beside each time by itself."""
    lines = []
    for label, file, chosen, dice, error in MOVING:
        cells = list[str]()
        for views in FEW_VIEWS:
            own = [row for row in read(file) if chosen(row, views)]
            means = [sum(float(row[name]) for row in own) / len(own) for name in (dice, error) if own and name]
            cells.append(" / ".join(f"{value:.3f}" for value in means) + f" ({len(own)})" if own else "not run")
        lines.append([label, *cells])
    return markdown(("method", *(f"{views} views" for views in FEW_VIEWS)), lines)


Chosen = Callable[[Row, str], bool]


def _tracked(end: str) -> Chosen:
    return lambda row, views: (
        (row["case"], row["first"], row["without"]) == (f"flow{views}{end}", "0", "none") and (row["every"] == "1")
    )


def _pinn(equations: str) -> Chosen:
    return lambda row, views: (row["case"], row["views"], row["equations"]) == ("channel", views, equations)


def _flow(method: str) -> Chosen:
    return lambda row, views: (row["case"], row["method"]) == (f"stir{views}", method)


MOVING: Sequence[tuple[str, str, Chosen, str, str]] = (
    ("16 cells in flow: `track`", "motion.csv", _tracked(""), "dice", "error"),
    ("16 cells in flow: `track --body`, the rest shape is known", "motion.csv", _tracked("-body"), "dice", "error"),
    ("4 cells in a channel: each time by itself", "pinn.csv", _pinn("start"), "dice", "error"),
    ("4 cells in a channel: one field of space and time", "pinn.csv", _pinn("none"), "dice", "error"),
    ("4 cells in a channel: `pinn`, with equations of flow", "pinn.csv", _pinn("curl"), "dice", "error"),
    ("stirred continuous matter: each time by itself", "moving_matter.csv", _flow("each time by itself"), "", "error"),
    ("the same: `reconstruct --motion flow`", "moving_matter.csv", _flow("all times in one"), "", "error"),
)
"""What is shown of motion: label, file, which rows, and the columns of Dice (empty: not measured) and error of δ."""
