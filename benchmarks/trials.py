"""What was tried and left out of the fit: each on tuning scenes, beside the fit as it is.

    python benchmarks/trials.py --csv docs/data/trials.csv           # half an hour on two cores
    python benchmarks/trials.py --cases foam12 --seeds 13 --trials "as it is" "relocation"

Seeds are below 100, which the table of the suite does not have. All trials of a scene share its start. Prints a
Markdown table: SSIM / FRCM of noise-free held-out frames, Dice / relative error of δ, and the fit's own seconds.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rows import write

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit
from second_order import cloud_of, gauss_newton, planned, quasi_newton
from torch import Tensor
from torch.nn.functional import softplus

import holosplat as hs
from holosplat.fit.density import _pair
from holosplat.fit.fidelity import Target
from holosplat.fit.loop import Fit, Plan, Record
from holosplat.fit.optimiser import Leaves, Optimiser, Trainable
from holosplat.fit.problem import Batch, Problem
from holosplat.fit.terms import FrameTerm, Objective
from holosplat.fit.terms.frames import NarrowingBlur, Weighted, linear_response
from holosplat.methods import FitOptions, Task, finished, gaussian_fit
from holosplat.methods.gaussians import GaussianStage, resolved
from holosplat.model import Model
from holosplat.optics.noise import sure_noise
from holosplat.representations.gaussians import GaussianCloud
from holosplat.workflows.evaluate import score_object
from holosplat_bench.suite.case import load_case

CASES, SEEDS = ["cells8", "noise12-2000", "thesis16", "foam12"], [12]
"""Narrow fringes, noise, coarse pixels, much surface."""
FLOOR = 0.1
"""Of the response, in frames weighted by its inverse; as in the fit of voxels."""


class Averaging:
    """An optimiser whose best parameters are the mean of those after its first `skipped` steps."""

    def __init__(self, inner: Optimiser, leaves: Leaves, skipped: int) -> None:
        self._inner, self._leaves, self._skipped, self._count = inner, leaves, skipped, 0
        self._sums = {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}

    def prepare(self, rates: Mapping[str, float]) -> None:
        """See `Optimiser`."""
        self._inner.prepare(rates)

    def apply(self, loss: Tensor) -> None:
        """See `Optimiser`."""
        self._inner.apply(loss)
        self._count += 1
        if self._count > self._skipped:
            for name, leaf in self._leaves.items():
                self._sums[name] += leaf.detach()

    @property
    def settled(self) -> bool:
        """See `Optimiser`."""
        return self._inner.settled

    def best(self) -> Leaves | None:
        """The mean."""
        added = self._count - self._skipped
        return {name: total / added for name, total in self._sums.items()} if added > 0 else None

    def resize(self, names: list[str], keep: Tensor, added: Mapping[str, Tensor]) -> None:
        """See `Optimiser`."""
        raise NotImplementedError("a mean needs the same Gaussians in all steps")

    def state_dict(self) -> dict[str, Any]:
        """See `Optimiser`."""
        return {"inner": self._inner.state_dict(), "count": self._count, "sums": self._sums}

    def load(self, state: dict[str, Any]) -> None:
        """See `Optimiser`."""
        self._inner.load(state["inner"])
        self._count, self._sums = state["count"], state["sums"]


def averaged(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Fit:
    """The mean of the parameters over the last third, with rates that fall threefold only."""
    plan = planned(scan, cloud, replace(options, schedule=replace(options.schedule, decay=0.3)))
    skipped = options.schedule.steps * 2 // 3
    return Fit(replace(plan, optimiser=lambda leaves: Averaging(plan.optimiser(leaves), leaves, skipped)))


class Thinned(GaussianCloud):
    """A cloud whose amplitudes are multiplied by `mask` [N, 1]."""

    mask: Tensor

    @property
    def amplitudes(self) -> Tensor:
        """Peak values [N, C]."""
        return softplus(self.raw_amplitudes) * self.mask


@dataclass(frozen=True)
class ThinnedProblem(Problem):
    """A problem in which a `share` of the Gaussians is left out of every step of the first four fifths."""

    share: float = 0.0
    generator: torch.Generator | None = None

    def loss(self, model: Model, batch: Batch) -> tuple[Tensor, Tensor, list[str]]:
        """See `Problem`; the Gaussians that are left are enhanced for the others."""
        if batch.progress >= 0.8:
            return super().loss(model, batch)
        whole = cloud_of(model)
        thinned = Thinned(whole.parameters().values(), whole.unit_length, whole.matter)
        kept = torch.rand(len(whole), 1, generator=self.generator) >= self.share
        thinned.backend, thinned.mask = whole.backend, kept / (1 - self.share)
        return super().loss(replace(model, object=thinned), batch)


def dropout(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions, share: float) -> Fit:
    """A share of the Gaussians left out of every step of the first four fifths, the others enhanced for it."""
    plan = planned(scan, cloud, options)
    p, generator = plan.problem, torch.Generator().manual_seed(1)
    return Fit(replace(plan, problem=ThinnedProblem(p.model, p.terms, p.free, share, generator)))


class FilteredFrames(FrameTerm):
    """The data term of frames after a filter, which takes frames [V, H, W] and the share of the fit that is done."""

    def __init__(
        self, scan: hs.Scan, model: Model, objective: Objective, keep: Callable[[Tensor, Tensor], Tensor]
    ) -> None:
        super().__init__(scan, model.instrument, objective, cloud_of(model).matter)
        self.measured, self.keep = torch.from_numpy(scan.frames), keep

    def compared(self, predicted: Tensor, batch: Batch) -> dict[str, Weighted]:
        """See `FrameTerm`."""
        self._target = Target(self.keep(self.measured, batch.progress), self.low, self.span, "cpu")
        return super().compared(self.keep(predicted, batch.progress), batch)


def with_frames(plan: Plan, term: FrameTerm) -> Fit:
    """A fit by another data term."""
    return Fit(replace(plan, problem=replace(plan.problem, terms=(term, *plan.problem.terms[1:]))))


def weighted(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Fit:
    """Frames divided by the linear response of a view, above a floor that grows with noise: large shapes count more.

    The weight of the term is such that at the start its gradient in the amplitudes is as long as that of plain frames.
    """
    plan, train = planned(scan, cloud, options), scan.train()
    model = plan.problem.model
    noise = float(sure_noise(torch.from_numpy(train.frames)).mean() / float(np.ptp(train.frames)))
    response = linear_response(train.exposures, cloud.matter.beta / cloud.matter.delta)
    relative = (1 / (response**2 + (FLOOR + 5 * noise) ** 2).sqrt()).float()
    weight = torch.ones_like(relative)
    term = FilteredFrames(train, model, options.objective, lambda frames, progress: filtered(frames, weight))
    plain = pull(term, model)
    weight = relative  # which `term` looks up anew
    weight = relative * (plain / pull(term, model))
    return with_frames(plan, term)


def pull(term: FrameTerm, model: Model) -> float:
    """Length of the gradient of the data term in the amplitudes."""
    amplitudes = cloud_of(model).raw_amplitudes.detach().requires_grad_()
    model = model.with_parameters({"object.raw_amplitudes": amplitudes})
    part = term(model, Batch(None, torch.zeros(3, dtype=torch.float64), torch.tensor(0.0), 0))[0]
    return float(torch.autograd.grad(part.value, amplitudes)[0].norm())


class Relocation:
    """Every 25 steps, from 10 to 60 % of them, the 3 % of Gaussians of least mass go to where the objective pulls most.

    There they take half of a Gaussian (as in MCMC splatting, Kheradmand et al. 2024, without its noise). `by`: gradient
    that says where: `centres`, or `density` (of the amplitudes, over the volume of the Gaussian).
    """

    def __init__(self, count: int, by: str) -> None:
        self._by, self._pull = by, torch.zeros(count)

    def on_gradients(self, leaves: Leaves) -> None:
        """Take in the gradients of one step."""
        gradient = leaves["object.centres" if self._by == "centres" else "object.raw_amplitudes"].grad
        assert gradient is not None
        size = gradient.norm(dim=1)
        volume = leaves["object.log_scales"].detach().exp().prod(dim=1)
        self._pull += size if self._by == "centres" else size / volume

    def after_step(self, trainable: Trainable, step: int, steps: int, generator: torch.Generator) -> bool:
        """Relocate, where it is due."""
        if not 0.1 * steps <= step <= 0.6 * steps or step % 25:
            return False
        cloud = cloud_of(trainable.model)
        count = max(1, round(0.03 * len(cloud)))
        lost = torch.topk(cloud.masses().detach().sum(dim=1), count, largest=False).indices
        self._pull[lost] = 0
        chosen = torch.topk(self._pull, count).indices
        keep = torch.ones(len(cloud), dtype=torch.bool)
        keep[lost] = keep[chosen] = False
        trainable.resize("object", torch.nonzero(keep)[:, 0], _pair(cloud, chosen, generator, shrink=1.26))
        self._pull = torch.zeros(len(cloud))
        return True

    def columns(self, model: Model) -> Record:
        """None."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """What was taken in since the last time."""
        return {"pull": self._pull}

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        self._pull = state["pull"]


def relocating(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions, by: str) -> Fit:
    """Gaussians of little mass go to where the objective pulls most."""
    plan = planned(scan, cloud, options)
    return Fit(replace(plan, events=(*plan.events, Relocation(len(cloud), by))))


def filtered(frames: Tensor, transfer: Tensor) -> Tensor:
    """Frames [V, H, W] after a filter of their mean-free part."""
    spectra = torch.fft.rfft2(frames - 1) * transfer
    return torch.fft.irfft2(spectra, s=(frames.shape[1], frames.shape[2])) + 1


def blurred(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions, sigma: float) -> Fit:
    """Frames compared coarse to fine from `sigma` pixels on, whether there is noise or not."""
    plan, train = planned(scan, cloud, options), scan.train()
    blur = NarrowingBlur(train.frames.shape[1:], sigma, torch.device("cpu"))
    return with_frames(plan, FilteredFrames(train, plan.problem.model, replace(options.objective, coarse=0.0), blur))


def judged(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Fit:
    """Two training views set aside, looked at every 25 steps, to choose the best state."""
    return gaussian_fit(scan, cloud, replace(options, schedule=replace(options.schedule, validation_views=2)))


def densified(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Fit:
    """Density control as splatting has it: 5 % cloned or split every 50 steps, by the gradient of positions."""
    control = replace(options.density, every=50, start=0.1, stop=0.6)
    return gaussian_fit(scan, cloud, replace(options, density=control))


TRIALS: dict[str, Callable[[hs.Scan, GaussianCloud, FitOptions], Fit]] = {
    "as it is": gaussian_fit,
    "mean of the late iterates": averaged,
    "dropout of a tenth": partial(dropout, share=0.1),
    "dropout of three tenths": partial(dropout, share=0.3),
    "blurred by 1 px at first": partial(blurred, sigma=1.0),
    "blurred by 2 px at first": partial(blurred, sigma=2.0),
    "weighted by the response": weighted,
    "Gauss–Newton for the amplitudes": gauss_newton,
    "L-BFGS": quasi_newton,
    "growth by gradient": densified,
    "relocation": partial(relocating, by="centres"),
    "relocation by density": partial(relocating, by="density"),
    "best by validation views": judged,
}


def main() -> None:
    """Run all trials on all scenes; print and write their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=CASES)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--trials", nargs="+", choices=TRIALS, default=list(TRIALS))
    parser.add_argument("--snapshots", type=Path)
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    settings = hs.preset("default")
    print("| case | seed | trial | SSIM / FRCM | Dice / error | fit [s] |\n| --- | --- | --- | --- | --- | --- |")
    for name in options.cases:
        for seed in options.seeds:
            case = load_case(name, seed, options.snapshots)
            scan, truth = case.scan(), case.truth()
            start = GaussianStage(settings).start(Task(scan.train(), case.prior), None)
            fit_options = resolved(settings.fit, case.prior, start.matter)
            for trial in options.trials:
                began = time.perf_counter()
                fit = TRIALS[trial](scan, start, fit_options)
                fit.run(lambda record: None)
                seconds = time.perf_counter() - began
                found = score_object(finished(fit), scan, truth, fit.model.instrument.oversample).headline()
                rows.append(
                    {"case": name, "seed": seed, "trial": trial, "commit": commit(), "seconds": seconds, **found}
                )
                images, volume = (
                    " / ".join(f"{found[key]:.3f}" for key in keys)
                    for keys in (("ssim", "frcm"), ("dice", "relative_error_delta"))
                )
                print(f"| {name} | {seed} | {trial} | {images} | {volume} | {seconds:.0f} |", flush=True)
    if options.csv:
        write(rows, options.csv)


if __name__ == "__main__":
    main()
