"""Pose search: bodies of known rest shape on straight paths that explain the shadows of several times, one after the
other (matching pursuit: Mallat & Zhang 1993, IEEE Trans. Signal Process. 41, 3397), and then all together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from ..mesh import TriangleMesh
from .shadows import Shadows
from .templates import Search, Templates

ROUNDED = 3.0
"""Standard deviations from which on a misfit counts by its size, no longer by its square: shadows of other bodies."""
MODEL_ERROR = 0.15
"""What the search expects affine bodies to miss of a shadow [radii of the ball of their volume], at least."""
STRAIN = 0.02
"""Cost of a squared strain of one, and of a turn by a radian, as a share of what the body casts."""
LEAST, ALSO = 0.35, 0.8
"""Share of what its shadow is worth by which a body must explain the frames; and share of the best one's from which on
others are taken in the same round."""
TRIED, FIRST_STEPS, STEPS, LAST_STEPS = 4, 8, 5, 15
"""Places that are tried in a round, and steps of the search for better poses: of one, of all, of all in the end."""
SURE, LOOKS = 0.8, 3
"""Share below which a body may stand for others, and how often that is looked into."""
SAME_HEIGHT = 1.0
"""Radii within which bodies that two beams might exchange are at one height."""
MOST_ROUNDS = 60
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
        """Where points `rest` [P, 3] about the centre are at a time, [P, 3]; turns are taken to be small."""
        away = rest @ self.matrix.T
        return away + time * np.cross(self.turning, away) + self.centre + time * self.velocity

    def scaled(self, factor: float) -> Pose:
        """The same in another unit of length."""
        return replace(self, centre=factor * self.centre, velocity=factor * self.velocity)


class Explained:
    """What bodies of one rest shape leave of shadows, and what they cost."""

    def __init__(self, mesh: TriangleMesh, seen: Shadows) -> None:
        radius = (3 * mesh.volume / (4 * np.pi)) ** (1 / 3)
        self.mesh, self.seen = mesh, seen
        self.noise = max(seen.noise, MODEL_ERROR * radius)
        self.target, self.rest = torch.from_numpy(seen.thickness), torch.from_numpy(mesh.vertices)
        self.radius = float(self.rest.norm(dim=1).mean())
        self.instants = np.unique(seen.times)
        self.worth = STRAIN * mesh.volume ** (4 / 3) * len(seen) / self.noise**2

    def beside(self, images: np.ndarray) -> Explained:
        """The same beside matter that casts `images` [N, H, W]."""
        return Explained(self.mesh, self.seen.without(images))

    def cost(self, left: Tensor | np.ndarray) -> Tensor:
        """Of shadows [N, H, W] that are left, in likelihoods: squares, but of large misfits their size."""
        width = ROUNDED * self.noise
        return ((torch.as_tensor(left).square() + width**2).sqrt() - width).sum() * width / self.noise**2

    def images(self, poses: Sequence[Pose]) -> np.ndarray:
        """Thickness [N, H, W] of bodies in `poses`."""
        if not poses:
            return np.zeros_like(self.seen.thickness)
        with torch.no_grad():
            return self._project(_parts(poses)).numpy()

    def share(self, pose: Pose) -> float:
        """What the pose explains of the shadows, over what it would of its own: 1 for a body that is there alone."""
        images = self.images([pose])
        gain = self.cost(self.target) - self.cost(self.seen.thickness - images)
        return float(gain / self.cost(images).clamp_min(1.0))

    def improved(self, poses: Sequence[Pose], steps: int) -> list[Pose]:
        """Poses that explain more, by so many steps of L-BFGS."""
        if not poses:
            return []
        first = _parts(poses)

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
            strain = parts[0].mT @ parts[0] - torch.eye(3, dtype=u.dtype)
            total = self.worth * (strain.square().sum() + parts[3].square().sum())
            total = total + self.cost(self.target - self._project(parts))
            (gradient,) = torch.autograd.grad(total, u)
            return float(total.detach()), gradient.numpy().ravel()

        start = np.zeros(NUMBERS * len(poses))
        found = minimize(value, start, jac=True, method="L-BFGS-B", options={"maxiter": steps})
        return _poses(moved(torch.from_numpy(found.x.reshape(-1, NUMBERS))))

    def _project(self, parts: Parts) -> Tensor:
        matrices, centres, velocity, turning = parts
        own = torch.from_numpy(self.mesh.faces)
        faces = torch.cat([own + len(self.rest) * k for k in range(len(matrices))])
        away = torch.einsum("bij,pj->bpi", matrices, self.rest)
        turned = torch.linalg.cross(turning[:, None].expand_as(away), away)
        nodes = {t: (away + t * turned + (centres + t * velocity)[:, None]).flatten(0, 1) for t in self.instants}
        return self.seen.project([nodes[t] for t in self.seen.times], faces)


def pursued(
    mesh: TriangleMesh, seen: Shadows, velocities: np.ndarray, begun: Sequence[Pose] = ()
) -> tuple[list[Pose], bool]:
    """Poses of all bodies of the rest shape `mesh` [pixels] that shadows show, on paths near `velocities` [K, 3].

    begun: poses that are known about; the search is done with and without them. The other value: whether those explain
    more that began with them.
    """
    search, every = Search(Templates.of(mesh, seen), seen, velocities), Explained(mesh, seen)
    found = _searched(every, search, [])
    if not begun:
        return found, False
    other = _searched(every, search, every.improved(begun, LAST_STEPS))
    costs = [float(every.cost(every.seen.thickness - every.images(poses))) for poses in (found, other)]
    return (other, True) if costs[1] < costs[0] else (found, False)


def _searched(every: Explained, search: Search, begun: list[Pose]) -> list[Pose]:
    """`begun` and what is found beside them, without those that explain nothing."""
    found = _more(every, search, [pose for k, pose in enumerate(begun) if _share(every, begun, k) >= LEAST])
    found = _second_look(every, search, exchanged(every, search, every.improved(found, LAST_STEPS)))
    return [pose for k, pose in enumerate(found) if _share(every, found, k) >= LEAST]


def _more(every: Explained, search: Search, found: list[Pose], without: Sequence[np.ndarray] = ()) -> list[Pose]:
    """`found`, and those that explain what these leave, one round after the other; the first one not near `without`."""
    left = every.beside(every.images(found))
    for turn in range(MOST_ROUNDS):
        tried = list[tuple[float, Pose]]()
        for hit in search.tops(left.seen, TRIED, without if turn == 0 else ()):
            start = Pose(hit.matrix, hit.centre, hit.velocity, np.zeros(3))
            (pose,) = left.improved([start], FIRST_STEPS)
            tried.append((left.share(pose), pose))
        tried.sort(key=lambda pair: -pair[0])
        if not tried or tried[0][0] < LEAST:
            break
        least = max(LEAST, ALSO * tried[0][0])
        for _, pose in tried:
            if left.share(pose) >= least:
                found = [*found, pose]
                left = left.beside(left.images([pose]))
        found = every.improved(found, STEPS)
        left = every.beside(every.images(found))
    return found


def _second_look(every: Explained, search: Search, found: list[Pose]) -> list[Pose]:
    """The bodies without those that explain least, where others in their place explain more.

    What was found first may have been taken for the shadows of several bodies, or for their crossing.
    """
    for _ in range(LOOKS):
        shares = [_share(every, found, k) for k in range(len(found))]
        if not shares or min(shares) >= SURE:
            break
        worst = int(np.argmin(shares))
        others = [pose for k, pose in enumerate(found) if k != worst]
        again = every.improved(_more(every, search, others, [found[worst].centre]), STEPS)
        costs = [float(every.cost(every.seen.thickness - every.images(poses))) for poses in (found, again)]
        if costs[1] >= costs[0]:
            break
        found = exchanged(every, search, again)
    return found


def exchanged(every: Explained, search: Search, found: list[Pose]) -> list[Pose]:
    """The same bodies, pairs of which have exchanged what two beams show of them where that explains more.

    Two beams see two bodies at one height as they would see two others, each in the shadow of the one in the first
    beam and of the other in the second. Their shapes and motion tell which they are; pairs that explain enough (`SURE`)
    are left as they are.
    """
    seen, directions = every.seen, np.unique(search.templates.directions, return_index=True)[1]
    if len(directions) != 2 or len(found) < 2:
        return found
    first, second = (seen.rotations[int(n)].numpy() for n in directions)
    height = np.cross(first[2], second[2]) / np.linalg.norm(np.cross(first[2], second[2]))
    found, sure = list(found), [_share(every, found, k) >= SURE for k in range(len(found))]
    for i in range(len(found)):
        for j in range(i):
            if (sure[i] and sure[j]) or abs((found[i].centre - found[j].centre) @ height) > SAME_HEIGHT * every.radius:
                continue
            left = every.beside(every.images([pose for k, pose in enumerate(found) if k not in (i, j)]))
            pair = [found[i], found[j]]
            others = []
            for one, other in (pair, pair[::-1]):
                both = np.concatenate([first[:2], second[:2]])
                moved = [
                    np.linalg.lstsq(both, np.concatenate([first[:2] @ a, second[:2] @ b]), rcond=1e-9)[0]
                    for a, b in ((one.centre, other.centre), (one.velocity, other.velocity))
                ]
                hit = search.here(left.seen, moved[0], moved[1])
                others.append(Pose(hit.matrix, hit.centre, hit.velocity, np.zeros(3)))
            others = left.improved(others, 2 * FIRST_STEPS)
            costs = [float(left.cost(left.seen.thickness - left.images(poses))) for poses in (pair, others)]
            if costs[1] < costs[0]:
                found[i], found[j] = others
    return every.improved(found, STEPS)


def _share(every: Explained, found: Sequence[Pose], number: int) -> float:
    """What a body explains of that which the others leave."""
    others = [pose for k, pose in enumerate(found) if k != number]
    return every.beside(every.images(others)).share(found[number])


def _unimodular(matrices: Tensor) -> Tensor:
    return matrices / torch.linalg.det(matrices).abs().clamp_min(1e-9)[:, None, None] ** (1 / 3)


def _parts(poses: Sequence[Pose]) -> Parts:
    names = ("matrix", "centre", "velocity", "turning")
    first, second, third, fourth = (torch.from_numpy(np.array([getattr(p, name) for p in poses])) for name in names)
    return first, second, third, fourth


def _poses(parts: Parts) -> list[Pose]:
    matrices, centres, velocity, turning = (part.detach().numpy() for part in parts)
    return [Pose(*numbers) for numbers in zip(matrices, centres, velocity, turning)]
