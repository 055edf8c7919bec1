"""Balls, their scan, and small fits of it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from holosplat.beamline.simulate import simulate
from holosplat.fit.density import DensityControl
from holosplat.fit.loop import Fit
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Views
from holosplat.matter import Matter
from holosplat.methods import FitOptions, GaussianRates, gaussian_fit
from holosplat.model import Instrument, Model
from holosplat.representations import GaussianCloud, random_cloud
from holosplat.scan import Exposures, Scan

PIXEL = 2e-6
MATERIAL = (7e-7, 2.6e-10)
SHAPE = (20, 24)
RATES = GaussianRates(0.02, 0.01, 0.01, 0.02)
BALLS = np.array([[-5.0, -3.0, 2.0, 4.0], [4.0, 4.0, -3.0, 3.0], [3.0, -5.0, -1.0, 3.5]]) * PIXEL
"""Centre (x, y, z) and radius of each ball [m]."""


class Balls:
    """Balls of the material; their line integrals are chords (no numerics shared with the Gaussians)."""

    def at(self, time: float) -> Balls:
        return self

    def project(self, views: Views) -> tuple[Tensor, Tensor]:
        h, w = views.shape
        x = (np.arange(w) + 0.5 - w / 2) * views.pixel_size
        y = (np.arange(h) + 0.5 - h / 2) * views.pixel_size
        chords = np.zeros((len(views), h, w))
        for v, (rotation, shift) in enumerate(zip(views.rotations, views.shifts)):
            for *centre, radius in BALLS:
                cx, cy, _ = rotation @ centre
                square = (x + shift[0] - cx)[None] ** 2 + (y + shift[1] - cy)[:, None] ** 2
                chords[v] += 2 * np.sqrt(np.clip(radius**2 - square, 0, None))
        return torch.from_numpy(chords * MATERIAL[1]), torch.from_numpy(chords * MATERIAL[0])


def a_scan(train: int = 6, test: int = 2) -> Scan:
    """Noise-free frames of the balls; the test frames stand last."""
    count = train + test
    views = Views.from_angles(np.arange(count) * 180.0 / count, SHAPE, PIXEL)
    is_test = np.arange(count) >= train
    return simulate(Balls(), Exposures.of(views, 20.0, 0.05, 0.3), is_test=is_test)


def a_cloud(count: int = 100, seed: int = 0) -> GaussianCloud:
    return random_cloud(count, Views.evenly_spaced(1, SHAPE, PIXEL), Matter.one(*MATERIAL), 4e-6, seed)


def fit_of(scan: Scan, *, objective=None, density=None, seed=0, cloud=None, rates=RATES, terms=(), **schedule) -> Fit:
    """A fit of a small random cloud; `schedule` are fields of `Schedule`."""
    how = Schedule(**schedule)
    options = FitOptions(objective or Objective(), how, rates, density or DensityControl(), terms, "cpu")
    return gaussian_fit(scan, cloud or a_cloud(), options, seed)


def cloud_of(fit: Fit) -> GaussianCloud:
    """The cloud as it is now."""
    assert isinstance(fit.model.object, GaussianCloud)
    return fit.model.object


def found_by(fit: Fit) -> GaussianCloud:
    """The cloud that the fit ends with."""
    assert isinstance(fit.result().object, GaussianCloud)
    return fit.result().object


def frames_of(cloud: GaussianCloud, instrument: Instrument, index: Tensor | None = None) -> Tensor:
    """Frames of a cloud in the exposures of `instrument`, without gradients."""
    with torch.no_grad():
        return Model(cloud, instrument).frames(index)


def run(fit: Fit, until: int | None = None) -> list[dict[str, float]]:
    """Advance the fit; returns its records without the clock."""
    records: list[dict[str, float]] = []
    fit.run(records.append, until)
    return [{name: value for name, value in record.items() if name != "seconds"} for record in records]


def equal(a: GaussianCloud, b: GaussianCloud) -> bool:
    """Whether two clouds are bit for bit the same."""
    return all(torch.equal(p, b.parameters()[name]) for name, p in a.parameters().items())


HASTY = {"rates": GaussianRates(3.0, 0.5, 0.01, 2.0), "decay": 1.0}
"""Rates at which the fit soon gets worse on views it does not see."""
