"""Gradients of distances and widths, and energies per view: every backend against float64 autograd and differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.watch import Watch
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.model.instrument import Instrument
from holosplat.optics.hologram import OpticalPath, cpu, hologram, optical_path
from holosplat.scan import Exposures
from holosplat.units import wavelength, wavenumber
from holosplat.volume import LineIntegrals

ENERGY, PITCH = 20.0, 0.5e-6
DOUBLE = torch.float64
TOLERANCE = 1e-4
UNIT = PITCH**2 / wavelength(ENERGY)
"""The distance [m] over which the finest fringe travels half a pixel."""
MATTER = {"one": [(0.7, 0.02)], "signed": [(0.5, -0.3)], "two": [(0.6, 0.0), (0.0, 0.2)]}
CASES = {
    "plain": (None, 1),
    "oversampled": (None, 2),
    "blurred": ([0.4, 0.9, 1.5], 1),
    "oversampled and blurred": ([0.4, 0.9, 1.5], 2),
    "thrice": ([0.4, 0.9, 1.5], 3),
}

SMALL = (2, 5), (1, 2)
"""Frame and margin [pixels] for tests of kernels."""


class Setup:
    """Three views in an odd, rectangular raster with unequal margins, at unequal distances.

    They have 4 × 7 pixels; 2 × 5 where Triton's interpreter runs, for which every row is a program.
    Its score is a fixed random sum over the frames; distances are in `UNIT`, widths in pixels.
    """

    def __init__(self, case: str, matter: str, device: torch.device | str | None = None):
        psf, self.factor = CASES[case]
        self.frame, self.margin = ((4, 7), (2, 3)) if device is None else SMALL
        device = device or "cpu"
        self.matter, self.device = MATTER[matter], device
        self.raster = tuple((n + 2 * m) * self.factor | 1 for n, m in zip(self.frame, self.margin))
        draw = torch.Generator().manual_seed(0)
        self.weights = torch.randn(3, *self.frame, generator=draw, dtype=DOUBLE)
        lines = torch.randn(3, len(self.matter), *self.raster, generator=draw, dtype=DOUBLE)
        self.unknowns = {"distance": torch.tensor([1.3, 2.0, 4.0], dtype=DOUBLE), "lines": lines}
        if psf is not None:
            self.unknowns["psf"] = torch.tensor(psf, dtype=DOUBLE)

    def path(self, distance: Tensor, psf: Tensor | None, dtype: torch.dtype) -> OpticalPath:
        """Made from tensors; without a width, without a blur."""
        sigma = np.zeros(3) if psf is None else self.factor * psf.to(self.device)
        corner = tuple(m * self.factor for m in self.margin)
        frame = (self.frame, corner, self.factor)
        return optical_path(
            self.raster, PITCH / self.factor, ENERGY, UNIT * distance.to(self.device), sigma, frame, dtype
        )

    def score(self, backend: str, unknowns: dict[str, Tensor], index: list[int] | None = None) -> Tensor:
        """From the views `index` (default: all)."""
        dtype = DOUBLE if backend == "reference" else torch.float32
        path = self.path(unknowns["distance"], unknowns.get("psf"), dtype)
        at = torch.arange(3) if index is None else torch.tensor(index)
        lines = unknowns["lines"][at].to(self.device, dtype)
        frames = hologram(lines, self.matter, path[at.to(self.device)], backend)
        return (frames.cpu().double() * self.weights[: len(at)]).sum()

    def gradients(self, backend: str, index: list[int] | None = None) -> dict[str, Tensor]:
        """Of the score, by name."""
        leaves = {name: value.clone().requires_grad_() for name, value in self.unknowns.items()}
        self.score(backend, leaves, index).backward()
        return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def error(found: dict[str, Tensor], true: dict[str, Tensor]) -> float:
    """The worst, over the unknowns, of the largest difference over the largest true value."""
    assert set(found) == set(true)
    return max(float((found[name] - true[name]).abs().max() / true[name].abs().max()) for name in true)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("matter", MATTER)
def test_gradients_of_the_reference_are_differences(matter, case):
    setup = Setup(case, matter)
    found = setup.gradients("reference")
    for name in sorted(set(found) - {"lines"}):
        for view in range(3):
            ends = []
            for step in (1e-5, -1e-5):
                moved = setup.unknowns[name].clone()
                moved[view] += step
                ends.append(setup.score("reference", {**setup.unknowns, name: moved}))
            slack = 1e-8 * float(found[name].abs().max())
            difference = float(ends[0] - ends[1]) / 2e-5
            assert float(found[name][view]) == pytest.approx(difference, rel=1e-6, abs=slack), name


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("matter", MATTER)
def test_gradients_of_the_cpu_are_those_of_the_reference(matter, case):
    setup = Setup(case, matter)
    assert error(setup.gradients("cpu"), setup.gradients("reference")) < TOLERANCE


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("matter", ["one", "two"])
def test_gradients_of_the_gpu_are_those_of_the_reference(matter, case, gpu):
    setup = Setup(case, matter, gpu)
    assert error(setup.gradients("cuda"), setup.gradients("reference")) < TOLERANCE


@pytest.mark.parametrize("mkl", [True, False])
def test_either_library_gives_the_same(mkl, monkeypatch):
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: mkl)
    test_gradients_of_the_cpu_are_those_of_the_reference("two", "oversampled and blurred")


WRONG = {
    "sign": lambda given: [-g for g in given],
    "conjugate": lambda given: [g.conj() for g in given],
    "rows only": lambda given: [given[0], torch.zeros_like(given[1])],
    "one part in a thousand": lambda given: [1.001 * g for g in given],
}


@pytest.mark.parametrize("wrong", WRONG)
def test_the_check_would_catch_a_wrong_gradient(wrong, monkeypatch):
    setup, right = Setup("oversampled and blurred", "two"), cpu.factor_gradients
    monkeypatch.setattr(cpu, "factor_gradients", lambda *given: tuple(WRONG[wrong](right(*given))))
    assert error(setup.gradients("cpu"), setup.gradients("reference")) > TOLERANCE


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
def test_picked_views_get_their_gradients(backend, gpu):
    """One view twice, one not at all."""
    setup = Setup("oversampled and blurred", "one", gpu if backend == "cuda" else None)
    found, true = (setup.gradients(b, [2, 0, 2]) for b in (backend, "reference"))
    assert error(found, true) < TOLERANCE
    assert float(found["distance"][1]) == float(found["psf"][1]) == 0


@pytest.mark.parametrize("backend", ["cpu", "cuda", "reference"])
@pytest.mark.parametrize("name", ["distance", "psf", "lines"])
def test_one_unknown_alone_gets_the_same_gradient(name, backend, gpu):
    setup = Setup("blurred", "one", gpu if backend == "cuda" else None)
    leaf = setup.unknowns[name].clone().requires_grad_()
    setup.score(backend, {**setup.unknowns, name: leaf}).backward()
    assert leaf.grad is not None
    assert torch.allclose(leaf.grad, setup.gradients(backend)[name], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_width_of_zero_has_no_gradient_and_a_small_one_a_proportional_one(backend):
    """Frames depend on σ²: the slope at σ is twice that at σ/2 for small widths."""
    setup = Setup("blurred", "one")
    setup.weights = setup.weights[[0, 0, 0]]
    setup.unknowns = {name: value[[0, 0, 0]] for name, value in setup.unknowns.items()}
    setup.unknowns["psf"] = torch.tensor([0.0, 0.02, 0.04], dtype=DOUBLE)
    slope = setup.gradients(backend)["psf"]
    assert float(slope[0]) == 0
    assert float(slope[2] / slope[1]) == pytest.approx(2, rel=0.02)


@pytest.mark.parametrize(
    ("asked", "transforms"), [((), 2), (("distance",), 3), (("psf",), 3), (("distance", "psf"), 4)]
)
def test_a_gradient_costs_one_transform_and_none_where_it_is_not_asked_for(asked, transforms, monkeypatch):
    setup, done, forward = Setup("blurred", "one"), [], cpu._forward
    monkeypatch.setattr(cpu, "_forward", lambda wave: done.append(1) or forward(wave))
    leaves = {n: v.clone().requires_grad_(n in asked or n == "lines") for n, v in setup.unknowns.items()}
    setup.score("cpu", leaves).backward()
    assert len(done) == 2 + transforms  # two transforms, of wave and contrast, in the frames themselves


def test_tensors_make_the_path_that_arrays_make():
    setup = Setup("oversampled and blurred", "one")
    corner = tuple(m * setup.factor for m in setup.margin)
    z, sigma = UNIT * setup.unknowns["distance"], setup.factor * setup.unknowns["psf"]
    common = (setup.raster, PITCH / setup.factor, ENERGY)
    fixed = optical_path(*common, z.numpy(), sigma.numpy(), (setup.frame, corner, setup.factor))
    other = optical_path(*common, 2 * z.numpy(), np.zeros(3), (setup.frame, corner, setup.factor))
    for path in (
        setup.path(setup.unknowns["distance"], setup.unknowns["psf"], torch.float32),
        other.corrected(z, sigma),
    ):
        assert all(torch.equal(a, b) for a, b in zip(path._arrays, fixed._arrays))
        assert (path.alike, path.shape, path.margin, path.factor) == (False, fixed.shape, fixed.margin, fixed.factor)


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("backend", ["cpu", "cuda", "reference"])
@pytest.mark.parametrize("channels", [1, 2])
def test_views_of_unequal_energies_are_those_of_single_ones(channels, backend, single, gpu):
    """Frames and gradients, bit for bit; `single`: one view with a table of its own."""
    on = gpu if backend == "cuda" else torch.device("cpu")
    energies, z, sigma = np.array([17.0, 20.0, 24.5]), UNIT * np.array([1.3, 2.0, 4.0]), np.array([0.4, 0.9, 1.5])
    frame, raster = (*SMALL, 1), (5, 9)
    k = [wavenumber(energy) * np.array([[6e-12, 3e-13], [1e-12, 9e-13]][:channels]) for energy in energies]
    draw = torch.Generator().manual_seed(3)
    lines = torch.randn(3, channels, *raster, generator=draw).to(on)
    weights = torch.randn(3, *SMALL[0], generator=draw).to(on)

    def taken(at: slice, energy: float | np.ndarray, refraction: np.ndarray) -> list[Tensor]:
        leaf = lines[at].clone().requires_grad_()
        path = optical_path(raster, PITCH, energy, z[at], sigma[at], frame).to(on)
        frames = hologram(leaf, refraction, path, backend)
        return [frames.detach(), torch.autograd.grad(frames, leaf, weights[at])[0]]

    views = [slice(v, v + 1) for v in range(3)]
    one_by_one = [taken(at, energies[at][0], k[at.start][None] if single else k[at.start]) for at in views]
    for found, wanted in zip(taken(slice(0, 3), energies, np.stack(k)), zip(*one_by_one)):
        assert torch.allclose(found, torch.cat(wanted), rtol=1e-6, atol=1e-6)
        assert backend == "reference" or torch.equal(found, torch.cat(wanted))


def test_an_instrument_takes_energies_per_exposure():
    """As instruments of one energy each, at distances of fringes that reach equally far; equal ones change nothing."""
    views, energies = Views.evenly_spaced(3, (9, 14), PITCH), np.array([17.0, 20.0, 24.5])
    z = UNIT * np.array([2.3, 2.35, 2.4]) * energies / ENERGY
    beams = Exposures(views, energies, z, np.full(3, 0.7), np.zeros(3), reference_kev=ENERGY)
    of_beams, draw = Instrument(beams), torch.Generator().manual_seed(3)
    D = 1e-9 * torch.rand(3, *of_beams.views.shape, generator=draw)
    B, found = 1e-3 * D, of_beams.image(1e-3 * D, D)
    assert torch.allclose(of_beams.image(B[[2, 0]], D[[2, 0]], np.array([2, 0])), found[[2, 0]], atol=1e-6)
    for v in range(3):
        alone = Instrument(beams[[v]]).image(B[[v]], D[[v]])
        assert torch.allclose(alone[0], found[v], atol=1e-6)
        as_at_reference = Instrument(replace(beams[[v]], reference_kev=float(energies[v]))).image(B[[v]], D[[v]])
        assert (v == 1) == torch.allclose(as_at_reference, alone, atol=1e-4)


@pytest.mark.parametrize("per_channel", [False, True])
def test_an_instrument_disperses_each_channel(per_channel):
    """Frames with factors of δ and β are those of the matter scaled by them; `per_channel`: unlike factors."""
    views, z = Views.evenly_spaced(2, (9, 14), PITCH), UNIT * np.array([2.3, 2.35])
    taken = Exposures(views, np.full(2, ENERGY), z, np.full(2, 0.7), np.zeros(2))
    factors = np.array([[[1.0, 1.0], [1.0, 1.0]], [[0.7, 0.4], [1.3, 1.9]]])[:, : 1 + per_channel]
    found, plain = (Instrument(taken, dispersion=given) for given in (factors, None))
    channels = 1e-9 * torch.rand(2, 2, *plain.views.shape, generator=torch.Generator().manual_seed(3))
    materials = ((1.0, 1e-3), (0.4, 2e-2))
    frames = found.frames(LineIntegrals(channels, materials))
    for v in range(2):
        scaled = tuple((d * f, b * g) for (d, b), (f, g) in zip(materials, np.broadcast_to(factors[v], (2, 2))))
        wanted = plain.frames(LineIntegrals(channels[[v]], scaled), np.array([v]))
        assert torch.allclose(frames[v], wanted[0], atol=1e-6)
    assert float((frames[1] - plain.frames(LineIntegrals(channels, materials))[1]).abs().max()) > 1e-3


def test_nothing_waits_for_the_device(gpu):
    setup = Setup("oversampled and blurred", "two", gpu)
    leaves = {
        n: v.to(gpu, v.dtype if n != "lines" else torch.float32).requires_grad_() for n, v in setup.unknowns.items()
    }
    table = torch.tensor([setup.matter] * 3, dtype=DOUBLE, device=gpu)
    planned, index = setup.path(leaves["distance"].detach(), None, torch.float32), torch.tensor([2, 0, 1], device=gpu)
    with Watch():
        path = planned[index].corrected(UNIT * leaves["distance"][index], setup.factor * leaves["psf"][index])
        hologram(leaves["lines"], table[index], path, "cuda").sum().backward()
    assert all(leaf.grad is not None for leaf in leaves.values())


def test_bad_input_is_named():
    setup = Setup("plain", "one")
    path, lines = setup.path(setup.unknowns["distance"], None, torch.float32), setup.unknowns["lines"].float()
    with pytest.raises(InputError, match="distance must be a float64 tensor with one number for each of the path's 3"):
        path.corrected(torch.ones(2, dtype=DOUBLE))
    with pytest.raises(InputError, match="psf_sigma must be a float64 tensor"):
        path.corrected(psf_sigma=torch.ones(3))
    with pytest.raises(InputError, match=r"refraction must have the shape .* but it has \(2, 1, 2\)"):
        hologram(lines, np.ones((2, 1, 2)), path, "cpu")
    with pytest.raises(InputError, match="refraction has no gradient"):
        hologram(lines, torch.ones(3, 1, 2, requires_grad=True), path, "cpu")
    with pytest.raises(InputError, match=r"one for each of 3 distances, but it has the shape \(2,\)"):
        optical_path((9, 13), PITCH, np.ones(2), np.ones(3), np.zeros(3), ((4, 7), (2, 3), 1))
    with pytest.raises(InputError, match="energy_kev must hold positive numbers"):
        optical_path((9, 13), PITCH, np.array([20.0, -1.0]), np.ones(2), np.zeros(2), ((4, 7), (2, 3), 1))
