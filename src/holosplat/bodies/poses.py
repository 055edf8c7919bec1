"""Poses of bodies of known rest shape on straight paths, and what they explain of the shadows of several times.

The two-view ambiguity: bodies whose shadows in two beams have the same size and tilt.
Parallel beams along d₁ and d₂ determine the second moments Q of a body up to one number: with N = d₁ d₂ᵀ + d₂ d₁ᵀ, the
shadows of Q + s N have the same moments for every s. Two of these have the same volume: s = 0, and
s = 2 a₁₂/(a₁₁ a₂₂ - a₁₂²), a = dᵢᵀ Q⁻¹ dⱼ (det(1 + s Q⁻¹ N) = (1 + s a₁₂)² - s² a₁₁ a₂₂ is one there). A search that
takes bodies for ellipsoids of a known volume finds the one or the other; finer details of the frames distinguish them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import torch
from torch import Tensor

from ..fit.run import Run
from ..geometry import Views
from ..mesh import TriangleMesh, ball_radius
from .shadows import Shadows

ROUNDED = 3.0
"""Standard deviations from which on a misfit counts by its size, no longer by its square: shadows of other bodies."""
MODEL_ERROR = 0.15
"""What the search expects affine bodies to miss of a shadow [radii of the ball of their volume], at least."""
STRAIN, FREER = 0.02, 0.001
"""Cost of a squared strain of one, and of a turn by a radian, as a share of what the body casts: while bodies are
found one after the other, when those that stand for several need larger strains; and then, for cells in flow have large
strains, and their shadows tell the wrong ones better where these cost little."""
HIDDEN = 0.15
"""Cost at one time of a body that one beam shows and another does not, as a share of what its shadow there would cost:
two of these explain what one body casts, and with more freedom."""
SHADOW = 0.2
"""Part of a body's largest thickness from which on a pixel is in its shadow."""
NUMBERS = 18
"""Unknowns of a pose: affine matrix, centre, velocity, turning."""

Parts = tuple[Tensor, Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class Pose:
    """A body x = M x₀ + c on a straight path. matrix: M [3, 3], of determinant one; centre: c [3] at time 0 [pixels];
    velocity [3] [pixels] and turning [3] (rotation vector) per unit of time, of which the scan has from -1 to 1."""

    matrix: np.ndarray
    centre: np.ndarray
    velocity: np.ndarray
    turning: np.ndarray

    def nodes(self, rest: np.ndarray, time: float) -> np.ndarray:
        """Places [P, 3] at a time of the points `rest` [P, 3] about the centre, for small rotations."""
        away = rest @ self.matrix.T
        return away + time * np.cross(self.turning, away) + self.centre + time * self.velocity

    def scaled(self, factor: float) -> Pose:
        """The same in another unit of length."""
        return replace(self, centre=factor * self.centre, velocity=factor * self.velocity)


class Explained:
    """The residual shadows of bodies of one rest shape, and their cost.

    strain: cost of a squared strain of one; run: whose step each improvement of poses is.
    """

    def __init__(self, mesh: TriangleMesh, seen: Shadows, strain: float = STRAIN, run: Run | None = None) -> None:
        radius = ball_radius(mesh.volume)
        self.mesh, self.seen, self.run = mesh, seen, run or Run()
        self.noise = max(seen.noise, MODEL_ERROR * radius)
        self.target, self.rest = torch.from_numpy(seen.thickness), torch.from_numpy(mesh.vertices)
        self.radius = float(self.rest.norm(dim=1).mean())
        self.instants = np.unique(seen.times)
        self.strain = strain
        self.worth = strain * mesh.volume ** (4 / 3) * len(seen) / self.noise**2

    @cached_property
    def shadow(self) -> float:
        """The cost of a whole shadow of the body at rest in a frame."""
        still = Pose(np.eye(3), *np.zeros((3, 3)))
        return float(self.cost(self.images([still]))) / len(self.seen)

    def beside(self, images: np.ndarray) -> Explained:
        """The same beside matter that casts `images` [N, H, W]."""
        return Explained(self.mesh, self.seen.without(images), self.strain, self.run)

    def without(self, poses: Sequence[Pose]) -> Explained:
        """The same beside bodies in `poses`."""
        return self.beside(self.images(poses))

    def cost(self, left: Tensor | np.ndarray) -> Tensor:
        """Of shadows [N, H, W] that are left, in likelihoods: squares, but of large misfits their size."""
        return self.cost_map(torch.as_tensor(left)).sum()

    def cost_map(self, left: Tensor) -> Tensor:
        """The same of each pixel of shadows [..., N, H, W]."""
        width = ROUNDED * self.noise
        return ((left.square() + width**2).sqrt() - width) * width / self.noise**2

    def images(self, poses: Sequence[Pose]) -> np.ndarray:
        """Thickness [N, H, W] of bodies in `poses`."""
        if not poses:
            return np.zeros_like(self.seen.thickness)
        with torch.no_grad():
            return self._project(_parts(poses)).numpy()

    def share(self, pose: Pose) -> float:
        """The explained part of the shadows over that of a body alone, which has 1."""
        images = self.images([pose])
        gain = self.cost(self.target) - self.cost(self.seen.thickness - images)
        return float(gain / self.cost(images).clamp_min(1.0))

    def shares(self, poses: Sequence[Pose]) -> np.ndarray:
        """[K]: what each body explains of that which the others leave, as `share`."""
        return self._shares(self.each(poses))

    def doubts(self, poses: Sequence[Pose]) -> np.ndarray:
        """[K]: what is left unexplained where each body casts its shadow, over the cost of that, and what is lacking of
        its share."""
        each = self.each(poses)
        left, own = self.cost_map(self.target - each.sum(0)), self.cost_map(each).sum((1, 2, 3)).clamp_min(1.0)
        dark = each > SHADOW * each.amax((1, 2, 3), keepdim=True)
        beside = ((left * dark).sum((1, 2, 3)) / own).numpy()
        return beside + (1 - self._shares(each)).clip(0.0)

    def _shares(self, each: Tensor) -> np.ndarray:
        left = self.target - each.sum(0)
        gains = [self.cost(left + one) - self.cost(left) for one in each]
        return np.array([float(gain / self.cost(one).clamp_min(1.0)) for gain, one in zip(gains, each)])

    def each(self, poses: Sequence[Pose]) -> Tensor:
        """[K, N, H, W] thickness of each body."""
        return torch.from_numpy(np.array([self.images([pose]) for pose in poses]).reshape(-1, *self.target.shape))

    def value(self, poses: Sequence[Pose]) -> float:
        """What is to be small: the cost of what `poses` leave, of their strains and turns, and of where they hide."""
        left = float(self.cost(self.seen.thickness - self.images(poses)))
        return left + self.strained(poses) + float(self.hidden(poses).sum())

    def hidden(self, poses: Sequence[Pose]) -> Tensor:
        """[K]: the cost of bodies that cast shadows in some beams and not in others; none at several times, whose paths
        tell such bodies."""
        if len(self.instants) > 1:
            return torch.zeros(len(poses), dtype=torch.float64)
        seen = self.each(poses).sum((2, 3)) / self.mesh.volume
        return HIDDEN * self.shadow * (seen.amax(1, keepdim=True) - seen).sum(1)

    def strained(self, poses: Sequence[Pose]) -> float:
        """The cost of strains and turns."""
        return float(self._strained(_parts(poses))) if poses else 0.0

    def improved(self, poses: Sequence[Pose], steps: int) -> list[Pose]:
        """Poses that explain more, by so many steps of L-BFGS."""
        return _poses(_unpacked(self.run.step("poses", lambda: self._better(_parts(poses), steps)))) if poses else []

    def _better(self, first: Parts, steps: int) -> Tensor:
        """The same of the parts of poses, packed."""
        from scipy.optimize import minimize  # which takes long to load

        def moved(u: Tensor) -> Parts:
            matrices = first[0] @ (torch.eye(3, dtype=u.dtype) + u[:, :9].reshape(-1, 3, 3) / self.radius)
            return (
                _unimodular(matrices),
                first[1] + u[:, 9:12],
                first[2] + u[:, 12:15],
                first[3] + u[:, 15:] / self.radius,
            )

        def value(flat: np.ndarray) -> tuple[float, np.ndarray]:
            u = torch.from_numpy(flat.reshape(-1, NUMBERS).copy()).requires_grad_()
            parts = moved(u)
            total = self._strained(parts) + self.cost(self.target - self._project(parts))
            (gradient,) = torch.autograd.grad(total, u)
            return float(total.detach()), gradient.numpy().ravel()

        start = np.zeros(NUMBERS * len(first[0]))
        found = minimize(value, start, jac=True, method="L-BFGS-B", options={"maxiter": steps})
        return _packed(moved(torch.from_numpy(found.x.reshape(-1, NUMBERS))))

    def _strained(self, parts: Parts) -> Tensor:
        strain = parts[0].mT @ parts[0] - torch.eye(3, dtype=parts[0].dtype)
        return self.worth * (strain.square().sum() + parts[3].square().sum())

    def _project(self, parts: Parts) -> Tensor:
        matrices, centres, velocity, turning = parts
        own = torch.from_numpy(self.mesh.faces)
        faces = torch.cat([own + len(self.rest) * k for k in range(len(matrices))])
        away = torch.einsum("bij,pj->bpi", matrices, self.rest)
        turned = torch.linalg.cross(turning[:, None].expand_as(away), away)
        nodes = {t: (away + t * turned + (centres + t * velocity)[:, None]).flatten(0, 1) for t in self.instants}
        return self.seen.project([nodes[t] for t in self.seen.times], faces)


def _unimodular(matrices: Tensor) -> Tensor:
    return matrices / torch.linalg.det(matrices).abs().clamp_min(1e-9)[:, None, None] ** (1 / 3)


def _parts(poses: Sequence[Pose]) -> Parts:
    names = ("matrix", "centre", "velocity", "turning")
    first, second, third, fourth = (torch.from_numpy(np.array([getattr(p, name) for p in poses])) for name in names)
    return first, second, third, fourth


def _packed(parts: Parts) -> Tensor:
    """[B, NUMBERS]."""
    return torch.cat([part.detach().flatten(1) for part in parts], dim=1)


def _unpacked(numbers: Tensor) -> Parts:
    matrices, centres, velocity, turning = numbers.split((9, 3, 3, 3), dim=1)
    return matrices.reshape(-1, 3, 3), centres, velocity, turning


def _poses(parts: Parts) -> list[Pose]:
    matrices, centres, velocity, turning = (part.detach().numpy() for part in parts)
    return [Pose(*numbers) for numbers in zip(matrices, centres, velocity, turning)]


ALIKE = 1e-4
"""Largest component of the difference of two directions that are one."""


def two_beams(views: Views) -> np.ndarray | None:
    """[2, 3] the directions of the beams, of either sense; None unless there are two."""
    found = list[np.ndarray]()
    for direction in views.rotations[:, 2]:
        if all(min(np.abs(direction - one).max(), np.abs(direction + one).max()) > ALIKE for one in found):
            found.append(direction)
    return np.array(found) if len(found) == 2 else None


def twin_of(second: np.ndarray, beams: np.ndarray) -> np.ndarray:
    """The second moments [3, 3] of the twin of a body of moments `second`, in their unit; beams: [2, 3]."""
    (a, b), (_, c) = beams @ np.linalg.inv(second) @ beams.T
    shear = np.outer(*beams)
    return second + 2 * b / (a * c - b**2) * (shear + shear.T)


def twin_map(second: np.ndarray, beams: np.ndarray) -> np.ndarray:
    """The matrix T [3, 3] of determinant one that takes a body of second moments `second` [3, 3] to its twin.

    Axes of the ellipsoid become those of the other one, in the order of their lengths, by the smallest turn.
    """
    (values, axes), (lengths, frame) = np.linalg.eigh(second), np.linalg.eigh(twin_of(second, beams))
    signs = [np.array(one) for one in product((1.0, -1.0), repeat=3)]
    turns = [(frame * sign) @ axes.T for sign in signs]
    sign = signs[int(np.argmax([np.trace(turn) if np.linalg.det(turn) > 0 else -np.inf for turn in turns]))]
    return (frame * sign * np.sqrt(lengths / values)) @ axes.T


def distance(second: np.ndarray, beams: np.ndarray) -> float:
    """How far a body of moments `second` [3, 3] is from its twin, over the root mean square of its extent.

    The Wasserstein distance of normal distributions of these moments (Givens & Shortt 1984, Michigan Math. J. 31, 231).
    """
    other, (values, axes) = twin_of(second, beams), np.linalg.eigh(second)
    root = (axes * np.sqrt(values)) @ axes.T
    common = np.sqrt(np.maximum(np.linalg.eigvalsh(root @ other @ root), 0)).sum()
    return float(np.sqrt(max(np.trace(second) + np.trace(other) - 2 * common, 0) / np.trace(second)))


def map_near(second: np.ndarray, beams: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Of all matrices [3, 3] that take a body of moments `second` to its twin, the one nearest to the matrix `near`.

    They are Q'^½ R Q^-½ of any rotation R: that of the polar decomposition of Q'^-½ `near` Q^½.
    """
    (before, less), (after, more) = _roots(second), _roots(twin_of(second, beams))
    left, _, right = np.linalg.svd(more @ near @ before)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return after @ turn @ less


def _roots(second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The symmetric square root of `second` [3, 3], and its inverse."""
    values, axes = np.linalg.eigh(second)
    return (axes * np.sqrt(values)) @ axes.T, (axes / np.sqrt(values)) @ axes.T
