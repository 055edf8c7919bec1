"""Tables of single studies in the docs, from docs/data alone; `docs/figures.py` puts them into the pages."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from .benchmark import DATA, Row, markdown, read, rounded, table

MAIN_JOB = "python benchmarks/main_job.py --seeds 311 312 313 --csv FILE --preset auto, and again with --surfaces alone"

DECIDED = "python benchmarks/families.py --data FOLDER"

BEFORE_TURNS = "755086a0cc"
"""The commit of the rows of few_photons.csv to compare with."""
BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def script(name: str) -> ModuleType:
    """benchmarks/NAME.py, whose own function makes the table."""
    if str(BENCHMARKS) not in sys.path:
        sys.path.append(str(BENCHMARKS))
    return importlib.import_module(name)


@table(
    "propagation",
    "python benchmarks/propagation.py --snapshots DIR --csv docs/data/propagation.csv",
    "ten minutes",
    "propagation.csv",
)
def propagation() -> str:
    """The benchmark's frames beside other programs."""
    return "\n".join(script("propagation").summary(read("propagation.csv")))


@table(
    "ablation", "python benchmarks/ablation.py --snapshots DIR --csv docs/data/ablation.csv", "hours", "ablation.csv"
)
def ablation() -> str:
    """What each ingredient is worth."""
    of = script("ablation")
    return "\n".join(of.summary(of.read(DATA / "ablation.csv")))


@table("trials", "python benchmarks/trials.py --csv docs/data/trials.csv", "an hour", "trials.csv")
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


@table("neural-options", "python benchmarks/tune_fields.py --csv FILE", "hours", "tune_fields.csv")
def neural_options() -> str:
    """Options of neural fields."""
    return _fields("neural", "ed18f76")


@table("voxel-options", "python benchmarks/tune_fields.py --csv FILE", "an hour", "tune_fields.csv")
def voxel_options() -> str:
    """Options of voxels."""
    return _fields("voxels", "6e3bb1e")


def _fields(method: str, commit: str) -> str:
    numbers = ("relative_error_delta", "dice", "ssim", "frcm")
    rows: list[dict[str, Any]] = [
        r | {n: float(r[n]) for n in numbers} for r in read("tune_fields.csv") if r["commit"] == commit
    ]
    return "\n".join(script("tune_fields").table(rows, method))


@table("verdicts", "python benchmarks/verdicts.py, and again with --summary", "an hour", "verdict_words.csv")
def verdicts() -> str:
    """What the verdict says of right and wrong runs."""
    names = ("mistake", "result", "runs", "consistent", "limited", "called wrong", "cause named")
    lines = [[row[name] or "–" for name in names] for row in read("verdict_words.csv")]
    return markdown(names, lines)


@table("imaging-chain", "python docs/figures.py imaging-chain WORK", "ten minutes", "imaging_chain.csv")
def imaging_chain() -> str:
    """The cost of each imperfection."""
    names = ("ssim", "frcm", "dice", "relative_error_delta")
    lines = [[r["imperfection"], *(rounded(r[n], 3) for n in names)] for r in read("imaging_chain.csv")]
    return markdown(("imperfection", "SSIM", "FRCM", "Dice", "relative error of δ"), lines)


@table("imperfections", "python docs/figures.py simulation", "minutes", "simulation_imperfections.csv")
def imperfections() -> str:
    """Motion and misalignment: what they do to a reconstruction."""
    names = ("ssim", "dice", "relative_error_delta")
    lines = [[r["case"], *(rounded(r[n], 3) for n in names)] for r in read("simulation_imperfections.csv")]
    return markdown(("", "SSIM of held-out views", "Dice", "relative error of δ"), lines).replace("|  |", "| |", 1)


@table("fibre", "python benchmarks/fibre.py", "ten minutes", "fibre.csv")
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


@table("skalak", "python benchmarks/tweezers.py", "minutes", "tweezers.csv")
def skalak() -> str:
    """Optical tweezers, Skalak's law."""
    return _tweezers("Skalak")


@table("springs", "python benchmarks/tweezers.py", "minutes", "tweezers.csv")
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

WAYS = {
    ("auto", "surfaces"): "`reconstruct`",
    ("default", "gaussians"): "`--method gaussians`",
    ("default", "surfaces"): "`surface` after these",
}
"""Preset and result of a row → how a user comes to it."""


def jobs() -> list[dict[str, Any]]:
    """The main job's rows, alone on the machine: three seeds, each of `WAYS`."""
    texts = {"case", "seed", "preset", "method", "single_material", "commit"}
    return [{k: v if k in texts else float(v) for k, v in row.items()} for row in read("main_job_idle.csv")]


def deviation(row: Mapping[str, Any]) -> float:
    """Of the mean δ inside the true cells [%]."""
    return 100 * (float(row["mean_delta"]) / float(row["true_mean_delta"]) - 1)


@table("main-job", MAIN_JOB, "five minutes", "main_job_idle.csv")
def main_job() -> str:
    """24 cells, each seed, each of `WAYS`."""
    named = [row | {"name": f"{row['seed']}, {WAYS[row['preset'], row['method']]}"} for row in jobs()]
    return _jobs(sorted(named, key=lambda row: row["seed"]), "seconds", "time / s")


def _jobs(rows: Sequence[Mapping[str, Any]], seconds: str, called: str) -> str:
    lines = []
    for row in rows:
        name = "snapshot 049" if row["case"] == "snapshot" else f"{row['case']}, {row['seed']}"
        name = row.get("name", name + (", surfaces" if row["method"] == "surfaces" else ""))
        digits = {"ssim": 3, "frcm": 3, "psnr": 1, "dice": 3}
        scores = [rounded(str(row[score]), n) for score, n in digits.items()]
        error, ratio = rounded(str(row["relative_error_delta"]), 3), rounded(str(row["ratio"]), 0)
        ratio += "" if str(row["single_material"]) == "True" else " (found)"
        count = str(int(row["gaussians"])) if int(row["gaussians"]) else "–"
        lines.append([name, *scores, f"{deviation(row):+.1f} %", error, ratio, count, rounded(str(row[seconds]), 0)])
    head = ("case, seed", "SSIM", "FRCM", "PSNR / dB", "Dice", "mean δ", "error of δ", "δ/β", "Gaussians")
    return markdown((*head, called), lines)


@table(
    "rerun",
    "OMP_NUM_THREADS=1 python benchmarks/main_job.py --cases cells nine ratio free noise poses plasma --surfaces --csv "
    "docs/data/main_job.csv",
    "an hour",
    "main_job.csv",
)
def rerun() -> str:
    """The generated jobs whose rows stand in main_job.csv."""
    return _rerun(lambda case: case != "snapshot")


@table(
    "snapshot",
    "OMP_NUM_THREADS=1 python benchmarks/main_job.py --cases snapshot --meshes DIR/rbc*_049.vtk --surfaces --csv "
    "docs/data/main_job.csv",
    "two minutes",
    "main_job.csv",
)
def snapshot() -> str:
    """The job of another program's cells."""
    return _rerun(lambda case: case == "snapshot")


def _rerun(wanted: Callable[[str], bool]) -> str:
    return _jobs([row for row in read("main_job.csv") if wanted(row["case"])], "cpu_seconds", "processor time / s")


@table(
    "sizes",
    "python benchmarks/sizes.py --pixels 128 256 512 1024 --method auto --csv docs/data/sizes.csv",
    "minutes",
    "sizes.csv",
)
def sizes() -> str:
    """Frames of more and more pixels across the same field."""
    lines = []
    for row in read("sizes.csv"):
        scores = [row["ssim"], row["frcm"], row["dice"], row["relative_error_delta"]]
        scores = [rounded(score, 3) for score in scores]
        times = [f"{float(row[name]):.0f}" for name in ("seconds", "cpu_seconds")]
        of = [row["pixels"], row["pitch_um"], f"{row['bodies']} of {row['diameter_um']}", row["method"], row["seed"]]
        lines.append([*of, *scores, row["result"], *times, f"{float(row['peak_gib']):.1f}", row["load"], row["commit"]])
    head = ("pixels", "pitch / µm", "bodies, µm", "method", "seed", "SSIM", "FRCM", "Dice", "error of δ", "result")
    return markdown((*head, "time / s", "of processors / s", "peak / GiB", "load", "commit"), lines)


@table("stages", "python benchmarks/stages.py --pixels 128 512 --csv docs/data/stages.csv", "minutes", "stages.csv")
def stages() -> str:
    """What the stages of a run take, of sizes beside each other."""
    rows = read("stages.csv")
    sizes = sorted({int(row["pixels"]) for row in rows})
    said = {(row["stage"], int(row["pixels"])): f"{row['seconds']} s, {float(row['share']):.1%}" for row in rows}
    named = dict.fromkeys(row["stage"] for row in rows)
    lines = [[stage, *(said.get((stage, size), "–").replace("%", " %") for size in sizes)] for stage in named]
    return markdown(("stage", *(f"{size}²" for size in sizes)), lines)


def worst(way: tuple[str, str]) -> dict[str, str]:
    """The worst of the three scenes; times are those of the longest run, `more` that beyond the Gaussians'."""
    rows = [row for row in jobs() if (row["preset"], row["method"]) == way]
    found = {name: f"{min(row[name] for row in rows):.3f}" for name in ("ssim", "frcm", "dice")}
    found["error"] = f"{max(row['relative_error_delta'] for row in rows):.3f}"
    found["mean"] = f"{max((deviation(row) for row in rows), key=abs):+.1f} %"
    before = {row["seed"]: row["seconds"] for row in jobs() if row["method"] == "gaussians"}
    more = max(row["seconds"] - before[row["seed"]] for row in rows)
    return found | {"time": f"{max(row['seconds'] for row in rows):.0f} s", "more": f"{more:.0f} s more"}


@table("readme", MAIN_JOB, "five minutes", "main_job_idle.csv")
def readme() -> str:
    """README's."""
    called = {"ssim": "SSIM of held-out views", "frcm": "FRCM of held-out views", "dice": "Dice of the volume"}
    called |= {"error": "relative error of δ", "mean": "mean δ inside the cells", "time": "time"}
    ways = [worst(way) for way in WAYS]
    ways[-1]["time"] = ways[-1]["more"]
    table = markdown(("", *WAYS.values()), [[label, *(way[name] for way in ways)] for name, label in called.items()])
    return table.replace("|  |", "| |", 1)


@table("wanted", MAIN_JOB, "five minutes", "main_job_idle.csv")
def wanted() -> str:
    """The same beside what was wanted."""
    aims = {
        "held-out SSIM / FRCM": ("> 0.975 / > 0.93", "{ssim} / {frcm}"),
        "Dice; relative error of δ": ("> 0.985; < 0.09", "{dice}; {error}"),
        "mean δ inside the cells": ("within 10 %", "{mean}"),
        "time, both together for `surface`": ("< 90 s; < 20 s for `reconstruct`", "{time}"),
    }
    cells = [worst(way) for way in WAYS]
    lines = [[label, aim, *(shown.format(**c) for c in cells)] for label, (aim, shown) in aims.items()]
    table = markdown(("worst of three scenes", "wanted", *WAYS.values()), lines)
    return table.replace("|  |", "| |", 1)


SERIES = {
    ("warm", "median CPU seconds, cold"): "a time that begins by itself [CPU s]",
    ("warm", "median CPU seconds, warm"): "a time that goes on from the one before [CPU s]",
    ("warm", "most CPU seconds, warm"): "the longest of these [CPU s]",
    ("warm", "Dice of the last time, warm"): "Dice of the eighth time, warm all the way",
    ("warm", "Dice of the last time, by itself"): "Dice of the eighth time, by itself",
    ("volume", "median CPU seconds, cold"): "continuous matter: a time that begins by itself [CPU s]",
    ("volume", "median CPU seconds, warm"): "continuous matter: a time that goes on [CPU s]",
    (
        "overhead",
        "median CPU seconds of a task beside the reconstruction itself",
    ): "a task, beside its reconstruction [CPU s]",
    ("overhead", "CPU seconds of a process whose task is done"): "a process, before it begins its first task [CPU s]",
    (
        "processes",
        "times faster, two processes than one",
    ): "64 windows of one time: faster by two processes than by one",
    ("processes", "times faster, two processes than one, windows of 8 times"): "64 windows of eight times: the same",
    (
        "processes",
        "times faster, two processes of plain Python than one",
    ): "plain Python, which shares nothing: the same",
    ("kills", "kills"): "kills (kill -9) at random moments",
    ("kills", "most times lost by a kill"): "times lost by one of them, at most",
    ("kills", "reruns that differ in a bit"): "reruns that differ in a bit",
}
"""What the table of series shows, by case and measure."""


@table("series", "python benchmarks/series.py --csv docs/data/series.csv", "an hour", "series.csv")
def series() -> str:
    """What tasks, warm starts and kills cost, with the load that the machine had."""
    lines = []
    for row in read("series.csv"):
        said = SERIES.get((row["case"], row["measure"]))
        if said is not None:
            lines.append([said, f"{float(row['value']):.3g}", f"{row['load_before']} to {row['load_after']}"])
    return markdown(("", "measured", "load average of the machine"), lines)


EQUATIONS = {
    "start": "each time by itself",
    "none": "one field, no equations",
    "curl": "one field, equations, v = ∇ × A",
    "free": "one field, equations, v free",
}
"""What the table of pinn calls its fields, in order."""


@table(
    "pinn",
    "python benchmarks/pinn.py --cases channel swirl --write (and espresso with --data)",
    "half an hour",
    "pinn.csv",
)
def pinn() -> str:
    """Fields of space and time with and without equations, each seed."""
    rows = read("pinn.csv")
    lines = []
    for case, views, name in sorted(
        {(r["case"], r["views"], r["equations"]) for r in rows},
        key=lambda key: (key[0], key[1], list(EQUATIONS).index(key[2])),
    ):
        own = [r for r in rows if (r["case"], r["views"], r["equations"]) == (case, views, name)]
        own.sort(key=lambda r: int(r["seed"]))
        dice, error = (", ".join(rounded(r[n], 3) for r in own) for n in ("dice", "error"))
        told = name in ("curl", "free")
        moving = (
            ", ".join(f"{rounded(r['velocity_error'], 2)} ({rounded(r['aligned'], 3)})" for r in own) if told else ""
        )
        seconds = max(float(r["cpu_seconds"]) + float(r["start_seconds"]) for r in own)
        lines.append([f"{case}, {views} views", EQUATIONS[name], dice, error, moving, f"{seconds:.0f} s"])
    columns = ("case", "field", "Dice", "error of δ", "error of the velocity (cosine)", "processor time")
    return markdown(columns, lines)


@table("random_scenes", "python benchmarks/random_scenes.py --write", "half an hour", "random_scenes.csv")
def random_scenes() -> str:
    """Error of δ, Dice, total and verdict of the default method, a line a scene."""
    lines = []
    for r in sorted(read("random_scenes.csv"), key=lambda r: (int(r["seed"]), int(r["number"]))):
        told = [r["kind"], r["prior"], r["views"], r["noise"], r["uneven"]]
        if r["error"]:
            good = {"True": "explained", "False": "warned"}.get(r["good"], "–")
            lines.append([*told, f"{r['error']} / {r['dice']} / {r['total']}", r["kept"], good])
        else:
            lines.append([*told, "–", "–", r["result"]])
    columns = ("matter", "known", "views", "noise", "uneven light", "error of δ / Dice / total", "result", "verdict")
    return markdown(columns, lines)


@table("families-rules", DECIDED, "an hour", "decision_families.csv")
def families_rules() -> str:
    """Families that rules of decision were made on beside all others: all rows, and those of the last seed alone."""
    of = script("families")
    rows = of.rows_of(of.PAGE)
    last = max(row.seed for row in rows)
    lines = of.table_of_rules(rows)
    beside = of.table_of_rules([row for row in rows if row.seed == last])
    head = (of.RULES[0], *(f"{name}, {seeds}" for seeds in ("all seeds", f"seed {last}") for name in of.RULES[1:3]))
    joined = [[*line[:3], *other[1:3], line[3]] for line, other in zip(lines, beside)]
    return markdown((*head, of.RULES[3]), joined).replace("|  |", "| |", 1)


@table("families-scenes", DECIDED, "an hour", "decision_families.csv")
def families_scenes() -> str:
    """Each scene of these families: what was decided, and what that cost."""
    of = script("families")
    return markdown(of.SCENES, of.table_of_scenes(of.rows_of(of.PAGE)))


@table("faults", "python benchmarks/faults.py --trials 200 --csv docs/data/faults.csv", "an hour", "faults.csv")
def faults() -> str:
    """What commands did when they were disturbed, kind by kind."""
    head = ("kind", "trials", "traceback", "hang", "crash", "silent", "torn", "lost", "let in")
    return markdown(head, [[row[name] for name in head] for row in read("faults.csv")])


@table("few-photons", "python benchmarks/few_photons.py", "half an hour", "few_photons.csv")
def few_photons() -> str:
    """Closed bodies in few photons, at the commit before surfaces took turns with the volume, and after."""
    rows, lines = read("few_photons.csv"), list[list[str]]()
    before = {(r["scene"], r["seed"]): r for r in rows if r["commit"] == BEFORE_TURNS}
    after = {(r["scene"], r["seed"]): r for r in rows if r["commit"] != BEFORE_TURNS}
    for key, old in before.items():
        new, (scene, photons) = after[key], key[0].split("@")
        scores = (f"{rounded(row['dice'], 3)}, {rounded(row['error'], 3)}" for row in (old, new))
        said = (row["explained"].replace("True", "yes").replace("False", "no") for row in (old, new))
        times = (f"{float(row['seconds']):.0f}" for row in (old, new))
        joined = (" → ".join(pair) for pair in (scores, said, times))
        lines.append([f"`{scene}`", photons, key[1], rounded(old["noise"], 2), *joined])
    lines.sort(key=lambda line: (line[0], -float(line[1]), line[2]))
    head = ("case", "photons", "seed", "noise / contrast", "Dice, error of δ", "called explained", "seconds of a core")
    return markdown(head, lines)


CALIBRATED = "python benchmarks/calibrate_intervals.py, and again with --summary"


@table("intervals", CALIBRATED, "a night", "interval_coverage.csv")
def intervals() -> str:
    """Coverage of intervals by factors of other families."""
    rows = [row for row in read("interval_coverage.csv") if row["quantity"] != "residual"]
    lines = []
    for name in dict.fromkeys(row["quantity"] for row in rows):
        own = [row for row in rows if row["quantity"] == name]
        every, parts = own[0], [int(row["covered"]) / int(row["scenes"]) for row in own[1:]]
        share = f"{int(every['covered']) / int(every['scenes']):.3f}"
        enough = f"{sum(part >= 0.8 for part in parts)} of {len(parts)}"
        lines.append([name, every["factor"], every["scenes"], share, enough, f"{min(parts):.2f}"])
    head = ("error of", "factor", "scenes", "covered", "families covered to 0.8 and more", "least of a family")
    return markdown(head, lines)


@table("mistakes", CALIBRATED, "a night", "interval_coverage.csv")
def mistakes() -> str:
    """Runs whose residual passes the limit of the verdict."""
    rows = [row for row in read("interval_coverage.csv") if row["quantity"] == "residual"]
    return markdown(
        ("scan", "runs", "above the limit", "the limit"),
        [[row["family"], row["scenes"], row["covered"], row["factor"]] for row in rows],
    )


@table("likely", CALIBRATED, "a night", "matter_reliability.csv")
def matter_map() -> str:
    """How often voxels of each range of probabilities are matter."""
    head = ("probability", "voxels", "expected to be matter", "are matter")
    ranges = [(f"{row['from']} to {row['to']}", row) for row in read("matter_reliability.csv")]
    return markdown(head, [[name, row["voxels"], row["expected"], row["matter"]] for name, row in ranges])


@table("distances", "python benchmarks/distances.py", "an hour", "distances.csv")
def distances() -> str:
    """Errors of thickness from frames of one view at one, two and four distances, ours beside hotopy's."""
    rows = read("distances.csv")
    sets, lines = list(dict.fromkeys(row["distances"] for row in rows)), []
    for photons in dict.fromkeys(row["photons"] for row in rows):
        for who in dict.fromkeys((row["program"], row["method"]) for row in rows):
            mine = [row for row in rows if (row["photons"], row["program"], row["method"]) == (photons, *who)]
            found = [[float(row["error"]) for row in mine if row["distances"] == one] for one in sets]
            seconds = max(float(row["seconds"]) for row in mine)
            cells = [f"{sum(each) / len(each):.3f}" for each in found]
            lines.append([photons if photons != "0" else "no noise", " ".join(who), *cells, f"{seconds:.2f}"])
    named = [f"{one} m" if float(one) < 1 else f"{one} distances" for one in sets]
    return markdown(("photons a pixel", "method", *named, "s"), lines)
