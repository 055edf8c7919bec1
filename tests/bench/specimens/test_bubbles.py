"""Bubbles in a medium: line integrals and voxels of a union of balls, and how they are drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.materials import WATER, DeltaBeta, parse_material
from holosplat.model import measure
from holosplat.scan import Exposures
from holosplat.specimens import Ball
from holosplat_bench.specimens.rods import RodScene, random_bubbles

PIXEL = 1e-6
AIR_IN_WATER = parse_material("air").delta_beta(20.0).against(WATER.delta_beta(20.0))


def union(first: float, second: float, apart: float) -> float:
    """Volume [m³] of two balls of the radii `first` and `second` whose centres are `apart` (the lens taken off)."""
    whole = 4 / 3 * math.pi * (first**3 + second**3)
    if apart >= first + second:
        return whole
    square = apart**2 + 2 * apart * (first + second) - 3 * (first - second) ** 2
    return whole - math.pi * (first + second - apart) ** 2 * square / (12 * apart)


def two(apart: float) -> RodScene:
    """Balls of the radii 9 and 6 µm, whose centres are `apart` [m] along a slanted line."""
    way = np.array([0.48, 0.6, 0.64]) * apart
    return RodScene.of_balls((Ball(-0.4 * way, 18e-6), Ball(0.6 * way, 12e-6)), AIR_IN_WATER)


@pytest.mark.parametrize("apart", [4e-6, 11e-6, 20e-6])
def test_what_overlaps_counts_once(apart):
    """On a rectangular, odd-sized detector; δ against the medium is below zero, and its integral the union's."""
    scene, views = two(apart), Views.from_angles([0.0, 37.0, 90.0], (45, 53), PIXEL)
    expected = AIR_IN_WATER.delta * union(9e-6, 6e-6, apart)
    assert AIR_IN_WATER.delta < 0
    _, delta = scene.project(views)
    assert (delta.sum(dim=(1, 2)) * PIXEL**2).numpy() == pytest.approx(expected, rel=5e-3)
    volume = scene.voxelise(Grid.of_views(views))
    assert float(volume.delta.sum()) * PIXEL**3 == pytest.approx(expected, rel=5e-3)
    assert float(volume.beta.sum() / volume.delta.sum()) == pytest.approx(AIR_IN_WATER.beta / AIR_IN_WATER.delta)
    assert volume.delta.min() == pytest.approx(AIR_IN_WATER.delta)  # never twice


def test_a_bubbles_frames_are_a_balls_of_the_opposite_contrast():
    """To first order in the contrast, at which the next one is a thousandth; projections are exactly opposite."""
    ball = (Ball(np.array([3e-6, -2e-6, 1e-6]), 14e-6),)
    views = Views.from_angles([0.0, 50.0], (33, 41), PIXEL)
    weak = DeltaBeta(1e-3 * AIR_IN_WATER.delta, 1e-3 * AIR_IN_WATER.beta)
    hole, body = (RodScene.of_balls(ball, DeltaBeta(s * weak.delta, s * weak.beta)) for s in (1, -1))
    for of_hole, of_body in zip(hole.project(views), body.project(views)):
        assert torch.equal(of_hole, -of_body)
    where = Exposures.of(views, 20.0, 0.1)
    changes = [measure(scene, where).double() - 1 for scene in (hole, body)]
    assert float((changes[0] + changes[1]).norm() / changes[0].norm()) < 5e-3
    assert float(changes[0].abs().max()) > 0


def test_bubbles_are_drawn_within_their_box():
    box, radii = (40e-6, 30e-6, 40e-6), (2e-6, 5e-6)
    scene = random_bubbles(8, radii, box, AIR_IN_WATER, 3)
    again, other = (random_bubbles(8, radii, box, AIR_IN_WATER, seed) for seed in (3, 4))
    assert np.array_equal(scene.ends[:, 0], again.ends[:, 0])
    assert not np.array_equal(scene.ends[:, 0], other.ends[:, 0])
    assert scene.radii.min() == pytest.approx(2e-6)
    assert scene.radii.max() == pytest.approx(5e-6)
    away = np.linalg.norm(scene.ends[:, 0][:, None] - scene.ends[:, 0], axis=-1) + 1e-3 * np.eye(8)
    assert (away > scene.radii[:, None] + scene.radii).all()
    low, high = scene.bounds
    assert (np.abs([low, high]) <= 0.5 * np.array(box)).all()
    assert scene.missing_field(Views.from_angles([0.0], (30, 40), PIXEL)) <= 0
    assert scene.missing_field(Views.from_angles([0.0], (20, 40), PIXEL)) == pytest.approx(
        max(-low[1], high[1]) - 10e-6
    )


def test_bubbles_overlap_where_they_may():
    crowd = random_bubbles(40, (4e-6, 5e-6), (30e-6, 30e-6, 30e-6), AIR_IN_WATER, 0, overlapping=True)
    away = np.linalg.norm(crowd.ends[:, 0][:, None] - crowd.ends[:, 0], axis=-1) + np.eye(40)
    assert (away < crowd.radii[:, None] + crowd.radii).any()
    with pytest.raises(InputError, match="only"):
        random_bubbles(40, (4e-6, 5e-6), (30e-6, 30e-6, 30e-6), AIR_IN_WATER, 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RodScene((), AIR_IN_WATER), "needs at least one, but there is none"),
        (lambda: random_bubbles(0, (1e-6, 2e-6), (1e-5,) * 3, AIR_IN_WATER), "count must be at least 1"),
        (lambda: random_bubbles(1, (3e-6, 2e-6), (1e-5,) * 3, AIR_IN_WATER), r"radii must be \(smallest, largest\)"),
        (lambda: random_bubbles(1, (0.0, 2e-6), (1e-5,) * 3, AIR_IN_WATER), "radius of bubbles"),
    ],
)
def test_bad_requests_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
