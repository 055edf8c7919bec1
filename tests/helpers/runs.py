"""Cells whose scan the tests of reconstruction share, and options for short runs."""

from __future__ import annotations

from holosplat.baselines import HolographicTV
from holosplat.fit.density import DensityControl
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.methods import FitOptions, Gaussians
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene

PIXEL = 3.2e-6
SHAPE = (40, 48)
CELL = HAEMOGLOBIN.delta_beta(20)
KNOWN = MaterialPrior.known(CELL)
STEPS = 12

SMALL = Gaussians(
    spacing_px=1.5,
    approximate_steps=10,
    volume=HolographicTV(iterations=40, corrections=3, inner=10, refine=1),
    fit=FitOptions(Objective(tv_volume=0.05, overfull=10.0), Schedule(steps=STEPS)),
)
RANDOM = Gaussians(
    start="random",
    random_count=150,
    fit=FitOptions(
        Objective(l1=1.0, ssim=0.2, frc=0.1, tv_volume=0.01),
        Schedule(steps=STEPS, views_per_step=2, validation_views=1, validate_every=4, volume_edge=12),
        density=DensityControl(every=3, start=0.0, stop=0.9, grow_fraction=0.1),
    ),
)
"""A fit in which everything is drawn at random that can be."""


def scene() -> MeshScene:
    box = (SHAPE[1] * PIXEL, SHAPE[0] * PIXEL, SHAPE[1] * PIXEL)
    return MeshScene.of_one_material(random_cells(6, box, 1, 14 * PIXEL), CELL)


class Interruption:
    """A progress that presses Ctrl-C (or breaks down) after a step of the fit."""

    def __init__(self, after: int, error: type[BaseException] = KeyboardInterrupt) -> None:
        self.after, self.error, self.stages = after, error, []

    def __call__(self, stage: str, fraction: float, record: dict[str, float]) -> None:
        self.stages.append(stage)
        if stage == "fit" and record["step"] == self.after:
            raise self.error
