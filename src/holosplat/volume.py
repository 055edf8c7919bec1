"""Matter: the `Volume` on a grid, the `Object` protocol that every model of matter answers, and known walls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

import numpy as np

from .checks import finite, require, shaped
from .display import of_volume
from .geometry import Grid, Poses, Views

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Volume:
    """The refractive index n = 1 - δ + iβ on a grid.

    delta, beta: [Z, Y, X] float32, dimensionless.
    grid: voxel size and place.

    Errors: `InputError` where the shapes are not that of the grid, and for values that are not finite.

    Examples:

        >>> import numpy as np
        >>> import holosplat as hs
        >>> grid = hs.Grid.centred((8, 8, 8), voxel_size=1e-6)
        >>> delta = np.zeros(grid.shape)
        >>> delta[2:6, 2:6, 2:6] = 5.8e-7
        >>> volume = hs.Volume(delta, delta / 2200, grid)
        >>> volume.delta.shape, volume.delta.dtype
        ((8, 8, 8), dtype('float32'))
    """

    delta: np.ndarray
    beta: np.ndarray
    grid: Grid

    def __post_init__(self) -> None:
        for name in ("delta", "beta"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            object.__setattr__(self, name, finite(name, shaped(name, array, self.grid.shape)))

    _repr_html_ = of_volume


@dataclass(frozen=True)
class LineIntegrals:
    """Line integrals along the beam by channels of matter; unpacks to `(B, D)`, of β and δ, each [V, H, W] in metres.

    channels: [V, C, H, W].
    materials: for each channel, the (δ, β) [m] that a unit of it integrates to: `D = Σ δ_c T_c`, `B = Σ β_c T_c`.
    """

    channels: torch.Tensor
    materials: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, B: torch.Tensor, D: torch.Tensor) -> LineIntegrals:
        """From the integrals of β and δ themselves, each [V, H, W] in metres."""
        import torch

        return cls(torch.stack((D, B), dim=1), ((1.0, 0.0), (0.0, 1.0)))

    @classmethod
    def of_any(cls, lines: LineIntegrals | tuple[torch.Tensor, torch.Tensor]) -> LineIntegrals:
        """From the projections of an `Object`: line integrals by channels, or the integrals `(B, D)` [V, H, W] in
        metres."""
        return lines if isinstance(lines, LineIntegrals) else cls.of(*lines)

    def __getitem__(self, index: int) -> torch.Tensor:
        """0: B, 1: D."""
        if not 0 <= index < 2:
            raise IndexError(index)
        factors = [material[1 - index] for material in self.materials]
        total = sum(f * channel for f, channel in zip(factors, self.channels.unbind(1)) if f != 0)
        return self.channels.new_zeros(self.channels[:, 0].shape) if isinstance(total, int) else total


@runtime_checkable
class Object(Protocol):
    """Anything made of matter: mesh scenes, voxel volumes, Gaussian clouds, and whatever moves."""

    def at(self, time: float) -> Object:
        """The object as it is at `time` [s]; a static one returns itself."""
        ...

    def project(self, views: Views, /) -> LineIntegrals | tuple[torch.Tensor, torch.Tensor]:
        """Line integrals `(B, D)` of β and δ along the beam, each [V, H, W] in metres, or `LineIntegrals`."""
        ...

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β averaged over (or sampled on) the voxels of `grid`."""
        ...


class Unmoved:
    """What objects have in common that do not move."""

    def at(self, time: float) -> Self:
        """The object itself."""
        return self


@runtime_checkable
class Component(Protocol):
    """A part of a model whose numbers can be fitted: they have names, and other ones can take their place."""

    def parameters(self) -> Mapping[str, torch.Tensor]:
        """The tensors that can be fitted, by name."""
        ...

    def with_parameters(self, parameters: Mapping[str, torch.Tensor]) -> Component:
        """The same part with other tensors in the place of those named; the others stay."""
        ...


@runtime_checkable
class TrainableObject(Object, Component, Protocol):
    """An Object whose numbers can be fitted; it projects poses without waiting for a device."""

    def with_parameters(self, parameters: Mapping[str, torch.Tensor]) -> TrainableObject:
        """The same object with other tensors in the place of those named."""
        ...

    def project(self, views: Views | Poses, /) -> LineIntegrals | tuple[torch.Tensor, torch.Tensor]:
        """Line integrals as of `Object`, differentiable in the parameters."""
        ...


def mean_wave(parts: torch.Tensor, absorbing: np.ndarray, refracting: np.ndarray) -> torch.Tensor:
    """Line integrals [2, V, H, W] of β and δ whose wave is the mean of those of `parts` [2, V, H, W, P] [m].

    At a flat face along the beam the phase jumps within a pixel, and the mean wave is not that of the mean phase.
    absorbing, refracting: k [V] for β and for δ at the frames' energies [1/m].
    """
    import torch

    middle = parts.mean(dim=-1)
    kb, kd = (torch.from_numpy(one).to(parts)[:, None, None] for one in (absorbing, refracting))
    b, d = parts - middle[..., None]
    amplitude, phase = torch.exp(-kb[..., None] * b), -kd[..., None] * d
    wave = torch.complex((amplitude * phase.cos()).mean(dim=-1), (amplitude * phase.sin()).mean(dim=-1))
    more = torch.stack((-wave.abs().clamp_min(DARKEST).log() / kb, -wave.angle() / kd))
    return middle + more


WAVES = 8
"""Parts of a pixel along its row, whose waves are joined."""
DARKEST = 1e-6
"""Least amplitude of a mean of waves, whose logarithm has no bound."""
FINER = 4
"""Points along a voxel's edge by which a wall's share of it is found."""
Section = tuple[float, float]
"""Extent along x and z [m]; of a circle both are the diameter."""


@dataclass(frozen=True)
class Wall(Unmoved):
    """A tube along y, or a channel in a slab that is larger than the field, of known place and matter; an `Object`.

    It has no ends. δ and β are differences from what lies outside of the wall.

    inner, outer: sections of the hollow and of the wall; outer None: the wall goes on for ever
    matter: (δ, β) of the wall, and filling: those of what fills the hollow, both against vacuum. It is vacuum outside,
        or the wall's matter where that goes on
    round: whether sections are circles; else rectangles
    centre: (x, z) of the middle [m]; turn: of the sections about y [rad], by the sense of `R(θ)` (docs/conventions.md)

    Errors: `InputError` for sections that are not positive, or an outer one that is not larger than the inner one.
    """

    inner: Section
    outer: Section | None
    matter: tuple[float, float]
    filling: tuple[float, float] = (0.0, 0.0)
    round: bool = False
    centre: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0

    def __post_init__(self) -> None:
        outer = self.outer or (np.inf, np.inf)
        require(
            all(0 < a < b for a, b in zip(self.inner, outer)),
            "a wall must have a hollow wider than 0 and a greater outer section, but they are "
            f"{self.inner} m and {self.outer} m; correct --wall.",
        )

    @property
    def inside(self) -> float:
        """Distance from the axis [m] beyond which there is nothing of the hollow."""
        half = 0.5 * (max(self.inner) if self.round else np.hypot(*self.inner))
        return float(half + np.hypot(*self.centre))

    @property
    def _parts(self) -> list[tuple[Section, np.ndarray]]:
        """Sections, and the (δ, β) that each adds to what is around it."""
        filled = [(self.inner, np.subtract(self.filling, self.matter))]
        return filled if self.outer is None else [(self.outer, np.array(self.matter, dtype=float)), *filled]

    def project(self, views: Views) -> tuple[torch.Tensor, torch.Tensor]:
        """Line integrals (B, D) [V, H, W] float64 [m], means over pixels along the rows of what its rays pass."""
        views.parallel("a wall in the beam")
        import torch

        shape = (2, len(views), *views.shape)
        B, D = torch.from_numpy(np.broadcast_to(self._lines(views, 0, 1), shape).copy())
        return B, D

    def behind(self, views: Views, absorbing: np.ndarray, refracting: np.ndarray) -> torch.Tensor:
        """Line integrals (B, D) [2, V, H or 1, W] float64 [m] of the mean wave in each pixel (`mean_wave`).

        H is 1 if all rows are alike.
        """
        import torch

        parts = np.stack([self._lines(views, n, WAVES) for n in range(WAVES)], axis=-1)
        return mean_wave(torch.from_numpy(parts), absorbing, refracting)

    def _lines(self, views: Views, part: int, parts: int) -> np.ndarray:
        """(B, D) [2, V, H or 1, W] [m], means over one of the `parts` of each pixel along its row."""
        across, up, along = (views.rotations[:, k, None, None] for k in range(3))
        level = np.hypot(along[..., 0], along[..., 2])
        dx, dz = along[..., 0] / level, along[..., 2] / level
        (rows, columns), sizes = views.shape, views.pixel_sizes[:, None, None]
        place = (part + 0.5) / parts - 0.5
        x = (np.arange(columns) - 0.5 * (columns - 1) + place) * sizes + views.shifts[:, :1, None]
        slope, tilt = (one[..., 0] * dz - one[..., 2] * dx for one in (across, up))
        beside = slope * x - (self.centre[0] * dz - self.centre[1] * dx)
        if not views.shares_axis:
            y = (np.arange(rows)[:, None] - 0.5 * (rows - 1)) * sizes + views.shifts[:, 1:, None]
            beside = beside + tilt * y
        turned = np.cos(self.turn), np.sin(self.turn)
        ray = np.abs(dx * turned[0] - dz * turned[1]), np.abs(dx * turned[1] + dz * turned[0])
        half, total = 0.5 * np.abs(slope) * sizes / parts, np.zeros((2, *beside.shape))
        for section, (delta, beta) in self._parts:
            left, right = (self._area(beside + side * half, section, ray) for side in (-1, 1))
            chord = (right - left) / (2 * half * level)
            total += np.array([beta, delta])[:, None, None, None] * chord
        return total

    def _area(self, s: np.ndarray, section: Section, ray: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Area [m²] of a section left of the line along `ray` (its parts along the sides) at a distance s from the
        middle, less half of it."""
        if self.round:
            radius = 0.5 * section[0]
            s = np.clip(s, -radius, radius)
            return s * np.sqrt(radius**2 - s**2) + radius**2 * np.arcsin(s / radius)
        wide, deep = 0.5 * section[0] * ray[1], 0.5 * section[1] * ray[0]
        reach, flat = wide + deep, np.abs(wide - deep)
        height = section[0] * section[1] / np.maximum(reach + flat, np.finfo(float).tiny)
        t = np.minimum(np.abs(s), reach)
        beyond = np.maximum(t - flat, 0)
        fall = np.maximum(reach - flat, np.finfo(float).tiny)
        return np.sign(s) * height * (t - 0.5 * beyond**2 / fall)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β, by the share of each voxel that lies in the wall and in the hollow."""
        total = np.zeros((2, grid.shape[0], 1, grid.shape[2]))
        for section, added in self._parts:
            total += added[:, None, None, None] * self._share(section, grid)
        delta, beta = (np.broadcast_to(part, grid.shape) for part in total)
        return Volume(delta, beta, grid)

    def content(self, volume: Volume) -> Volume:
        """What a `volume` has in the hollow, against the filling; zero in voxels that the wall touches, and beyond.

        A volume of all that is in the beam is nearer to the filling there than to nothing; any other is taken to be
        against the filling already.
        """
        grid = volume.grid
        wide, deep = self.inner[0] - grid.voxel_size[0], self.inner[1] - grid.voxel_size[2]
        hollow, known = self._share((wide, deep), grid) == 1, self.voxelise(grid)
        whole = volume.delta * hollow, volume.beta * hollow
        beside = whole[0] - known.delta * hollow, whole[1] - known.beta * hollow
        return Volume(*(beside if np.linalg.norm(beside[0]) < np.linalg.norm(whole[0]) else whole), grid)

    def _share(self, section: Section, grid: Grid) -> np.ndarray:
        """Share [Z, 1, X] of each voxel that lies in a section."""
        x, _, z = grid.axes()
        steps = (np.arange(FINER) + 0.5) / FINER - 0.5
        fine = [
            (np.asarray(places)[:, None] + size * steps).ravel()
            for places, size in ((x, grid.voxel_size[0]), (z, grid.voxel_size[2]))
        ]
        px, pz = fine[0][None] - self.centre[0], fine[1][:, None] - self.centre[1]
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        u, v = px * cos - pz * sin, px * sin + pz * cos
        wide, deep = section
        within = u**2 + v**2 <= (0.5 * wide) ** 2 if self.round else (abs(u) <= 0.5 * wide) & (abs(v) <= 0.5 * deep)
        return within.reshape(len(z), FINER, len(x), FINER).mean(axis=(1, 3))[:, None]
