"""What frames say of a distance, an energy or δ/β that is known to a range only.

    python benchmarks/uncertain.py --out docs/data/uncertain.csv        # about 20 minutes on one core

A row: the constant over the true one and its interval, in cases of the benchmark with ranges that are not centred on
the truth. Seed 7 served to choose the rules of `methods.uncertain`; reported are others.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from pathlib import Path

from rows import written

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from machine import commit

from holosplat.matter import KnownRatio, MaterialPrior
from holosplat.methods import Task
from holosplat.methods.illumination import prepared
from holosplat.methods.uncertain import Uncertain, determine
from holosplat_bench.declaration import Case
from holosplat_bench.suite.case import load_case

COLUMNS = ("case", "seed", "uncertain", "constant", "over_truth", "low", "high", "told", "seconds", "commit")
QUESTIONS = {
    "distance": {"distance": (0.5, 3.0)},
    "ratio": {"delta_beta": (0.3, 2.0)},
    "energy": {"energy_kev": (0.75, 1.25)},
    "distance and ratio": {"distance": (0.5, 3.0), "delta_beta": (0.4, 2.0)},
}
"""Ranges over the true values."""
CASES = ("soft12", "soft12-5000", "light12-5000", "cells8", "noise12-2000", "tissue16")


def truth(case: Case) -> dict[str, float]:
    """The constants of a case."""
    exposures, prior = case.exposures, case.prior
    ratio = prior.ratio if isinstance(prior, KnownRatio) else prior.materials[0].ratio
    return {"distance": exposures.distance[0], "energy_kev": exposures.energy_kev[0], "delta_beta": ratio}


def rows(name: str, seed: int, question: str) -> list[dict[str, object]]:
    """What is found in a case for a question."""
    case, found = load_case(name, seed), list[dict[str, object]]()
    true, factors = truth(case), QUESTIONS[question]
    ranges = {each: (low * true[each], high * true[each]) for each, (low, high) in factors.items()}
    prior = MaterialPrior.unknown() if "delta_beta" in ranges else MaterialPrior.of_ratio(true["delta_beta"])
    began = time.process_time()
    for one in determine(prepared(Task(case.scan().train(), prior)), Uncertain(**ranges)):
        numbers = (f"{value / true[one.name]:.3f}" for value in (one.value, one.low, one.high))
        spent = f"{time.process_time() - began:.1f}"
        found.append(dict(zip(COLUMNS, (name, seed, question, one.name, *numbers, one.told, spent, commit()))))
    return found


def main() -> None:
    """Write the table, line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=CASES)
    parser.add_argument("--questions", nargs="+", default=list(QUESTIONS), choices=list(QUESTIONS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    wanted = itertools.product(options.cases, options.seeds, options.questions)
    written(options.out, COLUMNS, (row for one in wanted for row in rows(*one)))


if __name__ == "__main__":
    main()
