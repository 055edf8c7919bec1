"""What holosplat does in the arena, as acts; each imports what it needs inside, in a process of its own."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from holosplat.geometry import Grid, Views
from holosplat.matter import MaterialPrior, Matter
from holosplat.scan import Exposures, Scan
from holosplat.units import wavenumber

from .contest import Answer, Question


def views_of(question: Question) -> Views:
    """The views."""
    return Views.from_angles(np.rad2deg(question.angles), question.frames.shape[1:], question.pixel)


def exposures_of(question: Question) -> Exposures:
    """The exposures."""
    return Exposures.of(views_of(question), question.energy_kev, question.distance)


def radian(question: Question) -> float:
    """δ of which a pixel's length turns the phase by one radian."""
    return 1 / (wavenumber(question.energy_kev) * question.pixel)


def slices(question: Question) -> Callable[[], Answer]:
    """Kernels: the slice matrices of tomography; strips, exact for square voxels."""
    from holosplat.projectors.voxels import SliceProjector

    views = views_of(question)
    projector = SliceProjector(Grid.of_views(views), views)
    volume, lines = (torch.from_numpy(a).float() for a in (question.volume, question.lines))

    def run() -> Answer:
        forward = projector.lines_out(projector.project(projector.volume_in(volume))) / question.pixel
        back = projector.volume_out(projector.backproject(projector.lines_in(lines))) / question.pixel
        return {"lines": forward.numpy(), "volume": back.numpy()}

    return run


def step(question: Question) -> Callable[[], Answer]:
    """Steps: voxels through the waves, by the compiled kernels and their adjoints."""
    from holosplat.model import Instrument
    from holosplat.representations import VoxelGrid

    exposures = exposures_of(question)
    instrument, grid, delta = Instrument(exposures), Grid.of_views(exposures.views), radian(question)
    matter, frames = Matter.one(delta, delta / question.ratio), torch.from_numpy(question.frames).float()

    def run() -> Answer:
        values = torch.from_numpy(question.volume).float()[None].requires_grad_()
        shown = instrument.frames(VoxelGrid(values, grid, matter).project(instrument.poses))
        (0.5 * (shown - frames).square().sum()).backward()
        assert values.grad is not None
        return {"gradient": values.grad[0].numpy()}

    return run


def _retrieval(name: str, question: Question) -> Callable[[], Answer]:
    from holosplat.optics.retrieval import RETRIEVALS

    exposures, frames, delta = exposures_of(question), torch.from_numpy(question.frames), radian(question)

    def run() -> Answer:
        thickness = RETRIEVALS[name](frames, exposures, delta, delta / question.ratio)
        return {"lines": thickness.numpy() / question.pixel}

    return run


contrast_transfer = partial(_retrieval, "ctf")
"""Retrieval: the linear inverse."""
tikhonov = partial(_retrieval, "tikhonov")
"""Retrieval: nonlinear, with positivity; what the tomographies are given, too."""


def _tomography(name: str, question: Question) -> Callable[[], Answer]:
    from holosplat.baselines import TOMOGRAPHIES

    views = views_of(question)
    grid, lines = Grid.of_views(views), torch.from_numpy(question.lines).float() * question.pixel

    def run() -> Answer:
        return {"volume": TOMOGRAPHIES[name](lines, views, grid, None, lambda fraction: None).numpy()}

    return run


backprojection = partial(_tomography, "fbp")
"""Tomography: filtered back-projection."""
sirt = partial(_tomography, "sirt-nonneg")
"""Tomography: SIRT without negative values."""
total_variation = partial(_tomography, "tv")
"""Tomography: total variation without negative values."""


def _job(method: str, question: Question) -> Callable[[], Answer]:
    from holosplat.methods import METHODS
    from holosplat.workflows.reconstruct import reconstruct

    exposures = exposures_of(question)
    scan = Scan(question.frames.astype(np.float32), exposures, np.zeros(len(exposures), dtype=bool))
    prior, grid = MaterialPrior.of_ratio(question.ratio), Grid.of_views(exposures.views)

    def run() -> Answer:
        found = reconstruct(scan, prior, METHODS[method]).object
        volume = found.voxelise(grid)
        return {"volume": volume.delta / radian(question), "beta": volume.beta}

    return run


default = partial(_job, "auto")
"""Jobs: what `holosplat reconstruct` does by itself."""
two_steps = partial(_job, "tikhonov-tv")
"""Jobs: nonlinear Tikhonov retrieval of each view, then total variation."""
