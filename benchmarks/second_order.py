"""Trials of `trials.py` that use curvature: Gauss–Newton for the amplitudes, and L-BFGS for everything."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

import holosplat as hs
from holosplat.fit.loop import Fit, Plan
from holosplat.fit.optimiser import Leaves
from holosplat.methods import FitOptions, gaussian_fit
from holosplat.model import Model
from holosplat.representations.gaussians import GaussianCloud, raw_of


def planned(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Plan:
    """The fit as it is, not begun."""
    return gaussian_fit(scan, cloud, options).plan


def cloud_of(model: Model) -> GaussianCloud:
    """The Gaussians of a model."""
    assert isinstance(model.object, GaussianCloud)
    return model.object


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

    def __init__(self, plan: Plan, measured: Tensor) -> None:
        """measured: the training frames."""
        super().__init__(plan)
        self._measured = measured

    def _advance(self) -> None:
        if self.step % 100 == 0:
            for _ in range(3):
                self._amplitude_step()
        super()._advance()

    def _amplitude_step(self) -> None:
        batch, cloud = self._batches.draw(self.step, self.step / self.schedule.steps), cloud_of(self.model).detached()
        problem, instrument, poses = self.plan.problem, self.model.instrument, self.model.instrument.poses

        def loss(amplitudes: Tensor) -> Tensor:
            return problem.loss(replace(self.model, object=with_amplitudes(cloud, amplitudes)), batch)[0]

        amplitudes = cloud.amplitudes.requires_grad_()
        signed, before = with_amplitudes(cloud, amplitudes), loss(amplitudes)
        gradient = torch.autograd.grad(before, amplitudes)[0]
        with torch.no_grad():
            lines = signed.project(poses)
            difference = instrument.frames(lines) - self._measured
        span = float(self._measured.max() - self._measured.min())
        weight = 1 / (difference.abs() + 0.01 * span) / difference.numel() / span

        def curvature(direction: Tensor) -> Tensor:
            along = with_amplitudes(cloud, direction).project(poses).channels
            size = 0.01 * lines.channels.abs().max() / along.abs().max().clamp_min(1e-20)
            with torch.no_grad():
                ahead, behind = (
                    instrument.frames(replace(lines, channels=lines.channels + s * size * along)) for s in (1, -1)
                )
            change = weight * (ahead - behind) / (2 * size)
            frames = instrument.frames(signed.project(poses))  # anew: its gradient can be taken once
            return torch.autograd.grad(frames, amplitudes, change)[0]

        scale = float((curvature(gradient) * gradient).sum() / gradient.square().sum())
        move = conjugate_gradients(lambda v: curvature(v) + self.damping * scale * v, -gradient)
        moved = (amplitudes.detach() + move).clamp_min(1e-4)
        with torch.no_grad():
            better = bool(loss(moved) < before)
            self.damping *= 0.3 if better else 10.0
            if better:
                self.trainable.leaves["object.raw_amplitudes"].copy_(raw_of(moved))


def gauss_newton(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Fit:
    """Levenberg–Marquardt steps for the amplitudes beside those of Adam."""
    return GaussNewton(planned(scan, cloud, options), torch.from_numpy(scan.train().frames))


class QuasiNewton(Fit):
    """L-BFGS with a strong line search in place of Adam, as many gradients, in five rounds of one objective each.

    Parameters are in units of a hundred of Adam's steps; gradients in units of the first loss.
    """

    def _advance(self) -> None:
        steps, problem = self.schedule.steps, self.plan.problem
        batch, start = self._batches.draw(self.step, self.step / steps), self.trainable.snapshot()
        units = {name: 100 * rate for name, rate in self.plan.rates(1.0, self.step).items()}
        scaled = {name: torch.zeros_like(p).requires_grad_() for name, p in start.items()}
        evaluations = min(steps // 5, steps - self.step)
        optimiser = torch.optim.LBFGS(
            list(scaled.values()),
            max_iter=evaluations,
            max_eval=evaluations,
            history_size=20,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )

        def moved() -> Leaves:
            return {name: p + units[name] * scaled[name] for name, p in start.items()}

        scale = float(problem.loss(problem.model.with_parameters(start), batch)[0])

        def closure() -> Tensor:
            optimiser.zero_grad()
            loss = problem.loss(problem.model.with_parameters(moved()), batch)[0] / scale
            loss.backward()
            return loss.detach()

        optimiser.step(closure)
        self.step += evaluations
        with torch.no_grad():
            for name, found in moved().items():
                self.trainable.leaves[name].copy_(found)


def quasi_newton(scan: hs.Scan, cloud: GaussianCloud, options: FitOptions) -> Fit:
    """L-BFGS in place of Adam."""
    return QuasiNewton(planned(scan, cloud, options))


def with_amplitudes(cloud: GaussianCloud, amplitudes: Tensor) -> Signed:
    """`cloud` with other amplitudes [N, C], of either sign."""
    signed = Signed((cloud.centres, cloud.log_scales, cloud.quaternions, amplitudes), cloud.unit_length, cloud.matter)
    signed.backend = cloud.backend
    return signed


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
