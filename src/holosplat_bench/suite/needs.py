"""What a benchmark takes of the machine, told before it starts (`holosplat.planning.acts`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holosplat.methods import Method
from holosplat.planning.needs import Costs, Needs, Sizes, of_fit, of_simulation
from holosplat.scan import Exposures

JUDGED = 60.0
"""Bytes of a voxel of a case whose truth and result are compared (`benchmarks/needs_acts.py`)."""


def of_methods(exposures: Exposures, is_test: np.ndarray, samples: int, methods: Sequence[Method]) -> Needs:
    """What a case of the benchmark takes, with such frames, of which some are held out, and so many wave samples along
    a pixel of its simulation."""
    sizes, voxels = Sizes.of(exposures[~is_test]), Sizes.of(exposures).voxels
    each = [needs for method in methods if (needs := of_fit(sizes, method)) is not None]
    made = of_simulation(exposures, samples, len(exposures))
    memory = max([made.memory, *(needs.memory for needs in each)]) + JUDGED * voxels
    disk = made.disk + 2 * Costs.written * voxels + 1e6 * len(each)
    return Needs(memory, disk, 10 + sum(needs.seconds for needs in each))


def of_benchmark(cases: Sequence[Needs]) -> Needs:
    """What several cases take, one after the other."""
    return Needs(max(one.memory for one in cases), sum(one.disk for one in cases), sum(one.seconds for one in cases))
