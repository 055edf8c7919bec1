"""Known walls: their line integrals, their share of voxels, and frames and retrieval of what lies in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.io.formats import read_as
from holosplat.io.reading import Reading, Told
from holosplat.materials import wall_of
from holosplat.model import measure
from holosplat.optics.retrieval import RETRIEVALS, tikhonov
from holosplat.optics.sampling import fringe_sampling
from holosplat.volume import Volume, Wall, mean_wave
from holosplat_bench.specimens.shapes import box_mesh, meshed

PIXEL, SHAPE = 1e-6, (5, 45)
GLASS, WATER = hs.DeltaBeta(1.2e-6, 3.6e-9), hs.DeltaBeta(5.8e-7, 2.6e-10)
BOX = Wall((20e-6, 14e-6), (30e-6, 29e-6), GLASS, WATER)
TUBE = Wall((16e-6, 16e-6), (24e-6, 24e-6), GLASS, WATER, round=True, centre=(1e-6, -2e-6))


def some_views(count: int = 5) -> Views:
    return Views.evenly_spaced(count, shape=SHAPE, pixel_size=PIXEL)


def walls() -> list[Wall]:
    return [BOX, replace(BOX, turn=0.3, centre=(2e-6, -1e-6)), TUBE, replace(BOX, outer=None)]


def box_scene(wall: Wall) -> hs.MeshScene:
    bodies = [(wall.outer, GLASS), (wall.inner, WATER.against(GLASS))]
    meshes = [
        ([box_mesh((-w / 2, -1e-3, -d / 2), (w / 2, 1e-3, d / 2))], matter)
        for (w, d), matter in ((section, matter) for section, matter in bodies if section)
    ]
    return meshed(meshes)


@pytest.mark.parametrize("wall", walls())
def test_every_view_holds_all_of_the_sections_matter(wall):
    areas = [np.pi / 4 * s[0] ** 2 if wall.round else s[0] * s[1] for s in (wall.inner, wall.outer or (0.0, 0.0))]
    within = np.subtract(WATER, GLASS) if wall.outer is None else np.array(WATER)
    delta, beta = areas[0] * within + (areas[1] - areas[0] if areas[1] else 0.0) * np.array(GLASS)
    B, D = wall.project(some_views())
    np.testing.assert_allclose(D.sum(dim=2) * PIXEL, delta, rtol=1e-12)
    np.testing.assert_allclose(B.sum(dim=2) * PIXEL, beta, rtol=1e-12)


def test_line_integrals_are_those_of_the_same_meshes():
    views = some_views().refined(4)
    B, D = BOX.project(views)
    Bm, Dm = box_scene(BOX).project(views)
    assert B.shape == (5, 20, 180)
    assert float((D - Dm).abs().mean() / Dm.abs().max()) < 1e-3
    assert float((B - Bm).abs().mean() / Bm.abs().max()) < 1e-3


def test_a_ray_through_the_middle_of_a_turned_tube():
    middle = replace(TUBE, centre=(0.0, 0.0))
    D = middle.project(replace(some_views(3), shape=(1, 45)))[1][:, 0, 22]
    x = np.linspace(-PIXEL / 2, PIXEL / 2, 1001)
    chords = [2 * np.sqrt((0.5 * s) ** 2 - x**2).mean() for s in (16e-6, 24e-6)]
    np.testing.assert_allclose(D, GLASS.delta * (chords[1] - chords[0]) + WATER.delta * chords[0], rtol=1e-6)


def test_rays_that_are_tilted_against_the_axis_are_longer():
    tilted = Views.from_rotations(rotation_tilted(np.array([20.0]), np.array([60.0])), SHAPE, PIXEL)
    tall = replace(BOX, inner=(1e-9, 1e-9))
    flat = tall.project(Views.from_angles([20.0], SHAPE, PIXEL))[1]
    assert float(tall.project(tilted)[1].max()) == pytest.approx(2 * float(flat.max()), rel=0.05)


@pytest.mark.parametrize("wall", [BOX, TUBE])
def test_voxels_hold_the_wall_and_the_filling(wall):
    grid = Grid.centred((31, 3, 33), voxel_size=PIXEL)
    volume = wall.voxelise(grid)
    x, _, z = grid.axes()
    middle = volume.delta[np.abs(z - wall.centre[1]).argmin(), 1, np.abs(x - wall.centre[0]).argmin()]
    assert middle == pytest.approx(WATER.delta)
    assert volume.delta.max() == pytest.approx(GLASS.delta)
    D = wall.project(Views.from_angles([0.0], (3, 33), PIXEL))[1][0, 1]
    np.testing.assert_allclose(volume.delta[:, 1].sum(axis=0) * PIXEL, D, rtol=0, atol=0.03 * float(D.max()))


@pytest.mark.parametrize("wall", walls())
def test_the_content_of_a_truth_is_what_its_hollow_has_beside_the_filling(wall):
    """Whether the truth has the wall or not; nothing is left of the wall alone, or of what the wall touches."""
    grid = Grid((45, 5, 45), (PIXEL,) * 3, (-22e-6, -2e-6, -22e-6))
    gas = -np.ones(grid.shape) * (np.indices(grid.shape)[2] == 24) * (np.indices(grid.shape)[0] < 28)
    known, bubble = wall.voxelise(grid), Volume(WATER.delta * gas, WATER.beta * gas, grid)
    inside = wall.content(bubble)
    assert inside.delta.min() == pytest.approx(-WATER.delta)
    assert not (inside.delta * (np.abs(known.delta - known.delta[22, 2, 22]) > 1e-12)).any()
    whole = wall.content(Volume(known.delta + bubble.delta, known.beta + bubble.beta, grid))
    np.testing.assert_allclose(whole.delta, inside.delta, atol=1e-12)
    np.testing.assert_allclose(whole.beta, inside.beta, atol=1e-15)
    assert np.abs(wall.content(known).delta).max() < 1e-12


def test_the_mean_wave_of_half_a_pixel_of_phase():
    jump, k = 2.2, np.array([1e11])
    parts = torch.tensor([[0.0, 0.0], [0.0, jump / k[0]]], dtype=torch.float64)[:, None, None, None]
    B, D = mean_wave(parts, k, k)[:, 0, 0, 0]
    wave = np.exp(-k[0] * float(B) - 1j * k[0] * float(D))
    assert wave == pytest.approx(0.5 * (1 + np.exp(-1j * jump)))


def test_frames_beside_a_wall_are_those_of_both():
    exposures = hs.Exposures.of(some_views(), energy_kev=20.0, distance=0.1)
    cell = hs.MeshScene.of_one_material([box_mesh((-4e-6, -2e-6, -3e-6), (3e-6, 2e-6, 4e-6))], WATER)
    both = meshed([*zip(([one] for one in box_scene(BOX).meshes), box_scene(BOX).materials), (cell.meshes, WATER)])
    true = hs.simulate(both, exposures, is_test=np.zeros(5, bool)).frames
    beside = replace(exposures, wall=BOX)
    assert fringe_sampling(beside) == 2 * fringe_sampling(exposures)  # its faces are steep
    found = measure(cell, beside, fringe_sampling(beside)).numpy()
    rms = np.sqrt(np.square(found - true).mean(axis=(1, 2)))
    assert rms.max() < 0.1 * np.sqrt(np.square(true - 1).mean())


def behind_faces(wall: Wall, energy_kev: float, distance: float, columns: int, parts: int = 128) -> np.ndarray:
    """A row [W] of the frame of a slab's hollow whose faces lie along the beam: the Fresnel integral of two phases that
    meet within a part of a pixel, on a field nine times as wide."""
    wavelength, (wide, deep) = 12.398419843320026e-10 / energy_kev, wall.inner
    count, step = 9 * columns * parts, PIXEL / parts
    x = (np.arange(count) - 0.5 * (count - 1)) * step
    share = np.clip((0.5 * wide - np.abs(x)) / step + 0.5, 0, 1)
    delta, beta = np.subtract(wall.filling, wall.matter)
    wave = 1 - share + share * np.exp(-2j * np.pi / wavelength * (delta - 1j * beta) * deep)
    kernel = np.exp(-1j * np.pi * wavelength * distance * np.fft.fftfreq(count, step) ** 2)
    intensity = np.abs(np.fft.ifft(np.fft.fft(wave) * kernel)) ** 2
    return intensity.reshape(-1, parts).mean(axis=1)[4 * columns : 5 * columns]


def test_the_frame_of_faces_along_the_beam_is_that_of_their_fresnel_integral():
    """To a tenth of a per cent of the light, of which its fringes have a fifth."""
    wall = Wall((31.2e-6, 43.7e-6), None, GLASS, WATER)
    views = Views.from_angles([0.0], (3, 81), PIXEL)
    exposures = replace(hs.Exposures.of(views, energy_kev=20.0, distance=0.1), wall=wall)
    nothing = hs.MeshScene.of_one_material([box_mesh((1e-3, 1e-3, 1e-3), (2e-3, 2e-3, 2e-3))], WATER)
    found = measure(nothing, exposures, fringe_sampling(exposures)).double().numpy()[0]
    true = behind_faces(wall, 20.0, 0.1, 81)
    assert np.std(true) > 0.1
    np.testing.assert_allclose(found, np.broadcast_to(true, found.shape), rtol=0, atol=4e-3)
    assert np.sqrt(np.square(found - true).mean()) < 1.5e-3


@pytest.mark.parametrize("method", list(RETRIEVALS))
def test_every_retrieval_finds_what_is_in_a_tube(method):
    exposures = hs.Exposures.of(some_views(3), energy_kev=20.0, distance=0.05)
    air = hs.DeltaBeta(0.0, 0.0).against(WATER)
    bubble = hs.MeshScene.of_one_material([box_mesh((-3e-6, -9e-3, -3e-6), (2e-6, 9e-3, 3e-6))], air)
    wall = replace(TUBE, centre=(0.0, 0.0))
    true = bubble.project(exposures.views)[1] / air.delta
    alone, beside = (
        RETRIEVALS[method](one, which, *air)
        for one, which in ((measure(bubble, each, 4), each) for each in (exposures, replace(exposures, wall=wall)))
    )
    errors = [float((found - true).norm() / true.norm()) for found in (alone, beside)]
    assert errors[1] < errors[0] + 0.15


def test_in_contact_a_wall_is_divided_out():
    exposures = replace(hs.Exposures.of(some_views(), energy_kev=20.0, distance=0.0), wall=BOX)
    matter = hs.DeltaBeta(1e-6, 1e-8)
    body = hs.MeshScene.of_one_material([box_mesh((-4e-6, -1, -3e-6), (3e-6, 1, 4e-6))], matter)
    true = body.project(exposures.views)[1] / matter.delta
    np.testing.assert_allclose(tikhonov(measure(body, exposures), exposures, *matter), true, atol=2e-7)


def a_scan() -> hs.Scan:
    exposures = hs.Exposures.of(some_views(), energy_kev=20.0, distance=0.1)
    return hs.Scan(np.ones((5, *SHAPE)), exposures, np.zeros(5, dtype=bool))


def test_what_is_said_of_a_wall():
    glass = hs.materials.parse_material("glass").delta_beta(20.0)
    found = wall_of("tube:1e-5:2e-5:glass:vacuum", 20.0)
    assert found == Wall((1e-5, 1e-5), (2e-5, 2e-5), glass, round=True)
    found = wall_of("cuvette:1e-5x2e-5:3e-5:1e-6,2e-9:glass:1e-6:0:90", 20.0)
    assert (found.inner, found.outer, found.matter) == ((1e-5, 2e-5), (3e-5, 3e-5), (1e-6, 2e-9))
    assert (found.filling, found.centre, found.turn) == (glass, (1e-6, 0.0), pytest.approx(np.pi / 2))
    assert wall_of("slab:1e-5:glass:glass", 20.0).outer is None


@pytest.mark.parametrize(
    "text",
    [
        "tube",
        "pipe:1:2:glass:water",
        "tube:a:2:glass:water",
        "tube:1x2:3:glass:water",
        "slab:1:glass:water:2",
        "slab:1:glass",
    ],
)
def test_other_walls_are_refused(text):
    with pytest.raises(InputError, match=r"--wall must be tube:INNER.*with FILLING as the --medium"):
        wall_of(text, 20.0)


def test_a_hollow_is_smaller_than_its_wall():
    with pytest.raises(InputError, match="greater outer section"):
        wall_of("tube:3e-5:2e-5:glass:vacuum", 20.0)


def test_a_reading_tells_the_wall(tmp_path):
    hs.write_scan(tmp_path / "scan.nxs", a_scan())
    reading = Reading(Told(wall="slab:1e-5:glass:water"))
    found = read_as(tmp_path / "scan.nxs", Reading.from_table(reading.as_table()))
    assert found.exposures[[1]].wall is not None
    assert found.provenance["wall"] == "slab:1e-5:glass:water"
