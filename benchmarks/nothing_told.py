"""Scenes of which nothing is told, by default: docs/data/nothing_told.csv.

    python benchmarks/nothing_told.py --data FOLDER                          # about half an hour on one core
    python benchmarks/nothing_told.py --data FOLDER --family "red cells" --seeds 101

A scene of `family_scenes` is reconstructed without its material, with the steps of `families.py`, and judged as there.
The file has a row for each commit that ran it; rows that are there are not made again.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from families import MADE_ON, METHOD
from family_scenes import MEASURED_FAMILIES, SIMULATED, Scene, scene
from machine import commit
from rows import machine, read, replaced, shown

import holosplat as hs

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "nothing_told.csv"
SCENES = {
    "round cell": 101,
    "soft cells": 102,
    "HL60, photons": 1,
    "red cells": 105,
    "tissue": 105,
    "HL60, near": 1,
    "crowd": 105,
    "uneven light": 1,
    "absorbers": 105,
}
"""Seeds of the scenes that are run unless others are asked for; of other families it is 106."""
FAMILIES = (*SIMULATED, *MEASURED_FAMILIES)
DECISIONS = ("δ/β in frames as measured", "light and noise", "matter")


@dataclass(frozen=True)
class Row:
    """use: whether rules were made on such scenes; true, found: δ/β, NaN where matter has two levels; decided: of
    `DECISIONS`; seconds: of the processor"""

    family: str
    seed: int
    commit: str
    use: str
    true: float
    found: float
    error: float
    result: str
    decided: str
    seconds: float
    machine: str


def run(made: Scene, family: str, seed: int) -> Row:
    """The default on one scene, without its material."""
    began = time.process_time()
    done = hs.reconstruct(made.scan, hs.MaterialPrior.unknown(), METHOD)
    seconds = round(time.process_time() - began, 1)
    prior = made.prior
    true = prior.materials[0].ratio if prior.materials else getattr(prior, "ratio", math.nan)
    decided = " | ".join(each.line for each in done.choice.decisions if each.name in DECISIONS)
    use, found = "made on" if family in MADE_ON else "others", [each.value for each in done.constants]
    what = (use, float(true), found[0] if found else math.nan, made.error(done), done.object.kind, decided)
    return Row(family, seed, commit(), *what, seconds, machine())


def main() -> None:
    """Make the rows that are asked for and not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of measured frames")
    parser.add_argument("--family", nargs="+", choices=FAMILIES, default=list(SCENES), metavar="FAMILY")
    parser.add_argument("--seeds", type=int, nargs="+", help="default: one of each family")
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for family in options.family:
        for seed in options.seeds or [SCENES.get(family, 106)]:
            if (family, str(seed), commit()) in {(r["family"], r["seed"], r["commit"]) for r in read(options.out)}:
                continue
            made = scene(family, seed, options.data)
            if isinstance(made, str):
                print(made)
                continue
            row = run(made, family, seed)
            replaced(options.out, row, key=3)
            shown(row)


if __name__ == "__main__":
    main()
