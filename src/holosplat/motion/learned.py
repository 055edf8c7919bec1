"""Bodies go on by a graph network that learnt from cells which `holosplat grow` let flow.

Encode, process, decode (Sanchez-Gonzalez et al. 2020, ICML; Pfaff et al. 2021, ICLR) on nodes spread over each body,
with edges to near nodes of the same body and of others. Features are scalars and vectors, and vectors are only scaled
and added (Schütt et al. 2021, ICML, 9377), so that a turned or shifted scene gives a turned or shifted forecast. What
is decoded is no step but the displacement over the whole horizon, a polynomial of time: nothing adds up over steps.

Lengths are in radii of a ball of the body's volume, times in the length of the window that the network sees. A window
is given by Legendre polynomials of degree `DEGREE`, which paths of flowing cells follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.polynomial import legendre
from torch import Tensor, nn

from ..checks import require
from ..learning.start import Card, read_network, write_network
from ..mesh import TriangleMesh, ball_radius
from ..ranges import ManyOrNone, Natural, ranged
from ..specimens.flow.suspension import PLASMA_VISCOSITY
from ..specimens.membrane.model import Elasticity
from .elastic import vertex_normals
from .forecast import Forecast, History, Model, error_at_end, of_kept_volume, on_paths, places_of

SHIPPED, VERSION = Path(__file__).with_name("flowing_cells.safetensors"), "dynamics 1"
DEGREE = 4
"""Of the polynomials of the window: what paths of flowing cells over 24 µm of way leave is a nanometre."""
POWERS = 5
"""Of the horizon in what is decoded, from 0 on."""
SPREADS = 4
"""Of the horizon in the standard error."""
NODES, NEAR, OTHERS = 162, 8, 4
"""Nodes of a body, and edges that come to each from its own body and from others."""
WORLD = 1.0
"""Radii within which nodes of other bodies are seen."""
LONGEST = 1.2
"""Windows ahead, at most: no longer horizon was trained on."""
LEAST_SPREAD = 1e-4
"""Standard error [radii] of which a node is always thought."""
RELAXATION = PLASMA_VISCOSITY / Elasticity().skalak_shear
"""Viscosity over shear modulus of healthy cells [s/m]: times a radius, the time in which a shape relaxes."""
CHANNELS, SCALARS = 2 * DEGREE + 2, 3
"""Vectors of a node: its own coefficients about the body's middle, the middle's without its place, the normal."""
QUICK = 0.1
"""Scale of the middle's coefficients, which go many radii in a window."""


@dataclass(frozen=True)
@ranged
class DynamicsSize:
    """How large the network is."""

    scalars: Natural = 64
    """Scalars of a node."""
    vectors: Natural = 32
    """Vectors of a node."""
    layers: Natural = 5
    """Messages that each node gets."""


@dataclass(frozen=True)
class Scene:
    """Bodies as the network sees them.

    own: [B, n, D + 1, 3] radii, coefficients of nodes about their body's middle; middle: [B, D + 1, 3] radii, of the
    middles, of which the first is relative to the first body's; normals: [B, n, 3]; said: [B, SCALARS]; edges: [2, E]
    numbers of nodes, to and from; foreign: [E] whether an edge is of two bodies.
    """

    own: Tensor
    middle: Tensor
    normals: Tensor
    said: Tensor
    edges: Tensor
    foreign: Tensor

    @classmethod
    def of(cls, own: Tensor, middle: Tensor, normals: Tensor, wait: Tensor, noise: Tensor) -> Scene:
        """wait: [B], the window over the time in which a cell's shape relaxes; noise: [B] radii, standard error."""
        way = middle[:, 1].norm(dim=-1)
        said = torch.stack([torch.log(wait), torch.log(noise + 1e-3), torch.log(way + 0.1)], dim=-1)
        edges, foreign = _edges(own.sum(2), middle.sum(1))
        return cls(own, middle, normals, said, edges, foreign)


def _edges(local: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
    """Edges [2, E] to each node from the nearest at the window's end, and which are of two bodies."""
    bodies, count, _ = local.shape
    apart = torch.cdist(local, local)
    apart.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    near = apart.topk(min(NEAR, count - 1), largest=False).indices
    offset = torch.arange(bodies, device=local.device)[:, None, None] * count
    to = torch.arange(bodies * count, device=local.device).reshape(bodies, count, 1).expand_as(near)
    own = torch.stack([to.reshape(-1), (near + offset).reshape(-1)])
    reach = local.norm(dim=-1).amax(1)
    between = torch.cdist(middle, middle) - reach - reach[:, None]
    one, other = torch.nonzero(between.fill_diagonal_(torch.inf) < WORLD, as_tuple=True)
    if not len(one):
        return own, torch.zeros(own.shape[1], dtype=torch.bool, device=own.device)
    apart = torch.cdist(local[one], local[other] + (middle[other] - middle[one])[:, None])
    far, from_ = apart.topk(min(OTHERS, count), largest=False)
    pair, node, which = torch.nonzero(far < WORLD, as_tuple=True)
    seen = torch.stack([one[pair] * count + node, other[pair] * count + from_[pair, node, which]])
    foreign = torch.arange(own.shape[1] + seen.shape[1], device=own.device) >= own.shape[1]
    return torch.cat([own, seen], dim=1), foreign


def _mlp(*widths: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for a, b in pairwise(widths):
        layers += [nn.Linear(a, b), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


class _Message(nn.Module):
    """What nodes hear of their neighbours, and what they make of it."""

    def __init__(self, size: DynamicsSize) -> None:
        super().__init__()
        f, v = size.scalars, size.vectors
        self.vectors = v
        self.heard = _mlp(2 * f + v + 2, f, f + v + 1)
        self.mix = nn.Linear(2 * v, v, bias=False)
        self.made = _mlp(2 * f + 2 * v, f, f + v)
        self.whole = nn.Linear(f, f)

    def forward(self, s: Tensor, v: Tensor, scene: Scene, way: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """s: [N, F]; v: [N, 3, V]; way: [E, 3] from the node to its neighbour [radii]; far: [E, 2]."""
        to, from_ = scene.edges
        change = v[from_] - v[to]
        along = torch.einsum("ex,exv->ev", way, change)
        said = self.heard(torch.cat([s[to], s[from_], along, far], dim=-1))
        scalars, gates, push = said.split([s.shape[1], self.vectors, 1], dim=-1)
        count = torch.zeros_like(s[:, :1]).index_add(0, to, torch.ones_like(far[:, :1]))
        heard = torch.zeros_like(s).index_add(0, to, scalars) / count
        moved = (
            torch.zeros_like(v).index_add(0, to, change * gates[:, None] + (way * push)[..., None]) / count[..., None]
        )
        bodies, nodes = scene.own.shape[:2]
        whole = self.whole(s.reshape(bodies, nodes, -1).mean(1)).repeat_interleave(nodes, 0)
        both = self.mix(torch.cat([v, moved], dim=-1))
        lengths = (both.square().sum(1) + 1e-8).sqrt()
        inner = (both * moved).sum(1)
        scalars, gates = self.made(torch.cat([s, heard + whole, lengths, inner], dim=-1)).split(
            [s.shape[1], self.vectors], dim=-1
        )
        return s + scalars, v + both * gates[:, None]


class Dynamics(nn.Module):
    """From a `Scene` to displacements and their standard errors."""

    def __init__(self, size: DynamicsSize = DynamicsSize()) -> None:
        super().__init__()
        self.size = size
        self.start = nn.Linear(CHANNELS, size.vectors, bias=False)
        self.embed = _mlp(size.vectors + SCALARS, size.scalars, size.scalars)
        self.messages = nn.ModuleList(_Message(size) for _ in range(size.layers))
        self.gates = _mlp(size.scalars, size.scalars, POWERS * size.vectors)
        self.spread = _mlp(size.scalars, size.scalars, SPREADS)
        self.skip = nn.Linear(CHANNELS, POWERS, bias=False)
        with torch.no_grad():
            for layer in (self.skip, self.gates[-1], self.spread[-1]):
                for name, value in layer.named_parameters():
                    value.fill_(-3.0 if layer is self.spread[-1] and name == "bias" else 0.0)

    def forward(self, scene: Scene) -> tuple[Tensor, Tensor]:
        """Coefficients [B, n, POWERS, 3] [radii] of the horizon's powers, beside what `base` says and `direct` adds,
        and of the standard error [B, n, SPREADS] [radii]."""
        bodies, nodes = scene.own.shape[:2]
        v = self.start(_vectors(scene.own, scene.middle, scene.normals).flatten(0, 1))
        lengths = (v.square().sum(1) + 1e-8).sqrt()
        s = self.embed(torch.cat([lengths, scene.said.repeat_interleave(nodes, 0)], dim=-1))
        places = (scene.own.sum(2) + scene.middle.sum(1)[:, None]).flatten(0, 1)
        way = places[scene.edges[1]] - places[scene.edges[0]]
        far = torch.stack([way.norm(dim=-1), scene.foreign.to(way.dtype)], dim=-1)
        for message in self.messages:
            s, v = message(s, v, scene, way, far)
        gates = self.gates(s).reshape(-1, POWERS, self.size.vectors)
        found = torch.einsum("npv,nxv->npx", gates, v).reshape(bodies, nodes, POWERS, 3)
        return found, nn.functional.softplus(self.spread(s)).reshape(bodies, nodes, SPREADS)

    def direct(self, own: Tensor, middle: Tensor, normals: Tensor) -> Tensor:
        """[B, n, POWERS, 3] what each node's own coefficients say: a linear extrapolation, learnt."""
        return self.skip(_vectors(own, middle, normals)).transpose(-1, -2)


def _vectors(own: Tensor, middle: Tensor, normals: Tensor) -> Tensor:
    """[B, n, 3, CHANNELS] vectors of each node."""
    shared = QUICK * middle[:, None, 1:].expand(-1, own.shape[1], -1, -1)
    return torch.cat([own, shared, normals[:, :, None]], dim=2).transpose(-1, -2)


def base(own: Tensor, middle: Tensor, horizon: Tensor) -> Tensor:
    """[B, n, H, 3] [radii]: on straight on from the window's end, at `horizon` [H] windows after it."""
    whole = own + middle[:, None]
    k = torch.arange(whole.shape[2], dtype=whole.dtype, device=whole.device)
    velocity = torch.einsum("k,bnkx->bnx", k * (k + 1), whole)
    return whole.sum(2)[:, :, None] + horizon[:, None] * velocity[:, :, None]


def ahead_of(found: Tensor, horizon: Tensor) -> Tensor:
    """[B, n, H, 3] of the coefficients [B, n, POWERS, 3]."""
    return torch.einsum("hp,bnpx->bnhx", horizon[:, None] ** torch.arange(found.shape[2], device=found.device), found)


def spread_of(found: Tensor, horizon: Tensor) -> Tensor:
    """[B, n, H] standard errors along the normal [radii]."""
    powers = horizon[:, None] ** torch.arange(found.shape[2], device=found.device)
    return ((powers**2) @ found.square()[..., None] + LEAST_SPREAD**2).sqrt()[..., 0]


def spread_nodes(places: np.ndarray, count: int) -> np.ndarray:
    """Numbers of `count` of the points [P, 3], each farthest from those before; all of them where there are fewer."""
    chosen, apart = [0], np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return np.array(chosen)


@dataclass(frozen=True)
class LearnedDynamics:
    """A trained network and its card; calibration: what its standard errors are multiplied by."""

    network: Dynamics
    card: Card

    @property
    def calibration(self) -> float:
        """Factor of the standard errors, by series that were not trained on."""
        return float(self.card.typical_misfit.get("spread", 1.0))


def write_dynamics(path: Path, network: Dynamics, card: Card) -> None:
    """Write the weights, whole or not at all."""
    write_network(path, network, card, VERSION, torch.float)


@lru_cache(maxsize=2)
def read_dynamics(path: Path = SHIPPED) -> LearnedDynamics:
    """The network in a file; `InputError` for one that `holosplat train --network dynamics` did not write."""
    return LearnedDynamics(*read_network(path, Dynamics, DynamicsSize, VERSION, "holosplat train --network dynamics"))


@dataclass(frozen=True)
@ranged
class GraphForecast:
    """How bodies move on by the network."""

    kind: ClassVar[str] = "graph"

    weights: str = ""
    """File of the network's weights (default: those of the package)."""
    window: ManyOrNone = 0
    """Last times of the run that the network sees (0: all)."""
    keep_volume: bool = True
    """Whether bodies keep the mean volume of the window."""

    def fit(self, history: History) -> Model:
        """The network on the history."""
        return Model(lambda ahead: learned(history, ahead, self))


def learned(history: History, ahead: np.ndarray, options: GraphForecast = GraphForecast()) -> Forecast:
    """The bodies of `history` at the later times `ahead` [N] s, by the network.

    Halves of the history say how uncertain the state is; else it is exact. The network knows the error of the motion;
    the rest of the error of places is added. Errors: `InputError` for fewer than DEGREE + 2 times, and for a horizon
    that was not trained on.
    """
    bodies, known = history.bodies, history.times
    known = known[-max(options.window, DEGREE + 2) :] if options.window else known
    require(
        len(known) > DEGREE + 1,
        f"the network must see {DEGREE + 2} times at least, but the run has {len(known)}; take --by paths.",
    )
    length = float(known[-1] - known[0])
    require(
        ahead[-1] - known[-1] <= LONGEST * length * (1 + 1e-9),
        f"the network was trained on horizons of up to {LONGEST:g} windows, but {ahead[-1] - known[-1]:.4g} s are "
        f"asked for after a window of {length:.4g} s; ask for fewer --times, or take --by paths.",
    )
    trained = read_dynamics(Path(options.weights)) if options.weights else read_dynamics()
    places = places_of(bodies, known)
    horizon = torch.from_numpy(np.r_[0.0, (ahead - known[-1]) / length])
    faces = [bodies.body(k)[1].numpy() for k in range(bodies.count)]
    states = [State.of(one, faces[k], known) for k, one in enumerate(places)]
    place = torch.zeros(bodies.count).double()
    if (halves := history.halves) is not None:
        both = [[State.of(one, faces[k], known) for k, one in enumerate(places_of(half, known))] for half in halves]
        states = [replace(one, noise=one.apart(*pair)) for one, *pair in zip(states, *both)]
        apart = zip(error_at_end(history), states)
        place = torch.tensor([max((a / one.radius) ** 2 - one.noise**2, 0.0) for a, one in apart])
    scene, radii = _scene(states, length)
    with torch.no_grad():
        found, spread = trained.network(scene)
        errors = trained.calibration * spread_of(spread.double(), horizon[1:])
    said = [one.later(trained.network, told.double(), horizon).numpy() for one, told in zip(states, found)]
    if options.keep_volume:
        said = of_kept_volume(bodies, places, said)
    band = (radii[:, None] * (errors.square().mean(1) + place[:, None]).sqrt()).T.numpy()
    return Forecast(on_paths(bodies, np.r_[known[-1], ahead], said), ahead, band)


@dataclass(frozen=True)
class State:
    """A body's window. own: [P, D + 1, 3] radii; middle: [D + 1, 3] radii; normals: [P, 3]; radius: [m]; nodes: numbers
    [n] of those that the network sees; noise: [radii], as of `apart`."""

    own: Tensor
    middle: Tensor
    normals: Tensor
    radius: float
    nodes: np.ndarray
    noise: float = 0.0

    @classmethod
    def of(cls, places: np.ndarray, faces: np.ndarray, times: np.ndarray) -> State:
        """From places [T, P, 3] [m] at `times` [T] s."""
        scaled = 2 * (times - times[0]) / (times[-1] - times[0]) - 1
        radius = ball_radius(abs(TriangleMesh(places[-1], faces).volume))
        fitted = legendre.legfit(scaled, places.reshape(len(times), -1), DEGREE) / radius
        whole = torch.from_numpy(fitted.reshape(DEGREE + 1, -1, 3)).transpose(0, 1)
        middle = whole.mean(0)
        own = whole - middle
        normals = vertex_normals(own.sum(1), torch.from_numpy(faces.astype(np.int64)))
        return cls(own, middle, normals, float(radius), spread_nodes(own.sum(1).numpy(), NODES))

    def apart(self, one: State, other: State) -> float:
        """Standard error of the motion [radii] by two halves: such errors in all coefficients, as the network was
        trained on, make the same error of velocities across the surface at the window's end."""
        a, b = (each.radius / self.radius * (each.own + each.middle) for each in (one, other))
        off = 0.5 * torch.einsum("pkx,px->pk", a - b, self.normals)
        rates = torch.tensor([float(k * (k + 1)) ** 2 for k in range(DEGREE + 1)]).double()
        return float(((rates @ off.square().mean(0)) * (DEGREE + 1) / rates.sum()).sqrt())

    def later(self, network: Dynamics, found: Tensor, horizon: Tensor) -> Tensor:
        """[H, P, 3] m of all vertices; found: [n, POWERS, 3] what the network says of its nodes."""
        end = self.own.sum(1)
        apart, near = torch.cdist(end, end[self.nodes]).topk(min(4, len(self.nodes)), largest=False)
        weights = 1 / (apart.square() + 1e-6)
        spread = torch.einsum("pk,pkqx->pqx", weights / weights.sum(1, keepdim=True), found[near])
        alone = self.own[None], self.middle[None]
        linear = network.direct(*(x.float() for x in (*alone, self.normals[None])))[0].double()
        moved = ahead_of((linear + spread)[None], horizon) + base(*alone, horizon)
        return self.radius * moved[0].transpose(0, 1)


def _scene(states: list[State], length: float) -> tuple[Scene, Tensor]:
    """The scene of the network, and the radii [B] [m]; bodies with few nodes have some of them twice."""
    radii = torch.tensor([one.radius for one in states], dtype=torch.float64)
    chosen = [np.resize(one.nodes, max(len(each.nodes) for each in states)) for one in states]
    own = torch.stack([one.own[nodes] for one, nodes in zip(states, chosen)])
    normals = torch.stack([one.normals[nodes] for one, nodes in zip(states, chosen)])
    middle = torch.stack([one.middle for one in states])
    shift = torch.stack([one.middle[0] * one.radius for one in states])
    middle = torch.cat([((shift - shift[0]) / radii.mean())[:, None], middle[:, 1:]], dim=1)
    noise = torch.tensor([one.noise for one in states], dtype=torch.float64)
    parts = own, middle, normals, length / (RELAXATION * radii), noise
    return Scene.of(*(part.float() for part in parts)), radii
