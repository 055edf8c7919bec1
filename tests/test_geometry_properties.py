"""Properties of poses, rasters and grids, of binned scans and of lists of exposures, whatever they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.strategies import numbers, rotations, scans, vectors, views
from holosplat.geometry import Grid, Views, rotation_tilted, rotation_y
from holosplat.scan import Scan

ANGLES = vectors(-720.0, 720.0, 3)
TINY = {"rtol": 0, "atol": 1e-12}


def pixel_centres(seen: Views) -> list[np.ndarray]:
    """Coordinates of the columns [V, W] and of the rows [V, H] of every view, in pixels of the first view's pitch."""
    counts = (seen.shape[1], seen.shape[0])
    return [
        (np.arange(n) + 0.5 - n / 2)[None] * seen.pixel_size + seen.shifts[:, axis : axis + 1]
        for axis, n in enumerate(counts)
    ]


# --- poses --------------------------------------------------------------------------------------------------


@given(ANGLES, ANGLES)
def test_rotations_are_proper_and_compose(first, second):
    for matrices in (rotation_y(first), rotation_tilted(first, second)):
        np.testing.assert_allclose(matrices @ matrices.transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), **TINY)
        np.testing.assert_allclose(np.linalg.det(matrices), 1, **TINY)
    np.testing.assert_allclose(rotation_y(first) @ rotation_y(second), rotation_y(first + second), rtol=0, atol=1e-11)
    np.testing.assert_allclose(rotation_y(-first), rotation_y(first).transpose(0, 2, 1), **TINY)
    np.testing.assert_allclose(rotation_tilted(first, 0 * first), rotation_y(first), **TINY)
    np.testing.assert_allclose(rotation_tilted(first, second)[:, 0], rotation_y(first)[:, 0], **TINY)


@given(views(), st.integers(1, 4), st.integers(1, 4))
def test_a_refined_raster_shows_the_same_field(seen, first, second):
    fine = seen.refined(first)
    assert (fine.width, fine.height) == pytest.approx((seen.width, seen.height), rel=1e-12)
    both, once = fine.refined(second), seen.refined(first * second)
    assert both.shape == once.shape
    assert both.pixel_size == pytest.approx(once.pixel_size, rel=1e-12)
    for coarse, finer in zip(pixel_centres(seen), pixel_centres(fine)):
        means = finer.reshape(len(seen), -1, first).mean(2)
        np.testing.assert_allclose(means, coarse, rtol=0, atol=1e-9 * seen.pixel_size)


@given(views(), st.tuples(st.integers(0, 5), st.integers(0, 5)))
def test_a_padded_raster_keeps_its_old_pixels(seen, margin):
    padded = seen.padded(margin)
    assert padded.shape == (seen.shape[0] + 2 * margin[0], seen.shape[1] + 2 * margin[1])
    for old, new, edge in zip(pixel_centres(seen), pixel_centres(padded), margin[::-1]):
        kept = new[:, edge : new.shape[1] - edge]
        np.testing.assert_allclose(kept, old, rtol=0, atol=1e-9 * seen.pixel_size)
    np.testing.assert_array_equal(padded.rotations, seen.rotations)


@given(views(), rotations(1))
def test_turning_all_views_turns_the_middle_of_their_grid(seen, turn):
    """The point nearest to all axes is one of the object, wherever the object's frame lies."""
    centre = Grid.of_views(seen).centre
    turned = Grid.of_views(replace(seen, rotations=seen.rotations @ turn[0].T)).centre
    np.testing.assert_allclose(turned, turn[0] @ centre, rtol=0, atol=1e-4 * seen.pixel_size)


# --- grids --------------------------------------------------------------------------------------------------

COUNTS = st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 6))


@st.composite
def grids(draw: st.DrawFn) -> Grid:
    size, origin = draw(vectors(1e-7, 1e-4, 3)), draw(vectors(-1e-3, 1e-3, 3))
    return Grid(draw(COUNTS), tuple(size.tolist()), tuple(origin.tolist()))


@given(grids(), COUNTS, COUNTS)
def test_a_block_of_a_grid_has_that_parts_voxels(grid, start, shape):
    block = grid.block(start, shape)
    for own, whole, first, n, d in zip(block.axes(), grid.axes(), start[::-1], shape[::-1], grid.voxel_size):
        np.testing.assert_allclose(own, whole[0] + d * (first + np.arange(n)), rtol=0, atol=1e-9 * d + 1e-15)
    assert block.shape == shape


@given(grids())
def test_the_middle_of_a_grid_is_that_of_its_voxels(grid):
    np.testing.assert_allclose(grid.centre, [axis.mean() for axis in grid.axes()], rtol=0, atol=1e-15)


@given(COUNTS, numbers(1e-9, 1e-3))
def test_a_centred_grid_has_its_middle_at_the_origin(shape, size):
    np.testing.assert_allclose(Grid.centred(shape, size).centre, 0, rtol=0, atol=1e-9 * size)


# --- scans --------------------------------------------------------------------------------------------------


def frames_of(scan: Scan) -> np.ndarray:
    return np.asarray(scan.frames, dtype=np.float64)


@st.composite
def divisible(draw: st.DrawFn) -> tuple[Scan, int, int]:
    """A scan, and two factors whose product divides its rows and columns."""
    first, second = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    rows, columns = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    shape = (rows * first * second, columns * first * second)
    poses = views(most=2).map(lambda seen: Views(seen.rotations, seen.shifts, shape, seen.pixel_size))
    return draw(scans(poses)), first, second


@given(divisible())
def test_binning_keeps_flux_and_field(case):
    scan, factor, _ = case
    small = scan.binned(factor)
    whole = frames_of(scan)
    np.testing.assert_allclose(
        frames_of(small).mean((1, 2)), whole.mean((1, 2)), rtol=0, atol=1e-5 * np.abs(whole).max() + 1e-9
    )
    assert (small.views.width, small.views.height) == pytest.approx((scan.views.width, scan.views.height), rel=1e-12)
    lengths = [s.exposures.psf_sigma_px * s.views.pixel_size for s in (scan, small)]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=1e-12)


@given(divisible())
def test_binning_twice_is_binning_by_the_product(case):
    scan, first, second = case
    twice, once = scan.binned(first).binned(second), scan.binned(first * second)
    np.testing.assert_allclose(frames_of(twice), frames_of(once), rtol=0, atol=1e-5 * np.abs(scan.frames).max() + 1e-9)
    np.testing.assert_allclose(twice.views.shifts, once.views.shifts, rtol=0, atol=1e-12)


@given(scans(views(shift_px=50.0)), st.integers(1, 4))
def test_a_binned_pixel_lies_in_the_middle_of_those_it_is_made_of(scan, factor):
    """Also where rows and columns are left over, as many on either side as can be."""
    if min(scan.views.shape) < factor:
        return
    small = scan.binned(factor)
    for fine, coarse in zip(pixel_centres(scan.views), pixel_centres(small.views)):
        spare = fine.shape[1] - factor * coarse.shape[1]
        used = fine[:, spare // 2 : spare // 2 + factor * coarse.shape[1]]
        wanted = used.reshape(len(scan), -1, factor).mean(2)
        np.testing.assert_allclose(coarse, wanted, rtol=0, atol=1e-9 * scan.views.pixel_size)


@given(scans())
def test_training_and_test_frames_are_all_frames(scan):
    held_out = scan.test()
    trained = scan[np.flatnonzero(~scan.is_test)]
    assert len(trained) + len(held_out) == len(scan)
    both = np.empty_like(np.asarray(scan.frames))
    both[~scan.is_test], both[scan.is_test] = trained.frames, held_out.frames
    np.testing.assert_array_equal(both, scan.frames)


@given(scans(), vectors(0.0, 9.0, 2))
def test_repeated_exposures_come_in_order_of_time(scan, times):
    seen = scan.exposures.repeated(times)
    count = len(scan)
    assert len(seen) == 2 * count
    np.testing.assert_array_equal(seen.time, np.repeat(times, count))
    for part in (slice(0, count), slice(count, None)):
        np.testing.assert_array_equal(seen.distance[part], scan.exposures.distance)
        np.testing.assert_array_equal(seen.views.rotations[part], scan.views.rotations)
