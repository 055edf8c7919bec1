"""The likeliest volume of continuous matter: whitened frames, a prior on slopes and values, and how it is found."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..backends import device, resolve
from ..checks import require
from ..geometry import Grid
from ..matter import DeltaBeta
from ..projectors.voxels import projector_for
from ..ranges import Positive, Signed, Weight, checked_dataclass
from .projected_gradient import direction, product
from .whitened import WhitenedFrames

MEMORY = 6
"""Pairs of steps and changes of the gradient that L-BFGS remembers."""
SUFFICIENT, SHRINK, TRIALS = 1e-4, 0.3, 12
"""Armijo's condition: the share of the expected decrease that a step must give, the factor that shortens one that does
not, and after how many trials the iteration ends."""
REFRESH = 10
"""Iterations after which the preconditioner is made anew."""
MATTER = 0.05
"""Share of the largest value above which a voxel counts as matter for the preconditioner."""
ALIKE = 1e-6
"""Difference of β, as a share, below which two materials have one ratio."""

Slope = Callable[[], Tensor]
"""Computes a gradient, which steps that are refused do not need."""


@checked_dataclass
class ContinuousPrior:
    """The prior of matter: `a Σ log(1 + (√(|∇u|² + ε²) - ε) / b) + m Σ log(1 + d(u) / v)`.

    Slopes of few voxels are large, those of most are almost zero, and most of space is empty, or full of one of the
    materials that are known: d is the distance to the nearest of these levels, one of which is 0, the medium. u is not
    negative, unless matter may lie on both sides of its medium.
    Logarithms, as of power laws, hardly shrink what is large, where total variation takes from every edge in proportion
    to its height (Nikolova 2005). As the misfit is in units of the noise, a and m have no unit, and hold for every
    noise.
    """

    slopes: Weight = 0.4
    """a: exponent of the power law of slopes."""
    slope: Positive = 0.02
    """b: slope from one voxel to the next beyond which the law holds, as a share of the matter's level."""
    rounding: Positive = 0.02
    """ε: slopes below which the prior is a square, as a share of the level."""
    values: Weight = 0.02
    """m: exponent of the power law of values."""
    value: Positive = 0.05
    """v: distance from the nearest level beyond which the law holds, as a share of the matter's level."""
    levels: tuple[Signed, ...] = ()
    """Occupancies of the known materials; none where no density is known."""
    two_sided: bool = False
    """Whether u may be negative."""

    def weakened(self, share: float) -> ContinuousPrior:
        """The prior with `share` of its exponents."""
        return replace(self, slopes=share * self.slopes, values=share * self.values)

    def on_larger_voxels(self, factor: int) -> ContinuousPrior:
        """The prior on voxels `factor` times larger: slopes are as much steeper, and every voxel stands for more."""
        steeper = {name: factor * getattr(self, name) for name in ("slopes", "slope", "rounding")}
        return replace(self, **steeper, values=factor**2 * self.values)

    def distance(self, u: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
        """How far u is from the nearest level, and the slope of that; within `epsilon` of one a square, but for 0 where
        u ≥ 0."""
        if not (self.levels or self.two_sided):
            return u, torch.ones_like(u)
        levels = u.new_tensor(sorted([0.0, *self.levels]))
        away = u - levels[torch.bucketize(u, 0.5 * (levels[1:] + levels[:-1]))]  # of one level all are in one bucket
        size = (away.square() + epsilon**2).sqrt()
        return size - epsilon, away / size


@dataclass(frozen=True)
class KnownLevels:
    """Known materials in an occupancy of `unit` [δ, β]; none where no density is known."""

    materials: tuple[DeltaBeta, ...]
    unit: DeltaBeta

    @property
    def occupancies(self) -> tuple[float, ...]:
        """The occupancy of each, rising."""
        return tuple(sorted(delta / self.unit.delta for delta, _ in self.materials))

    def absorbed(self, u: Tensor) -> Tensor | None:
        """β beside that of an occupancy u [Z, Y, X] of the unit, as large as between the two levels that are nearest;
        None where all matter has the unit's ratio."""
        knots = sorted([(0.0, 0.0), *((delta / self.unit.delta, beta) for delta, beta in self.materials)])
        beside = [beta - level * self.unit.beta for level, beta in knots]
        if max(map(abs, beside)) <= ALIKE * abs(self.unit.beta):
            return None
        at, values = u.new_tensor([level for level, _ in knots]), u.new_tensor(beside)
        right = torch.bucketize(u, at).clamp(1, len(at) - 1)
        share = ((u - at[right - 1]) / (at[right] - at[right - 1])).clamp(0, 1)
        return values[right - 1] + share * (values[right] - values[right - 1])


class VolumeProblem:
    """½ χ² of the frames and the prior of a volume u [Z, Y, X] of one material's occupancy, on voxels of a pixel.

    The volume has the rows beyond the frames, too (`WhitenedFrames.field`).
    level: what u is about in matter, the unit of the prior's slopes and values; lower: what u is at least; support
    [Z, Y, X] bool: where matter may be (None: anywhere), beyond which u must begin at zero, and stays there.
    """

    def __init__(
        self,
        frames: WhitenedFrames,
        prior: ContinuousPrior,
        level: float,
        backend: str = "cpu",
        support: Tensor | None = None,
    ) -> None:
        require(level > 0, f"the level of the matter must be positive, but it is {level:g}.")
        self.frames, self.prior, self.level = frames, prior, level
        self.lower = -math.inf if prior.two_sided else 0.0
        views = frames.field
        pixels = views.in_units_of(views.finest)
        self.grid = Grid.of_views(pixels)
        backend = resolve(backend)
        self.device = device(backend)
        self._projector = projector_for(self.grid, pixels, backend)
        self.support = None if support is None else support.to(self.device)
        self._symbol = self._data_symbol()
        frequencies = [torch.fft.fftfreq(n) for n in self.grid.shape[:2]] + [torch.fft.rfftfreq(self.grid.shape[2])]
        z, y, x = (4 * torch.sin(math.pi * f).square() for f in frequencies)
        self._laplacian = (z[:, None, None] + y[:, None] + x).to(self.device)

    def lines(self, u: Tensor) -> Tensor:
        """Line integrals [V, H, W] in pixels of path length."""
        return self._projector.lines_out(self._projector.project(self._projector.volume_in(u)))

    def backprojection(self, lines: Tensor) -> Tensor:
        """The adjoint of `lines`."""
        return self._projector.volume_out(self._projector.backproject(self._projector.lines_in(lines.contiguous())))

    def __call__(self, u: Tensor) -> tuple[float, Slope]:
        """The objective and its gradient [Z, Y, X]."""
        misfit, (prior, pull) = self.frames(self.lines(u)), self.penalty(u)

        def slope() -> Tensor:
            gradient = pull(self.backprojection(misfit.gradient))
            return gradient if self.support is None else gradient * self.support

        return misfit.value + prior, slope

    def unexplained(self, u: Tensor) -> float:
        """χ² a pixel of a volume u [Z, Y, X]."""
        return 2 * self.frames(self.lines(u)).value / self.frames.count

    def penalty(self, u: Tensor) -> tuple[float, Callable[[Tensor], Tensor]]:
        """The prior of u, and what adds its gradient to that of the misfit."""
        prior, level = self.prior, self.level
        b, epsilon, v = prior.slope * level, prior.rounding * level, prior.value * level
        size = _slopes(u, epsilon)
        value = prior.slopes * float(((size - epsilon) / b).log1p().double().sum())
        away, slope = prior.distance(u, epsilon)
        value += prior.values * float((away / v).log1p().double().sum())

        def pulled(gradient: Tensor) -> Tensor:
            pull = prior.slopes / ((b - epsilon + size) * size)
            for axis in range(3):
                flow = pull.narrow(axis, 0, u.shape[axis] - 1) * u.diff(dim=axis)
                gradient.narrow(axis, 1, u.shape[axis] - 1).add_(flow)
                gradient.narrow(axis, 0, u.shape[axis] - 1).sub_(flow)
            return gradient.add_(slope * (prior.values / (v + away)))

        return value, pulled

    def preconditioner(self, u: Tensor, times: int = 1) -> Callable[[Tensor], Tensor]:
        """About the inverse of the second derivative at u: by spatial frequency, of the data and of mean slopes.

        times: how often the data are there.
        """
        b, epsilon = self.prior.slope * self.level, self.prior.rounding * self.level
        size = _slopes(u, epsilon)
        pull = self.prior.slopes / ((b - epsilon + size) * size)
        matter = u.abs() > MATTER * u.abs().max()
        mean = float(pull[matter].mean()) if bool(matter.any()) else float(pull.mean())
        least = 1e-4 * mean + 1e-6 * float(self._symbol.max())
        inverse = 1 / (times * self._symbol + mean * self._laplacian + least)

        def applied(gradient: Tensor) -> Tensor:
            return torch.fft.irfftn(torch.fft.rfftn(gradient) * inverse, s=gradient.shape)

        return applied

    def _data_symbol(self) -> Tensor:
        """Spectrum of the response of the data's second derivative to one full voxel in the middle."""
        impulse, middle = torch.zeros(self.grid.shape, device=self.device), [n // 2 for n in self.grid.shape]
        impulse[tuple(middle)] = 1.0
        lines, shape, (rows, columns) = self.lines(impulse), self.frames.shape, self.frames.beyond
        seen = lines[:, rows : rows + shape[0], columns : columns + shape[1]]
        curved = torch.fft.irfft2(torch.fft.rfft2(seen) * self.frames.curvature(), s=shape)
        curved = pad(curved, (columns, columns, rows, rows))
        answer = torch.roll(self.backprojection(curved), [-m for m in middle], (0, 1, 2))
        return torch.fft.rfftn(answer).real.clamp_min(0)


def _slopes(u: Tensor, epsilon: float) -> Tensor:
    """√(|∇u|² + ε²) by forward differences."""
    square = torch.full_like(u, epsilon**2)
    for axis in range(3):
        square.narrow(axis, 0, u.shape[axis] - 1).add_(u.diff(dim=axis).square_())
    return square.sqrt_()


class Penalised(Protocol):
    """What a `Descent` makes small; lower: what its volume is at least."""

    lower: float

    def __call__(self, u: Tensor) -> tuple[float, Slope]:
        """The objective and its gradient [Z, Y, X]."""
        ...

    def preconditioner(self, u: Tensor) -> Callable[[Tensor], Tensor]:
        """About the inverse of the second derivative at u."""
        ...


class Descent:
    """Projected L-BFGS from `start` [Z, Y, X], an iteration at a time; the objective never rises.

    Voxels at the lower bound that the gradient would keep there are fixed, and the others take a step of L-BFGS among
    themselves, cut off there (two-metric projection: Bertsekas 1982; Nocedal & Wright 2006, algorithm 7.4, for the
    step, with the problem's preconditioner as first inverse).

    u: the volume; value: its objective; done: how many iterations; ended: whether none lowers the objective further;
    kept: whether steps that would leave nothing are shortened, for an empty volume is a trap: there the prior of
    continuous matter is steepest.
    """

    def __init__(self, problem: Penalised, start: Tensor, kept: bool = False) -> None:
        self.problem, self.u, self.kept = problem, start.clamp_min(problem.lower), kept
        self.value, slope = problem(self.u)
        self._gradient = slope()
        self.done, self.ended = 0, False
        self._pairs = list[tuple[Tensor, Tensor]]()
        self._conditioned(self.u)

    def _conditioned(self, at: Tensor) -> None:
        self._anchor, self._inverse = at, self.problem.preconditioner(at)

    def step(self) -> None:
        """One iteration, if any lowers the objective."""
        if self.done and self.done % REFRESH == 0:
            self._conditioned(self.u)
        u, gradient = self.u, self._gradient
        free = ((u > self.problem.lower) | (gradient < 0)).to(u)
        way = direction(gradient, self._pairs, self._inverse, free)
        found = self._searched(way)
        if found is None and self._pairs:
            self._pairs = []
            found = self._searched(direction(gradient, self._pairs, self._inverse, free))
        if found is None:
            self.ended = True
            return
        moved, value, slope = found
        step, change = moved - u, slope - gradient
        if product(step, change) > 0:
            self._pairs = [*self._pairs[1 - MEMORY :], (step, change)]
        self.u, self._gradient, self.value = moved, slope, value
        self.done += 1

    def _searched(self, way: Tensor) -> tuple[Tensor, float, Tensor] | None:
        """The first point of a shrinking series along the projected `way` that lowers the objective enough."""
        length, u, gradient = 1.0, self.u, self._gradient
        for _ in range(TRIALS):
            moved = (u + length * way).clamp_min(self.problem.lower)
            length *= SHRINK
            if self.kept and not bool(moved.any()):
                continue
            found, slope = self.problem(moved)
            if found <= self.value + SUFFICIENT * min(0.0, product(gradient, moved - u)):
                return moved, found, slope()
        return None

    def state_dict(self) -> dict[str, Any]:
        """Everything that `again` needs, for the same steps to the last bit, in main memory."""
        return {
            "u": self.u.cpu(),
            "value": self.value,
            "gradient": self._gradient.cpu(),
            "anchor": self._anchor.cpu(),
            "pairs": [[part.cpu() for part in pair] for pair in self._pairs],
            "done": self.done,
            "ended": self.ended,
            "kept": self.kept,
        }

    @classmethod
    def again(cls, problem: Penalised, state: Mapping[str, Any], on: torch.device | str = "cpu") -> Descent:
        """The descent as `state_dict` left it, on the device `on`."""
        found = cls.__new__(cls)
        found.problem, found.u, found.value = problem, state["u"].to(on), float(state["value"])
        found._gradient, found.done, found.ended = state["gradient"].to(on), int(state["done"]), bool(state["ended"])
        found.kept = bool(state["kept"])
        found._pairs = [(step.to(on), change.to(on)) for step, change in state["pairs"]]
        found._conditioned(state["anchor"].to(on))
        return found


def descend(problem: Penalised, start: Tensor, iterations: int) -> tuple[Tensor, list[float]]:
    """At most `iterations` of a `Descent`; the volume [Z, Y, X], and the objective before and after each."""
    descent = Descent(problem, start)
    values = [descent.value]
    while descent.done < iterations:
        descent.step()
        if descent.ended:
            break
        values.append(descent.value)
    return descent.u, values
