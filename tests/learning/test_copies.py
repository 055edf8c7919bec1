"""Copies of a scene: those that training shows, but exact."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from holosplat.learning.network import COPIES
from holosplat_bench.training.sample import Sample
from holosplat_bench.training.shown import example_of_views, make_example

VIEWS = np.arange(3)


@pytest.fixture(scope="module")
def sample() -> Sample:
    """Noise in three tilted and shifted views, of frames that are no squares."""
    rng = np.random.default_rng(3)
    images = rng.random((2, 3, 20, 16)).astype(np.float16)
    return Sample(
        images[0],
        images[1],
        np.full(3, 1e-3, np.float32),
        Rotation.random(3, rng=rng).as_matrix(),
        rng.normal(0, 1.5, (3, 2)),
        np.zeros(3, bool),
        rng.integers(0, 256, (16, 20, 16)).astype(np.uint8),
        np.zeros(8),
    )


@pytest.mark.parametrize("copy", COPIES, ids=str)
def test_a_copy_is_what_the_geometry_makes_of_it(copy, sample):
    scene = example_of_views(sample, 3)
    meant = make_example(sample, VIEWS, slice(None), copy.upside_down, copy.turns)

    taps, seen = copy.taps(scene.taps), copy.images(scene.images)

    assert torch.equal(seen, meant.images)
    assert torch.equal(copy.volume(scene.occupancy), meant.occupancy)
    assert (taps.shape, taps.grid) == (meant.taps.shape, meant.taps.grid)
    half = torch.nn.functional.avg_pool2d(seen, 2)
    torch.testing.assert_close(taps.lift(half), meant.taps.lift(half), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("copy", COPIES, ids=str)
def test_what_is_lifted_comes_back_to_the_same_voxels_to_the_last_bit(copy, sample):
    scene = example_of_views(sample, 3)
    images = torch.arange(3.0 * 10 * 8).reshape(3, 1, *scene.taps.shape)
    shown = images.flip(2) if copy.upside_down else images
    taps = copy.taps(scene.taps)

    lifted, plain = (each.lift(part).unflatten(2, each.grid) for each, part in ((taps, shown), (scene.taps, images)))

    assert all(torch.equal(copy.back(ours[0]), theirs[0]) for ours, theirs in zip(lifted, plain))
    assert torch.equal(copy.back(copy.volume(scene.occupancy)), scene.occupancy)


def test_all_copies_differ(sample):
    occupancy = example_of_views(sample, 3).occupancy

    assert len({copy.volume(occupancy).numpy().tobytes() for copy in COPIES}) == 8
    assert torch.equal(COPIES[0].volume(occupancy), occupancy)
