"""Planning: the reference numbers, the waves against theory, the arithmetic, and surveys."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from helpers.planned import CELL, ellipsoid
from holosplat.geometry import Views
from holosplat.materials import HAEMOGLOBIN, PLASMA, RED_CELL, WATER, Compound, DeltaBeta
from holosplat.model import measure
from holosplat.planning.contrast import Setup, Subject, signal_to_noise_squared, visibility
from holosplat.planning.plan import Recording, crowther_limit, experiment, plan, survey
from holosplat.report.plan import survey_figure
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import evans_fung_cell
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavelength, wavenumber

DRY = replace(CELL, material=HAEMOGLOBIN, medium=None)

VACUUM = DeltaBeta(0.0, 0.0)


@dataclass(frozen=True)
class Made(Subject):
    """An object whose δ and β are given, whatever its material."""

    added: DeltaBeta = VACUUM

    def contrast(self, energy_kev: float) -> DeltaBeta:
        return self.added


# --- the reference numbers ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("subject", "pixel", "photons"),
    [
        (CELL, 3.2e-6, 1.2e6),
        (CELL, 1e-6, 3.5e4),
        (CELL, 0.5e-6, 7.4e3),
        (DRY, 3.2e-6, 1.6e3),
        (DRY, 1e-6, 45),
        (DRY, 0.5e-6, 10),
    ],
)
def test_photons_for_a_signal_to_noise_of_five(subject, pixel, photons):
    """An 8 µm cell face-on at 20 keV and 10 cm, computed independently elsewhere: within 30 %."""
    found = plan(subject, Setup(20.0, 0.1, pixel), Recording()).detection.photons
    assert found == pytest.approx(photons, rel=0.3)


def test_the_references_are_those_of_a_resting_cell_on_the_corner_of_four_pixels():
    """Evans & Fung's own 7.82 µm, and Δδ = 2.7e-8, meet the plasma numbers within 4 %."""
    cell = Made(evans_fung_cell(subdivisions=5), RED_CELL, PLASMA, DeltaBeta(2.7e-8, -1.5e-11))
    for pixel, photons in ((3.2e-6, 1.2e6), (1e-6, 3.5e4), (0.5e-6, 7.4e3)):
        found = plan(cell, Setup(20.0, 0.1, pixel), Recording()).detection.photons
        assert found == pytest.approx(photons, rel=0.04)


# --- the waves ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance", "pixel", "blur"), [(0.02, 0.5e-6, 0.0), (0.1, 1e-6, 0.0), (0.1, 3.2e-6, 0.7), (1.0, 1e-6, 0.4)]
)
def test_weak_objects_follow_the_contrast_transfer_function(distance, pixel, blur):
    """Σ c² of a weak phase ball is the integral of |2 sin(πλz f²) k δ T(f)|² by pixel and blur, over all places.

    Guigay (1977, Optik 49, 121); a ball's thickness has the transform 4π (sin qa - qa cos qa) / q³, q = 2πf.
    """
    radius, delta = 4e-6, 1e-10
    seen = visibility(
        Made(ellipsoid(radius, radius, radius, 5), WATER, None, DeltaBeta(delta, 0.0)),
        Setup(20.0, distance, pixel, blur),
    )
    n, step = 1200, 1 / (120e-6 + 8 * wavelength(20) * distance * 1e6)
    f = (np.arange(n) - n / 2 + 0.5) * step
    f2 = f[:, None] ** 2 + f**2
    qa = 2 * np.pi * np.sqrt(f2) * radius
    thickness = 4 * np.pi * radius**3 * (np.sin(qa) - qa * np.cos(qa)) / qa**3
    contrast = 2 * np.sin(np.pi * wavelength(20) * distance * f2) * wavenumber(20) * delta * thickness
    contrast = contrast * np.sinc(pixel * f[:, None]) * np.sinc(pixel * f)
    contrast = contrast * np.exp(-2 * np.pi**2 * (blur * pixel) ** 2 * f2)
    assert seen.information.mean() == pytest.approx((contrast**2).sum() * (step / pixel) ** 2, rel=0.015)


@pytest.mark.parametrize("shape", [(40, 46), (41, 47)], ids=["even", "odd"])
@pytest.mark.parametrize("pixel", [1e-6, 3.2e-6])
def test_the_frame_is_that_of_a_simulated_detector(shape, pixel):
    """On even and odd, rectangular rasters: the cell on the corner of four pixels, and in the middle of one."""
    setup = Setup(20.0, 0.1, pixel, 0.4)
    seen = visibility(DRY, setup)
    views = Views.from_angles([0.0], shape, pixel)
    scene = MeshScene((DRY.mesh,), (DRY.contrast(20.0),))
    frame = measure(scene, Exposures.of(views, 20.0, 0.1, 0.4), 12, torch.float64)[0].numpy()
    wanted = float(signal_to_noise_squared(frame - 1).sum())
    if shape[0] % 2 == 0:
        assert seen.information_in_the_middle == pytest.approx(wanted, rel=0.02)
        half, middle = min(len(seen.middle), 40) // 2, len(seen.middle) // 2
        cut = frame[20 - half : 20 + half, 23 - half : 23 + half] - 1
        ours = seen.middle[middle - half : middle + half, middle - half : middle + half]
        np.testing.assert_allclose(ours, cut, atol=0.02 * np.abs(cut).max())
    else:
        f = len(seen.information)
        place = ((f + 1) // 2 - 1 + f // 2) % f  # half a pixel from the corner, to half a sample
        assert seen.information[place, place] == pytest.approx(wanted, rel=0.02)


def test_equal_fresnel_numbers_and_phases_give_equal_frames():
    """All lengths across twice as large, the distance four times, δ half: the same contrast in every pixel.

    Pixels are so large that Fresnel's kernel, whose law this is, is exact to rounding."""
    small = Made(ellipsoid(48e-6, 32e-6, 40e-6), WATER, None, DeltaBeta(1.25e-8, 6.25e-11))
    large = Made(ellipsoid(96e-6, 64e-6, 80e-6), WATER, None, DeltaBeta(6.25e-9, 3.125e-11))
    one, other = (visibility(*pair) for pair in ((small, Setup(12, 12.8, 112e-7)), (large, Setup(12, 51.2, 224e-7))))
    np.testing.assert_allclose(other.middle, one.middle, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(other.information, one.information, rtol=1e-9)
    assert other.spread == pytest.approx(2 * one.spread, rel=1e-9)


def test_where_the_object_lies_matters_on_coarse_pixels_only():
    fine, coarse = (visibility(CELL, Setup(20.0, 0.1, pixel)).information for pixel in (0.5e-6, 3.2e-6))
    assert fine.max() / fine.min() < 1.01
    assert coarse.max() / coarse.min() > 2
    np.testing.assert_allclose(coarse, coarse.T, rtol=1e-3)  # the cell is round
    assert coarse.min() < coarse.mean() < coarse.max()


def test_a_source_blurs_with_the_distance():
    at = Setup(20.0, 0.2, 1e-6, 0.3, source_angle=2e-6)
    assert at.blur_px == pytest.approx(0.5)
    blurred, same = visibility(CELL, at), visibility(CELL, Setup(20.0, 0.2, 1e-6, 0.5))
    np.testing.assert_allclose(blurred.information, same.information, rtol=1e-12)
    assert blurred.information.mean() < visibility(CELL, Setup(20.0, 0.2, 1e-6, 0.3)).information.mean()


def test_phase_and_absorption_are_those_of_the_thickest_ray():
    silica = Subject(ellipsoid(5e-6, 5e-6, 10e-6), Compound("SiO2", 2.2), WATER)
    added = Compound("SiO2", 2.2).delta_beta(10.0).against(WATER.delta_beta(10.0))
    seen = visibility(silica, Setup(10.0, 0.01, 1e-6))
    assert seen.phase == pytest.approx(wavenumber(10.0) * added.delta * 20e-6, rel=0.01)
    assert seen.absorption == pytest.approx(1 - math.exp(-2 * wavenumber(10.0) * added.beta * 20e-6), rel=0.01)
    assert visibility(CELL, Setup(20.0)).absorption < 0  # plasma absorbs more
    edge_on = visibility(CELL.tilted(90.0), Setup(20.0))
    assert edge_on.phase == pytest.approx(wavenumber(20.0) * CELL.contrast(20.0).delta * 8e-6, rel=0.25)


def test_the_filter_reaches_its_signal_to_noise_on_counts():
    """Of Poisson counts with and without a strong signal, by c / (1 + c/2): the formula's value within 3 %."""
    rng = np.random.default_rng(1)
    contrast, photons = rng.uniform(-0.7, 1.5, 60), 0.9
    weight = contrast / (1 + contrast / 2)
    outputs = [
        (rng.poisson(photons * mean, (60000, 60)) * weight).sum(1) for mean in (1.0 + 0 * contrast, 1 + contrast)
    ]
    squared = (outputs[1].mean() - outputs[0].mean()) ** 2 / (0.5 * (outputs[0].var() + outputs[1].var()))
    assert squared == pytest.approx(photons * signal_to_noise_squared(contrast).sum(), rel=0.03)
    weak = 1e-4 * contrast
    np.testing.assert_allclose(signal_to_noise_squared(weak), weak**2, rtol=1e-3)


# --- the arithmetic -----------------------------------------------------------------------------------------


def test_signal_to_noise_grows_as_the_root_of_the_photons():
    few, many = (plan(CELL, Setup(), Recording(photons)).detection for photons in (100.0, 10000.0))
    assert many.snr == pytest.approx(10 * few.snr, rel=1e-12)
    assert many.photons == few.photons
    assert plan(CELL, Setup(), Recording(few.photons)).detection.snr == pytest.approx(5)
    assert few.snr_worst <= few.snr <= few.snr_best
    assert few.photons_best <= few.photons_mean <= few.photons_worst


def test_the_numbers_of_a_recording():
    """By hand: λ = 0.62 Å at 20 keV, so √(λz) = 2.49 µm at 10 cm."""
    recording = Recording(1e4, 16, (100, 200), 1e6, 1e-7, 2.0, 12, 50)
    found = plan(CELL, Setup(20.0, 0.1, 0.5e-6), recording)
    assert found.waves.fringe == pytest.approx(2.4898e-6, rel=1e-4)
    assert found.waves.fringe_px == pytest.approx(4.9796, rel=1e-4)
    assert found.waves.fresnel_object == pytest.approx(16e-12 / 6.1992e-12, rel=1e-3)
    assert found.waves.fresnel_pixel == pytest.approx(0.25e-12 / 6.1992e-12, rel=1e-3)
    assert (found.waves.delta, found.waves.beta) == CELL.contrast(20.0)
    assert found.sampling.limit_object == pytest.approx(math.pi * 8e-6 / 16, rel=1e-3)
    assert found.sampling.views_object == 51
    assert found.sampling.limit_field == pytest.approx(math.pi * 100e-6 / 16)
    assert found.sampling.views_field == 629
    assert found.sampling.field == pytest.approx((100e-6, 50e-6))
    assert crowther_limit(8e-6, found.sampling.views_object) <= 0.5e-6
    assert found.motion.blur_px == pytest.approx(2.0 * 1e-7 / 0.5e-6)
    assert found.motion.step_px == pytest.approx(4.0)
    assert found.motion.longest_exposure == pytest.approx(0.25e-6)
    assert found.motion.slowest_rate == pytest.approx(4e6)
    assert found.storage.data_rate == pytest.approx(100 * 200 * 1.5 * 16 * 1e6)
    assert found.storage.raw == pytest.approx(100 * 200 * 1.5 * 16 * 50)
    assert found.storage.volume == (200, 100, 200)
    assert found.storage.volume_bytes == 200 * 100 * 200 * 8
    assert found.storage.volumes_bytes == 200 * 100 * 200 * 8 * 50


def test_an_exposure_is_the_whole_frame_unless_said():
    moving = plan(CELL, Setup(), Recording(frame_rate=1000.0, velocity=1e-3)).motion
    assert moving.blur_px == moving.step_px == pytest.approx(1e-6 / 3.2e-6)
    nothing = plan(CELL, Setup(), Recording())
    assert set(vars(nothing.motion).values()) == {None}
    assert set(vars(nothing.storage).values()) == {None}


# --- surveys ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def surveyed():
    """A cell in plasma over 3 energies and 5 distances, with a source that blurs long distances."""
    setup = Setup(20.0, 0.1, 2e-6, 0.2, source_angle=4e-6)
    return survey(CELL, setup, 1e5, np.geomspace(0.01, 2, 5), np.array([9.0, 15.0, 30.0]))


def test_a_survey_holds_what_plans_say(surveyed):
    for e, z in ((0, 0), (1, 2), (2, 4)):
        at = replace(surveyed.setup, energy_kev=float(surveyed.energies_kev[e]), distance=float(surveyed.distances[z]))
        one = plan(CELL, at, Recording(1e5))
        assert surveyed.snr[e, z] == pytest.approx(one.detection.snr_rms, rel=1e-12)
        assert surveyed.spread[e, z] == one.waves.spread
    assert surveyed.snr[surveyed.best] == surveyed.snr.max()
    assert surveyed.setup.distance == surveyed.distances[surveyed.best[1]]
    assert 0 < surveyed.best[1] < 4  # the source's blur bounds the distance


def test_the_table_of_a_survey(surveyed):
    for e, row in enumerate(surveyed.table()):
        best = int(np.argmax(surveyed.snr[e]))
        assert row["best_distance_m"] == surveyed.distances[best]
        assert row["snr"] == pytest.approx(surveyed.snr[e].max())
        assert row["photons_for_5"] == pytest.approx(1e5 * 25 / row["snr"] ** 2)
        assert surveyed.distances[0] <= row["distance_for_90_percent_m"] <= row["best_distance_m"]
        near = np.interp(np.log(row["distance_for_90_percent_m"]), np.log(surveyed.distances), np.log(surveyed.snr[e]))
        assert math.exp(near) == pytest.approx(0.9 * row["snr"])
        assert (row["delta"], row["beta"]) == CELL.contrast(row["energy_kev"])


def test_the_figure_shows_the_survey(surveyed):
    """The map's colours, the curves and the frame are the survey's numbers; with one energy there is no map."""
    figure = survey_figure(surveyed)
    colours, curves, _, frame, _ = (figure.axes[i] for i in (0, 2, 1, 3, 4))
    np.testing.assert_allclose(colours.collections[0].get_array(), surveyed.snr)
    drawn = [line.get_ydata() for line in curves.lines if len(line.get_ydata()) == 5]
    assert len(drawn) == 3
    np.testing.assert_allclose(drawn, surveyed.snr)
    shown = frame.images[0].get_array()
    n, m = len(surveyed.best_frame), len(shown)
    cut = surveyed.best_frame[(n - m) // 2 : (n + m) // 2, (n - m) // 2 : (n + m) // 2]
    assert np.corrcoef(shown.reshape(-1), cut.reshape(-1))[0, 1] == pytest.approx(1)
    line = replace(surveyed, energies_kev=surveyed.energies_kev[:1], information=surveyed.information[:1])
    assert len(survey_figure(line).axes) == 3
    column = replace(surveyed, distances=surveyed.distances[:1], information=surveyed.information[:, :1])
    assert survey_figure(column).axes[0].get_xlabel() == "photon energy (keV)"


def test_the_experiment_of_a_plan_is_as_wide_as_object_and_fringes_on_joined_pixels():
    """A cell of known sides; the photons of joined pixels add up."""
    setup = Setup(20.0, 0.1, 0.1e-6)
    x, y, z = CELL.extent
    rows, columns = (math.ceil((side + 4 * setup.fringe) / 0.1e-6) for side in (y, math.hypot(x, z)))
    scene, exposures, photons = experiment(CELL, setup, Recording(100.0, 5), 20)
    joined = min(rows, columns) // 20
    assert exposures.views.shape == (rows // joined, columns // joined)
    assert exposures.views.pixel_size == pytest.approx(joined * 0.1e-6)
    assert photons == pytest.approx(100 * joined**2)
    assert len(exposures) == 5
    assert tuple(scene.materials[0]) == tuple(CELL.contrast(20.0))
    small = experiment(CELL, setup, Recording(100.0, 5, (11, 19)), 20)[1]
    assert small.views.shape == (11, 19)
    coarse = replace(setup, pixel_size=5e-6)
    assert max(experiment(CELL, coarse, Recording(100.0, 5), 20)[1].views.shape) < 11
    assert experiment(CELL, coarse, Recording(100.0, 5, (8, 30)), 20, 11)[1].views.shape == (8, 11)
