"""What was tried and left out of the fit: each on tuning scenes, beside the fit as it is.

    python benchmarks/trials.py --csv docs/data/trials.csv           # half an hour on two cores
    python benchmarks/trials.py --cases foam12 --seeds 13 --trials "as it is" "relocation"

Seeds are below 100, which the table of the suite does not have. All trials of a scene share its start. Prints a
Markdown table: SSIM / FRCM of noise-free held-out frames, Dice / relative error of δ, and the fit's own seconds.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from holosplat.fit.misfit import Draw, NarrowingBlur
from holosplat.fit.waves import linear_response
from holosplat.workflows.start import starting_cloud
from machine import commit
from torch import Tensor
from torch.nn.functional import softplus

import holosplat as hs
from holosplat.bench.case import load_case
from holosplat.fit.density import _pair
from holosplat.fit.fidelity import Target
from holosplat.fit.loop import Fit, FitOptions
from holosplat.geometry import Poses
from holosplat.optics.noise import sure_noise
from holosplat.representations.gaussians import GaussianCloud, raw_of
from holosplat.workflows.evaluate import score_object
from holosplat.workflows.reconstruct import fit_options

CASES, SEEDS = ["cells8", "noise12-2000", "thesis16", "foam12"], [12]
"""Narrow fringes, noise, coarse pixels, much surface."""
FLOOR = 0.1
"""Of the response, in frames weighted by its inverse; as in the fit of voxels."""


class Averaged(Fit):
    """The mean of the parameters over the last third, with rates that fall threefold only."""

    def __init__(self, scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> None:
        super().__init__(scan, cloud, replace(options, schedule=replace(options.schedule, decay=0.3)))
        self._sum, self._from = [torch.zeros_like(p) for p in cloud.parameters], options.schedule.steps * 2 // 3

    def _advance(self) -> None:
        super()._advance()
        if self.step > self._from:
            for total, parameter in zip(self._sum, self.cloud.parameters):
                total += parameter.detach()

    def result(self) -> GaussianCloud:
        """The mean."""
        return self.cloud.replaced([total / (self.step - self._from) for total in self._sum])


class Thinned(GaussianCloud):
    """A cloud whose amplitudes are multiplied by `mask` [N, 1]."""

    mask: Tensor

    @property
    def amplitudes(self) -> Tensor:
        """Peak values [N, C]."""
        return softplus(self.raw_amplitudes) * self.mask


class Dropout(Fit):
    """A share of the Gaussians left out of every step of the first four fifths, the others enhanced for it."""

    def __init__(self, scan: hs.Scan, cloud: GaussianCloud, options: FitOptions, share: float) -> None:
        super().__init__(scan, cloud, options)
        self._share, self._random = share, torch.Generator().manual_seed(1)

    def _work(self, draw: Draw) -> Tensor:
        whole = self.cloud
        if self.step < 0.8 * self.options.schedule.steps:
            thinned = Thinned(whole.parameters, whole.unit_length, whole.delta, whole.beta, whole.second)
            kept = torch.rand(len(whole), 1, generator=self._random) >= self._share
            thinned.backend, thinned.mask = whole.backend, kept / (1 - self._share)
            self.trainable.cloud = thinned
        values = super()._work(draw)
        self.trainable.cloud = whole
        return values


class Weighted(Fit):
    """Frames divided by the linear response of a view, above a floor that grows with noise: large shapes count more.

    The weight of the term is such that at the start its gradient in the amplitudes is as long as that of plain frames.
    """

    def __init__(self, scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> None:
        super().__init__(scan, cloud, options)
        self._frames, self._plain = self._misfit._target.frames, self._misfit._image_terms
        self._misfit._image_terms = self._weighted_terms
        noise = sure_noise(self._frames).mean() / self._misfit.span
        response = linear_response(self.train.exposures, cloud.beta / cloud.delta)
        weight = (1 / (response**2 + (FLOOR + 5 * noise) ** 2).sqrt()).float()
        self._weight = torch.ones_like(weight)
        plain = self._pull()
        self._weight = weight
        self._weight = weight * (plain / self._pull())

    def _weighted_terms(self, predicted: Tensor, draw: Draw) -> dict[str, tuple[float | Tensor, Tensor]]:
        misfit = self._misfit
        misfit._target = Target(filtered(self._frames, self._weight), misfit.low, misfit.span, self.backend)
        return self._plain(filtered(predicted, self._weight), draw)

    def _pull(self) -> float:
        """Length of the gradient of the image terms in the amplitudes."""
        cloud, draw = self.cloud, self._draw()
        predicted = self.instrument.frames(cloud.project(Poses.of(self.instrument.views, self.instrument.device)))
        loss = sum(weight * value.mean() for weight, value in self._weighted_terms(predicted, draw).values())
        return float(torch.autograd.grad(loss, cloud.raw_amplitudes)[0].norm())


class Relocating(Fit):
    """Every 25 steps, from 10 to 60 % of them, the 3 % of Gaussians of least mass go to where the objective pulls most.

    There they take half of a Gaussian (as in MCMC splatting, Kheradmand et al. 2024, without its noise). `by`: gradient
    that says where: `centres`, or `density` (of the amplitudes, over the volume of the Gaussian).
    """

    def __init__(self, scan: hs.Scan, cloud: GaussianCloud, options: FitOptions, by: str) -> None:
        super().__init__(scan, cloud, options)
        self._by, self._pull = by, torch.zeros(len(cloud))

    def _work(self, draw: Draw) -> Tensor:
        cloud = self.cloud
        leaf = cloud.centres if self._by == "centres" else cloud.raw_amplitudes
        handle = leaf.register_hook(self._record)
        values = super()._work(draw)
        handle.remove()
        steps = self.options.schedule.steps
        if 0.1 * steps <= self.step <= 0.6 * steps and self.step % 25 == 0:
            self._relocate(max(1, round(0.03 * len(cloud))))
        return values

    def _record(self, gradient: Tensor) -> None:
        size = gradient.norm(dim=1)
        self._pull += size if self._by == "centres" else size / self.cloud.scales.detach().prod(dim=1)

    def _relocate(self, count: int) -> None:
        cloud = self.cloud
        mass = cloud.masses().detach().sum(dim=1)
        lost = torch.topk(mass, count, largest=False).indices
        self._pull[lost] = 0
        chosen = torch.topk(self._pull, count).indices
        keep = torch.ones(len(cloud), dtype=torch.bool)
        keep[lost] = keep[chosen] = False
        self.trainable.resize(torch.nonzero(keep)[:, 0], _pair(cloud, chosen, self._generator, shrink=1.26))
        self._pull = torch.zeros(len(cloud))


class Signed(GaussianCloud):
    """A cloud whose amplitudes are its fourth parameter itself, of either sign."""

    @property
    def amplitudes(self) -> Tensor:
        """Peak values [N, C]."""
        return self.raw_amplitudes


class GaussNewton(Fit):
    """Before steps 0, 100 and 200, three Levenberg–Marquardt steps for all amplitudes together.

    The curvature is that of the frames (absolute differences reweighted as squares), the gradient that of the whole
    objective; ten conjugate gradients a step; a step that does not lower the objective is taken back.
    """

    damping = 1e-3

    def _advance(self) -> None:
        if self.step % 100 == 0:
            for _ in range(3):
                self._amplitude_step()
        super()._advance()

    def _amplitude_step(self) -> None:
        draw, cloud = self._draw(), self.cloud.detached()
        amplitudes = cloud.amplitudes.requires_grad_()
        signed = with_amplitudes(cloud, amplitudes)
        before = self._misfit(signed, draw)[0]
        gradient = torch.autograd.grad(before, amplitudes)[0]
        poses = Poses.of(self.instrument.views, self.instrument.device)
        with torch.no_grad():
            lines = signed.project(poses)
            difference = self.instrument.frames(lines) - self._misfit._target.frames
        weight = 1 / (difference.abs() + 0.01 * self._misfit.span) / difference.numel() / self._misfit.span

        def curvature(direction: Tensor) -> Tensor:
            along = with_amplitudes(cloud, direction).project(poses).channels
            size = 0.01 * lines.channels.abs().max() / along.abs().max().clamp_min(1e-20)
            with torch.no_grad():
                ahead, behind = (
                    self.instrument.frames(replace(lines, channels=lines.channels + s * size * along)) for s in (1, -1)
                )
            change = weight * (ahead - behind) / (2 * size)
            frames = self.instrument.frames(signed.project(poses))  # anew: its gradient can be taken once
            return torch.autograd.grad(frames, amplitudes, change)[0]

        scale = float((curvature(gradient) * gradient).sum() / gradient.square().sum())
        move = conjugate_gradients(lambda v: curvature(v) + self.damping * scale * v, -gradient)
        moved = (amplitudes.detach() + move).clamp_min(1e-4)
        with torch.no_grad():
            after = self._misfit(with_amplitudes(cloud, moved), draw)[0]
            better = bool(after < before)
            self.damping *= 0.3 if better else 10.0
            if better:
                self.cloud.raw_amplitudes.copy_(raw_of(moved))


class QuasiNewton(Fit):
    """L-BFGS with a strong line search in place of Adam, as many gradients, in five rounds of one objective each.

    Parameters are in units of a hundred of Adam's steps; gradients in units of the first loss.
    """

    def _advance(self) -> None:
        steps, draw, start = self.options.schedule.steps, self._draw(), self.cloud.detached()
        units = [100 * rate for rate in self.options.schedule.rates(0)]
        leaves = [torch.zeros_like(p).requires_grad_() for p in start.parameters]
        evaluations = min(steps // 5, steps - self.step)
        optimiser = torch.optim.LBFGS(
            leaves,
            max_iter=evaluations,
            max_eval=evaluations,
            history_size=20,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )

        def cloud() -> GaussianCloud:
            return start.replaced([p + unit * x for p, unit, x in zip(start.parameters, units, leaves)])

        scale = float(self._misfit(start, draw)[0])

        def closure() -> Tensor:
            optimiser.zero_grad()
            loss = self._misfit(cloud(), draw)[0] / scale
            loss.backward()
            return loss.detach()

        optimiser.step(closure)
        self.step += evaluations
        with torch.no_grad():
            for leaf, found in zip(self.cloud.parameters, cloud().parameters):
                leaf.copy_(found)


def with_amplitudes(cloud: GaussianCloud, amplitudes: Tensor) -> Signed:
    """`cloud` with other amplitudes [N, C], of either sign."""
    signed = Signed([*cloud.parameters[:3], amplitudes], cloud.unit_length, cloud.delta, cloud.beta, cloud.second)
    signed.backend = cloud.backend
    return signed


def filtered(frames: Tensor, transfer: Tensor) -> Tensor:
    """Frames [V, H, W] after a filter of their mean-free part."""
    spectra = torch.fft.rfft2(frames - 1) * transfer
    return torch.fft.irfft2(spectra, s=(frames.shape[1], frames.shape[2])) + 1


def conjugate_gradients(matrix: Callable[[Tensor], Tensor], right: Tensor, steps: int = 10) -> Tensor:
    """An approximate solution of `matrix(x) = right` (Hestenes & Stiefel 1952)."""
    found, residual = torch.zeros_like(right), right.clone()
    direction, square = residual.clone(), residual.square().sum()
    for _ in range(steps):
        image = matrix(direction)
        length = square / (direction * image).sum().clamp_min(1e-30)
        found, residual = found + length * direction, residual - length * image
        square, last = residual.square().sum(), square
        direction = residual + square / last * direction
    return found


def blurred(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions, sigma: float) -> Fit:
    """Frames compared coarse to fine from `sigma` pixels on, whether there is noise or not."""
    fit = Fit(scan, cloud, options)
    fit._misfit._blur = NarrowingBlur(fit.train.frames.shape[1:], sigma, torch.device("cpu"))
    return fit


def judged(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Fit:
    """Two training views set aside, looked at every 25 steps, to choose the best state."""
    return Fit(scan, cloud, replace(options, schedule=replace(options.schedule, validation_views=2)))


def densified(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Fit:
    """Density control as splatting has it: 5 % cloned or split every 50 steps, by the gradient of positions."""
    control = replace(options.density, every=50, start=0.1, stop=0.6)
    return Fit(scan, cloud, replace(options, density=control))


TRIALS: dict[str, Callable[[hs.Scan, GaussianCloud, FitOptions], Fit]] = {
    "as it is": Fit,
    "mean of the late iterates": Averaged,
    "dropout of a tenth": partial(Dropout, share=0.1),
    "dropout of three tenths": partial(Dropout, share=0.3),
    "blurred by 1 px at first": partial(blurred, sigma=1.0),
    "blurred by 2 px at first": partial(blurred, sigma=2.0),
    "weighted by the response": Weighted,
    "Gauss–Newton for the amplitudes": GaussNewton,
    "L-BFGS": QuasiNewton,
    "growth by gradient": densified,
    "relocation": partial(Relocating, by="centres"),
    "relocation by density": partial(Relocating, by="density"),
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
            start = starting_cloud(scan.train(), case.prior, settings, 0, lambda stage, fraction: None)
            for trial in options.trials:
                began = time.perf_counter()
                fit = TRIALS[trial](scan, start.detached(), fit_options(case.prior, settings, start))
                fit.run(lambda record: None)
                seconds = time.perf_counter() - began
                found = score_object(fit.result(), scan, truth, fit.instrument.oversample).headline()
                rows.append(
                    {"case": name, "seed": seed, "trial": trial, "commit": commit(), "seconds": seconds, **found}
                )
                images, volume = (
                    " / ".join(f"{found[key]:.3f}" for key in keys)
                    for keys in (("ssim", "frcm"), ("dice", "relative_error_delta"))
                )
                print(f"| {name} | {seed} | {trial} | {images} | {volume} | {seconds:.0f} |", flush=True)
    if options.csv:
        with options.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
