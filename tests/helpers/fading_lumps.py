"""Soft lumps that drift and fade, and frames of them at several times: rectangular, of odd sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import holosplat as hs
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta
from holosplat.optics.background import LightOptions
from holosplat.scan import Exposures, Scan
from holosplat.specimens.continuous import Bump, ContinuousScene, ellipsoid
from holosplat_bench.specimens.carried import CarriedScene, Fades

PIXEL, SHAPE = 1e-6, (19, 23)
MATTER = DeltaBeta(8e-7, 8e-10)
TIMES = np.linspace(0.0, 1.0, 4)
EVEN = LightOptions("even", still="none", noise="white")


@dataclass(frozen=True)
class Drift:
    """A uniform translation by `way` [m] a second."""

    way: tuple[float, float, float]

    def back(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        return points - time * np.array(self.way)[:, None]

    def forth(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        return points + time * np.array(self.way)[:, None]


def drifting(way: tuple[float, float, float] = (4e-6, -2e-6, 3e-6), fades: Fades | None = None) -> CarriedScene:
    """Three soft lumps."""
    places = [(-3e-6, -1e-6, 1e-6), (1e-6, 2e-6, -2e-6), (-1e-6, -2e-6, -3e-6)]
    parts = tuple(ellipsoid(c, (3e-6, 2.4e-6, 2.7e-6), Bump(2), MATTER) for c in places)
    return CarriedScene(ContinuousScene(parts), Drift(way), 10e-6, 4e-7, fades=fades or Fades(0.0))


def series(scene: CarriedScene, photons: float = 800.0) -> tuple[CarriedScene, Scan]:
    """Three views at four times."""
    views = Views.from_angles([0.0, 60.0, 110.0], SHAPE, PIXEL)
    exposures = Exposures.of(views, 20.0, 0.1).repeated(TIMES)
    nothing = np.zeros(len(exposures), dtype=bool)
    return scene, hs.simulate(scene, exposures, photons_per_pixel=photons, seed=1, is_test=nothing, oversample=2)
