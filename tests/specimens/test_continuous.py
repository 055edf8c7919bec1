"""Continuous matter: chords and masses against quadrature, means over voxels, and what the specimens are."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.matter import DeltaBeta
from holosplat.specimens.continuous import Bump, ContinuousScene, Element, Soft, ellipsoid, random_rotation
from holosplat.specimens.soft_matter import soft_cells
from holosplat_bench.specimens.soft_matter import (
    SHEPP_LOGAN,
    body_with_absorber,
    coated_droplets,
    round_cell,
    shepp_logan,
    tissue,
)

UM = 1e-6
MATTER = DeltaBeta(2e-7, 2e-7 / 1500)
DENSE = DeltaBeta(3e-6, 4e-8)
SMALL, LARGE = (1e-5, 1e-5, 1e-5), (5e-5, 5e-5, 5e-5)
PROFILES = [Soft(0.0), Soft(0.3), Soft(1.2), Soft(2.0), Bump(1), Bump(3)]
SCENES = {
    "cells": lambda seed: soft_cells(4, (16 * UM, 28 * UM), (80 * UM, 60 * UM, 70 * UM), MATTER, seed, 3 * UM),
    "round": lambda seed: round_cell(70 * UM, MATTER, seed),
    "tissue": lambda seed: tissue((80 * UM, 64 * UM, 70 * UM), MATTER, seed, 20, 100),
    "coated": lambda seed: coated_droplets(
        5, (12 * UM, 30 * UM), 3 * UM, (80 * UM, 60 * UM, 70 * UM), (MATTER, DENSE), seed
    ),
    "absorber": lambda seed: body_with_absorber((80 * UM, 60 * UM, 64 * UM), MATTER, DENSE, 12 * UM, seed, 2),
}


def near(value, rel=1e-6, abs=0.0):
    """pytest.approx without its absolute tolerance of 1e-12."""
    return pytest.approx(value, rel=rel, abs=abs)


def edges(profile) -> list[float]:
    """Radii between which a profile is smooth."""
    inner = 1 - 0.5 * profile.width if isinstance(profile, Soft) else 0.0
    return [max(inner, 0.0), profile.reach]


def one(profile, gradient=(0.0, 0.0, 0.0)) -> Element:
    """An ellipsoid at a place, turned somehow."""
    rng = np.random.default_rng(3)
    return ellipsoid((5e-6, -3e-6, 4e-6), (20e-6, 12e-6, 9e-6), profile, MATTER, random_rotation(rng), gradient)


def quadrature(function, radii: list[float]) -> float:
    """The integral over the pieces between `radii`."""
    return sum(quad(function, low, high)[0] for low, high in pairwise(radii))


def tilted_views(shape: tuple[int, int], pixel: float) -> Views:
    return Views(rotation_tilted([0.0, 37.0], [0.0, 20.0]), np.array([[0, 0], [2e-6, -1e-6]]), shape, pixel)


def field(pitch: float = 1e-6) -> Grid:
    """A grid of odd, unequal counts of 96 × 84 × 90 µm or a little more."""
    counts = tuple(2 * math.ceil(n / (2 * pitch)) + 1 for n in (90e-6, 84e-6, 96e-6))
    return Grid.centred(counts, pitch)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("profile", PROFILES, ids=str)
def test_mass_and_chords_of_profiles_are_their_integrals(profile):
    radii = [0.0, *edges(profile)]
    assert profile.mass == near(quadrature(lambda s: 4 * np.pi * s**2 * profile.density(s * s), radii), rel=1e-8)
    for b2 in (0.0, 0.16, 0.7, 0.97):

        def along(t, b2=b2):
            return float(profile.density(np.float64(b2 + t * t)))

        chord = 2 * quadrature(along, [math.sqrt(max(r * r - b2, 0)) for r in radii])
        assert float(profile.chord(np.float64(b2))) == near(chord, rel=1e-8, abs=1e-12)
    assert float(profile.chord(np.float64(1.01 * profile.reach**2))) == 0


@pytest.mark.parametrize("source", [None, 120e-6])
@pytest.mark.parametrize("profile", [Soft(0.5), Bump(2)], ids=str)
def test_line_integrals_are_those_of_the_density(profile, source):
    """Each of the rays of a pixel of an odd, rectangular detector, tilted and shifted, by adaptive quadrature."""
    element = one(profile, (8e3, -5e3, 6e3))
    views = tilted_views((9, 13), 4e-6)
    if source is not None:
        views = replace(views, sources=np.full(len(views), source))
    lines = ContinuousScene((element,)).project(views)
    assert lines.materials == (tuple(MATTER),)
    found, fine = lines[1].numpy(), views.refined(2)
    for v, i, j in ((0, 4, 6), (0, 3, 8), (1, 5, 7), (1, 2, 5)):
        rays = []
        for row in (2 * i, 2 * i + 1):
            for column in (2 * j, 2 * j + 1):
                x = (column + 0.5 - fine.shape[1] / 2) * fine.pixel_size + fine.shifts[v, 0]
                y = (row + 0.5 - fine.shape[0] / 2) * fine.pixel_size + fine.shifts[v, 1]

                way = np.array([0.0, 0.0, 1.0] if source is None else [x, y, source])
                way /= np.linalg.norm(way)

                def along(t, at=(x, y, 0.0), way=way, rotation=fine.rotations[v]):
                    return float(element.density(rotation.T @ (np.array(at) + 1e-6 * t * way)))

                rays.append(quad(along, -60, 60, limit=300, points=[0.0], epsabs=1e-8)[0] * 1e-6)
        assert found[v, i, j] == near(MATTER.delta * np.mean(rays), rel=1e-5, abs=1e-18)
    assert found.max() > 1e-6 * MATTER.delta


def test_a_scene_in_a_cone_reaches_as_far_as_its_lines_and_lies_beyond_the_source():
    """As far as the box that holds it, at most two pixels of 1 µm more; and a source within the scene is refused."""
    scene = ContinuousScene((one(Soft(0.5)),))
    views = replace(tilted_views((41, 61), 1e-6), sources=np.full(2, 150e-6))
    beyond = scene.missing_field(views)
    rows, columns = np.nonzero(scene.project(views)[1].amax(0).numpy())
    margin = min(rows.min(), columns.min(), 40 - rows.max(), 60 - columns.max())
    assert -0.5e-6 < 1e-6 * margin + beyond < 2.5e-6
    assert scene.missing_field(replace(views, sources=None)) < beyond
    with pytest.raises(InputError, match="the source must lie before the specimen"):
        scene.project(replace(views, sources=np.full(2, 10e-6)))


@pytest.mark.parametrize("profile", PROFILES, ids=str)
def test_projections_and_voxels_have_the_mass(profile):
    scene = ContinuousScene((one(profile, (6e3, 0.0, -9e3)),))
    views, grid = tilted_views((57, 81), 1e-6), field()
    delta, beta = scene.mass
    assert beta == near(delta / 1500)
    lines = scene.project(views)
    for got, mass in ((lines[0], beta), (lines[1], delta)):
        assert got.sum((1, 2)).numpy() * 1e-12 == near(mass, rel=5e-4)
    assert scene.voxelise(grid).delta.sum(dtype=float) * 1e-18 == near(delta, rel=3e-4)


def test_voxels_are_means_and_converge():
    """Means over voxels of twice the edge are means of eight of the small ones, better the smoother the edge."""
    errors = []
    for profile in (Soft(0.0), Soft(0.5)):
        scene = ContinuousScene((one(profile),))
        coarse = scene.voxelise(Grid.centred((15, 21, 17), 3e-6)).delta
        fine = scene.voxelise(Grid.centred((45, 63, 51), 1e-6)).delta
        exact = fine.reshape(15, 3, 21, 3, 17, 3).mean((1, 3, 5), dtype=float)
        errors.append(np.linalg.norm(coarse - exact) / np.linalg.norm(exact))
    assert errors[0] < 0.02
    assert errors[1] < 0.002


def test_several_materials_are_two_channels():
    scene = ContinuousScene((one(Soft(0.1)), ellipsoid((0, 0, 0), (15e-6,) * 3, Soft(0.2), DENSE)))
    lines = scene.project(tilted_views((31, 45), 2e-6))
    assert lines.materials == ((1.0, 0.0), (0.0, 1.0))
    for got, mass in ((lines[0], scene.mass.beta), (lines[1], scene.mass.delta)):
        assert got.sum((1, 2)).numpy() * 4e-12 == near(mass, rel=2e-3)
    pure = ContinuousScene((ellipsoid((0, 0, 0), (4e-6,) * 3, Soft(0.0), DeltaBeta(1e-7, 0.0)),))
    assert pure.kinds == (DeltaBeta(1e-7, 0.0),)
    absorbing = ContinuousScene((ellipsoid((0, 0, 0), (4e-6,) * 3, Soft(0.0), DeltaBeta(0.0, 1e-9)),))
    assert absorbing.project(tilted_views((9, 9), 2e-6))[0].max() > 0


@pytest.mark.parametrize("name", SCENES)
def test_specimens_lie_in_their_box_are_matter_and_follow_their_seed(name):
    scene, again, other = (SCENES[name](seed) for seed in (0, 0, 1))
    assert scene.mass == again.mass
    assert scene.mass != other.mass
    assert scene.missing_field(Views.evenly_spaced(5, (66, 82), UM)) <= 3e-6 * (name == "round")
    volume = scene.voxelise(field(3e-6))
    for values in (volume.delta, volume.beta):
        assert values.min() >= -1e-6 * values.max()
    assert np.sum(volume.delta, dtype=float) * 27e-18 == near(scene.mass.delta, rel=2e-3)
    low, high = scene.bounds
    assert np.all(low < 0)
    assert np.all(high > 0)


def test_soft_matter_has_no_levels():
    """No value of δ, within 2 %, is that of more than a third of what is inside."""
    for name in ("cells", "round", "tissue"):
        delta = SCENES[name](0).voxelise(field(2e-6)).delta
        inside = delta[delta > 0.1 * delta.max()]
        counts, _ = np.histogram(inside, np.arange(0, 1.02, 0.02) * delta.max())
        assert counts.max() < len(inside) / 3


def test_the_head_phantom_has_its_levels():
    half = 40e-6
    scene = shepp_logan(0.92 * 2 * half, MATTER)
    skull, ventricle, tumour, brain = (0.0, 0.9, 0.0), (0.22, 0.0, 0.0), (0.0, 0.35, -0.15), (0.0, -0.35, 0.0)
    points = half * np.array([(x, z, -y) for x, y, z in (skull, ventricle, tumour, brain)])
    found = sum(e.matter.delta / MATTER.delta * e.density(points) for e in scene.elements)
    assert found == near(np.array([1.0, 0.0, 0.3, 0.2]), abs=1e-9)
    exact = sum(level * 4 / 3 * np.pi * np.prod(semi) for level, semi, _, _ in SHEPP_LOGAN) * half**3
    assert scene.mass.delta == near(MATTER.delta * exact)
    assert shepp_logan(0.92 * 2 * half, MATTER, 2e-6).mass.delta == near(MATTER.delta * exact, rel=0.02)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Soft(2.5), "width must be at most 2"),
        (lambda: Bump(0), "power must be at least 1"),
        (lambda: ContinuousScene(()), "at least one element"),
        (lambda: ellipsoid((0, 0), (1e-6,) * 3, Soft(), MATTER), "centre of an element must have the shape"),
        (lambda: ellipsoid((0, 0, 0), (1e-6, 1e-6, 0), Soft(), MATTER), "semi-axis of an element"),
        (lambda: Element(np.zeros(3), 1e-6 * np.ones((3, 3)), Soft(), MATTER, np.zeros(3)), "at right angles"),
        (lambda: soft_cells(0, (1e-6, 2e-6), SMALL, MATTER), "count must be at least 1"),
        (lambda: soft_cells(2, (2e-6, 1e-6), SMALL, MATTER), "smallest, largest"),
        (lambda: soft_cells(2, (2e-6, 4e-6), SMALL, MATTER, edge=1e-6), "edge must lie between"),
        (lambda: tissue(SMALL, MATTER, cells=0), "cells must be at least 1"),
        (lambda: tissue(SMALL, MATTER, granules=-1), "granules must not be negative"),
        (lambda: shepp_logan(1e-4, MATTER, 1e-5), "edge must lie between"),
        (lambda: coated_droplets(2, (4e-6, 8e-6), 2e-6, LARGE, (MATTER, DENSE)), "coating must lie between"),
        (lambda: body_with_absorber(LARGE, MATTER, DENSE, 6e-5), "bead must lie between"),
        (lambda: body_with_absorber(LARGE, MATTER, DENSE, 6e-6, beads=0), "beads must be at least 1"),
    ],
)
def test_what_cannot_be_is_refused(make, match):
    with pytest.raises(InputError, match=match):
        make()
