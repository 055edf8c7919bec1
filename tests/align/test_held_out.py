"""Held-out frames beside finished matter, and the geometry that a run keeps."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.misaligned_balls import BALLS, MATERIAL, PIXEL, SHAPE, scan_of
from holosplat.align import PoseOptions, PosePrior
from holosplat.align.geometry import Geometry, wanted
from holosplat.align.held_out import place_frames
from holosplat.align.views import AlignedViews
from holosplat.beamline.misalignment import Misalignment
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.representations import VoxelGrid


def balls() -> VoxelGrid:
    """The balls on voxels of a pixel, each the mean over 4³ points."""
    fine = 4
    grid = Grid.centred((SHAPE[1], SHAPE[0], SHAPE[1]), PIXEL)
    x, y, z = ((np.arange(n * fine) + 0.5 - n * fine / 2) / fine for n in (grid.shape[2], grid.shape[1], grid.shape[0]))
    inside = sum(
        (x - a) ** 2 + (y[:, None] - b) ** 2 + (z[:, None, None] - c) ** 2 < radius**2 for a, b, c, radius in BALLS
    )
    shape = [size for n in grid.shape for size in (n, fine)]
    means = np.asarray(inside, dtype=np.float32).reshape(shape).mean((1, 3, 5))
    return VoxelGrid(torch.from_numpy(means)[None], grid, Matter.one(*MATERIAL))


@pytest.mark.parametrize(("error", "rounds"), [(1.0, 6), (4.0, 4)])
def test_frames_are_found_beside_matter_that_is_known(error, rounds):
    """One by one, and with no motion of the object to be chosen."""
    scan, true = scan_of(Misalignment(error, 0.6, 0.0, seed=3), 3, 3)
    options = PoseOptions(PosePrior(shift=2 * error), rounds=rounds, retrieval=15)
    found = place_frames(balls(), scan, options)
    turns = np.einsum("vij,vkj->vik", found.exposures.views.rotations, true.views.rotations)
    degrees = np.abs(Rotation.from_matrix(turns).as_rotvec(degrees=True))
    shifts = np.abs(found.exposures.views.shifts - true.views.shifts) / PIXEL
    assert np.abs(scan.views.shifts - true.views.shifts).max() > 0.8 * error * PIXEL
    assert shifts.max() < 0.1
    assert degrees.max() < 0.5
    assert np.all(found.after < 0.9 * found.before)
    np.testing.assert_array_equal(found.exposures.distance, scan.exposures.distance)


def test_frames_that_are_where_they_should_be_stay_near():
    scan, true = scan_of(Misalignment(), 2, 2)
    found = place_frames(balls(), scan, PoseOptions(PosePrior(angle=0.0, roll=0.0), rounds=2))
    assert np.abs(found.changes[:, :2]).max() < 0.05
    np.testing.assert_array_equal(found.exposures.views.rotations, true.views.rotations)


def test_a_geometry_goes_into_files_and_onto_scans():
    scan, true = scan_of(Misalignment(1.0, 0.6, 0.0, seed=3), 4, 2)
    train = np.flatnonzero(~scan.is_test)
    there = (np.full((2, 7), 0.5), np.full((2, 7), 0.1), np.zeros(2), np.full(2, 0.2), np.full(2, 0.1), ("kept",))
    found = AlignedViews(true[train], *there)
    geometry = Geometry.of_training(scan, found, PosePrior(angle=0.0))
    again = Geometry.from_dict(json.loads(json.dumps(geometry.as_dict())))
    assert again.refined == ("shifts", "roll")
    placed = again.applied(scan)
    np.testing.assert_array_equal(placed.views.shifts[train], true.views.shifts[train])
    np.testing.assert_array_equal(placed.views.rotations[train], true.views.rotations[train])
    np.testing.assert_array_equal(placed.views.shifts[scan.is_test], scan.views.shifts[scan.is_test])
    whole = again.with_frames(np.flatnonzero(scan.is_test), AlignedViews(true[np.flatnonzero(scan.is_test)], *there))
    np.testing.assert_array_equal(whole.applied(scan).views.shifts, true.views.shifts)
    assert whole.lines()[1:] == ["kept"]
    assert "shifts, roll refined" in whole.lines()[0]
    with pytest.raises(InputError, match="4 frames"):
        again.applied(scan[[0, 1]])
    with pytest.raises(InputError, match="geometry"):
        Geometry.from_dict({"rotations": []})


def test_what_is_refined_is_named():
    assert wanted("shifts, roll", PosePrior()) == PosePrior(angle=0.0, distance=0.0)
    with pytest.raises(InputError, match="tilt"):
        wanted("shifts,tilt", PosePrior())
    with pytest.raises(InputError, match="distance"):
        wanted("distance", PosePrior())
