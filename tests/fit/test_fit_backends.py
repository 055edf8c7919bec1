"""One fit, every backend: the same cloud comes out, nothing waits for a device, and a plain fit needs no kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from helpers.kernels import few_programs
from holosplat import native
from holosplat.checks import InputError, MissingError
from holosplat.fit.density import DensityControl
from holosplat.fit.loop import Fit
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Views
from holosplat.matter import Matter
from holosplat.methods import FitOptions, GaussianRates, gaussian_fit
from holosplat.model import measure
from holosplat.representations import GaussianCloud, random_cloud
from holosplat.scan import Exposures, Scan

PIXEL, SHAPE, COUNT = 2e-6, (11, 13), 6
EVERYTHING = Objective(
    l1=0.7, l2_amplitude=0.1, ssim=0.2, tv_image=0.01, frc=0.1, anisotropy=0.1, tv_volume=0.05, overfull=1.0
)
SCHEDULE = Schedule(steps=2, views_per_step=2, volume_edge=6, oversample=1)
RATES = GaussianRates(0.01, 0.01, 0.01, 0.02)


def a_cloud(channels: int = 1, seed: int = 0) -> GaussianCloud:
    """Turned ellipsoids: the gradients of round Gaussians' rotations are rounding errors, which Adam would follow."""
    matter = Matter.one(7e-7, 2.6e-10) if channels == 1 else Matter.free(7e-7, 2.6e-10)
    cloud = random_cloud(COUNT, Views.evenly_spaced(1, SHAPE, PIXEL), matter, 6e-6, seed)
    generator = torch.Generator().manual_seed(seed)
    cloud.log_scales += 0.5 * torch.randn(COUNT, 3, generator=generator)
    cloud.quaternions += torch.randn(COUNT, 4, generator=generator)
    return cloud


def a_scan(channels: int = 1) -> Scan:
    """Frames of another cloud, in three views, none held out."""
    exposures = Exposures.of(Views.evenly_spaced(3, SHAPE, PIXEL), 20.0, 0.05, 0.4)
    with torch.no_grad():
        frames = measure(a_cloud(channels, seed=1), exposures).numpy()
    return Scan(frames, exposures, np.zeros(3, dtype=bool), {})


def a_fit(backend: str, channels: int = 1, objective: Objective = EVERYTHING, rates=RATES, **schedule: float) -> Fit:
    how = replace(SCHEDULE, **schedule)  # type: ignore[arg-type]
    options = FitOptions(objective, how, rates, backend=backend)  # type: ignore[arg-type]
    return gaussian_fit(a_scan(channels), a_cloud(channels), options)


def run(fit: Fit) -> tuple[list[dict[str, float]], list[Tensor]]:
    """Every record, and the parameters at the end, in main memory."""
    records: list[dict[str, float]] = []
    fit.run(records.append)
    return records, [parameter.cpu() for parameter in fit.result().parameters().values()]


class Waits(TorchDispatchMode):
    """Lists the operations that would wait for a device: values that come to the host, shapes that depend on them."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.seen: list[str] = []

    def watched(self, act: Callable[[], Tensor]) -> Tensor:
        """Act, and add to `seen` what waited meanwhile."""
        self.found = []
        result = act()
        self.seen += self.found
        return result

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
        name = function.name().removeprefix("aten::").split(".")[0]
        if name in ("_local_scalar_dense", "nonzero", "masked_select", "_unique2", "equal", "is_nonzero"):
            self.found.append(name)
        if name == "index" and any(a is not None and a.dtype == torch.bool for a in arguments[1]):
            self.found.append("index by a mask")
        return function(*arguments, **(keywords or {}))


def assert_alike(found: tuple, wanted: tuple) -> None:
    """The records agree, and so do nearly all parameters."""
    for record, other in zip(found[0], wanted[0], strict=True):
        assert record.keys() == other.keys()
        same = {name: value for name, value in other.items() if name != "seconds"}
        assert {name: record[name] for name in same} == pytest.approx(same, rel=2e-3, abs=1e-6)
    for parameter, other in zip(found[1], wanted[1]):
        # Adam's first steps have the size of the rates whatever the gradient: only tiny gradients may differ in sign.
        assert float(((parameter - other).abs() < 1e-3).float().mean()) > 0.98


@pytest.mark.parametrize("channels", [1, 2])
def test_the_compiled_fit_is_the_plain_one(channels):
    objective = replace(EVERYTHING, overfull=EVERYTHING.overfull if channels == 1 else 0.0)
    assert_alike(*(run(a_fit(backend, channels, objective, steps=6)) for backend in ("cpu", "reference")))


def test_the_gpus_fit_is_the_plain_one_and_waits_for_nothing(gpu, monkeypatch):
    """Every term in use; nothing in a step may look at the device's values, or a CUDA graph could not hold it."""
    few_programs(monkeypatch, gpu, 8)
    with Waits() as waits:
        fit = a_fit("cuda", detach_worst=True)
        work, fit._work = fit._work, lambda draw: waits.watched(lambda: work(draw))
        fit._capture = None  # on a GPU, too, the steps themselves are looked at
        found = run(fit)
    assert waits.seen == []
    assert_alike(found, run(a_fit("reference", detach_worst=True)))


def test_the_check_for_waiting_would_see_it():
    values = torch.arange(4.0)
    with Waits() as waits:
        float(values.sum())
        values[values > 1]
    assert waits.found == ["_local_scalar_dense", "index by a mask"]


def test_a_plain_fit_needs_no_kernels(monkeypatch):
    def absent(*arguments: object) -> None:
        raise MissingError("no kernels here")

    scan = a_scan()
    monkeypatch.setattr(native, "call", absent)
    options = FitOptions(EVERYTHING, SCHEDULE, RATES, DensityControl(every=2, start=0, stop=1), backend="reference")
    fit = gaussian_fit(scan, a_cloud(), options)
    fit.run(lambda record: None)
    assert fit.finished
    with pytest.raises(MissingError, match="no kernels"):
        gaussian_fit(scan, a_cloud(), replace(options, backend="cpu"))


@pytest.mark.parametrize("looks", [{}, {"validation_views": 1, "validate_every": 1}], ids=["", "validated"])
def test_a_diverging_fit_stops_with_a_sentence(looks):
    """And its sound steps were handed out."""
    fit, records = a_fit("cpu", rates=replace(RATES, log_scales=1e6), steps=6, **looks), []
    with pytest.raises(InputError, match=r"diverged at step [1-6].*lower the rates"):
        fit.run(records.append)
    assert len(records) == fit.step - 1


def test_an_unknown_backend_is_refused():
    with pytest.raises(InputError, match="backend must be one of auto, cpu, cuda, reference"):
        a_fit("tpu")


@pytest.mark.gpu
def test_captured_steps_are_the_eager_ones(gpu):
    captured, eager = a_fit("cuda", steps=20), a_fit("cuda", steps=20)
    eager._capture = None
    found, cloud = run(captured)
    wanted, exact = run(eager)
    assert captured._capture._graphs  # it did capture
    assert [r["loss"] for r in found] == pytest.approx([r["loss"] for r in wanted], rel=1e-3)
    for parameter, other in zip(cloud, exact):
        assert float((parameter - other).abs().mean()) < 1e-3
