"""Frames of several photon energies: what exposures say of them, what matter does, and retrieval from them."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from helpers.energies import frames_by_energy
from holosplat.beamline.simulate import Simulation, simulate
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_y
from holosplat.io.images import read_tiff, write_tiff
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.materials import HAEMOGLOBIN, PLASMA, RED_CELL, WATER, dispersion
from holosplat.matter import MaterialPrior
from holosplat.methods.presets import preset
from holosplat.model.instrument import Instrument
from holosplat.optics.hologram import hologram, optical_path
from holosplat.optics.retrieval import RETRIEVALS, invert_contrast, retrieve_thickness
from holosplat.optics.sampling import padding, resolving_oversample
from holosplat.scan import Exposures, Scan, far_from_edges
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavelength, wavenumber
from holosplat.volume import LineIntegrals
from holosplat.workflows.evaluate import evaluate
from holosplat.workflows.provenance import scan_hash
from holosplat.workflows.reconstruct import reconstruct
from holosplat_bench.formats.nerf_synthetic import read_nerf_synthetic, write_nerf_synthetic

SHAPE, PIXEL = (21, 27), 1.3e-6
ENERGIES = np.array([18.0, 15.0, 24.0, 15.0])


def exposures(energy: float | np.ndarray = ENERGIES) -> Exposures:
    views = Views(rotation_y([0.0, 40.0, 80.0, 120.0]), 1e-7 * np.arange(8.0).reshape(4, 2), SHAPE, PIXEL)
    distance, psf = np.array([0.05, 0.08, 0.05, 0.08]), np.array([0.4, 0.0, 0.4, 0.3])
    return Exposures(views, energy, distance, psf, np.arange(4.0))  # type: ignore[arg-type]  # a number is for all


def noisy(seed: int = 0) -> np.ndarray:
    return (1 + 0.05 * np.random.default_rng(seed).normal(size=(4, *SHAPE))).astype(np.float32)


def test_one_number_is_for_all_frames():
    found = exposures(20)
    assert found.energy_kev.tolist() == [20.0] * 4
    assert (found.has_one_energy, found.one_energy("it"), found.reference_energy) == (True, 20.0, 20.0)
    assert replace(found, energy_kev=25.0).reference_energy == 25.0
    assert scan_hash(Scan(noisy(), found, np.zeros(4, bool))) == scan_hash(Scan(noisy(), exposures(20.0), np.zeros(4)))


def test_frames_that_are_picked_keep_the_energy_at_which_matter_is_said():
    found = exposures()[[1, 3]]
    assert found.energy_kev.tolist() == [15.0, 15.0]
    assert (found.has_one_energy, found.reference_energy) == (True, 18.0)
    assert found.repeated(np.array([0.0, 1.0])).reference_energy == 18.0


@pytest.mark.parametrize("energy", [[18.0, 15.0, 2e3, 15.0], [18.0, np.nan, 20.0, 15.0], [18.0, -1.0, 20.0, 15.0]])
def test_bad_energies_are_refused(energy):
    with pytest.raises(InputError, match="energy must"):
        exposures(np.array(energy))


def test_who_needs_one_energy_says_so():
    with pytest.raises(InputError, match="the report needs frames of one photon energy, but theirs go from 15 to 24"):
        exposures().one_energy("the report")


def test_units_take_arrays():
    assert wavelength(ENERGIES).tolist() == [wavelength(float(e)) for e in ENERGIES]
    assert wavenumber(ENERGIES).tolist() == [wavenumber(float(e)) for e in ENERGIES]
    with pytest.raises(InputError, match="energy_kev must hold positive"):
        wavelength(np.array([1.0, 0.0]))


def test_the_finest_and_the_widest_fringes_set_the_sampling():
    """The margin is that of the frame whose fringes reach furthest, samples those of the narrowest fringe."""
    each = [exposures()[[i]] for i in range(4)]
    assert padding(exposures(), 2) == tuple(max(padding(one, 2)[axis] for one in each) for axis in (0, 1))
    assert resolving_oversample(exposures(), 8, 1) == max(resolving_oversample(one, 8, 1) for one in each)


def test_the_rule_for_matter_without_a_formula():
    """Twice the energy: a quarter of δ, a sixteenth of β."""
    assert far_from_edges(np.array([10.0, 20.0, 5.0]), 10.0).tolist() == [[1, 1], [1 / 4, 1 / 16], [4, 16]]
    delta, beta = exposures().refraction(2.0, -3.0)
    assert delta == pytest.approx(2 * (18 / ENERGIES) ** 2)
    assert beta == pytest.approx(-3 * (18 / ENERGIES) ** 4)
    assert dispersion(ENERGIES, 18.0).tolist() == far_from_edges(ENERGIES, 18.0).tolist()


def test_a_formula_has_its_own_values():
    found = dispersion(ENERGIES, 18.0, RED_CELL, PLASMA)
    said = [RED_CELL.delta_beta(e).against(PLASMA.delta_beta(e)) for e in (*ENERGIES.tolist(), 18.0)]
    assert found == pytest.approx(np.array([np.divide(one, said[-1]) for one in said[:-1]]))
    assert found[0].tolist() == [1.0, 1.0]


def test_the_rule_is_near_to_the_tables_where_edges_are_far():
    """Water between 10 and 30 keV: δ to 0.3 %, β to 15 %."""
    energies = np.array([10.0, 15.0, 20.0, 30.0])
    ratio = dispersion(energies, 20.0, WATER) / far_from_edges(energies, 20.0)
    assert ratio[:, 0] == pytest.approx(np.ones(4), abs=3e-3)
    assert ratio[:, 1] == pytest.approx(np.ones(4), abs=0.15)


@pytest.mark.parametrize("kind", ["nxtomo", "tiff", "nerf-synthetic"])
def test_files_keep_the_energy_of_each_frame(kind, tmp_path):
    write, read = {
        "nxtomo": (write_scan, read_scan),
        "tiff": (write_tiff, read_tiff),
        "nerf-synthetic": (write_nerf_synthetic, read_nerf_synthetic),
    }[kind]
    write(tmp_path / "scan", Scan(noisy(), exposures(), np.array([False, True, False, True])))
    assert read(tmp_path / "scan").exposures.energy_kev.tolist() == ENERGIES.tolist()


def test_a_file_of_one_energy_says_it_once(tmp_path):
    write_scan(tmp_path / "scan.nxs", Scan(noisy(), exposures(17.0), np.zeros(4, bool)))
    with h5py.File(tmp_path / "scan.nxs") as file:
        assert file["/entry/instrument/beam/incident_energy"].shape == ()
        assert file["/entry/instrument/beam/incident_energy"][()] == 17.0


@pytest.mark.parametrize("beta", [3e-10, -2e-11])
@pytest.mark.parametrize("name", list(RETRIEVALS))
def test_every_view_is_retrieved_at_its_own_energy(name, beta):
    """As from each frame alone, of matter with the δ and β that it has there."""
    frames, delta = torch.from_numpy(noisy().astype(np.float64)), 4e-7
    options = {} if name in ("paganin", "ctf") else {"options": _few_steps(name)}
    found = RETRIEVALS[name](frames, exposures(), delta, beta, **options)
    for i in range(4):
        alone = replace(exposures()[[i]], reference_kev=None)
        at = exposures().refraction(delta, beta)
        wanted = RETRIEVALS[name](frames[[i]], alone, float(at[0][i]), float(at[1][i]), **options)
        np.testing.assert_allclose(found[[i]].numpy(), wanted.numpy(), rtol=1e-6, atol=1e-12)


def _few_steps(name: str):
    from holosplat.optics.retrieval import ADMM, Tikhonov
    from holosplat_bench.opponents.alternating import Projections

    kinds = {"tikhonov": Tikhonov, "admm": ADMM}
    return kinds.get(name, Projections)(iterations=3)


def test_the_plain_filters_take_numbers_of_each_view():
    """Two views of one optics and two more of another: as the calls for either, raster for raster."""
    frames = torch.from_numpy(noisy().astype(np.float64))
    energy, delta, beta = np.array([18.0, 18.0, 20.0, 20.0]), np.array([4e-7, 4e-7, 3e-7, 3e-7]), np.full(4, 1e-10)
    z = np.full(4, 0.06)
    for solve in (retrieve_thickness, lambda f, *rest: invert_contrast(f - 1, *rest)):
        found = solve(frames, PIXEL, z, energy, delta, beta)
        for pair in (slice(0, 2), slice(2, 4)):
            numbers = (float(array[pair][0]) for array in (energy, delta, beta))
            wanted = solve(frames[pair], PIXEL, z[pair], *numbers)
            assert found[pair].numpy() == pytest.approx(wanted.numpy(), rel=0.02, abs=2e-8)


def test_simulated_frames_of_several_energies_see_the_formulas_own_values():
    h, w = SHAPE
    cells = random_cells(1, (0.7 * w * PIXEL, 0.8 * h * PIXEL, 0.7 * w * PIXEL), 1, 14 * PIXEL)
    taken = exposures()

    def matter(energy: float) -> MeshScene:
        return MeshScene.of_one_material(cells, RED_CELL.delta_beta(energy))

    found = list(frames_by_energy(matter, taken, Simulation(oversample=2)))
    for i, energy in enumerate(ENERGIES.tolist()):
        wanted = simulate(matter(energy), replace(taken[[i]], reference_kev=None), oversample=2).frames[0]
        np.testing.assert_array_equal(found[i], wanted)


@pytest.mark.parametrize("formula", [False, True])
@pytest.mark.parametrize(("backend", "dtype"), [("cpu", torch.float32), ("reference", torch.float64)])
def test_an_instrument_of_several_energies_is_several_instruments(backend, dtype, formula):
    """Each frame, of all or of some by index, is that of its own energy and of what matter is there."""
    said = RED_CELL.delta_beta(18.0).against(PLASMA.delta_beta(18.0))
    factors = dispersion(ENERGIES, 18.0, RED_CELL, PLASMA) if formula else far_from_edges(ENERGIES, 18.0)
    taken = replace(exposures(), distance=np.full(4, 0.05), psf_sigma_px=np.full(4, 0.3))
    whole = Instrument(taken, 2, dtype, backend, factors if formula else None)
    lines = torch.from_numpy(1e-5 * np.random.default_rng(0).random((4, 1, *whole.views.shape))).to(dtype)
    found = whole.frames(LineIntegrals(lines, (tuple(said),)))
    some = whole.frames(LineIntegrals(lines[[2, 1]], (tuple(said),)), np.array([2, 1]))
    assert some.numpy() == pytest.approx(found[[2, 1]].numpy(), abs=1e-6)
    for i, energy in enumerate(ENERGIES.tolist()):
        margin = tuple(2 * m for m in whole.margin)
        optics = (energy, np.array([0.05]), np.array([0.6]), (SHAPE, margin, 2))
        path = optical_path(whole.views.shape, whole.views.pixel_size, *optics, dtype)
        ours = [wavenumber(energy) * said[c] * factors[i, c] for c in (0, 1)]
        wanted = hologram(lines[[i]], [(ours[0], ours[1])], path, backend)
        assert found[[i]].numpy() == pytest.approx(wanted.numpy(), abs=1e-6)


@pytest.mark.usefixtures("unjudged_runs")
def test_a_reconstruction_takes_each_frame_at_its_own_energy():
    """Frames of 16 and 28 keV in turn, of the formula's own values: as well as of one energy, and far better than as if
    all had the same."""
    views = Views.evenly_spaced(8, (40, 48), 0.6e-6)
    taken = Exposures(views, np.where(np.arange(8) % 2, 28.0, 16.0), 0.08, 0.4, 0.0)  # type: ignore[arg-type]
    cells = random_cells(3, (views.width, views.height, views.width), 1)

    def matter(energy: float) -> MeshScene:
        return MeshScene.of_one_material(cells, HAEMOGLOBIN.delta_beta(energy))

    frames = np.stack(list(frames_by_energy(matter, taken, Simulation(oversample=3))))
    truth, prior = matter(16.0).voxelise(Grid.of_views(views)), MaterialPrior.known(HAEMOGLOBIN.delta_beta(16.0))
    ssim = {}
    for name, told in (("own", taken), ("one", replace(taken, energy_kev=16.0))):
        scan = Scan(frames, told, np.arange(8) % 4 == 3)
        result = reconstruct(scan, prior, preset("fast"))
        scores = evaluate(result, scan, truth)
        assert result.energy_kev == 16.0
        assert scores.test is not None
        assert scores.volume is not None
        ssim[name] = float(scores.test.ssim.mean())
        if name == "own":
            assert scores.volume.dice > 0.97
    assert ssim["own"] > 0.99
    assert ssim["one"] < 0.9
