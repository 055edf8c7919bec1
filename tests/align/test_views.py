"""Poses of single views: derivatives, steps, the common motion, and scans of balls whose poses are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.nn.functional import interpolate, pad

from helpers.discs import ball_lines
from helpers.misaligned_balls import BALLS, MATERIAL, PIXEL, scan_of
from holosplat.align import AlignedViews, PoseOptions, PosePrior, align_views
from holosplat.align.derivatives import NUMBERS, Normal, Predicted, blurred, in_pixels, moved_onto, projections, step
from holosplat.align.fixed_matter import EDGES, SURFACES, VOXELS
from holosplat.align.initial_geometry import mirrored, shifts_by_mass
from holosplat.align.views import PLANNED, POSES, Judged
from holosplat.beamline.misalignment import Misalignment
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import MaterialPrior
from holosplat.model import Instrument
from holosplat.scan import Exposures, Scan
from holosplat.volume import LineIntegrals

QUICK = PoseOptions(rounds=2, retrieval=15, first=20, edges=0, few_views=2)
"""Options of tests that do not ask how near the poses come; test_rehearsal.py has what few views need beside."""


def apart(found: Exposures, true: Exposures) -> tuple[float, float, float]:
    """Rms errors but for a motion of the whole object: shifts [pixels], turns across the beam, and roll [degrees]."""
    moved = moved_onto(found.views, true.views)
    turns = np.einsum("vij,vkj->vik", moved.rotations, true.views.rotations)
    degrees = Rotation.from_matrix(turns).as_rotvec(degrees=True)
    shifts = (moved.shifts - true.views.shifts) / PIXEL
    across, roll = degrees[:, :2], degrees[:, 2]
    return float(np.sqrt((shifts**2).mean())), float(np.sqrt((across**2).mean())), float(np.sqrt((roll**2).mean()))


@pytest.fixture(scope="module")
def misaligned() -> tuple[Scan, Exposures, AlignedViews]:
    scan, true = scan_of(Misalignment(1.0, 0.6, 0.02, seed=2))
    options = PoseOptions(PosePrior(distance=0.02), rounds=2, retrieval=20, edges=25)
    return scan, true, align_views(scan, MaterialPrior.known(MATERIAL), options)


def test_shifts_turns_and_roll_of_every_view_are_found(misaligned):
    """Of held-out views, too: the edges of balls say it several times better than voxels."""
    scan, true, found = misaligned
    before, after = apart(scan.exposures, true), apart(found.exposures, true)
    assert min(before) > 0.25
    assert after[0] < 0.02
    assert after[1] < 0.12
    assert after[2] < 0.08


def test_surfaces_are_taken_where_matter_has_edges(misaligned):
    """And not for soft lumps of the same material, whose frames voxels explain."""
    assert [one.choice for one in misaligned[2].decisions if one.name == EDGES] == [SURFACES]
    scan, true, _ = misaligned
    instrument = Instrument(true, 1)
    my, mx = instrument.margin
    wide = pad(torch.from_numpy(PIXEL * gaussians(in_pixels(true.views))).float(), (mx, mx, my, my))[:, None]
    frames = instrument.frames(LineIntegrals(wide, ((MATERIAL.delta, MATERIAL.beta),)))
    few = PosePrior(shift=1.0, angle=0.0, roll=0.0)
    options = PoseOptions(few, rounds=1, retrieval=8, first=10, steps=4, few_views=2, edges=12)
    found = align_views(Scan(frames.numpy(), true, scan.is_test), MaterialPrior.known(MATERIAL), options)
    assert [one.choice for one in found.decisions if one.name == EDGES] == [VOXELS]


def test_edges_tell_the_distances_beside_their_mean(misaligned):
    """The first fringe is narrower than a pixel: the mean of the training views is as planned, and few are held out."""
    scan, true, found = misaligned
    train = ~scan.is_test
    before, after = (np.log(e.distance / true.distance)[train] for e in (scan.exposures, found.exposures))
    assert before.std() > 0.015
    assert after.std() < 0.4 * before.std()
    assert after.mean() == pytest.approx(before.mean(), abs=1e-3)
    np.testing.assert_array_equal(found.exposures.distance[~train], scan.exposures.distance[~train])
    assert np.all(found.errors[:, 5] > 0.004)


def test_distances_are_as_planned_where_no_edges_are_known():
    scan, _ = scan_of(Misalignment(0.0, 0.0, 0.02, seed=2), 6)
    options = replace(QUICK, uncertain=PosePrior(shift=1.0, angle=0.0, roll=0.0, distance=0.02), rounds=1)
    found = align_views(scan, MaterialPrior.known(MATERIAL), options)
    np.testing.assert_array_equal(found.exposures.distance, scan.exposures.distance)
    assert any("distances are as planned" in word for word in found.words)


def test_what_is_left_falls_and_is_told(misaligned):
    scan, _, found = misaligned
    assert found.after.mean() < 0.85 * found.before.mean()
    assert "hardly told: distance" in [word.split(", in views")[0] for word in found.words]  # its mean is the plan's
    text = "\n".join(found.lines())
    assert "rms" in text
    assert len(found.lines()) == 3 + len(found.words) + len(found.decisions) + len(scan)
    moved = moved_onto(found.exposures.views, scan.views)
    np.testing.assert_allclose(moved.shifts, found.exposures.views.shifts, atol=1e-3 * PIXEL)
    np.testing.assert_allclose(moved.rotations, found.exposures.views.rotations, atol=1e-6)


def test_the_errors_are_those_that_are_said(misaligned):
    """To within a factor of twenty, on matter so small; what remains without noise is smaller than they are."""
    _, true, found = misaligned
    shift, turn, roll = apart(found.exposures, true)
    said = np.sqrt(np.square(found.errors).mean(0))
    for error, stated in ((shift, said[:2].mean()), (turn, said[2:4].mean()), (roll, said[4])):
        assert 0.05 < error / stated < 2


def test_what_is_said_to_be_known_stays():
    scan, _ = scan_of(Misalignment(1.0, 0.6, 0.0, seed=2), 6)
    options = replace(QUICK, uncertain=PosePrior(shift=1.0, angle=0.0, roll=0.0))
    found = align_views(scan, MaterialPrior.known(MATERIAL), options)
    np.testing.assert_allclose(found.exposures.views.rotations, scan.views.rotations, atol=1e-12)
    assert np.abs(found.changes[:, :2]).max() > 0.3
    assert np.abs(found.changes[:, 2:]).max() < 1e-9


def test_a_good_plan_is_kept():
    """It loses nothing, for what differs by less than can be known is put back."""
    scan, _ = scan_of(Misalignment(), 8)
    found = align_views(scan, MaterialPrior.known(MATERIAL), replace(QUICK, rounds=3))
    assert [one.choice for one in found.decisions if one.name == POSES] == [PLANNED]
    np.testing.assert_allclose(found.exposures.views.shifts, scan.views.shifts, atol=1e-9 * PIXEL)


def test_large_shifts_begin_with_centres_of_mass():
    """Five pixels are more than the slopes of cells reach; the held-out views are found, too."""
    scan, true = scan_of(Misalignment(4.0, 0.0, 0.0, seed=4), 8)
    options = replace(QUICK, uncertain=PosePrior(shift=4.0, angle=0.0, roll=0.0), rounds=3)
    found = align_views(scan, MaterialPrior.known(MATERIAL), options)
    assert apart(scan.exposures, true)[0] > 2.5
    assert apart(found.exposures, true)[0] < 0.25


def test_centres_of_mass_meet_in_one_point():
    views = Views(Rotation.random(7, rng=np.random.default_rng(2)).as_matrix(), np.zeros((7, 2)), (45, 51), 1.0)
    shifts = np.random.default_rng(3).normal(size=(7, 2))
    lines = np.sum([ball_lines(replace(views, shifts=shifts), ball, 2).numpy() for ball in BALLS], axis=0)
    found = replace(views, shifts=shifts_by_mass(lines, views))
    true = moved_onto(replace(views, shifts=shifts), found)
    np.testing.assert_allclose(true.shifts, found.shifts, atol=0.02)


def test_mirrored_frames_are_named():
    images = torch.rand(4, 9, 13, generator=torch.Generator().manual_seed(0))
    frames = torch.stack([images[0], images[1].flip(-1), images[2].flip(-2), images[3].flip((-1, -2))])
    assert mirrored(frames + 0.01, images) == ["", "x", "y", "xy"]


def test_a_mirrored_beam_is_reported(misaligned):
    scan, true, _ = misaligned
    frames = scan.frames.copy()
    frames[3] = frames[3, :, ::-1]
    known = Scan(frames, true, scan.is_test)
    options = replace(QUICK, uncertain=PosePrior(shift=0.2, angle=0.0, roll=0.0), rounds=1)
    found = align_views(known, MaterialPrior.known(MATERIAL), options)
    assert [word for word in found.words if "mirrored" in word] == ["view 3 looks mirrored: reverse its columns"]


@pytest.mark.parametrize(("enough", "kept"), [(10, True), (4, False)])
def test_few_training_frames_do_not_judge_what_was_found(monkeypatch, enough, kept):
    """They agree with any poses, so that what is left of them says nothing; of enough frames it does."""
    left = iter([1.0, 1.1])

    def judged(_, scan, *__):
        size = next(left)
        return Judged(np.full(len(scan), size), [""] * len(scan), torch.full(scan.frames.shape, size))

    worse = classmethod(judged)
    monkeypatch.setattr(Judged, "of", worse)
    scan, _ = scan_of(Misalignment(1.0, 0.0, 0.0, seed=2), 5, 6)
    options = replace(QUICK, uncertain=PosePrior(angle=0.0, roll=0.0), rounds=1, few_views=enough)
    found = align_views(scan, MaterialPrior.known(MATERIAL), options)
    assert found.changes.any() == kept


def test_few_views_do_not_tell_turns_from_depth():
    scan, _ = scan_of(Misalignment(0.5, 0.3, 0.0, seed=1), 4, 4)
    found = align_views(scan, MaterialPrior.known(MATERIAL), replace(QUICK, rounds=1))
    assert any("angles between beams" in word for word in found.words)
    with pytest.raises(InputError, match="2 training frames"):
        align_views(scan[[0, 2]].with_split(np.array([False, True])), MaterialPrior.known(MATERIAL))
    with pytest.raises(InputError, match="shift"):
        PosePrior(shift=-1.0)


PLACES, WIDTH = ((4.0, -3.0, 5.0), (-6.0, 2.0, 1.0)), 3.0
"""Centres and standard deviation of round Gaussians [pixels]."""


def gaussians(views: Views) -> np.ndarray:
    """Their line integrals [V, H, W], blurred by the voxels' hats of variance 1/6."""
    (h, w), variance = views.shape, WIDTH**2 + 1 / 6
    x, y = np.arange(w) + 0.5 - w / 2, np.arange(h)[:, None] + 0.5 - h / 2
    mass = (2 * np.pi) ** 1.5 * WIDTH**3 / (2 * np.pi * variance)
    images = []
    for rotation, shift in zip(views.rotations, views.shifts):
        at = [rotation[:2] @ np.array(place) - shift for place in PLACES]
        images.append(sum(mass * np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * variance)) for a, b in at))
    return np.array(images)


def smooth(images: np.ndarray) -> np.ndarray:
    """Without the ripple of the lattice, as the fit sees them."""
    return blurred(torch.from_numpy(images).double(), 1.0).numpy()


@pytest.mark.parametrize("number", range(5))
def test_derivatives_of_projections_are_those_of_gaussians(number):
    views = Views(
        Rotation.random(3, rng=np.random.default_rng(3)).as_matrix(),
        np.array([[1.0, -2], [0, 0], [0.5, 3]]),
        (31, 37),
        1.0,
    )
    grid = Grid.centred((41, 35, 39), 1.0)
    x, y, z = grid.axes()
    volume = sum(
        np.exp(-((x - a) ** 2 + (y[:, None] - b) ** 2 + (z[:, None, None] - c) ** 2) / (2 * WIDTH**2))
        for a, b, c in PLACES
    )

    def moved(size: float) -> Views:
        shifts, turn = views.shifts.copy(), np.zeros(3)
        if number < 2:
            shifts[:, number] += size
        else:
            turn[number - 2] = size
        return replace(views, rotations=Rotation.from_rotvec(turn).as_matrix() @ views.rotations, shifts=shifts)

    wanted = smooth((gaussians(moved(1e-3)) - gaussians(moved(-1e-3))) / 2e-3)
    lines, slopes = projections(torch.from_numpy(volume).float(), grid, views)
    np.testing.assert_allclose(smooth(lines.numpy()), smooth(gaussians(views)), atol=0.02 * gaussians(views).max())
    found = smooth(slopes[:, number].numpy())
    assert np.linalg.norm(found - wanted) < 0.1 * np.linalg.norm(wanted)
    assert (found * wanted).sum() / (wanted**2).sum() == pytest.approx(1, abs=0.04)


def test_a_step_solves_a_linear_problem_and_the_prior_holds_back():
    r = torch.Generator().manual_seed(1)
    coarse = torch.randn(2, len(NUMBERS), 7, 9, generator=r)
    columns = interpolate(coarse, size=(35, 45), mode="bilinear")
    true = torch.linspace(-1, 1, 2 * len(NUMBERS)).reshape(2, -1).double()
    measured = torch.einsum("vk,vkhw->vhw", true.float(), columns) + 1e-3 * torch.randn(2, 35, 45, generator=r)
    here, nothing = Predicted(torch.zeros(2, 35, 45), columns), torch.zeros_like(true)
    wide = torch.full((len(NUMBERS),), 10.0, dtype=torch.float64)
    first = step(Normal.of(measured, here, 1.0), nothing, wide)
    then = Predicted(torch.einsum("vk,vkhw->vhw", first.numbers.float(), columns), columns)
    second = step(Normal.of(measured, then, 1.0), first.numbers, wide)
    torch.testing.assert_close(second.numbers, true, atol=2e-3, rtol=0)
    assert float(((second.numbers - true) ** 2 / second.covariances.diagonal(dim1=1, dim2=2)).mean()) < 4
    held = wide.clone()
    held[2] = 0
    kept = step(Normal.of(measured, here, 1.0), nothing, held)
    assert not kept.numbers[:, 2].any()
    assert not kept.covariances[:, 2].any()
    narrow = step(Normal.of(measured, here, 1.0), nothing, torch.full_like(wide, 1e-6))
    assert float(narrow.numbers.abs().max()) < 1e-3


def test_a_motion_of_the_whole_object_is_taken_away():
    views = Views(
        Rotation.random(5, rng=np.random.default_rng(1)).as_matrix(),
        np.random.default_rng(0).normal(size=(5, 2)),
        (9, 11),
        1.0,
    )
    turn, motion = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), np.array([0.3, -1.0, 2.0])
    rotations = views.rotations @ turn
    moved = replace(views, rotations=rotations, shifts=views.shifts + rotations[:, :2] @ motion)
    back = moved_onto(moved, views)
    np.testing.assert_allclose(back.rotations, views.rotations, atol=1e-9)
    np.testing.assert_allclose(back.shifts, views.shifts, atol=1e-9)
