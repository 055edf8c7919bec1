"""What each ingredient of the reconstruction is worth: every one changed in turn, on cases of the suite.

    python benchmarks/ablation.py --snapshots DIR --csv docs/data/ablation.csv     # the suite, two hours on one core
    python benchmarks/ablation.py --cases noise12-2000 cells4 --seeds 101 102
    python benchmarks/ablation.py --summary docs/data/ablation.csv

Prints Markdown: a line for every run (SSIM / FRCM on noise-free held-out frames, Dice / relative error of δ against the
true volume), then what each variant changes, on cases without noise and with it. Runs that the CSV file has are not
repeated.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rows import read as texts
from rows import write

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from machine import commit

import holosplat as hs
from holosplat.methods import Task, finished
from holosplat.methods.gaussians import GaussianStage
from holosplat.workflows.evaluate import score_object
from holosplat_bench.declaration import Case
from holosplat_bench.suite.case import case_names, load_case

AS_IT_IS = "as it is"
Row = dict[str, Any]


def objective(**changed: float) -> Callable[[hs.Gaussians], hs.Gaussians]:
    """Other weights in the objective of the fit."""
    return lambda s: replace(s, fit=replace(s.fit, objective=replace(s.fit.objective, **changed)))


def schedule(**changed: int) -> Callable[[hs.Gaussians], hs.Gaussians]:
    """Another schedule of the fit."""
    return lambda s: replace(s, fit=replace(s.fit, schedule=replace(s.fit.schedule, **changed)))


def without_noise_rules(s: hs.Gaussians) -> hs.Gaussians:
    """The same weights and spacing, however noisy the frames are."""
    return objective(noise_gain=0.0)(replace(s, spacing_noise=0.0))


VARIANTS: dict[str, Callable[[hs.Gaussians], hs.Gaussians]] = {
    AS_IT_IS: lambda s: s,
    "no two levels": objective(two_levels=0.0),
    "no total variation in the fit": objective(tv_volume=0.0),
    "no bound at one in the fit": objective(overfull=0.0),
    "no rounds of agreement": lambda s: replace(s, volume=replace(s.volume, corrections=0)),
    "no rules for noise": without_noise_rules,
    "L1 within the noise, too": objective(noise_width=0.0),
    "noisy frames not blurred": objective(coarse=0.0),
    "one ratio for all matter": lambda s: replace(s, most_materials=1),
    "rounds of agreement in noise, too": lambda s: replace(s, volume=replace(s.volume, noisy=1.0)),
    "100 steps": schedule(steps=100),
    "600 steps": schedule(steps=600),
    "no fit (the start alone)": schedule(steps=0),
}


class Runs:
    """Fits of one case, which share the starts that their settings have in common."""

    def __init__(self, case: Case) -> None:
        self._case, self._scan, self._truth = case, case.scan(), case.truth()
        self._starts: dict[str, hs.representations.GaussianCloud] = {}

    def score(self, settings: hs.Gaussians) -> Row:
        """The numbers that matter, and how long the fit took (without the start) [s]."""
        stage, task = GaussianStage(settings), Task(self._scan.train(), self._case.prior)
        key = repr(replace(settings, fit=hs.preset("default").fit))
        if key not in self._starts:
            self._starts[key] = stage.start(task, None)
        began = time.perf_counter()
        fit = stage.fit(task, self._starts[key])
        fit.run(lambda record: None)
        seconds = time.perf_counter() - began
        found = score_object(finished(fit), self._scan, self._truth, fit.model.instrument.oversample).headline()
        return {"photons": self._case.photons or 0, "seconds": seconds, **found}


def read(file: Path | None) -> list[Row]:
    """The rows of a CSV file, numbers as such; none where there is no file."""
    words = ("case", "variant", "commit")
    return [{k: v if k in words else float(v) for k, v in row.items()} for row in (texts(file) if file else ())]


def shown(row: Row) -> str:
    """A run as a line of the first table."""
    pairs = (("ssim", "frcm"), ("dice", "relative_error_delta"))
    images, volume = (" / ".join(f"{row[key]:.3f}" for key in keys) for keys in pairs)
    return f"| {row['case']} | {row['seed']:.0f} | {row['variant']} | {images} | {volume} | {row['seconds']:.0f} |"


def summary(rows: list[Row]) -> list[str]:
    """What each variant changes, the one that costs most first: the mean error of δ as a multiple of that as it is, and
    the mean gain of FRCM, on cases without noise and with it; the case where it changes the error most."""
    whole = {(row["case"], row["seed"]): row for row in rows if row["variant"] == AS_IT_IS}
    compared: dict[str, list[tuple[Row, float, float]]] = {}
    for row in rows:
        base = whole.get((row["case"], row["seed"]))
        if base is not None and row["variant"] != AS_IT_IS:
            error = row["relative_error_delta"] / base["relative_error_delta"]
            compared.setdefault(row["variant"], []).append((row, error, row["frcm"] - base["frcm"]))

    def part(found: list[tuple[Row, float, float]]) -> str:
        if not found:
            return "– | –"
        errors, gains = [error for _, error, _ in found], [gain for _, _, gain in found]
        return f"×{np.exp(np.log(errors).mean()):.2f} | {np.mean(gains):+.3f}"

    lines = [
        "| changed | cases | error, no noise | FRCM | error, noise | FRCM | most on |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for variant, found in sorted(compared.items(), key=lambda item: -np.mean([np.log(e) for _, e, _ in item[1]])):
        clean, noisy = ([f for f in found if bool(f[0]["photons"]) is noise] for noise in (False, True))
        row, error, _ = max(found, key=lambda f: abs(np.log(f[1])))
        lines.append(f"| {variant} | {len(found)} | {part(clean)} | {part(noisy)} | `{row['case']}`, ×{error:.2f} |")
    return lines


def main() -> None:
    """Run all variants on all cases; print and write their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=case_names())
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[101])
    parser.add_argument("--snapshots", type=Path)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--summary", type=Path, help="only sum up this file")
    options = parser.parse_args()
    if options.summary:
        print("\n".join(summary(read(options.summary))))
        return
    rows = read(options.csv)
    done = {(row["case"], row["seed"], row["variant"]) for row in rows}
    print("| case | seed | variant | SSIM / FRCM | Dice / error | fit [s] |\n| --- | --- | --- | --- | --- | --- |")
    for name in options.cases:
        for seed in options.seeds:
            wanted = [variant for variant in options.variants if (name, seed, variant) not in done]
            if not wanted:
                continue
            runs = Runs(load_case(name, seed, options.snapshots))
            for variant in wanted:
                found = runs.score(VARIANTS[variant](hs.preset("default")))
                rows.append({"case": name, "seed": seed, "variant": variant, "commit": commit(), **found})
                print(shown(rows[-1]), flush=True)
                if options.csv:
                    write(rows, options.csv)
    print("\n" + "\n".join(summary(rows)))


if __name__ == "__main__":
    main()
