"""`Model`: frames of several times at once, where beams really are, uneven light, and the gradients of all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.bumpy import bumpy, surfaces
from helpers.voxels import twin
from holosplat.beamline.misalignment import Misalignment
from holosplat.checks import InputError
from holosplat.geometry import Grid, Poses, Views, rotation_y
from holosplat.matter import Matter
from holosplat.model import Alignment, Instrument, LightField, Model, measure, smooth_modes
from holosplat.model.alignment import WIDTHS
from holosplat.representations import GaussianCloud, VoxelGrid
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures
from holosplat.volume import LineIntegrals, TrainableObject

PIXEL, SHAPE = 1e-6, (23, 31)
MATTER = Matter.one(7e-7, 2.5e-10)
TOLERANCE = 1e-4
"""Of gradients in float32, relative to the largest of their kind."""


def planned(shape: tuple[int, int] = SHAPE) -> Exposures:
    """Four views without a common axis, each with a shift, a distance and a blur of its own, at three times."""
    rotations = np.concatenate([rotation_y([10, 50]), Rotation.random(2, rng=1).as_matrix()])
    shifts = PIXEL * np.array([[0, 0], [0.7, -0.4], [-1.2, 0.3], [0.1, 0.9]])
    taken = Exposures.of(Views(rotations, shifts, shape, PIXEL), 20.0, 0.05, 0.4)
    distance, blur = np.array([0.03, 0.05, 0.04, 0.06]), np.array([0.4, 0.9, 0.6, 0.5])
    return replace(taken, distance=distance, psf_sigma_px=blur)


def a_cloud(backend: str = "cpu") -> GaussianCloud:
    r = torch.Generator().manual_seed(0)
    centres, scales = 9 * (torch.rand(9, 3, generator=r) - 0.5), 0.9 + torch.rand(9, 3, generator=r)
    parameters = [centres, scales.log(), torch.randn(9, 4, generator=r), raw_of(0.2 + torch.rand(9, 1, generator=r))]
    dtype = torch.float64 if backend == "reference" else torch.float32
    return GaussianCloud([p.to(dtype) for p in parameters], PIXEL, MATTER).on(backend)


# --- several times ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drift:
    """A cloud that moves [pixels a second]; with fitted parameters or without (`still` knows nothing of them)."""

    cloud: GaussianCloud
    velocity: tuple[float, float, float] = (1.5, -0.7, 0.4)
    asked: ClassVar[list[float]] = []

    def at(self, time: float) -> GaussianCloud:
        self.asked.append(time)
        return self.cloud.with_parameters({"centres": self.cloud.centres + time * torch.tensor(self.velocity)})


class Plain:
    """A cloud that takes views only, as objects do that are not fitted."""

    def __init__(self, drift: Drift, time: float | None = None) -> None:
        self.drift, self.time = drift, time

    def at(self, time: float) -> Plain:
        return Plain(self.drift, time)

    def project(self, views: Views) -> LineIntegrals:
        assert isinstance(views, Views)
        return self.drift.at(self.time).project(views)


def at_times() -> Exposures:
    return replace(planned(), time=np.array([0.5, 2.0, 0.0, 2.0]))


@pytest.mark.parametrize("kind", [lambda drift: drift, Plain], ids=["trainable", "plain"])
@pytest.mark.parametrize("index", [None, [0, 1, 2, 3], [3, 0, 1], [1, 1, 2, 0, 3], [2]])
def test_several_times_in_a_batch_are_each_time_alone(index, kind):
    """In any order, and more than once."""
    taken, obj = at_times(), kind(Drift(a_cloud("reference")))
    chosen = None if index is None else torch.tensor(index)
    with torch.no_grad():
        found = Model(obj, Instrument(taken, 1, torch.float64)).frames(chosen)
        alone = torch.cat([measure(obj, taken[[i]], 1, torch.float64) for i in range(4)])
    torch.testing.assert_close(found, alone[list(range(4)) if index is None else index], rtol=0, atol=2e-6)
    assert (alone[1] - alone[3]).abs().max() > 1e-2
    assert (alone[0] - measure(obj, replace(taken, time=np.zeros(4))[[0]], 1, torch.float64)[0]).abs().max() > 1e-2


def test_matter_is_looked_at_once_a_time_and_later_by_the_delay():
    drift = Drift(a_cloud())
    model = Model(drift, Instrument(at_times()))
    Drift.asked.clear()
    later = model.frames(torch.tensor([3, 1, 0]), delay=0.25)
    assert sorted(Drift.asked) == [0.75, 2.25]
    delayed = replace(at_times(), time=at_times().time + 0.25)
    torch.testing.assert_close(later, Model(drift, Instrument(delayed)).frames(torch.tensor([3, 1, 0])))


# --- where beams are ----------------------------------------------------------------------------------------


def correction(nominal: Exposures, true: Exposures) -> Alignment:
    """What leads from `nominal` to `true`."""
    turns = Rotation.from_matrix(true.views.rotations @ nominal.views.rotations.transpose(0, 2, 1)).as_rotvec()
    shifts = (true.views.shifts - nominal.views.shifts) / nominal.views.pixel_size
    stretches, blurs = true.distance / nominal.distance - 1, true.psf_sigma_px - nominal.psf_sigma_px
    return Alignment(*(torch.from_numpy(a) for a in (turns, shifts, stretches, blurs)))


def misaligned() -> tuple[Exposures, Exposures, Alignment]:
    """Plan, truth, and what leads from one to the other."""
    nominal = planned()
    true = Misalignment(shift_px=0.8, rotation_deg=2.0, distance=0.05, seed=4).true_exposures(nominal)
    true = replace(true, psf_sigma_px=nominal.psf_sigma_px + np.array([0.3, -0.2, 0.1, 0.4]))
    return nominal, true, correction(nominal, true)


@pytest.mark.parametrize("oversample", [1, 2])
def test_an_aligned_model_gives_the_frames_of_the_true_exposures(oversample):
    """Of rectangular, odd frames; any correction by the wrong sign is far off."""
    nominal, true, alignment = misaligned()
    cloud = a_cloud("reference")
    instrument = Instrument(nominal, oversample, torch.float64)
    with torch.no_grad():
        wanted = Model(cloud, Instrument(true, oversample, torch.float64)).frames()
        found = Model(cloud, instrument, alignment).frames()
        assert (found - wanted).abs().max() < 2e-5  # the rasters' margins differ a little with the distances
        for name, values in alignment.parameters().items():
            wrong = alignment.with_parameters({name: -values})
            assert (Model(cloud, instrument, wrong).frames() - wanted).abs().max() > 2e-3, name
        picked = torch.tensor([3, 0, 3])
        torch.testing.assert_close(Model(cloud, instrument, alignment).frames(picked), found[picked], rtol=0, atol=1e-9)


def test_corrected_exposures_are_the_true_ones():
    nominal, true, alignment = misaligned()
    found = alignment.exposures(nominal)
    for name in ("distance", "psf_sigma_px"):
        np.testing.assert_allclose(getattr(found, name), getattr(true, name), rtol=1e-12)
    np.testing.assert_allclose(found.views.rotations, true.views.rotations, atol=1e-12)
    np.testing.assert_allclose(found.views.shifts, true.views.shifts, atol=1e-12 * PIXEL)


def test_no_correction_yet_is_the_plan():
    taken, cloud = planned(), a_cloud("reference")
    instrument = Instrument(taken, 1, torch.float64)
    alignment = Alignment.planned(4, "turns", "shifts", "stretches", "blurs")
    light = LightField.even(4, smooth_modes(SHAPE, 2).double())
    with torch.no_grad():
        plain = Model(cloud, instrument).frames()
        torch.testing.assert_close(Model(cloud, instrument, alignment, light).frames(), plain, rtol=0, atol=1e-12)


def test_what_is_not_asked_for_is_not_computed(monkeypatch):
    """Without alignment and light the instrument takes line integrals, of its own poses, and nothing else."""
    instrument, asked, poses = Instrument(planned()), [], []
    frames, project = instrument.frames, GaussianCloud.project
    monkeypatch.setattr(instrument, "frames", lambda *args: (asked.append(args[1:]), frames(*args))[1])
    monkeypatch.setattr(GaussianCloud, "project", lambda self, at: (poses.append(at), project(self, at))[1])
    monkeypatch.setattr(instrument, "_path", None)
    for name in ("poses", "distance", "psf_sigma_px"):
        monkeypatch.setattr(Alignment, name, None)
    monkeypatch.setattr(LightField, "factor", None)
    Model(a_cloud(), instrument).frames()
    assert asked == [(None,)]
    assert poses[0] is instrument.poses
    some = torch.tensor([2, 1])
    Model(a_cloud(), instrument).frames(some)
    assert asked[1][0] is some
    assert len(asked[1]) == 1


def test_a_correction_alone_leaves_the_others_out(monkeypatch):
    """Shifts need no new optics, and blurs no new poses."""
    instrument = Instrument(planned())
    monkeypatch.setattr(instrument, "_path", None)
    Model(a_cloud(), instrument, Alignment.planned(4, "shifts", "turns")).frames()
    blurred = Instrument(planned())
    alignment = Alignment.planned(4, "blurs")
    poses = alignment.poses(blurred.poses, PIXEL)
    assert poses.rotations is blurred.poses.rotations
    assert poses.shifts is blurred.poses.shifts
    assert alignment.distance(planned()) is None


def test_frames_that_need_the_host_are_known():
    """New optics are made there, and times are told apart there: such steps cannot be captured."""
    model = Model(a_cloud(), Instrument(planned()))
    aligned = {name: replace(model, alignment=Alignment.planned(4, name)).capturable for name in WIDTHS}
    assert model.capturable
    assert {name for name, free in aligned.items() if free} == {"turns", "shifts"}
    assert not Model(a_cloud(), Instrument(at_times())).capturable


# --- light --------------------------------------------------------------------------------------------------


def test_modes_are_orthonormal_and_the_first_is_even():
    modes = smooth_modes((13, 18), 2).double()
    assert modes.shape == (9, 13, 18)
    assert torch.equal(modes[0], torch.ones(13, 18).double())
    products = torch.einsum("ihw,jhw->ij", modes, modes) / (13 * 18)
    torch.testing.assert_close(products, torch.eye(9).double(), rtol=0, atol=1e-6)
    with pytest.raises(InputError, match="order of smooth modes must be 0 or more, but it is -1"):
        smooth_modes((5, 5), -1)


def test_light_multiplies_each_frame_by_its_own_factor():
    modes = smooth_modes(SHAPE, 1)
    light = LightField(0.1 * torch.randn(4, 4, generator=torch.Generator().manual_seed(1)), modes)
    model = Model(a_cloud(), Instrument(planned()), light=light)
    plain = replace(model, light=None).frames()
    factor = (light.coefficients @ modes.reshape(4, -1)).exp().reshape(4, *SHAPE)
    torch.testing.assert_close(model.frames(), factor * plain, rtol=1e-6, atol=0)
    index = torch.tensor([2, 0])
    torch.testing.assert_close(model.frames(index), (factor * plain)[index], rtol=1e-5, atol=0)


# --- gradients ----------------------------------------------------------------------------------------------


class Twin(VoxelGrid):
    """Voxels whose line integrals are those of plain torch, in float64."""

    def with_parameters(self, parameters):
        return Twin(parameters.get("values", self.values), self.grid, self.matter)

    def project(self, views: Views | Poses) -> LineIntegrals:
        assert isinstance(views, Poses)
        return LineIntegrals(twin(self.values, self.grid, views, (1, 1, 1)), self.matter.channels)


def voxels(exact: bool) -> VoxelGrid:
    """A smooth blob in cubes of a pixel."""
    grid = Grid.centred((15, 17, 19), PIXEL)
    x, y, z = (torch.from_numpy(axis / PIXEL) for axis in grid.axes())
    values = torch.exp(-((z[:, None, None] - 1) ** 2 + (y[:, None] + 1.5) ** 2 + 0.5 * (x - 1) ** 2) / 12)[None].float()
    return Twin(values.double(), grid, MATTER) if exact else VoxelGrid(values, grid, MATTER)


OBJECTS = {
    "gaussians": lambda exact: a_cloud("reference" if exact else "cpu"),
    "surfaces": lambda exact: surfaces(bumpy(2, 6.0, (1.0, -2.0, 1.5)), unit=PIXEL),
    "voxels": voxels,
}
NAMES = ("alignment.turns", "alignment.shifts", "alignment.stretches", "alignment.blurs", "light.coefficients")


def unknown(obj: TrainableObject, exact: bool) -> Model:
    """The object in exposures that are a little off plan, in uneven light."""
    draw = torch.Generator().manual_seed(7)
    instrument = Instrument(planned(), 1, torch.float64 if exact else torch.float32)
    sizes = {"turns": 0.02, "shifts": 0.4, "stretches": 0.03, "blurs": 0.1}
    plan = Alignment.planned(4, *sizes).parameters()
    alignment = Alignment(**{n: sizes[n] * torch.randn(p.shape, generator=draw).double() for n, p in plan.items()})
    coefficients, modes = 0.05 * torch.randn(4, 4, generator=draw), smooth_modes(SHAPE, 1)
    light = LightField(coefficients.double(), modes.double()) if exact else LightField(coefficients, modes)
    return Model(obj, instrument, alignment, light)


def total(frames: Tensor) -> Tensor:
    weights = torch.randn(frames.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return (frames * weights.to(frames)).sum()


def gradients(model: Model, index: Tensor | None = None) -> dict[str, Tensor]:
    """Of a fixed random sum over the frames."""
    leaves = {name: model.parameters()[name].clone().requires_grad_() for name in NAMES}
    total(model.with_parameters(leaves).frames(index)).backward()
    return {name: leaf.grad.double() for name, leaf in leaves.items() if leaf.grad is not None}


def errors(found: dict[str, Tensor], true: dict[str, Tensor]) -> dict[str, float]:
    return {name: float((found[name] - g).abs().max() / g.abs().max()) for name, g in true.items()}


@pytest.mark.parametrize("kind", OBJECTS)
def test_gradients_of_alignment_and_light_are_those_of_float64(kind):
    """All at once; views picked by index, one twice and one not at all."""
    index = torch.tensor([2, 0, 3, 2])
    found, true = (gradients(unknown(OBJECTS[kind](exact), exact), index) for exact in (False, True))
    assert tuple(true) == NAMES
    worst = errors(found, true)
    assert max(worst.values()) < TOLERANCE, worst
    for name in NAMES:
        assert not found[name][1].any()
        assert all(bool(found[name][v].any()) for v in (0, 2, 3))
        assert errors({name: -found[name]}, {name: true[name]})[name] > 1


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_finite_differences(name):
    """Of Gaussians in float64, every number of the parameter: each sign is seen."""
    model = unknown(a_cloud("reference"), exact=True)
    gradient, values = gradients(model)[name], model.parameters()[name]
    step = 1e-5
    for place in np.ndindex(*values.shape):
        ends = []
        for sign in (1, -1):
            moved = values.clone()
            moved[place] += sign * step
            with torch.no_grad():
                ends.append(float(total(model.with_parameters({name: moved}).frames())))
        wanted = (ends[0] - ends[1]) / (2 * step)
        assert float(gradient[place]) == pytest.approx(wanted, abs=1e-5 * float(gradient.abs().max())), place


# --- names and bad input ------------------------------------------------------------------------------------


def test_parameters_have_the_names_of_their_parts():
    model = unknown(a_cloud(), exact=False)
    assert tuple(model.parameters()) == (*(f"object.{name}" for name in a_cloud().parameters()), *NAMES)
    centres, shifts = torch.zeros(9, 3), torch.ones(4, 2).double()
    other = model.with_parameters({"object.centres": centres, "alignment.shifts": shifts})
    assert other.parameters()["object.centres"] is centres
    assert other.parameters()["alignment.shifts"] is shifts
    kept = set(model.parameters()) - {"object.centres", "alignment.shifts"}
    assert all(other.parameters()[name] is model.parameters()[name] for name in kept)
    assert not model.parameters()["alignment.shifts"].eq(1).any()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Model(a_cloud(), Instrument(planned()), Alignment.planned(3, "shifts")), "alignment .* all its 4"),
        (lambda: Model(a_cloud(), Instrument(planned()), light=even(5)), "light .* all its 4"),
        (
            lambda: Model(a_cloud(), Instrument(planned())).with_parameters({"light.coefficients": EMPTY}),
            "no parameter",
        ),
        (lambda: Alignment(shifts=torch.zeros(4, 3).double()), "needs the shapes"),
        (lambda: Alignment(shifts=torch.zeros(4, 2).double(), blurs=torch.zeros(3).double()), "needs the shapes"),
        (
            lambda: Alignment.planned(4, "tilts"),
            "corrects turns, shifts, stretches, blurs, magnified, energies, bandwidths, but tilts is asked for",
        ),
        (lambda: LightField(torch.zeros(4, 2), torch.zeros(3, 5, 5)), "needs coefficients"),
    ],
)
def test_what_does_not_fit_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


EMPTY = torch.zeros(0)


def even(count: int) -> LightField:
    return LightField.even(count, smooth_modes(SHAPE, 0))
