"""What each ingredient of the reconstruction is worth: every one changed in turn, on cases of the suite.

    python benchmarks/ablation.py --snapshots DIR --csv docs/data/ablation.csv     # twenty minutes on two cores
    python benchmarks/ablation.py --cases noise12-2000 cells4 --seeds 101 102

Prints a Markdown table: SSIM / FRCM on noise-free held-out frames, Dice / relative error of δ against the true volume.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from machine import commit

import holosplat as hs
from holosplat.experiments.bench.case import Case, load_case
from holosplat.experiments.evaluate import score_object
from holosplat.experiments.reconstruct import fit_options
from holosplat.experiments.start import starting_cloud
from holosplat.fit.loop import Fit

CASES = ["thesis16", "main4", "cells4", "cells8", "xmpi4", "noise12-2000", "plasma8-1e4", "shells8", "foam12"]
Settings = hs.Settings


def objective(**changed: float) -> Callable[[Settings], Settings]:
    """Other weights in the objective of the fit."""
    return lambda s: replace(s, fit=replace(s.fit, objective=replace(s.fit.objective, **changed)))


def schedule(**changed: int) -> Callable[[Settings], Settings]:
    """Another schedule of the fit."""
    return lambda s: replace(s, fit=replace(s.fit, schedule=replace(s.fit.schedule, **changed)))


def without_noise_rules(s: Settings) -> Settings:
    """The same weights and spacing, however noisy the frames are."""
    return objective(noise_gain=0.0)(replace(s, spacing_noise=0.0))


VARIANTS: dict[str, Callable[[Settings], Settings]] = {
    "as it is": lambda s: s,
    "no two levels": objective(two_levels=0.0),
    "no total variation in the fit": objective(tv_volume=0.0),
    "no bound at one in the fit": objective(overfull=0.0),
    "no rounds of agreement": lambda s: replace(s, volume=replace(s.volume, corrections=0)),
    "no rules for noise": without_noise_rules,
    "L1 within the noise, too": objective(noise_width=0.0),
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
        self._starts: dict[str, hs.GaussianCloud] = {}

    def score(self, settings: Settings) -> dict[str, Any]:
        """The numbers that matter, and how long the fit took (without the start) [s]."""
        key = repr(replace(settings, fit=hs.preset("default").fit))
        if key not in self._starts:
            train, prior = self._scan.train(), self._case.prior
            self._starts[key] = starting_cloud(train, prior, settings, 0, lambda stage, fraction: None)
        began = time.perf_counter()
        cloud = self._starts[key].detached()
        fit = Fit(self._scan, cloud, fit_options(self._case.prior, settings, cloud), 0)
        fit.run(lambda record: None)
        seconds = time.perf_counter() - began
        found = score_object(fit.result(), self._scan, self._truth, fit.instrument.oversample).headline()
        return {"seconds": seconds, **found}


def main() -> None:
    """Run all variants on all cases; print and write their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=CASES)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[101])
    parser.add_argument("--snapshots", type=Path)
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print("| case | seed | variant | SSIM / FRCM | Dice / error | fit [s] |\n| --- | --- | --- | --- | --- | --- |")
    for name in options.cases:
        for seed in options.seeds:
            runs = Runs(load_case(name, seed, options.snapshots))
            for variant in options.variants:
                row = runs.score(VARIANTS[variant](hs.preset("default")))
                rows.append({"case": name, "seed": seed, "variant": variant, "commit": commit(), **row})
                images, volume = (
                    " / ".join(f"{row[key]:.3f}" for key in keys)
                    for keys in (("ssim", "frcm"), ("dice", "relative_error_delta"))
                )
                print(f"| {name} | {seed} | {variant} | {images} | {volume} | {row['seconds']:.0f} |", flush=True)
    if options.csv:
        with options.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
