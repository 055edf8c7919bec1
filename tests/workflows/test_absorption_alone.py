"""Scans in contact, and fans of a few rows: the same functions and commands, and β comes out right."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from helpers.cli import holosplat, refused, worked
from helpers.contact import ENERGY, PIXEL, contact_scan, inside, mean_beta, turned
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.volumes import write_volume
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import METHODS, Auto, Gaussians
from holosplat.methods.presets import preset
from holosplat.optics.retrieval import RETRIEVALS, absorption_alone
from holosplat.optics.retrieval.spectra import sensitivity
from holosplat.optics.sampling import fringe_sampling, resolving_oversample
from holosplat.scan import Exposures
from holosplat.units import wavelength, wavenumber
from holosplat.volume import Volume
from holosplat.workflows.evaluate import evaluate, of_absorption
from holosplat.workflows.reconstruct import reconstruct
from holosplat.workflows.run_folder import RunFolder

BETA = 1e-7
BALL = (2.0, 0.0, -3.0, 11.0, BETA)
PRIORS = {
    "known": MaterialPrior.known(DeltaBeta(500 * BETA, BETA)),
    "ratio": MaterialPrior.of_ratio(500),
    "nothing": MaterialPrior.unknown(),
}


@pytest.fixture(scope="module")
def scan():
    return contact_scan([BALL], (13, 40), photons=5000)


# --- optics --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RETRIEVALS)
@pytest.mark.parametrize("beta", [BETA, -BETA])
def test_every_retrieval_is_the_logarithm_in_contact(name, beta):
    """Also of matter that absorbs less than its medium; frames at a distance go their own way beside them."""
    scan = contact_scan([(*BALL[:4], beta)], (13, 40), count=3)
    frames = torch.from_numpy(scan.frames)
    expected = -np.log(scan.frames) / (2 * wavenumber(ENERGY) * beta)
    assert RETRIEVALS[name](frames, scan.exposures, 500 * BETA, beta).numpy() == pytest.approx(expected, abs=1e-9)
    mixed = replace(scan.exposures, distance=np.array([0.0, 0.05, 0.0]))
    found = RETRIEVALS[name](frames, mixed, 500 * BETA, beta).numpy()
    assert found[[0, 2]] == pytest.approx(expected[[0, 2]], abs=1e-9)
    assert np.abs(found[1] - expected[1]).max() > 1e-7


@pytest.mark.parametrize("name", RETRIEVALS)
def test_matter_that_does_not_absorb_is_not_seen_in_contact(name, scan):
    with pytest.raises(InputError, match=r"distance 0.*absorption alone"):
        RETRIEVALS[name](torch.from_numpy(scan.frames), scan.exposures, 1e-6, 0.0)


def test_opaque_pixels_have_a_finite_thickness(scan):
    """No photon counts as one."""
    frames = torch.from_numpy(scan.frames).clone()
    frames[:, 6, 20] = 0
    found = RETRIEVALS["tikhonov"](frames, scan.exposures, 500 * BETA, BETA)
    assert bool(found.isfinite().all())
    per_metre = 2 * wavenumber(ENERGY) * BETA
    assert float(found[0, 6, 20]) * per_metre == pytest.approx(np.log(5000), rel=0.1)


def at(chi: float) -> Exposures:
    """A frame with this χ at its highest frequency."""
    return Exposures.of(turned(1, (7, 9)), ENERGY, 2 * PIXEL**2 * chi / (np.pi * wavelength(ENERGY)))


def test_refraction_is_unseen_where_it_adds_less_than_a_hundredth():
    """At 0, and where χ at the highest frequency is below β/δ / 100, of either sign."""
    for ratio in (1e-3, -1e-3):
        assert [bool(absorption_alone(at(chi), ratio)[0]) for chi in (0, 0.99e-5, 1.01e-5)] == [True, True, False]
    assert not absorption_alone(at(0.99e-5), 0.0)[0]


def test_the_sensitivity_to_phase_is_that_of_absorption_in_contact():
    """2 β/δ at χ = 0, twice sin χ for β = 0, and 1 from there on where fringes are seen."""
    assert sensitivity(at(0), 1e-3)[0] == pytest.approx(2e-3)
    assert sensitivity(at(0.1), 0.0)[0] == pytest.approx(2 * np.sin(0.1), rel=1e-6)
    assert [sensitivity(at(chi), 0.0)[0] for chi in (0.6, 1.5, 40.0)] == [1, 1, 1]
    assert sensitivity(at(0.1), 0.3)[0] == pytest.approx(2 * (0.3 * np.cos(0.1) + np.sin(0.1)), rel=1e-6)


def test_samples_of_waves_that_make_no_fringe():
    """One a pixel in contact and for fringes below a sixteenth of a pixel; others decide where they are seen."""
    pixels = [0.0, 1 / 17, 1 / 15, 0.5]
    distance = (np.array(pixels) * PIXEL) ** 2 / wavelength(ENERGY)
    taken = replace(Exposures.of(turned(4, (7, 9)), ENERGY, 0.0), distance=distance)
    assert [fringe_sampling(taken[[i]]) for i in range(4)] == [1, 1, 8, 3]
    assert fringe_sampling(taken[[0, 1, 3]]) == 3
    assert [resolving_oversample(taken[[i]], 8, at_least=4) for i in (0, 3)] == [4, 16]


# --- reconstructions -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("known", PRIORS)
@pytest.mark.parametrize("name", ["holographic-tv", "voxels"])
def test_beta_of_a_ball_in_contact(name, known, scan):
    """Within 2 % inside the ball, of all matter within 2 %; δ by the ratio, or said not to be told."""
    found = reconstruct(scan, PRIORS[known], METHODS[name])
    volume = found.object.voxelise(Grid.of_views(scan.views))
    assert mean_beta(volume, BALL) == pytest.approx(1, abs=0.02)
    assert volume.beta.sum() == pytest.approx(BETA * inside(volume.grid, BALL).sum(), rel=0.03)
    assert volume.delta.sum() / volume.beta.sum() == pytest.approx(1 if known == "nothing" else 500, rel=1e-3)
    assert found.delta_told == (known != "nothing")
    beta = Volume(0 * volume.beta, volume.beta, volume.grid)
    truth = Volume(500 * BETA * inside(volume.grid, BALL), BETA * inside(volume.grid, BALL), volume.grid)
    scores = evaluate(found, None, truth)
    assert scores.volume is not None
    assert scores.volume.dice > 0.9
    assert any("relative error of β" in line for line in scores.lines()) == (known == "nothing")
    assert np.array_equal(of_absorption(beta).delta, beta.beta)


@pytest.mark.parametrize("shape", [(1, 41), (2, 40)])
def test_a_fan_of_a_few_rows_reconstructs(shape):
    """Gaussians as by the fast preset, in space and by its frames; the judge scores one row, too."""
    scan = contact_scan([BALL], shape, photons=20000)
    method = preset("fast")
    assert isinstance(method, Gaussians)
    schedule = replace(method.fit.schedule, steps=20, validation_views=1, validate_every=10)
    found = reconstruct(scan, PRIORS["ratio"], replace(method, fit=replace(method.fit, schedule=schedule)))
    volume = found.object.voxelise(Grid.of_views(scan.views))
    assert mean_beta(volume, BALL) == pytest.approx(1, abs=0.05)
    scores = evaluate(found, scan, None)
    assert scores.test is not None
    assert scores.test.mean["ssim"] > 0.9


def test_a_wide_fan_of_few_rows_reconstructs_by_default():
    """Frames are binned no further than their rows allow, where a default of a square frame's would be."""
    ball = (4.0, 0.0, -9.0, 24.0, BETA)
    scan = contact_scan([ball], (1, 137), photons=50_000)
    found = reconstruct(scan, PRIORS["ratio"], Auto().with_effort(0.3))
    volume = found.object.voxelise(Grid.of_views(scan.views))
    assert mean_beta(volume, ball) == pytest.approx(1, abs=0.05)
    assert found.verdict is not None
    assert found.verdict.good


@pytest.mark.usefixtures("undrawn_reports")
def test_the_commands_run_in_contact_on_one_row(tmp_path):
    """reconstruct, evaluate, render; what is said of δ is that it is not told."""
    scan, run = contact_scan([BALL], (1, 41), photons=20000), tmp_path / "run"
    write_scan(tmp_path / "scan.nxs", scan)
    assert not read_scan(tmp_path / "scan.nxs").exposures.distance.any()
    done = holosplat("reconstruct", tmp_path / "scan.nxs", "--out", run, "--method", "holographic-tv")
    assert "δ is not told" in done.out + done.err
    assert json.loads(RunFolder(run).summary.read_text())["material"]["delta_told"] is False
    again = holosplat("evaluate", run, "--scan", tmp_path / "scan.nxs")
    assert "δ is not told" in again.out + again.err
    holosplat("render", run, "--scan", tmp_path / "scan.nxs", "--out", tmp_path / "rendered.nxs", "--split", "all")
    rendered = read_scan(tmp_path / "rendered.nxs").frames
    assert np.abs(rendered - scan.frames).mean() < 0.02
    said = worked(holosplat("export", run, "--volume", tmp_path / "v.h5"))
    assert "δ is not told, for the frames show absorption alone" in said.err
    with h5py.File(tmp_path / "v.h5") as file:
        assert sorted(file) == ["beta", "mu_per_m", "views"]
        mu, beta = (np.asarray(file[name]) for name in ("mu_per_m", "beta"))
        assert file["mu_per_m"].attrs["units"] == "1/m"
    np.testing.assert_allclose(mu, 2 * wavenumber(ENERGY) * beta, rtol=1e-6)
    itself = worked(holosplat("evaluate", run, "--scan", tmp_path / "scan.nxs", "--truth", tmp_path / "v.h5"))
    assert "relative error of β 0.00" in itself.out
    facts = worked(holosplat("info", tmp_path / "v.h5")).out
    assert "a volume of µ and β" in facts
    refused(holosplat("export", run, "--compact", tmp_path / "c.h5"), "δ, which", "absorption alone")


def test_a_plan_in_contact():
    said = json.loads(holosplat("plan", "--distance", "0", "--json").out)
    assert said["plan"]["waves"]["fresnel_object"] == "inf"
    assert said["plan"]["waves"]["fringe"] == 0
    assert 0 < said["plan"]["detection"]["snr"] < 0.1
    assert "absorption alone" in holosplat("plan", "--distance", "0").out


@pytest.mark.usefixtures("undrawn_reports")
def test_a_report_of_contact_frames_shows_what_they_show(tmp_path):
    """µ, also where the ratio δ/β is told; its truth is that of µ, too."""
    scan, run = contact_scan([BALL], (1, 41), photons=20000), tmp_path / "run"
    write_scan(tmp_path / "scan.nxs", scan)
    ball = inside(Grid.of_views(scan.views), BALL) * BETA
    write_volume(tmp_path / "truth.h5", Volume(500 * ball, ball, Grid.of_views(scan.views)))
    how = ("--method", "tikhonov-tv", "--delta-beta", 500)
    worked(holosplat("reconstruct", tmp_path / "scan.nxs", "--out", run, *how))
    scores = json.loads(worked(holosplat("evaluate", run, "--truth", tmp_path / "truth.h5", "--json")).out)["volume"]
    page = RunFolder(run).report.read_text(encoding="utf-8")
    assert "mean µ in the matter" in page
    assert "relative error of δ" not in page
    assert "Projected absorption" in page
    assert "δ is β times the ratio that was told" in page
    assert scores["true_ratio"] == pytest.approx(500)
    view = json.loads(page.split('class="header">')[1].split("</script>")[0])
    assert not view["delta_told"]
    through = 4 * wavenumber(ENERGY) * BETA * BALL[3] * PIXEL  # 2k∫β of the ball's diameter
    assert view["phase"] == pytest.approx([0, through], rel=0.2)
