"""Frames of light with a bandwidth: closed forms, order of convergence, gradients, and what costs nothing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.model import Alignment, Instrument
from holosplat.optics.coherence import FWHM, MOST_ENERGIES, QUADRATURE, Spectrum, quadrature
from holosplat.optics.hologram import cpu
from holosplat.scan import Exposures
from holosplat.units import wavelength, wavenumber
from holosplat.volume import LineIntegrals

ENERGY, PITCH = 20.0, 0.5e-6
UNIT = PITCH**2 / wavelength(ENERGY)
"""The distance [m] over which the finest fringe travels half a pixel."""
DOUBLE = torch.float64
TURN = 1 / float(wavenumber(ENERGY))
"""δ integrated along the beam [m] that gives a phase of one radian."""


def exposures(bandwidth: float, count: int = 3, distance: float = 4.0, shape: tuple[int, int] = (9, 14)) -> Exposures:
    """An odd, rectangular raster; unequal distances (in units) and blurs."""
    z = UNIT * distance * np.linspace(1, 1.2, count)
    views = Views.evenly_spaced(count, shape, PITCH)
    return Exposures(views, ENERGY, z, 0.4, np.zeros(count), bandwidth=bandwidth)  # type: ignore[arg-type]


def lines(instrument: Instrument, size: float = 1.0, dtype: torch.dtype = DOUBLE) -> LineIntegrals:
    """Smooth matter of the given phase [rad], and absorption beside it."""
    draw = torch.Generator().manual_seed(5)
    raw = torch.rand(len(instrument.exposures), 2, *instrument.views.shape, generator=draw, dtype=DOUBLE)
    raw = torch.nn.functional.avg_pool2d(raw, 3, 1, 1)
    return LineIntegrals((raw * size * TURN).to(dtype), ((1.0, 1e-2), (0.3, 5e-2)))


def test_weak_matter_loses_contrast_as_the_spectrums_transform():
    """A phase grating of contrast c at f: mean over E of `2 c (E₀/E) sin(πλ₀z f² E₀/E)`, by a fine trapezoid rule."""
    shape, period, width = (15, 40), 4, 0.2
    beam = exposures(width, 1, 13.0, shape)
    beam = replace(beam, psf_sigma_px=np.zeros(1))
    pink = Instrument(beam, 1, DOUBLE)
    h, w = pink.views.shape
    x = (torch.arange(w, dtype=DOUBLE) + 0.5 - w / 2) * PITCH
    amplitude, f = 1e-5, 1 / (period * PITCH)
    D = (amplitude * TURN * torch.cos(2 * math.pi * f * x)).expand(1, h, w)
    inner = pink.image(torch.zeros_like(D), D)[0, shape[0] // 2].numpy()
    t = (np.arange(shape[1]) + 0.5 - shape[1] / 2) * PITCH
    # -φ = k D, and I - 1 = 2 sin(χ) · k D … of first order in D
    found = 2 * np.mean((inner - 1)[12:-12] * np.cos(2 * np.pi * f * t)[12:-12])
    s = np.linspace(-5, 5, 20_001)
    weight = np.exp(-(s**2) / 2)
    energy = 1 + s * width / FWHM
    energy, weight = energy[energy > 0.1], weight[energy > 0.1]
    chi = np.pi * wavelength(ENERGY) * beam.distance[0] * f**2
    wanted = -2 * amplitude * np.sum(weight / energy * np.sin(chi / energy)) / weight.sum()
    assert abs(found) == pytest.approx(abs(wanted), rel=0.01)
    sharp = 2 * amplitude * math.sin(chi)
    assert abs(abs(sharp) - abs(wanted)) > 0.05 * abs(wanted)  # what is tested is no rounding


@pytest.mark.parametrize("phase", [0.3, 3.0])
def test_the_sum_over_energies_converges_at_its_order(phase, monkeypatch):
    """The remainder of n nodes is `(χσ)²ⁿ n!/(2n)!`: halving the bandwidth takes 2²ⁿ of it away."""
    for count in (1, 2, 3):
        errors = []
        for width in (0.16, 0.08):
            nodes, weights = np.polynomial.hermite.hermgauss(9)
            beams = exposures(width, 2)
            exact = (math.sqrt(2) / FWHM * nodes, weights / weights.sum())
            monkeypatch.setattr("holosplat.model.instrument.quadrature", lambda _, exact=exact: exact)
            fine = Instrument(beams, 1, DOUBLE)
            few, own = np.polynomial.hermite.hermgauss(count)
            coarse = (math.sqrt(2) / FWHM * few, own / own.sum())
            monkeypatch.setattr("holosplat.model.instrument.quadrature", lambda _, few=coarse: few)
            matter = lines(fine, phase)
            errors.append(float((Instrument(beams, 1, DOUBLE).frames(matter) - fine.frames(matter)).abs().max()))
        assert math.log2(errors[0] / errors[1]) == pytest.approx(2 * count, abs=0.5), count


@pytest.mark.parametrize(
    ("width", "distance", "most"),
    [(0.01, 8.0, 2), (0.03, 8.0, 4), (0.1, 8.0, 5), (0.2, 30.0, 25), (0.1, 80.0, 25), (0.02, 400.0, 25)],
)
def test_as_many_energies_are_taken_as_the_error_allows(width, distance, most):
    """For the finest fringe and all coarser ones, whether they are seen or washed out; against a fine sum."""
    beams = exposures(width, 2, distance)
    nodes, weights = quadrature(beams)
    fine = np.linspace(-7, 7, 40_001)
    normal = np.exp(-0.5 * fine**2)
    finest = math.pi * wavelength(ENERGY) * float(beams.distance.max()) / (2 * PITCH**2)
    for chi in finest * np.linspace(0, 1, 41):
        exact = normal @ np.exp(1j * chi / (1 + width / FWHM * fine)) / normal.sum()
        found = weights @ np.exp(1j * chi / (1 + width * nodes))
        assert abs(found - exact) <= QUADRATURE
    assert len(nodes) <= most
    assert weights.sum() == pytest.approx(1)


def test_the_sum_is_that_of_the_spectrums_own_energies():
    """As frames of each energy alone, with matter that disperses as δ ∝ E⁻², β ∝ E⁻⁴; views picked likewise."""
    beams = exposures(0.1)
    pink = Instrument(beams, 1, DOUBLE)
    matter, count = lines(pink), len(quadrature(beams)[0])
    assert count > 1
    light, total = Spectrum.gaussian(ENERGY, 0.1, count), torch.zeros(3, 9, 14, dtype=DOUBLE)
    for energy, weight in zip(light.energies_kev, light.weights):
        alone = Instrument(replace(beams, energy_kev=energy, reference_kev=ENERGY, bandwidth=np.zeros(3)), 1, DOUBLE)
        my, mx = (a - b for a, b in zip(pink.margin, alone.margin))
        assert (my, mx) == (0, 0) or energy != ENERGY
        padded = torch.nn.functional.pad(matter.channels, (-mx, -mx, -my, -my))
        total += weight * alone.frames(LineIntegrals(padded, matter.materials))
    frames = pink.frames(matter)
    assert float((frames - total).abs().max()) < 2e-2 * float(frames.std())  # margins differ a little
    picked = pink.frames(LineIntegrals(matter.channels[[2, 0]], matter.materials), np.array([2, 0]))
    assert torch.allclose(picked, frames[[2, 0]], atol=1e-12)


UNKNOWNS = {"energies": [0.01, -0.02, 0.0], "bandwidths": [0.02, -0.01, 0.005]}


def score(backend: str, on: torch.device, numbers: dict[str, torch.Tensor], leaf: torch.Tensor) -> torch.Tensor:
    beams = exposures(0.06, shape=(2, 5))
    dtype = DOUBLE if backend == "reference" else torch.float32
    instrument = Instrument(beams, 1, dtype, backend, on=on)
    light = Alignment(**{name: value.to(on) for name, value in numbers.items()}).light(beams)
    matter = LineIntegrals(leaf.to(on, dtype), ((1.0, 1e-2), (0.3, 5e-2)))
    weights = torch.randn(3, 2, 5, generator=torch.Generator().manual_seed(2), dtype=DOUBLE)
    return (instrument.frames(matter, light=light).cpu().double() * weights).sum()


def gradients(backend: str, on: torch.device) -> list[torch.Tensor]:
    numbers = {name: torch.tensor(value, dtype=DOUBLE, requires_grad=True) for name, value in UNKNOWNS.items()}
    matter = lines(Instrument(exposures(0.06, shape=(2, 5)), 1, DOUBLE)).channels.requires_grad_()
    return list(torch.autograd.grad(score(backend, on, numbers, matter), [*numbers.values(), matter]))


def differs(found: list[torch.Tensor], true: list[torch.Tensor]) -> float:
    return max(float((f - t).abs().max() / t.abs().max()) for f, t in zip(found, true))


def test_gradients_of_the_reference_are_differences():
    on = torch.device("cpu")
    matter = lines(Instrument(exposures(0.06, shape=(2, 5)), 1, DOUBLE)).channels
    found = dict(zip(UNKNOWNS, gradients("reference", on)))
    for name, at in UNKNOWNS.items():
        for view in range(3):
            ends = []
            for step in (1e-5, -1e-5):
                numbers = {key: torch.tensor(value, dtype=DOUBLE) for key, value in UNKNOWNS.items()}
                numbers[name][view] = at[view] + step
                ends.append(score("reference", on, numbers, matter))
            difference = float(ends[0] - ends[1]) / 2e-5
            assert float(found[name][view]) == pytest.approx(difference, rel=1e-5)


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
def test_gradients_of_kernels_are_those_of_the_reference(backend, gpu):
    on = gpu if backend == "cuda" else torch.device("cpu")
    assert differs(gradients(backend, on), gradients("reference", torch.device("cpu"))) < 2e-4


@pytest.mark.parametrize("wrong", ["sign", "one part in a hundred"])
def test_the_check_would_catch_a_wrong_gradient(wrong, monkeypatch):
    right, factor = cpu.factor_gradients, -1.0 if wrong == "sign" else 1.01
    monkeypatch.setattr(cpu, "factor_gradients", lambda *given: tuple(factor * g for g in right(*given)))
    on = torch.device("cpu")
    assert differs(gradients("cpu", on), gradients("reference", on)) > 2e-4


def test_moved_energies_and_bandwidths_are_those_of_other_exposures():
    """To the few parts in a million that the change of δ within the quadrature takes."""
    beams = exposures(0.06)
    moved = Alignment(**{name: torch.tensor(value, dtype=DOUBLE) for name, value in UNKNOWNS.items()})
    planned, other = Instrument(beams, 1, DOUBLE), Instrument(moved.exposures(beams), 1, DOUBLE)
    assert planned.margin == other.margin
    matter = lines(planned)
    found, wanted = planned.frames(matter, light=moved.light(beams)), other.frames(matter)
    assert torch.allclose(found, wanted, atol=1e-6)
    assert float((wanted - planned.frames(matter)).abs().max()) > 1e-3


def test_light_of_one_energy_costs_one_set_of_waves(monkeypatch):
    made, real = [], cpu.hologram
    monkeypatch.setattr(cpu, "hologram", lambda *given: made.append(1) or real(*given))
    for width, cost in ((0.0, 1), (1e-4, 1), (0.1, len(quadrature(exposures(0.1))[0]))):
        instrument, before = Instrument(exposures(width)), len(made)
        instrument.frames(lines(instrument, dtype=torch.float32))
        assert len(made) - before == cost


def test_bad_input_is_named():
    with pytest.raises(InputError, match=r"bandwidth must lie between 1e-09 and 0\.5"):
        exposures(0.7)
    far = exposures(0.3, 1, 400.0)
    with pytest.raises(InputError, match=f"takes more than {MOST_ENERGIES} energies"):
        quadrature(far)
    plain = Instrument(exposures(0.0), 1, DOUBLE)
    widths = torch.full((3,), 0.01, dtype=DOUBLE)
    with pytest.raises(InputError, match="a fit of the bandwidth needs a planned one above 0"):
        plain.frames(lines(plain), light=(None, widths))
