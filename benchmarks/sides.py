"""Whether matter is taken for spherical where it is not: rows of docs/data/sides.csv.

    python benchmarks/sides.py --data FOLDER            # half an hour on one core
    python benchmarks/sides.py --data FOLDER --family HL60 --seeds 101

The decision on which side of its medium matter lies (`contrast.decide_sides`), of the families of `families.py`, told
what they are told there, and of shocks in water, on which the question about spherical matter was made. `spherical` is
its gain over the null on unseen frames, empty where nothing asks: of a known material, of absorption alone, of few
views. `seconds` of the processor are those of all that is decided before a fit, `without` those without the question.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from family_scenes import MEASURED_FAMILIES, SIMULATED, scene
from machine import commit
from rows import machine, read, replaced, shown

import holosplat as hs
from holosplat.methods import Auto, Task, illumination
from holosplat.methods.contrast import SPHERICAL, STAGE, decide_sides
from holosplat.specimens import Substances
from holosplat_bench.specimens.gas_waves import ExpandingShock

PAGE = Path(__file__).resolve().parents[1] / "docs/data/sides.csv"
SHOCK = "shock in water"


@dataclass(frozen=True)
class Row:
    """made_on: whether the question was made on this family; choice: of the sides, empty where nothing asked."""

    family: str
    seed: int
    made_on: str
    choice: str
    spherical: str
    error: str
    frames: str
    seconds: float
    without: float
    machine: str
    commit: str


def shock(seed: int) -> tuple[hs.Scan, hs.MaterialPrior]:
    """One time of an expanding shock, of four views and 3000 photons a pixel, told the ratio of its water."""
    water = hs.materials.parse_material("water").delta_beta(20.0)
    drawn = ExpandingShock(42e-6).drawn(Substances(water, medium=water), seed)
    views = hs.Views.evenly_spaced(4, shape=(48, 48), pixel_size=1e-6)
    exposures = hs.Exposures.of(views, energy_kev=20.0, distance=0.1)
    nothing = np.zeros(4, dtype=bool)
    scan = hs.simulate(drawn.scene.at(0.6), exposures, photons_per_pixel=3000, seed=seed, is_test=nothing)
    return scan, hs.MaterialPrior.of_ratio(water.ratio)


def decided(scan: hs.Scan, prior: hs.MaterialPrior, spherical: bool) -> tuple[Task, float]:
    """The task once everything before a fit is decided, and seconds."""

    def asked(*given: object) -> object:
        return decide_sides(*given[:3], spherical=spherical and bool(given[3]))  # type: ignore[arg-type]

    began = time.process_time()
    with patch.object(illumination, "decide_sides", asked):
        return illumination.prepared(Task(scan.train(), prior), Auto()), time.process_time() - began


def run(family: str, seed: int, scan: hs.Scan, prior: hs.MaterialPrior) -> Row:
    """The decision with the question, and the time without it."""
    (task, seconds), (_, without) = (decided(scan, prior, spherical) for spherical in (True, False))
    sides = [each for each in task.decisions if each.name == STAGE]
    gains = {one.name: one for each in sides for one in each.compared}
    choice = SPHERICAL if task.prior.spherical else sides[-1].choice if sides else ""
    found = gains.get(SPHERICAL)
    numbers = ("", "") if found is None else (f"{found.gain:.4f}", f"{found.error:.4f}")
    frames = " × ".join(map(str, (len(task.scan), *task.scan.views.shape)))
    made_on = "yes" if family == SHOCK else "no"
    return Row(
        *(family, seed, made_on, choice, numbers[0], numbers[1], frames),
        *(round(seconds, 1), round(without, 1), machine(), commit()),
    )


def main() -> None:
    """Make the rows that are not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    every = [SHOCK, *MEASURED_FAMILIES, *SIMULATED]
    parser.add_argument("--family", nargs="+", choices=every, default=every, metavar="NAME")
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--data", type=Path, help="the folder of measured frames")
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for seed, family in product(options.seeds, options.family):
        there = {(row["family"], row["seed"]) for row in read(options.out)}
        if (family, str(seed)) in there:
            continue
        if family == SHOCK:
            given = shock(seed)
        else:
            made = scene(family, seed, options.data)
            if isinstance(made, str):  # why it is not there
                print(made, flush=True)
                continue
            given = made.scan, made.prior
        row = run(family, seed, *given)
        replaced(options.out, row, key=2)
        shown(row)


if __name__ == "__main__":
    main()
