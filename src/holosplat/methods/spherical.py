"""Continuous matter that is spherical, as a shock from a point: its likeliest profile over the radius, and centre."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ..backends import resolve
from ..fit.run import Record, interrupts_held
from ..fit.smooth_volume import ContinuousPrior, VolumeProblem
from ..fit.whitened import WhitenedFrames
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..memory import memory_kept
from ..model import Instrument, Model
from ..representations import VoxelGrid
from ..volume import LineIntegrals, Unmoved, Volume

AXES = 3
NEAREST = 1e-9
"""Distance of a ray from the centre at least, in units of the spacing: no ray's derivative has a direction there."""
LEAST = 1e-12
"""Least second derivative, as a share of the largest."""
DAMPED, EASED, MOST_DAMPED = 1e-3, 10.0, 1e6
"""Damping at first, as a share of each second derivative; the factor by which it falls after a step that helped and
grows after one that did not; and the one at which the fit ends, for then no step helps."""
WORTH = 0.5
"""Gain of the log-likelihood below which a step is the last: by so much one of the unknowns moves it on average. Where
the sphere leaves more than noise, that is in units of what it leaves (quasi-likelihood: McCullagh & Nelder 1989)."""
MOST = 30
"""Steps at most; Gauss and Newton's take about eight."""


@dataclass(frozen=True)
class ProfileErrors:
    """What frames tell of a spherical volume. centre: standard errors of `(x, y, z)` [m]; spacing: of the radii 0, 1, …
    of the profile [m]; covariance: [K, K] of δ at these, between which it is linear"""

    centre: tuple[float, ...]
    spacing: float
    covariance: np.ndarray

    def hats(self, radii: np.ndarray) -> np.ndarray:
        """Derivatives [N, K] of δ at N radii [m] by that at the radii of the profile."""
        away = radii[:, None] / self.spacing - np.arange(len(self.covariance))
        return np.maximum(1 - np.abs(away), 0.0)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON; `from_dict` reads them."""
        return {"centre_m": self.centre, "spacing_m": self.spacing, "covariance": self.covariance.tolist()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ProfileErrors:
        """What `as_dict` described. Errors: `KeyError`, `TypeError` or `ValueError` for anything else."""
        covariance = np.array(values["covariance"], dtype=np.float64)
        if covariance.ndim != 2 or covariance.shape[0] != covariance.shape[1]:
            raise ValueError("covariance")
        return cls(tuple(map(float, values["centre_m"])), float(values["spacing_m"]), covariance)


@dataclass(frozen=True)
class SphericalMatter(Unmoved):
    """Matter that is spherical, of exact line integrals: no voxel blurs its fronts.

    centre: `(x, y, z)` [m]; spacing: of the radii 0, 1, … of the profile [m]; values: [K] float64, occupancies at
    these, between which it is linear, and 0 beyond; material: δ and β of an occupancy of one.
    """

    centre: np.ndarray
    spacing: float
    values: Tensor
    material: DeltaBeta

    def project(self, views: Views) -> LineIntegrals:
        """Line integrals of the material [V, 1, H, W] [m], at the centres of pixels."""
        return LineIntegrals((self.spacing * self.lines(views))[:, None], (self.material,))

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β at the centres of voxels."""
        x, y, z = grid.axes()
        away = [at - middle for at, middle in zip((x, y[:, None], z[:, None, None]), self.centre)]
        radius = np.sqrt(sum(np.square(one) for one in away)) / self.spacing
        values = np.interp(radius, np.arange(len(self.values) + 1), [*self.values.tolist(), 0.0])
        return Volume(values * self.material.delta, values * self.material.beta, grid)

    def lines(self, views: Views) -> Tensor:
        """Line integrals [V, H, W] of the occupancy in units of the spacing, float32.

        With `q(n) = ½ (n √(n² - ρ²) - ρ² arcosh(n / ρ))` at a distance ρ < n from the centre, else 0, they are
        `2 Σ q(n) (u(n-1) - 2 u(n) + u(n+1))`: Abel's transform of straight pieces (Bracewell 2000, chapter 14).
        """
        bends, per_view = self._bends(), list[Tensor]()
        for radius, _ in self._seen(views):
            back, pieces = _pieces(radius, len(bends))
            lines = torch.zeros(len(back), dtype=torch.float64)
            for bend, (ring, _) in zip(bends, pieces):
                lines[: len(ring)].add_(ring, alpha=bend)
            per_view.append(lines.float()[back].reshape(radius.shape))
        return torch.stack(per_view)

    def slopes(self, views: Views) -> list[Tensor]:
        """Derivatives [V, H, W] of `lines` by the centre along x, y, z, in units of the spacing, and by the values."""
        bends, per_view = self._bends(), list[Tensor]()
        for radius, way in self._seen(views):
            back, pieces = _pieces(radius, len(bends))
            moved, rings = (torch.zeros(n, len(back), dtype=torch.float64) for n in (1, len(bends) + 2))
            for n, (bend, (ring, angle)) in enumerate(zip(bends, pieces), 2):
                moved[0, : len(ring)].add_(angle, alpha=bend)
                rings[n, : len(ring)] = ring
            found = torch.cat([moved, 2 * rings.diff(n=2, dim=0)]).float()[:, back]
            moved, rest = found.reshape(-1, *radius.shape).split([1, len(bends)])
            per_view.append(torch.cat([moved * way.float(), rest]))
        return list(torch.stack(per_view, dim=1))

    def _bends(self) -> list[float]:
        """Twice the second differences of the values, at the radii 1, 2, …"""
        return (2 * torch.cat([self.values, self.values.new_zeros(2)]).diff(n=2)).tolist()

    def _seen(self, views: Views) -> Iterator[tuple[Tensor, Tensor]]:
        """Of each view the distances [H, W] of the centre from the pixels' rays, in units of the spacing, and the
        direction [3, H, W] in which the centre moves away from them."""
        h, w = views.shape
        for v, rotation in enumerate(views.rotations):
            pitch, (sx, sy) = views.pixel_sizes[v], views.shifts[v]
            y, x = np.meshgrid(
                (np.arange(h) - 0.5 * (h - 1)) * pitch + sy, (np.arange(w) - 0.5 * (w - 1)) * pitch + sx, indexing="ij"
            )
            place, way = np.stack([x, y, np.zeros_like(x)]), np.zeros((3, h, w))
            way[2] = 1.0
            if views.sources is not None:
                way = place + views.sources[v] * way
                way /= np.linalg.norm(way, axis=0)
            away = (rotation @ self.centre)[:, None, None] - place
            away -= (away * way).sum(axis=0) * way
            radius = np.maximum(np.linalg.norm(away, axis=0) / self.spacing, NEAREST)
            direction = np.tensordot(rotation.T, away, 1) / (radius * self.spacing)
            yield torch.from_numpy(radius), torch.from_numpy(direction)


def _pieces(radius: Tensor, count: int) -> tuple[Tensor, Iterator[tuple[Tensor, Tensor]]]:
    """The place of each pixel in the order of the distances `radius` ρ; and for n = 1 to `count` the q(n) of
    `SphericalMatter.lines`, and its derivative by ρ, of the pixels with ρ < n, in that order."""
    near, order = radius.flatten().sort()

    def pieces() -> Iterator[tuple[Tensor, Tensor]]:
        for n, end in enumerate(torch.searchsorted(near, torch.arange(1.0, count + 1).double()).tolist(), 1):
            inside = near[:end]
            angle = inside * (n / inside).acosh()
            yield 0.5 * (n * (n**2 - inside.square()).sqrt() - inside * angle), -angle

    return order.argsort(), pieces()


class Sphere:
    """The likeliest spherical matter, by Gauss and Newton's steps with damping (Levenberg 1944, Marquardt 1963).

    Unknowns are the centre (z, y, x) in voxels of a pixel from the origin of their grid, and the values at the radii
    0, 1, … voxels below half the shorter side. So few unknowns need no prior: hundreds of pixels tell each of them. In
    a step those values are fixed at the bound `lower` that the gradient would keep there (Bertsekas 1982).

    frames: in units of their noise; start [Z, Y, X]: a volume of them, whose means over spheres are where the fit
    begins, about the point by whose reflection the frames change least (`_symmetric_about`); told: what the sum of the
    volume is, and the standard error of that, where something else than frames tells it.
    """

    def __init__(
        self,
        frames: WhitenedFrames,
        start: Tensor,
        backend: str = "cpu",
        lower: float = -math.inf,
        told: tuple[float, float] | None = None,
    ) -> None:
        self.told, self.frames, self.grid = told, frames.of_samples(), Grid.of_views(frames.field)
        rows, columns = frames.beyond
        contrast = pad(frames.known(frames.measured - 1), (columns, columns, rows, rows))
        problem = VolumeProblem(frames, ContinuousPrior(two_sided=True), 1.0, backend)
        count, centre = max(1, min(start.shape) // 2), _symmetric_about(problem.backprojection(contrast).cpu())
        axes = [torch.arange(n, dtype=torch.float64) for n in start.shape]
        places = torch.stack(torch.meshgrid(*axes, indexing="ij"))
        near = (places - centre[:, None, None, None]).norm(dim=0).round().long().clamp_max(count).flatten()
        sums, members = (torch.zeros(count + 1, dtype=torch.float64) for _ in range(2))
        sums.index_add_(0, near, start.double().cpu().flatten())
        members.index_add_(0, near, torch.ones_like(near, dtype=torch.float64))
        self.lower = torch.cat([torch.full((AXES,), -math.inf), torch.full((count,), lower)]).double()
        self.unknowns = torch.cat([centre, (sums / members.clamp_min(1))[:count]]).maximum(self.lower)
        self.value, self.damping, self.done = self._value(self.unknowns), DAMPED, 0
        self.cut, self.ended = False, False

    def matter(self, unknowns: Tensor | None = None) -> SphericalMatter:
        """What the unknowns are of."""
        unknowns = self.unknowns if unknowns is None else unknowns
        edge = self.grid.voxel_size[0]
        centre = np.array(self.grid.origin) + edge * unknowns[:AXES].flip(0).numpy()
        return SphericalMatter(centre, edge, unknowns[AXES:], self.frames.material)

    def step(self) -> None:
        """One step, if any helps; where none does for the first time, the profile is cut (`_cut`), and it goes on."""
        level, matrix, missing = self._equations()
        if not matrix.any():  # the centre has left the field, and nothing is seen of the sphere
            self.ended = True
            return
        free = (self.unknowns > self.lower) | (missing > 0)
        diagonal = torch.diag(matrix.diag().clamp_min(LEAST * float(matrix.diag().max())))
        gained = 0.0
        while self.damping < MOST_DAMPED and not gained:
            tried = self.unknowns.clone()
            damped = (matrix + self.damping * diagonal)[free][:, free]
            tried[free] += level[free] * torch.linalg.solve(damped, missing[free])
            tried = tried.maximum(self.lower)
            value = self._value(tried)
            self.damping *= 1 / EASED if value < self.value else EASED
            if value < self.value:
                gained, self.unknowns, self.value, self.done = self.value - value, tried, value, self.done + 1
        last = gained < WORTH * max(1.0, 2 * self.value / self.frames.measured.numel())
        if last and not self.cut:
            self._cut(matrix + LEAST * diagonal, self.unknowns / level)
        else:
            self.ended = last or self.done >= MOST

    def errors(self) -> tuple[float, Tensor]:
        """Standard error of the sum of the volume, and covariance of the unknowns, of which no value is unknown beyond
        the last one that is not 0. The error of the sum is large, for frames hardly tell slow changes of the profile.
        """
        level, matrix, _ = self._equations()
        last = AXES + 1 + int(self.unknowns[AXES:].nonzero().max())
        matrix, sums, level = matrix[:last, :last], (_volumes(self.unknowns) * level)[:last], level[:last]
        regular = matrix + LEAST * matrix.diag().max() * torch.eye(last, dtype=matrix.dtype)
        covariance = torch.linalg.inv(regular)
        return math.sqrt(float(sums @ covariance @ sums)), covariance * torch.outer(level, level)

    def _equations(self) -> tuple[Tensor, Tensor, Tensor]:
        """Units of the unknowns, and in these the second derivatives, and minus the gradient."""
        level = torch.ones_like(self.unknowns)
        level[AXES:] = float(self.unknowns[AXES:].abs().max()) or 1.0  # in smaller units rounding hides the slopes
        matter, views = self.matter(), self.frames.instrument.views
        x, y, z, *values = matter.slopes(views)
        changes = [self._there(one) * float(unit) for one, unit in zip((z, y, x, *values), level)]
        equations = self.frames.normal_equations(self._there(matter.lines(views)), changes)
        matrix, missing = (each.cpu() for each in equations)
        if self.told:
            value, error = self.told
            sums = _volumes(self.unknowns) * level
            matrix = matrix + torch.outer(sums, sums) / error**2
            missing = missing + sums * (value - self.sum_of(self.unknowns)) / error**2
        return level, matrix, missing

    def _cut(self, matrix: Tensor, unknowns: Tensor) -> None:
        """Leave out the outermost values as far as the frames do not tell them from 0, by Akaike's criterion (1974): a
        value must gain more than one of the log-likelihood. What slow changes of the profile do inside, which frames
        hardly tell, goes with what it would be outside; a shock runs into a medium that is even.

        matrix: second derivative of the misfit by the `unknowns` [K], of which without the last the misfit rises by
        `½ x (C⁻¹) x` of their values x and their covariance C.
        """
        covariance, count = torch.linalg.inv(matrix), len(unknowns) - AXES
        rise = [count * 1.0]
        for kept in range(count - 1, 0, -1):
            out = slice(AXES + kept, None)
            rise.append(0.5 * float(unknowns[out] @ torch.linalg.solve(covariance[out, out], unknowns[out])) + kept)
        kept = count - int(np.argmin(rise))
        self.unknowns, self.lower = self.unknowns[: AXES + kept], self.lower[: AXES + kept]
        self.value, self.damping, self.cut = self._value(self.unknowns), DAMPED, True

    def _value(self, unknowns: Tensor) -> float:
        lines = self.matter(unknowns).lines(self.frames.instrument.views)
        misfit = self.frames(self._there(lines)).value
        away = (self.sum_of(unknowns) - self.told[0]) / self.told[1] if self.told else 0.0
        return misfit + 0.5 * away**2

    @staticmethod
    def sum_of(unknowns: Tensor) -> float:
        """Integral of the occupancy over all space, in voxels."""
        return float(_volumes(unknowns) @ unknowns)

    def _there(self, lines: Tensor) -> Tensor:
        return lines.to(self.frames.instrument.device)


def _volumes(unknowns: Tensor) -> Tensor:
    """Slopes of the integral over all space by the unknowns of a `Sphere`: `4π ∫ h r² dr` of the values' hats h."""
    radii = torch.arange(len(unknowns) - AXES, dtype=torch.float64)
    hats = radii.square() + 1 / 6
    hats[:1] = 1 / 12
    return torch.cat([torch.zeros(AXES, dtype=torch.float64), 4 * math.pi * hats])


def _symmetric_about(volume: Tensor) -> Tensor:
    """The point (z, y, x), in half voxels, about which a volume is most nearly its own reflection: half of where its
    convolution with itself is largest. What few views smear of a sphere is as symmetric as the sphere, and so are its
    fringes, which noise hides less than what is retrieved of them."""
    twice = [2 * n for n in volume.shape]
    convolved = torch.fft.irfftn(torch.fft.rfftn(volume, s=twice).square(), s=twice)
    index = np.unravel_index(int(convolved.argmax()), convolved.shape)
    return 0.5 * torch.tensor([float(n) for n in index], dtype=torch.float64)


def likeliest_sphere(frames: WhitenedFrames, start: Tensor, lower: float) -> SphericalMatter:
    """The matter at which a `Sphere` ends."""
    sphere = Sphere(frames, start, lower=lower)
    while not sphere.ended:
        sphere.step()
    return sphere.matter()


class SphericalFit:
    """A spherical volume in progress, as a run asks of every fit (`fit.run`). begun: what it starts from; told: its
    total δ and the standard error of that [m³], where something else than frames tells them."""

    aside = 0
    stopped_early = False
    best_step = 0

    def __init__(
        self, frames: WhitenedFrames, begun: VoxelGrid, backend: str, lower: float, told: tuple[float, ...] = ()
    ) -> None:
        self.backend, self.step, self.seconds, self._begun = resolve(backend), 0, 0.0, begun
        self._unit = math.prod(begun.grid.voxel_size) * begun.matter.delta
        known = (told[0] / self._unit, told[1] / abs(self._unit)) if told else None
        self._frames, self._sphere = frames, Sphere(frames, begun.values[0], self.backend, lower, known)

    @property
    def oversample(self) -> int:
        """Wave samples a pixel."""
        return self._frames.instrument.oversample

    @property
    def finished(self) -> bool:
        """Whether no step helps any more."""
        return self._sphere.ended

    @property
    def share(self) -> float:
        """How much of the work is done."""
        return 1.0 if self.finished else self.step / MOST

    def errors(self) -> tuple[float, ProfileErrors]:
        """Standard error of the total δ [m³], and those of centre and profile."""
        error, covariance = self._sphere.errors()
        centre = covariance.diag()[:AXES].sqrt().flip(0) * self._begun.grid.voxel_size[0]
        values = covariance[AXES:, AXES:] * self._begun.matter.delta**2
        spacing, unit = self._begun.grid.voxel_size[0], abs(self._unit)
        return error * unit, ProfileErrors(tuple(centre.tolist()), spacing, values.numpy())

    @property
    def voxels(self) -> VoxelGrid:
        """The volume as it is now."""
        delta = self._sphere.matter().voxelise(self._begun.grid).delta / self._begun.matter.delta
        return self._begun.with_parameters({"values": torch.from_numpy(delta).float()[None]})

    def result(self) -> Model:
        """The model of the volume as it is now."""
        exposures = self._frames.train.exposures
        return Model(self.voxels, Instrument(exposures, self.oversample, backend=self.backend))

    def resolved(self) -> dict[str, Any]:
        """What the options have become."""
        return {"radii": len(self._sphere.unknowns) - AXES}

    def columns(self) -> list[str]:
        """Names of what a record holds."""
        return ["step", "seconds", "loss"]

    def run(self, on_record: Callable[[Record], None], until: int | None = None) -> None:
        """Advance to the end (or to step `until`), with one record a step; Ctrl-C is passed on between two."""
        with memory_kept(), interrupts_held() as release:
            while not self.finished and (until is None or self.step < until):
                started = time.perf_counter()
                self._sphere.step()
                self.step = self._sphere.done
                self.seconds += time.perf_counter() - started
                on_record({"step": self.step, "loss": self._sphere.value, "seconds": self.seconds})
                release()

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load` needs to go on as if nothing had happened."""
        sphere = self._sphere
        numbers = {"value": sphere.value, "damping": sphere.damping, "done": sphere.done}
        return {
            "unknowns": sphere.unknowns,
            "seconds": self.seconds,
            **numbers,
            "cut": sphere.cut,
            "ended": sphere.ended,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        sphere, self.seconds = self._sphere, float(state["seconds"])
        for name in ("unknowns", "value", "damping", "done", "cut", "ended"):
            setattr(sphere, name, state[name])
        sphere.lower, self.step = sphere.lower[: len(sphere.unknowns)], sphere.done
