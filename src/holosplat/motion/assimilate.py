"""A flow of cells fitted to holograms of several times: its numbers, and the state that it begins with (4D-Var).

The model is a strong constraint: between the first time and the last nothing but its mechanics moves the cells. Frames
of all times then tell a few numbers: the peak of the flow, the shear modulus, and how each cell is off at the first
time. The loss is minus the logarithm of the probability, of noise and of what is known before; its gradient goes back
through the waves, the surface projector and all time steps (Le Dimet & Talagrand 1986, Tellus A 38, 97).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from ..checks import require
from ..matter import Matter
from ..mesh import TriangleMesh, joined
from ..metrics.volumes import normal_distance
from ..model import Instrument, Model
from ..ranges import Natural, Positive, ranged
from ..representations import SurfaceMesh
from ..scan import Scan
from .cell_model import CellModel, Range
from .detections import beside, only
from .dynamics import Window
from .forecast import Forecast
from .membrane_fit import Bound, CellFlow, Unknowns, advanced

AFFINE = 12
"""Numbers of a cell's first state: how far it is moved, and its linear map."""
FINE = 4
"""By how much steps are shortened, which nothing checks here."""
CHANGE = 0.05
"""Of a whitened unknown, in differences of gradients: far above the rounding of frames."""
MOST_UNKNOWNS = 64
"""Up to which the curvature is computed, by a gradient for each."""
MEDIAN = 1.4826
"""Standard deviation over the median of absolute values, of a normal distribution."""


@dataclass(frozen=True)
@ranged
class Assimilation:
    """How a flow is fitted to frames."""

    peak: Range
    """Of the flow [m/s], two standard deviations below and above; equal: known."""
    shear: Range = (2e-6, 10e-6)
    """Skalak's modulus [N/m], likewise."""
    state: Positive = 0.1e-6
    """Standard deviation of the first state: how far a cell may be moved, or its surface by a linear map [m]."""
    oversample: Natural = 2
    """Wave samples a pixel: the gradient of a surface is right to second order in their distance."""
    steps: Natural = 20
    """Of L-BFGS, at most."""
    curvature: bool = True
    """Whether to compute standard errors from the curvature at the end, where unknowns are few enough."""

    def __post_init__(self) -> None:
        for name, (low, high) in (("peak", self.peak), ("shear", self.shear)):
            require(
                0 < low <= high, f"{name} must be a range LOW:HIGH above 0, but it is {low:g}:{high:g}; correct it."
            )

    def unknowns(self, cells: int) -> int:
        """How many there are of so many cells."""
        return sum(low < high for low, high in (self.peak, self.shear)) + AFFINE * cells


@dataclass(frozen=True)
class Assimilated:
    """A flow estimated from frames.

    unknowns: peak and modulus; told: standard errors after over those before, by name (1: nothing; absent: given, or
    not computed); meshes: the cells [m] at the first time; places: of each cell [T, Q, 3] [m] at the scan's times;
    losses: of the start and the end.
    """

    unknowns: Unknowns
    told: dict[str, float]
    meshes: list[TriangleMesh]
    places: list[np.ndarray]
    losses: tuple[float, float]


def assimilate(
    scan: Scan, model: CellModel, meshes: Sequence[TriangleMesh], matter: Matter, options: Assimilation
) -> Assimilated:
    """The flow that explains the frames of `scan`, of several times, from cells that are about `meshes` at the first.

    matter: of the cells, alike in all. Errors: `InputError` for frames of one time.
    """
    require(len(scan.instants) > 1, "a flow is fitted to frames of two times or more, but there is one.")
    fit = _Fit.of(scan, model, meshes, matter, options)
    start = np.zeros(fit.size)
    first = fit(start)[0]
    found = minimize(fit, start, jac=True, method="L-BFGS-B", options={"maxiter": options.steps})
    told = fit.told(found.x) if options.curvature and fit.size <= MOST_UNKNOWNS else {}
    with torch.no_grad():
        unknowns, nodes = fit.meant(torch.from_numpy(found.x))
        ways = fit.ways(unknowns, nodes)
    outward = model.frame.outward
    places = [np.array([outward(one.places(at[c]).numpy()) for at in ways]) for c, one in enumerate(fit.bound)]
    moved = [TriangleMesh(way[0], mesh.faces, mesh.name) for way, mesh in zip(places, meshes)]
    return Assimilated(unknowns, told, moved, places, (first, float(found.fun)))


@dataclass(frozen=True)
class _Fit:
    """The loss of whitened unknowns [N], and its gradient."""

    scan: Scan
    model: CellModel
    flow: CellFlow
    nodes: Tensor
    bound: list[Bound]
    faces: Tensor
    matter: Matter
    middle: dict[str, float]
    widths: dict[str, float]
    state: float
    noise: float
    instruments: list[Instrument]

    @classmethod
    def of(
        cls, scan: Scan, model: CellModel, meshes: Sequence[TriangleMesh], matter: Matter, options: Assimilation
    ) -> _Fit:
        flow, nodes, bound = model.dressed(meshes)
        faces = torch.from_numpy(joined(meshes).faces)
        ranges = {"peak": options.peak, "shear": options.shear}
        middle = {name: float(np.sqrt(low * high)) for name, (low, high) in ranges.items()}
        widths = {n: 0.25 * float(np.log(high / low)) for n, (low, high) in ranges.items() if high > low}
        at_each = [np.flatnonzero(scan.exposures.time == t) for t in scan.instants]
        instruments = [Instrument(scan.exposures[kept], options.oversample) for kept in at_each]
        rest = (scan, model, flow, nodes, bound, faces, matter, middle, widths, options.state)
        rough = cls(*rest, 1.0, instruments)
        with torch.no_grad():
            misses = torch.cat([miss.ravel() for miss in rough.misses(*rough.meant(torch.zeros(rough.size)))])
        return cls(*rest, MEDIAN * float(misses.abs().median()), instruments)

    @property
    def size(self) -> int:
        """How many unknowns there are."""
        return len(self.widths) + AFFINE * len(self.nodes)

    def meant(self, white: Tensor) -> tuple[Unknowns, Tensor]:
        """The numbers and the first nodes [C, P, 3] [m] of whitened unknowns [N]."""
        common = {name: torch.tensor(value, dtype=torch.float64) for name, value in self.middle.items()}
        for value, (name, width) in zip(white.double(), self.widths.items()):
            common[name] = common[name] * torch.exp(width * value)
        own = self.state * white.double()[len(self.widths) :].reshape(-1, AFFINE)
        about = (self.nodes - self.nodes.mean(1, keepdim=True)) / self.model.radius
        linear = torch.einsum("cxy,cpy->cpx", own[:, 3:].reshape(-1, 3, 3), about)
        return Unknowns(**common), self.nodes + own[:, None, :3] + linear

    def ways(self, unknowns: Unknowns, nodes: Tensor) -> list[Tensor]:
        """The nodes at each of the scan's times."""
        times, found, steps = self.scan.instants, [nodes], self.model.steps(self.middle["peak"], FINE)
        for wait in np.diff(times):
            velocity = lambda places: self.flow.velocity(places, unknowns)  # noqa: E731
            found.append(advanced(velocity, found[-1], float(wait), *steps))
        return found

    def misses(self, unknowns: Unknowns, nodes: Tensor) -> list[Tensor]:
        """Residuals of the frames of each time [V, H, W]."""
        found, unit = [], self.scan.views.finest
        for time, at, instrument in zip(self.scan.instants, self.ways(unknowns, nodes), self.instruments):
            vertices = torch.cat([self.model.frame.outside(one.places(x)) for one, x in zip(self.bound, at)])
            surfaces = SurfaceMesh(vertices / unit, self.faces, unit, self.matter)
            measured = torch.from_numpy(self.scan.frames[self.scan.exposures.time == time])
            found.append(Model(surfaces, instrument).frames() - measured)
        return found

    def __call__(self, white: np.ndarray) -> tuple[float, np.ndarray]:
        """Loss and gradient [N]."""
        unknown = torch.from_numpy(white.copy()).requires_grad_()
        parts = [(miss.double() / self.noise).square().sum() for miss in self.misses(*self.meant(unknown))]
        loss = 0.5 * (sum(parts) + unknown.square().sum())
        (gradient,) = torch.autograd.grad(loss, unknown)
        return float(loss.detach()), gradient.numpy().copy()

    def told(self, white: np.ndarray) -> dict[str, float]:
        """Standard errors of the common unknowns over those before: roots of the inverse of the loss's curvature."""
        here = self(white)[1]
        rows = [(self(white + step)[1] - here) / CHANGE for step in CHANGE * np.eye(self.size)]
        curvature = 0.5 * (np.array(rows) + np.array(rows).T)
        values, axes = np.linalg.eigh(curvature)
        inverse = (axes / np.maximum(values, 1.0)) @ axes.T  # what is known before is never lost
        return {name: float(np.sqrt(inverse[k, k])) for k, name in enumerate(self.widths)}


SAME = 1e-3
"""Share of a step within which two times are one."""
STEPS = 20
"""Of L-BFGS, at most."""


def carry_by_frames(window: Window, train: Scan, oversample: int) -> Forecast:
    """The cells of `window`, fitted to its frames and carried on; told: what was found of the flow.

    train: frames of the run, relative to the light, of which those of the window's times are taken, without what all
    other bodies predict of them; oversample: wave samples a pixel. The band has the part of the state, as fits to
    halves tell it, and how far the model ends from the surfaces that were tracked, growing with time.
    """
    slack = SAME * float(np.diff(window.past).min())
    frames = train[np.flatnonzero(train.exposures.time >= window.past[0] - slack)]
    others = [k for k in range(window.bodies.count) if k not in window.cells]
    if others:
        frames = beside(frames, only(window.bodies, others), oversample)
    options = Assimilation(window.peak, window.options.shear, oversample=oversample, steps=STEPS)
    start = window.meshes(0)
    found = assimilate(frames, window.model, start, window.bodies.matter, options)
    later = window.model.run(found.meshes, np.r_[window.past[0], window.every], found.unknowns)
    later = [own[1:] for own in later]
    pairs = zip(later, window.meshes(-1))
    left = np.array([normal_distance(TriangleMesh(own[0], seen.faces), seen) for own, seen in pairs])
    said = found.unknowns.as_dict(found.told) | {"loss_before": found.losses[0], "loss_after": found.losses[1]}
    if (count := options.unknowns(len(start))) > MOST_UNKNOWNS:
        said["unasked"] = float(count)
    return replace(window.gone_on(later, left), told=said)
