"""Scans of specimens that leave the field, as `holosplat simulate --specimen` makes them."""

from __future__ import annotations

import numpy as np

from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.materials import parse_material
from holosplat.matter import DeltaBeta
from holosplat.scan import Exposures, Scan
from holosplat.specimens.drawn import Substances
from holosplat_bench.specimens.matter import MATTER

PITCH, ENERGY = 1e-6, 20.0


def filled(name: str, shape: tuple[int, int], count: int, photons: float | None = None) -> Scan:
    """Frames of a kind of specimen with its usual materials, drawn by seed 0, in `count` views over half a turn."""
    kind = MATTER[name](MATTER[name].extent * shape[1] * PITCH)
    nothing = DeltaBeta(0.0, 0.0)
    material, core, medium = (parse_material(one).delta_beta(ENERGY) if one else nothing for one in kind.named)
    drawn = kind.drawn(Substances(material, None if kind.named[1] is None else core, medium), 0)
    exposures = Exposures.of(Views.evenly_spaced(count, shape, PITCH), ENERGY, 0.1)
    return simulate(drawn.scene, exposures, photons_per_pixel=photons, seed=0, is_test=np.zeros(count, dtype=bool))
