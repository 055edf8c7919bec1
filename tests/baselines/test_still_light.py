"""Light that is the same in all views, found beside matter; matter near the axis; weights by the misfit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.baselines import PrimalDual
from holosplat.baselines.holographic_tv import HolographicTV, holographic_tv
from holosplat.baselines.rays import rays_of
from holosplat.baselines.tomography import TotalVariation, near_axis, tv_solver
from holosplat.geometry import Grid, Views
from holosplat.metrics import dice
from holosplat.optics.patterns import smooth_modes
from holosplat.projectors.voxels import SliceProjector
from holosplat.units import wavenumber

SHAPE, COUNT = (5, 31), 9
DISCS = ((-5.0, 3.0, 6.0), (7.0, -4.0, 4.0))
"""x, z and radius of each disc [pixels]; the phantom is the same in all slices."""


def views() -> Views:
    return Views.evenly_spaced(COUNT, SHAPE, 1.0)


def truth() -> torch.Tensor:
    grid = Grid.of_views(views())
    x, _, z = np.meshgrid(*grid.axes(), indexing="ij")
    inside = sum((x - a) ** 2 + (z - b) ** 2 < r**2 for a, b, r in DISCS)
    return torch.from_numpy(np.asarray(inside, dtype=np.float32).transpose(2, 1, 0).copy())


def lines() -> torch.Tensor:
    projector = SliceProjector(Grid.of_views(views()), views())
    return projector.lines_out(projector.project(projector.volume_in(truth())))


def light(order: int = 2) -> torch.Tensor:
    """Some light [H, W] in pixels of path, as strong as the matter, whose mean is 0."""
    modes = smooth_modes(SHAPE, order)[1:]
    return torch.tensordot(torch.linspace(3, -2, len(modes)), modes, dims=1)


def solved(images: torch.Tensor, weights: torch.Tensor | None = None, **options) -> tuple[torch.Tensor, PrimalDual]:
    rays = rays_of(images, views(), Grid.of_views(views()))
    solver = tv_solver(rays, 1.0, TotalVariation(0.05, 100, 400, **options), lambda done: None, weights=weights)
    return solver.volume, solver


@pytest.mark.parametrize("weighted", [False, True])
def test_matter_and_light_are_told_apart(weighted):
    images = lines() + light()
    weights = torch.exp(-0.05 * lines()) if weighted else None
    found, solver = solved(images, weights, still_light=2)
    assert dice(found.numpy() > 0.5, truth().numpy() > 0.5) > 0.97
    torch.testing.assert_close(solver.still_light(images), light(), atol=0.6, rtol=0)
    blind, _ = solved(images, weights)
    assert dice(blind.numpy() > 0.5, truth().numpy() > 0.5) < 0.9


def test_the_duals_say_nothing_of_light_and_a_volume_without_is_the_same():
    """The optimality condition `Mᵀ q = 0`, with rays of unlike steps and weights; without light, light costs little."""
    weights = torch.exp(-0.05 * lines())
    found, solver = solved(lines(), weights, still_light=3)
    modes = smooth_modes(SHAPE, 3)[1:].flatten(1)
    total = solver.projector.lines_out(solver._residual_dual).sum(dim=0).flatten()
    assert float((modes @ total).abs().max()) < 1e-3
    assert float(solver._residual_dual.abs().max()) > 1e-3
    plain, _ = solved(lines(), weights)
    assert float((found - plain).abs().mean()) < 0.01


def test_matter_lies_near_the_axis():
    grid = Grid.of_views(views())
    near = near_axis(grid, 9.0)
    assert near.shape == grid.shape
    assert near[:, 0].sum().item() == pytest.approx(np.pi * 81, rel=0.05)
    found, _ = solved(lines(), inside=9.0)
    assert not bool(found[~near].any())
    assert bool(found[near].any())


def test_total_variation_weighs_as_much_as_the_misfit_asks():
    noise = torch.randn(COUNT, *SHAPE, generator=torch.Generator().manual_seed(0))
    _, calm = solved(lines(), misfit=2.0, discount=0.0)
    _, rough = solved(lines() + 3 * noise, misfit=2.0, discount=0.0)
    assert calm.radius < 0.2
    assert 2.0 < rough.radius < 6.5


def test_frames_in_contact_say_which_light_a_flat_left():
    """From frames to a volume: intensities in contact, whose light differs by a third from the flat."""
    pixel, material = 2e-5, hs.DeltaBeta(1e-6, 1e-9)
    mu = 2 * wavenumber(20.0) * material.beta
    exposures = hs.Exposures.of(replace(views(), pitch=pixel), 20.0, 0.0)
    frames = torch.exp(-mu * pixel * (lines() + light())).numpy()
    scan = hs.Scan(frames, exposures, np.zeros(COUNT, dtype=bool))
    options = HolographicTV(iterations=300, still_light=2, misfit=2.0, inside=12 * pixel)
    found, _ = holographic_tv(scan, material, options, lambda stage, part: None)
    blind, _ = holographic_tv(scan, material, replace(options, still_light=0), lambda stage, part: None)
    assert dice(found.numpy() > 0.5, truth().numpy() > 0.5) > 0.95
    assert dice(blind.numpy() > 0.5, truth().numpy() > 0.5) < 0.9
