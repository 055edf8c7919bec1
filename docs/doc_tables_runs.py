"""Tables of single studies in the docs, from docs/data alone; `docs/figures.py` puts them into the pages."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from doc_tables import DATA, Row, markdown, read, rounded

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
MAIN_SEEDS = ("101", "102", "103")
HARDER = ("nine", "free", "ratio", "noise", "poses", "plasma")


def script(name: str) -> ModuleType:
    """benchmarks/NAME.py, whose own function makes the table."""
    if str(BENCHMARKS) not in sys.path:
        sys.path.append(str(BENCHMARKS))
    return importlib.import_module(name)


def propagation() -> str:
    """The benchmark's frames beside other programs."""
    return "\n".join(script("propagation").summary(read("propagation.csv")))


def ablation() -> str:
    """What each ingredient is worth."""
    of = script("ablation")
    return "\n".join(of.summary(of.read(DATA / "ablation.csv")))


def trials() -> str:
    """What was tried and left out: SSIM / FRCM, Dice / error of δ."""
    rows = read("trials.csv")
    cases = ("cells8", "noise12-2000", "thesis16", "foam12")
    lines = []
    for trial in dict.fromkeys(r["trial"] for r in rows):
        own = {r["case"]: r for r in rows if r["trial"] == trial}
        lines.append([trial, *(_four(own[case]) for case in cases)])
    return markdown(("trial", *(f"`{case}`" for case in cases)), lines)


def _four(row: Row) -> str:
    ssim, frcm, dice, error = (rounded(row[n], 3) for n in ("ssim", "frcm", "dice", "relative_error_delta"))
    return f"{ssim} / {frcm}, {dice} / {error}"


def neural_options() -> str:
    """Options of neural fields."""
    return _fields("neural", "ed18f76")


def voxel_options() -> str:
    """Options of voxels."""
    return _fields("voxels", "6e3bb1e")


def _fields(method: str, commit: str) -> str:
    numbers = ("relative_error_delta", "dice", "ssim", "frcm")
    rows: list[dict[str, Any]] = [
        r | {n: float(r[n]) for n in numbers} for r in read("tune_fields.csv") if r["commit"] == commit
    ]
    return "\n".join(script("tune_fields").table(rows, method))


def verdicts() -> str:
    """Right and wrong runs."""
    lines = []
    for row in read("verdicts.csv"):
        numbers = [row[n] or "–" for n in ("error", "total", "over_contrast", "over_noise", "over_allowed")]
        lines.append([row["case"], *numbers, "explained" if row["good"] == "True" else "not explained"])
    head = ("run", "error of δ", "total δ over the true", "residual over contrast", "over noise")
    return markdown((*head, "over what is allowed", "verdict"), lines)


def imaging_chain() -> str:
    """The cost of each imperfection."""
    names = ("ssim", "frcm", "dice", "relative_error_delta")
    lines = [[r["imperfection"], *(rounded(r[n], 3) for n in names)] for r in read("imaging_chain.csv")]
    return markdown(("imperfection", "SSIM", "FRCM", "Dice", "relative error of δ"), lines)


def imperfections() -> str:
    """Motion and misalignment: what they do to a reconstruction."""
    names = ("ssim", "dice", "relative_error_delta")
    lines = [[r["case"], *(rounded(r[n], 3) for n in names)] for r in read("simulation_imperfections.csv")]
    return markdown(("", "SSIM of held-out views", "Dice", "relative error of δ"), lines).replace("|  |", "| |", 1)


def fibre() -> str:
    """A fibre in uneven light, by method: one frame, or from the least to the greatest of several seeds."""
    lights = {"even": "even light", "noise": "even light, 1900 photons"}
    lights["uneven"] = "the same, uneven and grainy, {} seeds"
    rows, lines = read("fibre.csv"), []
    for light, called in lights.items():
        for method in ("tikhonov", "admm", "ctf"):
            own = [r for r in rows if (r["light"], r["method"]) == (light, method)]
            cells = []
            for name in ("error", "total", "least_phase", "air"):
                values = sorted({float(r[name]) for r in own})
                cells.append(" to ".join(f"{v:.3f}" for v in dict.fromkeys((values[0], values[-1]))))
            lines.append([called.format(len(own)), f"`{method}`", *cells])
    head = ("frame", "method", "error", "total phase over the true", "least phase (rad; true -1.149)", "air (rad)")
    return markdown(head, lines)


def skalak() -> str:
    """Optical tweezers, Skalak's law."""
    return _tweezers("Skalak")


def springs() -> str:
    """Optical tweezers, springs of which a part does not soften."""
    return _tweezers("springs")


def _tweezers(model: str) -> str:
    of = script("tweezers")
    found = []
    for row in read("tweezers.csv"):
        if (row["model"], row["nodes"]) == (model, "362"):
            values = [float(row[n]) for n in ("force_n", "axial_m", "transverse_m", "area_change", "volume_change")]
            found.append(of.Stretched(*values, 0.0, None))
    return "\n".join(of.table(found))


# --- the main job -------------------------------------------------------------------------------------------


def main_job() -> str:
    """24 cells, each seed, Gaussians and surfaces."""
    return _jobs([r for r in read("main_job.csv") if r["case"] == "cells"])


def harder() -> str:
    """The harder jobs that were run."""
    rows = read("main_job.csv")
    return _jobs([r for case in HARDER for r in rows if r["case"] == case])


def snapshot() -> str:
    """Cells of an ESPResSo run."""
    return _jobs([r for r in read("main_job.csv") if r["case"] == "snapshot"])


def _jobs(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        name = row["case"] + (f", {row['seed']}" if row["case"] != "snapshot" else " 049")
        name += ", surfaces" if row["method"] == "surfaces" else ""
        deviation = f"{100 * (float(row['mean_delta']) / float(row['true_mean_delta']) - 1):+.1f} %"
        scores = [rounded(row[n], d) for n, d in (("ssim", 3), ("frcm", 3), ("psnr", 1), ("dice", 3))]
        ratio = f"{float(row['ratio']):.0f}" + ("" if row["single_material"] == "True" else " (found)")
        last = [rounded(row["relative_error_delta"], 3), ratio, row["gaussians"].replace("0", "–", 1)
                if row["gaussians"] == "0" else row["gaussians"], rounded(row["cpu_seconds"], 0)]  # fmt: skip
        lines.append([name, *scores, deviation, *last])
    head = ("case, seed", "SSIM", "FRCM", "PSNR / dB", "Dice", "mean δ", "error of δ", "δ/β", "Gaussians")
    return markdown((*head, "processor time / s"), lines)


def worst() -> str:
    """README's: the worst of three scenes."""
    rows = [r for r in read("main_job.csv") if r["case"] == "cells"]
    parts = [[r for r in rows if r["method"] == method] for method in ("gaussians", "surfaces")]
    lines = []
    called = {"ssim": "SSIM of held-out views", "frcm": "FRCM of held-out views", "dice": "Dice of the volume"}
    for name, label in called.items():
        lines.append([label, *(f"{min(float(r[name]) for r in part):.3f}" for part in parts)])
    errors = (max(float(r["relative_error_delta"]) for r in part) for part in parts)
    lines.append(["relative error of δ", *(f"{e:.3f}" for e in errors)])
    off = ([100 * (float(r["mean_delta"]) / float(r["true_mean_delta"]) - 1) for r in part] for part in parts)
    lines.append(["mean δ inside the cells", *(f"{max(o, key=abs):+.1f} %" for o in off)])
    alone, both = ({r["seed"]: float(r["cpu_seconds"]) for r in part} for part in parts)
    more = max(both[s] - alone[s] for s in alone)
    lines.append(["processor time", f"{math.ceil(max(alone.values()))} s", f"{math.ceil(more)} s more"])
    return markdown(("", "Gaussians (`reconstruct`)", "surfaces fitted from them (`surface`)"), lines).replace(
        "|  |", "| |", 1
    )
