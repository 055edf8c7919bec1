"""Forecasts by mechanics that are fitted to the frames of a window themselves (4D-Var).

The model of `assimilate` is a strong constraint: from the first time of the window on nothing but the flow of the
channel and the membranes moves the cells. So what the frames of all these times say goes into the peak of the flow,
the shear modulus, and where and how deformed each cell is at first; from there the model runs through the window and
on.
"""

from __future__ import annotations

import numpy as np

from ..mesh import TriangleMesh
from ..metrics.volumes import normal_distance
from ..scan import Scan
from .assimilate import MOST_UNKNOWNS, Assimilated, Assimilation, assimilate
from .dynamics import Window
from .forecast import Forecast
from .remainder import beside, only

SAME = 1e-3
"""Share of a step within which two times are one."""
STEPS = 20
"""Of L-BFGS, at most."""


def carry_by_frames(window: Window, train: Scan, oversample: int) -> tuple[Forecast, dict[str, float]]:
    """The cells of `window`, fitted to its frames and carried on; and what was found of the flow.

    train: frames of the run, relative to the light, of which those of the window's times are taken, without what all
    other bodies predict of them; oversample: wave samples a pixel. The band has the part of the state, as fits to
    halves tell it, and how far the model ends from the surfaces that were tracked, growing with time.
    """
    slack = SAME * float(np.diff(window.past).min())
    frames = train[np.flatnonzero(train.exposures.time >= window.past[0] - slack)]
    others = [k for k in range(window.bodies.count) if k not in window.cells]
    if others:
        frames = beside(frames, only(window.bodies, others), oversample)
    options = Assimilation(window.peak, window.options.shear, oversample=oversample, steps=STEPS)
    start = window.meshes(0)
    found = assimilate(frames, window.model, start, window.bodies.matter, options)
    later = window.model.run(found.meshes, np.r_[window.past[0], window.every], found.unknowns)
    later = [own[1:] for own in later]
    pairs = zip(later, window.meshes(-1))
    left = np.array([normal_distance(TriangleMesh(own[0], seen.faces), seen) for own, seen in pairs])
    return window.gone_on(later, left), _as_plain_numbers(found, options, len(start))


def _as_plain_numbers(found: Assimilated, options: Assimilation, cells: int) -> dict[str, float]:
    """Plain numbers: peak and modulus, their relative standard errors, and the number of chosen unknowns."""
    said = {"peak_m_s": float(found.unknowns.peak), "shear_n_m": float(found.unknowns.shear)}
    said |= {f"{name}_told": value for name, value in found.told.items()}
    said |= {"loss_before": found.losses[0], "loss_after": found.losses[1]}
    count = options.unknowns(cells)
    return said | ({"unasked": float(count)} if count > MOST_UNKNOWNS else {})
