"""Pose search: affine bodies on straight paths that explain the shadows, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from ..mesh import TriangleMesh
from .shadows import Shadows
from .templates import Search, Templates

ROUNDED = 3.0
STRAIN = 0.02


@dataclass(frozen=True)
class Pose:
    """A body: vertices [P, 3] at the middle time, velocity [3], turning [3] (rotation vector), per unit of time."""

    nodes: np.ndarray
    velocity: np.ndarray
    turning: np.ndarray


class Explained:
    """What bodies of one mesh cost: the robust misfit of the shadows, and their strain."""

    def __init__(self, mesh: TriangleMesh, seen: Shadows, noise: float) -> None:
        self.mesh, self.seen, self.noise = mesh, seen, noise
        self.target = torch.from_numpy(seen.thickness)
        rest = torch.from_numpy(mesh.vertices - mesh.vertices.mean(0))
        self.rest, self.inverse = rest, torch.linalg.pinv(rest)
        self.radius = float(rest.norm(dim=1).mean())
        self.instants = np.unique(seen.times)
        self.scale = float((mesh.volume ** (4 / 3)) * len(seen) / noise**2)

    def faces(self, count: int) -> Tensor:
        own = torch.from_numpy(self.mesh.faces)
        return torch.cat([own + len(self.rest) * k for k in range(count)])

    def cost(self, left: Tensor) -> Tensor:
        width = ROUNDED * self.noise
        return ((left.square() + width**2).sqrt() - width).sum() * width / self.noise**2

    def nodes(self, matrices: Tensor, centres: Tensor, velocity: Tensor, turning: Tensor, time: float) -> Tensor:
        """[B P, 3] of bodies [B]: matrices [B, 3, 3] of determinant one on the rest shape."""
        away = torch.einsum("bij,pj->bpi", matrices, self.rest)
        away = away + time * torch.linalg.cross(turning[:, None].expand_as(away), away)
        return (away + (centres + time * velocity)[:, None]).flatten(0, 1)

    def project(self, parts: tuple[Tensor, Tensor, Tensor, Tensor]) -> Tensor:
        faces, nodes = self.faces(len(parts[0])), {}
        for time in self.instants:
            nodes[time] = self.nodes(*parts, float(time))
        return self.seen.project([nodes[time] for time in self.seen.times], faces)

    def strain(self, matrices: Tensor) -> Tensor:
        right = matrices.mT @ matrices
        return (right - torch.eye(3, dtype=right.dtype)).square().sum((1, 2))

    def parts(self, poses: Sequence[Pose]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        nodes = torch.from_numpy(np.array([pose.nodes for pose in poses]))
        centres = nodes.mean(1)
        matrices = unimodular(torch.einsum("pj,bpi->bij", self.inverse.mT, nodes - centres[:, None]))
        motion = [torch.from_numpy(np.array([getattr(p, name) for p in poses])) for name in ("velocity", "turning")]
        return matrices, centres, motion[0], motion[1]

    def poses(self, parts: tuple[Tensor, Tensor, Tensor, Tensor]) -> list[Pose]:
        matrices, centres, velocity, turning = parts
        nodes = torch.einsum("bij,pj->bpi", matrices, self.rest) + centres[:, None]
        return [Pose(n.numpy(), v.numpy(), w.numpy()) for n, v, w in zip(nodes, velocity, turning)]

    def improved(self, poses: Sequence[Pose], steps: int) -> tuple[list[Pose], float, float]:
        """Poses that explain more, their misfit and their strain's cost."""
        first = self.parts(poses)
        count, r = len(poses), self.radius

        def moved(u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            matrices = unimodular(first[0] @ (torch.eye(3, dtype=u.dtype) + u[:, :9].reshape(-1, 3, 3) / r))
            return matrices, first[1] + u[:, 9:12], first[2] + u[:, 12:15], first[3] + u[:, 15:18] / r

        def value(u: Tensor) -> tuple[Tensor, Tensor]:
            parts = moved(u)
            extra = self.strain(parts[0]).sum() + parts[3].square().sum()
            return self.cost(self.target - self.project(parts)), STRAIN * self.scale * extra

        def both(flat: np.ndarray) -> tuple[float, np.ndarray]:
            u = torch.from_numpy(flat.reshape(count, 18).copy()).requires_grad_()
            total = sum(value(u))
            total.backward()
            return float(total.detach()), u.grad.numpy().ravel()

        found = minimize(both, np.zeros(18 * count), jac=True, method="L-BFGS-B", options={"maxiter": steps})
        u = torch.from_numpy(found.x.reshape(count, 18))
        with torch.no_grad():
            misfit, extra = value(u)
            return self.poses(moved(u)), float(misfit), float(extra)

    def images(self, poses: Sequence[Pose]) -> np.ndarray:
        with torch.no_grad():
            return self.project(self.parts(poses)).numpy()


def unimodular(matrices: Tensor) -> Tensor:
    return matrices / torch.linalg.det(matrices).abs().clamp_min(1e-9)[:, None, None] ** (1 / 3)


def pursued(mesh, seen, velocities, noise, most=30, least=0.3, tries=4, say=lambda *a: None):
    templates = Templates.of(mesh, seen)
    search = Search(templates, seen, velocities)
    every, found = Explained(mesh, seen, noise), []
    left = seen
    say("templates", len(templates.nodes), templates.bin, templates.images.shape)
    while len(found) < most:
        tops = search.tops(left)[:tries]
        if not tops:
            break
        alone = Explained(mesh, left, noise)
        before = float(alone.cost(alone.target))
        tried = []
        for hit in tops:
            start = Pose(hit.nodes, hit.velocity, np.zeros(3))
            (pose,), misfit, strain = alone.improved([start], 8)
            own = float(alone.cost(torch.from_numpy(alone.images([pose]))))
            tried.append(((before - misfit - strain) / max(own, 1.0), pose))
        tried.sort(key=lambda pair: -pair[0])
        say(len(found), [round(t[0], 2) for t in tried], np.round(tried[0][1].nodes.mean(0), 1))
        if tried[0][0] < least:
            break
        taken = 0
        for share, pose in tried:
            images = alone.images([pose])
            before = float(alone.cost(torch.from_numpy(left.thickness)))
            gain = before - float(alone.cost(torch.from_numpy(left.thickness - images)))
            now = gain / max(float(alone.cost(torch.from_numpy(images))), 1.0)
            if share >= least and (taken == 0 or now > 0.8 * tried[0][0]):
                found.append(pose)
                left = left.without(images)
                taken += 1
        found, _, _ = every.improved(found, 5)
        left = seen.without(every.images(found))
        say("  taken", taken)
    found, misfit, strain = every.improved(found, 20)
    say("end", misfit, strain)
    return found
