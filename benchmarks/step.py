"""A whole step of the fit, measured against the same step in eager torch, side by side in one run.

    python benchmarks/step.py --json            # two threads; needs quiet cores to mean anything
    python benchmarks/step.py --backend cuda    # where there is a GPU (no comparison, no memory of the host)

The step: splat, exit wave, Fresnel, intensity, point-spread function, 0.8 L1 + 0.2 (1 - SSIM), backward, Adam, on four
views of two-channel Gaussians with standard deviations of 1 to 4 px (cutoff 4 standard deviations), PSF 0.5 px,
20 keV, 10 cm, 0.5 µm pixels.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from eager_step import EagerStep
from machine import commit, memory_megabytes

import holosplat as hs
from holosplat.backends import device_name, resolve
from holosplat.fit.fidelity import Target, l1_and_ssim
from holosplat.fit.loop import Fit
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Poses
from holosplat.matter import Matter
from holosplat.methods import FitOptions, GaussianRates, gaussian_fit
from holosplat.methods.gaussian_options import Backend
from holosplat.representations.gaussians import raw_of
from holosplat.volume import LineIntegrals
from holosplat.workflows.provenance import environment

SEED, VIEWS, PIXEL = 0, 4, 0.5e-6
SIZES = {"256": (8_000, 256), "512": (30_000, 512), "512_244k": (244_000, 512)}
RATES = (1e-3, 1e-3, 1e-3, 1e-3)


def workload(count: int, size: int) -> tuple[hs.Scan, hs.representations.GaussianCloud]:
    """A cloud that fills the field of view, and frames of the same cloud with other amplitudes."""
    generator = torch.Generator().manual_seed(SEED)
    centres = (torch.rand(count, 3, generator=generator) - 0.5) * size
    log_scales = torch.log(1 + 3 * torch.rand(count, 3, generator=generator))
    quaternions = torch.randn(count, 4, generator=generator)
    share = 4.0 * size**2 / count / 100  # about 1 rad through all of it, whatever the number of Gaussians
    amplitudes = share * (0.2 + torch.rand(count, 2, generator=generator))
    delta = 1.5e-7
    cloud = hs.representations.GaussianCloud(
        (centres, log_scales, quaternions, raw_of(amplitudes)), PIXEL, Matter.free(delta, delta / 1000)
    )
    other = cloud.replaced((centres, log_scales, quaternions, raw_of(amplitudes.flip(0))))
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(VIEWS, (size, size), PIXEL), 20.0, 0.1, 0.5)
    with torch.no_grad():
        frames = hs.model.measure(other.on(resolve("auto")), exposures).cpu().numpy()
    return hs.Scan(frames, exposures, np.zeros(VIEWS, dtype=bool), {}), cloud


def fit_of(scan: hs.Scan, cloud: hs.representations.GaussianCloud, backend: Backend) -> Fit:
    """The project's own loop, with the objective and the rates of this benchmark."""
    schedule = Schedule(steps=10_000, oversample=1, decay=1.0)
    options = FitOptions(Objective(l1=0.8, ssim=0.2), schedule, GaussianRates(*RATES), backend=backend)
    return gaussian_fit(scan, cloud, options)


def steps(fit: Fit, count: int) -> tuple[list[float], float]:
    """Times of `count` steps of one run [ms], and the last loss."""
    stamps, losses = [time.perf_counter()], [0.0]

    def mark(record: dict[str, float]) -> None:
        stamps.append(time.perf_counter())
        losses.append(record["loss"])

    fit.run(mark, until=fit.step + count)
    return (1e3 * np.diff(stamps)).tolist(), losses[-1]


def eager_steps(eager: EagerStep, count: int) -> list[float]:
    """Times of `count` steps in eager torch [ms]."""
    times = []
    for _ in range(count):
        started = time.perf_counter()
        eager.step()
        times.append(1e3 * (time.perf_counter() - started))
    return times


def compare(size: str, rounds: int) -> dict[str, float]:
    """Steps of ours and of eager torch in turns: best and median times [ms], their ratio, and both losses."""
    scan, cloud = workload(*SIZES[size])
    ours, eager = fit_of(scan, cloud, "cpu"), EagerStep(scan, cloud, RATES)
    first = {"loss_ours": steps(ours, 1)[1], "loss_eager": eager.step()}
    fast: list[float] = []
    slow: list[float] = []
    for _ in range(rounds):
        fast += steps(ours, 20)[0]
        slow += eager_steps(eager, 2)
        print(f"{size}: {min(fast):.1f} ms, eager {min(slow):.0f} ms", file=sys.stderr)
    return {
        f"step_ms_{size}": min(fast),
        f"step_ms_{size}_median": float(np.median(fast)),
        f"eager_ms_{size}": min(slow),
        f"step_ratio_{size}": min(slow) / min(fast),
        **{f"{name}_{size}": value for name, value in first.items()},
    }


def on_gpu() -> dict[str, float]:
    """Steps on a GPU [ms], replayed from a captured graph; each batch of steps ends with a look at the values."""
    found = {}
    for size in ("256", "512", "512_244k"):
        fit = fit_of(*workload(*SIZES[size]), "cuda")
        fit.run(lambda record: None, until=40)
        torch.cuda.synchronize()
        started = time.perf_counter()
        fit.run(lambda record: None, until=240)
        torch.cuda.synchronize()
        found[f"step_ms_{size}"] = 1e3 * (time.perf_counter() - started) / 200
    return found


def parts(size: str, repeat: int = 10) -> dict[str, float]:
    """Best times [ms] of the parts of a step, one after the other."""
    scan, cloud = workload(*SIZES[size])
    fit = fit_of(scan, cloud, "cpu")
    cloud, instrument = fit.model.object, fit.model.instrument
    assert isinstance(cloud, hs.representations.GaussianCloud)
    poses, rates = Poses.of(instrument.views), GaussianRates(*RATES).at(1.0, moving=True)
    times: dict[str, list[float]] = {}

    def timed(name: str, act: Callable[..., Any], *arguments: Any) -> Any:
        started = time.perf_counter()
        result = act(*arguments)
        times.setdefault(name, []).append(1e3 * (time.perf_counter() - started))
        return result

    low, span = float(scan.frames.min()), float(np.ptp(scan.frames))
    target = Target(torch.from_numpy(scan.frames), low, span, "cpu")

    def adam(loss: torch.Tensor) -> None:
        fit.trainable.optimiser.prepare(rates)
        fit.trainable.optimiser.apply(loss)

    for _ in range(repeat):
        lines = timed("splat", cloud.project, poses)
        held = LineIntegrals(lines.channels.detach().requires_grad_(), lines.materials)
        frames = timed("optics", instrument.frames, held)
        shown = frames.detach().requires_grad_()
        l1, ssim = timed("l1_ssim", l1_and_ssim, shown, target)
        loss = (0.8 * l1 + 0.2 * ssim).mean()
        timed("l1_ssim_backward", loss.backward)
        timed("optics_backward", frames.backward, shown.grad)
        timed("splat_backward", lines.channels.backward, held.channels.grad)
        timed("adam", adam, loss.detach())
    return {f"part_ms_{size}_{name}": min(values) for name, values in times.items()}


def memory(size: str) -> dict[str, float]:
    """Peak memory of steps [MB] beyond what is there before, gradients and predicted frames; page faults a step."""
    scan, cloud = workload(*SIZES[size])
    fit = fit_of(scan, cloud, "cpu")
    before = memory_megabytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    steps(fit, 1)
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    steps(fit, 20)
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults
    gradients = sum(p.numel() * p.element_size() for p in fit.trainable.leaves.values())
    outputs = (gradients + scan.frames.nbytes) / 1e6
    grown = memory_megabytes("VmHWM") - before - outputs
    return {f"memory_mb_{size}": grown, f"page_faults_{size}": faults / 20}


def in_a_fresh_process(size: str) -> dict[str, float]:
    """`memory`, where nothing else has used memory before."""
    done = subprocess.run([sys.executable, __file__, "--memory", size], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def main() -> None:
    """Read the arguments, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--backend", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--memory", choices=SIZES, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.memory:
        print(json.dumps(memory(options.memory)))
        return
    backend = resolve(options.backend)
    found: dict[str, Any] = {"device": device_name(backend), "seed": SEED, "commit": commit(), **environment(backend)}
    if backend == "cuda":
        found |= on_gpu()
    else:
        for size in ("512", "256"):
            found |= compare(size, options.rounds) | parts(size)
        found["step_ratio"] = found["step_ratio_512"]
        found |= in_a_fresh_process("512_244k")
    if options.json:
        print(json.dumps(found, indent=2))
    else:
        for name, value in found.items():
            print(f"{name:32} {value:.4g}" if isinstance(value, float) else f"{name:32} {value}")


if __name__ == "__main__":
    main()
