"""The options of voxels and neural fields fitted through the waves, each varied by itself on tuning scenes.

    python benchmarks/tune_fields.py --csv docs/data/tune_fields.csv     # an hour on two cores
    python benchmarks/tune_fields.py --methods neural --options noise_weight --cases noise12-500 --seeds 12

Cases are those of the suite, of known material, with seeds below 100, which its table does not have. Both methods start
from the volume of `holographic_tv`, as in the suite. Prints a Markdown table a method: the relative error of δ, its
ratio to that of the defaults on each scene, Dice, and SSIM / FRCM of noise-free held-out frames.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from rows import write

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from changes import changed
from machine import commit

from holosplat.methods import Method, Task, VoxelFit, Voxels, finished
from holosplat.methods.presets import preset
from holosplat.methods.voxels import HolographicStage
from holosplat.optics.sampling import fringe_sampling
from holosplat.representations import Stored, VoxelGrid
from holosplat.workflows.evaluate import score_object
from holosplat_bench.declaration import Case
from holosplat_bench.opponents.fields import Encoding, Network
from holosplat_bench.opponents.neural_fields import NeuralFields, NeuralFit
from holosplat_bench.suite.case import load_case

CASES, SEEDS = ["cells8", "noise12-2000", "thesis16"], [11]
"""Narrow fringes, noise, and coarse pixels, all of known material."""

VOXELS: dict[str, Sequence[Any]] = {
    "weight": (0.02, 0.1, 0.2),
    "noise_weight": (0.0, 0.3, 1.0),
    "steps": (30, 120),
    "coarse_steps": (50, 150),
    "floor": (0.05, 0.3),
    "smoothing": (0.0025, 0.02),
}
NEURAL: dict[str, Sequence[Any]] = {
    "rate": (0.01, 0.04),
    "weight": (0.003, 0.03),
    "noise_weight": (0.03, 0.3, 1.0),
    "steps": (125, 500),
    "floor": (0.05, 0.3),
    "network": (Network(hidden=64), Network(Encoding(levels=5)), Network(Encoding(kind="fourier"))),
}
TABLES = {"voxels": VOXELS, "neural": NEURAL}
METHODS = {"voxels": (Voxels, VoxelFit()), "neural": (NeuralFields, NeuralFit())}


def continued(method: Method, task: Task, start: VoxelGrid) -> Stored:
    """What the stages of `method` make of `start`, which stands for its first stage."""
    found: Stored = start
    for stage in method.stages()[1:]:
        found = stage.start(task, found)
        fit = stage.fit(task, found)
        if fit is not None:
            fit.run(lambda record: None)
            found = finished(fit)
    return found


def variants(options: Any, table: dict[str, Sequence[Any]]) -> list[tuple[str, Any]]:
    """The options as they are, and with every single other value of the table."""
    others = [(name, value) for name, values in table.items() for value in values]
    return [("as it is", options), *((_label(k, v), changed(options, {k: v})) for k, v in others)]


def _label(name: str, value: Any) -> str:
    if not isinstance(value, Network):
        return f"{name} = {value}"
    changed = {f.name: getattr(value, f.name) for f in fields(value) if getattr(value, f.name) != f.default}
    return ", ".join(f"{k} = {v}" for k, v in changed.items() if k != "encoding") or _of_encoding(value.encoding)


def _of_encoding(encoding: Encoding) -> str:
    plain = Encoding()
    changed = {f.name: getattr(encoding, f.name) for f in fields(encoding)}
    return "encoding: " + ", ".join(f"{k} = {v}" for k, v in changed.items() if v != getattr(plain, k))


def scored(case: Case, methods: Sequence[str], varied: Sequence[str]) -> list[dict[str, Any]]:
    """A row for every variant of every method on one case."""
    if case.prior.kind != "known":
        raise SystemExit(f"{case.name} tells nothing of its material; choose cases of a known one.")
    scan, truth = case.scan(), case.truth()
    task = Task(scan.train(), case.prior)
    start = HolographicStage(preset("default").volume).start(task, None)
    oversample, rows = fringe_sampling(scan.exposures), []
    for name in methods:
        method, options = METHODS[name]
        table = {k: v for k, v in TABLES[name].items() if not varied or k in varied}
        for label, chosen in variants(options, table):
            began = time.perf_counter()
            found = continued(method(fit=chosen), task, start)
            seconds = time.perf_counter() - began
            numbers = score_object(found, scan, truth, oversample).headline()
            rows.append({"case": case.name, "seed": case.seed, "method": name, "variant": label, "commit": commit()})
            rows[-1] |= {"seconds": round(seconds, 2), **numbers}
            error = numbers["relative_error_delta"]
            print(f"{case.name} {case.seed} {name} {label}: {error:.4f}, {seconds:.0f} s", file=sys.stderr, flush=True)
    return rows


def table(rows: Sequence[dict[str, Any]], method: str) -> list[str]:
    """Lines of Markdown: means over the scenes, one line a variant."""
    own = [row for row in rows if row["method"] == method]
    standard = {(r["case"], r["seed"]): r["relative_error_delta"] for r in own if r["variant"] == "as it is"}
    lines = ["| variant | error of δ | on each scene, of that as it is | Dice | SSIM / FRCM |", "|" + " --- |" * 5]
    for label in dict.fromkeys(row["variant"] for row in own):
        same = [row for row in own if row["variant"] == label]
        mean = {k: np.mean([r[k] for r in same]) for k in ("relative_error_delta", "dice", "ssim", "frcm")}
        ratios = ", ".join(f"×{r['relative_error_delta'] / standard[r['case'], r['seed']]:.2f}" for r in same)
        lines.append(
            f"| {label} | {mean['relative_error_delta']:.3f} | {ratios} | {mean['dice']:.3f} | {mean['ssim']:.3f} / "
            f"{mean['frcm']:.3f} |"
        )
    return lines


def main() -> None:
    """Run what was asked for; print a table a method and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--options", nargs="+", default=[], choices=sorted({*VOXELS, *NEURAL}), help="default: all")
    parser.add_argument("--cases", nargs="+", default=CASES)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    parser.add_argument("--csv", type=Path)
    chosen = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for name in chosen.cases:
        for seed in chosen.seeds:
            rows += scored(load_case(name, seed, None), chosen.methods, chosen.options)
            if chosen.csv:  # after every scene, for there is an hour to lose
                write(rows, chosen.csv)
    for method in chosen.methods:
        print(f"\n{method}\n", *table(rows, method), sep="\n")
    print(f"\nCommit {commit()}, torch {torch.__version__}, {torch.get_num_threads()} threads.")


if __name__ == "__main__":
    main()
