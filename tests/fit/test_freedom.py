"""Where beams are, fitted together with matter: the gauge, what is expected, and distances that are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.bumpy import bumpy, surfaces
from holosplat.align.derivatives import moved_onto
from holosplat.beamline.misalignment import Misalignment
from holosplat.checks import InputError
from holosplat.fit.pose_refinement import GeometryPrior, PoseRefinement, mean_distance_error, projection, with_alignment
from holosplat.fit.problem import Batch, Schedule
from holosplat.geometry import Views, rotation_y
from holosplat.methods.surface_fit import SurfaceFit, surface_fit
from holosplat.model import Alignment, Instrument, Model, measure
from holosplat.scan import Exposures, Scan

PIXEL, SHAPE = 1e-6, (33, 46)
"""A pixel of less than half a fringe at 0.1 m."""
ANY = Rotation.random(5, rng=np.random.default_rng(0)).as_matrix()


def matter(subdivisions: int = 3, swollen: float = 1.0):
    parts = ((8.0, (-8.0, 1.0, 2.0)), (5.0, (9.0, -4.0, -6.0)), (4.0, (2.0, 7.0, 10.0)))
    return surfaces(*(bumpy(subdivisions, swollen * radius, centre) for radius, centre in parts), unit=PIXEL)


def misaligned(distance: float = 0.1) -> tuple[Scan, Exposures]:
    """Frames of bumpy balls in five views, and where these are; the plan is off by a share of a pixel and 3 %."""
    planned = Exposures.of(Views(ANY, np.zeros((5, 2)), SHAPE, PIXEL), 20.0, distance, 0.3)
    true = Misalignment(0.3, 0.3, 0.03, seed=3).true_exposures(planned)
    return Scan(measure(matter(), true, 3).detach().numpy(), planned, np.zeros(5, dtype=bool)), true


def free(count: int = 5, **known: float) -> PoseRefinement:
    return replace(PoseRefinement(1.0, 0.02, 0.02, 0.03, np.zeros((count, 7)), edges=True), **known)


OPTIONS = SurfaceFit(schedule=Schedule(steps=30, oversample=3, decay=0.2))


@pytest.fixture(scope="module")
def fitted():
    scan, true = misaligned()
    fit = surface_fit(scan, matter(3, 1.03), OPTIONS, freedom=free())
    saved = []
    fit.run(lambda record: saved.append(fit.state_dict()) if record["step"] == 20 else None)
    return scan, true, fit, saved[0]


def test_a_fit_finds_matter_shifts_and_distances_together(fitted):
    """From distances that are wrong by 3 %, and a body that is too large by as much."""
    scan, true, fit, _ = fitted
    alignment = fit.result().alignment
    assert alignment is not None
    assert alignment.shifts is not None
    assert alignment.turns is not None
    found = alignment.exposures(scan.exposures)
    before, after = (np.abs(e.distance / true.distance - 1) for e in (scan.exposures, found))
    assert before.max() > 0.03
    assert after.max() < 0.01
    wrong, right = (moved_onto(e.views, true.views) for e in (scan.exposures, found))
    assert np.abs(wrong.shifts - true.views.shifts).max() > 0.2 * PIXEL
    assert np.abs(right.shifts - true.views.shifts).max() < 0.08 * PIXEL
    design = scan.views.rotations[:, :2].reshape(-1, 3)
    assert np.abs(design.T @ alignment.shifts.detach().numpy().reshape(-1)).max() < 1e-9
    turns = np.einsum("vji,vj->i", scan.views.rotations, alignment.turns.detach().numpy())
    assert np.abs(turns).max() < 1e-9


def test_it_goes_on_where_it_was_stopped(fitted):
    """Bit for bit, the geometry included."""
    scan, _, fit, saved = fitted
    again = surface_fit(scan, matter(3, 1.03), OPTIONS, freedom=free())
    again.load(saved)
    again.run(lambda record: None)
    for name, value in fit.result().parameters().items():
        assert torch.equal(value, again.result().parameters()[name]), name


def test_what_is_known_stays_and_without_freedom_there_is_no_geometry():
    scan, _ = misaligned()
    quick = replace(OPTIONS, schedule=Schedule(steps=2, oversample=1))
    fit = surface_fit(scan, matter(1), quick, freedom=free(shift=0.0, angle=0.0, distance=0.0))
    fit.run(lambda record: None)
    assert [name for name in fit.result().parameters() if name.startswith("alignment")] == ["alignment.turns"]
    turns = fit.result().parameters()["alignment.turns"]
    assert not turns[:, :2].any()
    assert turns[:, 2].abs().min() > 0
    for nothing in (None, free(shift=0.0, angle=0.0, roll=0.0, distance=0.0)):
        assert surface_fit(scan, matter(1), quick, freedom=nothing).result().alignment is None


def test_the_mean_distance_stays_where_fringes_are_narrower_than_pixels():
    """At a hundredth of the distance the first fringe is a quarter of a pixel."""
    scan, _ = misaligned(0.001)
    quick = replace(OPTIONS, schedule=Schedule(steps=3, oversample=2))
    fit = surface_fit(scan, matter(1), quick, freedom=free())
    fit.run(lambda record: None)
    stretches = fit.result().parameters()["alignment.stretches"]
    assert stretches.abs().max() > 1e-4
    assert abs(float(stretches.mean())) < 1e-12
    assert not free().tells_mean(scan.exposures)
    wide = misaligned(0.1)[0].exposures
    assert free().tells_mean(wide)
    assert not replace(free(), edges=False).tells_mean(wide)
    assert mean_distance_error(scan.exposures) == pytest.approx(0.015 * 1e-12 / (6.199e-11 * 0.001), rel=1e-3)


def test_projections_take_out_common_motions_alone():
    """Of what is not free nothing is left; a turn of the object about the one axis of all views is common, too."""
    motions = ANY.reshape(-1, 3)
    every = projection(motions, np.ones(15, dtype=bool))
    assert np.linalg.matrix_rank(every.numpy()) == 12
    assert torch.allclose(every @ torch.from_numpy(motions), torch.zeros(15, 3, dtype=torch.float64), atol=1e-12)
    roll = projection(motions, np.tile([False, False, True], 5))
    assert torch.equal(roll, torch.diag(torch.tensor([0.0, 0, 1] * 5, dtype=torch.float64)))
    across = projection(rotation_y([0, 40, 90]).reshape(-1, 3), np.tile([True, True, False], 3))
    about = torch.tensor([0.0, 1, 0] * 3, dtype=torch.float64)
    assert float((across @ about).abs().max()) < 1e-12
    assert np.linalg.matrix_rank(across.numpy()) == 5
    nothing = projection(np.ones((4, 1)), np.zeros(4, dtype=bool))
    assert not nothing.any()


def test_what_is_expected_counts_from_the_plan():
    """Half the squares of all numbers in their deviations, those found before included; of fixed ones nothing."""
    so_far = np.array([[2.0, 0, 0, 0, 0.04, 0, 0], [0, 0, 0, 0, 0, 0.06, 0.05]])
    known = PoseRefinement(2.0, 0.0, 0.02, 0.03, so_far, 0.01)
    exposures = Exposures.of(Views(ANY[:2], np.zeros((2, 2)), SHAPE, PIXEL), 20.0, 0.1)
    model = Model(matter(1), Instrument(exposures), Alignment.planned(2, "shifts", "turns", "stretches", "magnified"))
    (part,) = GeometryPrior(known, 0.5, torch.device("cpu"))(model, Batch(None, torch.zeros(3), torch.zeros(()), 0))
    assert float(part.value) == pytest.approx(0.5 * (1 + 4 + 4 + 25))
    assert part.weight == 0.5
    with pytest.raises(InputError, match="so_far"):
        PoseRefinement(1.0, 0.0, 0.0, 0.0, np.zeros((3, 5)))


def test_what_a_fit_found_is_added_and_places_the_frames():
    """Of two fits one after the other; pixels and distances, too, and a view that is set aside stays."""
    exposures = misaligned()[0].exposures
    r = torch.Generator().manual_seed(0)
    sizes = ((4, 3), (4, 2), (4,), (4,))
    some = [0.01 * torch.randn(*size, generator=r, dtype=torch.float64) for size in sizes]
    found = Alignment(some[0], some[1], some[2], magnified=some[3])
    start = replace(free(), so_far=np.full((5, 7), 0.5))
    after = start.after(found)
    numbers = torch.cat([some[1], some[0], some[2][:, None], some[3][:, None]], dim=1).numpy()
    placed = with_alignment(exposures, found)
    aside = np.flatnonzero((after.so_far == 0.5).all(axis=1))
    assert len(aside) == 1
    fitted = np.delete(np.arange(5), aside)
    np.testing.assert_allclose(after.so_far[fitted], 0.5 + numbers, rtol=1e-6)
    wanted = found.exposures(exposures[fitted])
    for name in ("pixel_sizes", "shifts", "rotations"):
        np.testing.assert_allclose(getattr(placed.views, name)[fitted], getattr(wanted.views, name), rtol=1e-12)
        np.testing.assert_array_equal(getattr(placed.views, name)[aside], getattr(exposures.views, name)[aside])
    np.testing.assert_allclose(placed.distance[fitted], wanted.distance)
    assert np.ptp(placed.views.pixel_sizes) > 1e-3 * exposures.views.pitch
