"""Fits of more than matter: detector shifts, and the level of the light, beside a cloud."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from helpers.fit_balls import MATERIAL, PIXEL, RATES
from holosplat.fit.loop import Fit
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Views
from holosplat.matter import Matter
from holosplat.methods import FitOptions, gaussian_fit
from holosplat.model import Alignment, Instrument, LightField, Model, smooth_modes
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures, Scan

SHAPE, VIEWS = (21, 27), 5
OBJECT = ("object.centres", "object.log_scales", "object.raw_amplitudes")


def truth() -> GaussianCloud:
    """Blobs of three pixels."""
    r = torch.Generator().manual_seed(3)
    centres = 10 * (torch.rand(8, 3, generator=r) - 0.5)
    round_ones = torch.tensor([1.0, 0, 0, 0]).repeat(8, 1)
    raw = raw_of(0.5 + torch.rand(8, 1, generator=r))
    return GaussianCloud((centres, torch.full((8, 3), 0.8), round_ones, raw), PIXEL, Matter.one(*MATERIAL))


def start() -> GaussianCloud:
    """The blobs, somewhat off in place, size and amplitude."""
    r, cloud = torch.Generator().manual_seed(4), truth()
    centres = cloud.centres + 0.3 * torch.randn(8, 3, generator=r)
    scales = cloud.log_scales + 0.1 * torch.randn(8, 3, generator=r)
    raw = cloud.raw_amplitudes + 0.2 * torch.randn(8, 1, generator=r)
    return cloud.with_parameters({"centres": centres, "log_scales": scales, "raw_amplitudes": raw})


def exposures() -> Exposures:
    views = Views(Rotation.random(VIEWS, rng=2).as_matrix(), np.zeros((VIEWS, 2)), SHAPE, PIXEL)
    return Exposures.of(views, 20.0, 0.05, 0.3)


def scan_of(model: Model) -> Scan:
    """The model's frames, said to be of the planned exposures."""
    with torch.no_grad():
        return Scan(model.frames().numpy(), exposures(), np.zeros(VIEWS, dtype=bool))


def joint_fit(scan: Scan, free: tuple[str, ...], rates: dict[str, float], **parts) -> Fit:
    """A fit of the parameters `free` of a model that has more parts than matter."""
    options = FitOptions(Objective(), Schedule(steps=150, decay=0.02), replace(RATES, centres=0.05), backend="cpu")
    plan = gaussian_fit(scan, start(), options).plan
    problem = replace(plan.problem, model=replace(plan.problem.model, **parts), free=free)

    def joint_rates(factor: float, step: int) -> dict[str, float]:
        return {**plan.rates(factor, step), **{name: rate * factor for name, rate in rates.items()}}

    fit = Fit(replace(plan, problem=problem, rates=joint_rates))
    fit.run(lambda record: None)
    return fit


def away(shifts: np.ndarray) -> float:
    """Rms of detector shifts [V, 2] [pixels] but for what a shift of the whole object would be."""
    design = -exposures().views.rotations[:, :2].reshape(-1, 3)
    left = shifts.ravel() - design @ np.linalg.lstsq(design, shifts.ravel(), rcond=None)[0]
    return float(np.sqrt(np.mean(left**2)))


def test_detector_shifts_are_found_beside_the_cloud():
    errors = np.random.default_rng(5).normal(0, 1.0, (VIEWS, 2))
    true = Alignment(shifts=torch.from_numpy(errors))
    scan = scan_of(Model(truth(), Instrument(exposures(), 2), true))
    unknown = Alignment.planned(VIEWS, "shifts")
    fit = joint_fit(scan, (*OBJECT, "alignment.shifts"), {"alignment.shifts": 0.1}, alignment=unknown)
    found = fit.result().alignment
    assert found is not None
    assert found.shifts is not None
    assert away(errors) > 0.5
    assert away(found.shifts.numpy() - errors) < 0.1 * away(errors)
    assert away(-found.shifts.numpy() - errors) > away(errors)
    fixed = joint_fit(scan, OBJECT, {}, alignment=unknown)
    assert torch.equal(fixed.result().alignment.shifts, torch.zeros(VIEWS, 2).double())
    with torch.no_grad():
        frames = [done.result().frames().numpy() for done in (fit, fixed)]
    losses = [float(np.abs(predicted - scan.frames).mean()) for predicted in frames]
    assert losses[0] < 0.2 * losses[1]


def test_the_level_of_the_light_is_found_beside_the_cloud():
    levels = torch.tensor([0.05, -0.03, 0.0, 0.08, -0.06])[:, None]
    even = LightField.even(VIEWS, smooth_modes(SHAPE, 0))
    scan = scan_of(Model(truth(), Instrument(exposures(), 2), light=replace(even, coefficients=levels)))
    fit = joint_fit(scan, (*OBJECT, "light.coefficients"), {"light.coefficients": 0.005}, light=even)
    found = fit.result().light
    assert found is not None
    np.testing.assert_allclose(found.coefficients, levels, atol=0.003)
