"""The frames of several times, to be compared with a flow; and the same flow in richer bases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..fit.flow_volume import FlowProblem
from ..fit.smooth_volume import Descent
from ..fit.whitened import WhitenedFrames
from ..inference import Compared
from ..matter import DeltaBeta
from ..methods import Task
from ..optics.noise import NoiseModel
from ..representations import Flow, Lattice, TimeBasis
from ..scan import Scan


@dataclass(frozen=True)
class Frames:
    """The frames of each time, ready: scans [T] (training frames), times [T] [s], the noise of each, one material."""

    scans: Sequence[Scan]
    times: np.ndarray
    noise: Sequence[NoiseModel]
    material: DeltaBeta

    @classmethod
    def of(cls, task: Task, material: DeltaBeta) -> Frames:
        """The frames of a task of several times, corrected for uneven light."""
        times = task.scan.instants
        scans = [task.scan.at_instant(k) for k in range(len(times))]
        parts = [Task(scan, task.prior, light=task.light) for scan in scans]
        return cls(scans, times, [part.noise for part in parts], material)

    def whitened(self, k: int, factor: int, keep: np.ndarray | None = None) -> WhitenedFrames:
        """The frames of the time numbered k on pixels `factor` times larger; keep: [V] bool, which of them."""
        scan, noise = self.scans[k], self.noise[k]
        if keep is not None:
            index = np.flatnonzero(keep)
            scan, noise = scan[index], noise[torch.from_numpy(index)]
        return WhitenedFrames(scan.binned(factor), self.material, noise.binned(factor))


def merged(scan: Scan) -> Scan:
    """The mean of the frames of each pose over the times, as a scan of one time."""
    same = dict[bytes, list[int]]()
    for k in range(len(scan)):
        same.setdefault(scan.views[[k]].fingerprint(), []).append(k)
    if len(same) == len(scan):
        return scan.as_static()
    frames = np.stack([scan.frames[each].mean(axis=0) for each in same.values()])
    return replace(scan[[each[0] for each in same.values()]], frames=frames).as_static()


Masks = list[np.ndarray]
"""Of each time, which of its frames: [V] bool."""
WINDOW, PATIENCE = 10, 3
"""Iterations from one look at held-out frames to the next, and looks without a better one after which the fit ends."""


def kept_frames(counts: Sequence[int], held_out: int, seed: int, fold: int = 0) -> Masks:
    """Of each of the times, which have `counts` of frames, all frames but one in `held_out`, drawn at random, others in
    each `fold`; one a time at least."""
    keep, together = np.ones(sum(counts), dtype=bool), sum(counts) // held_out
    keep[np.random.default_rng(seed).permutation(len(keep))[fold * together : (fold + 1) * together]] = False
    found = np.split(keep, np.cumsum(counts)[:-1])
    for each in found:
        each[0] |= not each.any()
    return found


def others(keep: Masks) -> Masks:
    """The frames that `keep` leaves out."""
    return [~each for each in keep]


def iterations_that_predict(kept: FlowProblem, aside: FlowProblem, u: Tensor, most: int) -> tuple[int, float]:
    """How many iterations from `u` [Z, Y, X] on, fitted to the frames `kept`, predict those `aside` best; and what that
    takes from ½ χ² of these, beside the first look.

    A volume that follows noise predicts other frames worse, so the end of the fit is where the data put it (early
    stopping; Prechelt 1998), and not where the objective has its minimum. `most`: of them, at most.
    """
    descent, first = Descent(kept, u), min(WINDOW, most)
    best, least, begun = 0, np.inf, np.inf
    while descent.done < most and not descent.ended:
        descent.step()
        if descent.done % WINDOW and descent.done < most and not descent.ended:
            continue
        missed = sum(aside.misfit(descent.u))
        begun = missed if descent.done <= first else begun
        if missed < least:
            best, least = descent.done, missed
        elif descent.done >= best + PATIENCE * WINDOW:
            break
    return max(best, 1), float(begun - least) if best else 0.0


def likelihood_ratio(name: str, null: Tensor, other: Tensor) -> Compared:
    """The candidate `name`, which leaves `other` [F, H, W] of frames in units of their noise, beside the null.

    With known noise, the logarithm of the likelihood ratio `½ Σ (n² - o²)` has the standard deviation `√Σ (n - o)²`
    (Cox 1961, Proc. 4th Berkeley Symp. 1, 105). Noise counts as large as what is left, if that is more. Both are given
    per `Σ o²`: the gain is then the logarithm of the ratio of residuals, where these are nearly alike.
    """
    n, o = (images.double() for images in (null, other))
    left = float(o.square().sum())
    noise = max(1.0, left / o.numel()) ** 0.5
    return Compared(name, 0.5 * float((n.square().sum()).log() - np.log(left)), noise * float((n - o).norm()) / left)


Change = Callable[[Flow], Flow | None]
"""A flow in a richer basis; None for one that it does not suit."""


def freer_flows(extents: tuple[float, float, float], cells: tuple[int, int], most_degree: int) -> list[Change]:
    """Changes that are tried in turn: a higher degree in time each, then more cells in space.

    extents: of the field `(x, y, z)`; cells: along its longest edge, at first and at most.
    """
    degrees = [lambda f, d=d: of_degree(f, d) if f.basis.degree == d - 1 else None for d in range(1, most_degree + 1)]
    finer = [count for count in (3 * cells[0] // 2, 2 * cells[0]) if count <= cells[1]]
    return [*degrees, *(lambda f, c=c: on_lattice(f, Lattice.around(extents, c)) for c in finer)]


def of_degree(flow: Flow, degree: int) -> Flow:
    """The same flow in a basis of time of a higher degree, which holds it."""
    old = flow.basis
    basis = TimeBasis(old.first, old.last, degree, old.pieces)
    times = np.linspace(old.first, old.last, 4 * (basis.count + old.count))
    weights = old.weights(times)

    def raised(tensor: Tensor) -> Tensor:
        values = np.einsum("tk,k...->t...", weights, tensor.numpy())
        return torch.from_numpy(basis.fitted(times, values)).to(tensor)

    found = {name: raised(tensor) for name, tensor in flow.parameters().items()}
    return Flow(found["potential"], flow.lattice, basis, flow.reference, flow.steps, found.get("sources"))


def on_lattice(flow: Flow, lattice: Lattice) -> Flow:
    """The least-squares approximation of the same flow on another lattice, along each axis."""
    matrices = []
    for axis in range(3):
        count, first, cell = lattice.counts[2 - axis], lattice.first[axis], lattice.cell
        places = torch.linspace(first, first + cell * (count - 1), 8 * count, dtype=torch.float64)
        points = torch.zeros(len(places), 3, dtype=torch.float64)
        points[:, axis] = places
        old, new = (one.weights(points, axis, 0)[0] for one in (flow.lattice, lattice))
        matrices.append(torch.linalg.lstsq(new, old).solution)
    x, y, z = matrices

    def moved(tensor: Tensor) -> Tensor:
        return torch.einsum("...zyx,cz,by,ax->...cba", tensor.double(), z, y, x).to(tensor)

    found = {name: moved(tensor) for name, tensor in flow.parameters().items()}
    return Flow(found["potential"], lattice, flow.basis, flow.reference, flow.steps, found.get("sources"))
