"""Is matter with levels told from a continuum, in the cases of the benchmark?

    python benchmarks/levels.py --out docs/data/levels.csv              # about three minutes on two cores

Every case is told its own prior, and then, where that is a known material, its ratio alone. A row: by how much a free
volume predicts unseen views better than a flat one (`methods.levels`), the standard error, and what is decided.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import time
from pathlib import Path

from rows import written

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from machine import commit

from holosplat.inference import Compared
from holosplat.matter import Known, MaterialPrior
from holosplat.methods import Task
from holosplat.methods.illumination import prepared
from holosplat.methods.levels import decide_matter
from holosplat_bench.suite.case import case_names, load_case

COLUMNS = ("case", "seed", "prior", "gain", "error", "choice", "light", "seconds", "commit")


def rows(name: str, seed: int) -> list[dict[str, object]]:
    """What is decided of a case, by what is known of it."""
    case, found = load_case(name, seed), list[dict[str, object]]()
    train, priors = case.scan().train(), [case.prior]
    if isinstance(case.prior, Known) and case.prior.material.beta:
        priors.append(MaterialPrior.of_ratio(case.prior.material.ratio))
    for prior in priors:
        began = time.process_time()
        task = prepared(Task(train, prior))
        decision = decide_matter(task)
        last = decision.compared[-1] if decision.compared else Compared("", math.nan, math.nan)
        light = task.decisions[-1].choice if task.decisions else "as measured"
        values = (name, seed, prior.kind, f"{last.gain:.4f}", f"{last.error:.4f}", decision.choice, light)
        found.append(dict(zip(COLUMNS, (*values, f"{time.process_time() - began:.1f}", commit()))))
    return found


def main() -> None:
    """Write the table, line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=case_names())
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    scenes = itertools.product(options.cases, options.seeds)
    written(options.out, COLUMNS, (row for scene in scenes for row in rows(*scene)))


if __name__ == "__main__":
    main()
