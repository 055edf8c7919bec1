"""Specimens that move: cells in a channel, grown into a time series of mesh files (`holosplat grow`)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ..backends import require_device
from ..checks import InputError, as_written, in_range, require
from ..fit.run import interrupts_held
from ..io.atomic import atomic_path, read_json, require_new, write_json
from ..io.guard import read_archive
from ..io.paraview import TimeStep, write_pvd
from ..io.vtk import write_mesh
from ..mesh import TriangleMesh
from ..progress import Advance
from ..ranges import Seconds, Seed, Small, checked_dataclass
from ..specimens.flow.suspension import Channel, Medium, State, Stepper, Suspension
from ..specimens.membrane.model import Elasticity, Membrane
from ..specimens.membrane.rest import resting_cell
from ..specimens.red_cells import DIAMETER, SHUFFLES, place_cells
from ..units import in_percent

FORMAT = "holosplat cells 1"
COMPACT = "cells_{:03d}.npz"
"""Nodes [C, P, 3] [m] of a snapshot, not folded, faces [F, 3] and time [s]."""
TRAVEL = 1e-6
"""Distance [m] that the fastest fluid moves between snapshots without a given interval."""
MOST_VOLUME, MOST_AREA = 0.01, 0.05
"""Greatest change of a cell's volume and area, relative to rest."""
FIRST_STEP = 0.01
"""The first step to try, in inverse shear rates."""
MOST_CELLS, MOST_SNAPSHOTS = 1000, 100_000


@checked_dataclass
class Growth:
    """Which cells, in which flow, recorded when."""

    cells: int = 16
    """Number of cells."""
    box: tuple[Small, Small, Small] = (80e-6, 34e-6, 26e-6)
    """The channel (x, y, z) [m]: flow along x, periodic; walls across y and z."""
    flow: float = 0.05
    """Velocity of the undisturbed flow on the channel's axis [m/s]."""
    snapshots: int = 50
    """Number of snapshots."""
    interval: Seconds | None = None
    """Time between snapshots [s] (default: in which the fastest fluid goes 1 µm)."""
    warm_up: Seconds = 0.0
    """Time before the first snapshot, in which resting cells take up the flow [s]."""
    diameter: Small = DIAMETER
    """Of a resting cell [m]."""
    frequency: int = 6
    """Resolution f of the meshes: 10 f² + 2 nodes (6: 362)."""
    seed: Seed = 0
    """Seed of the cells' places and directions."""
    tolerance: float = 1e-3
    """Greatest estimated error of a step in time, in mean edges of the mesh."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where velocities are computed; a GPU pays from some fifty cells on."""
    compact: bool = False
    """Whether a snapshot is one file of nodes, cells_TTT.npz, as `train --network dynamics` reads it, and no meshes."""
    elasticity: Elasticity = field(default_factory=Elasticity)
    medium: Medium = field(default_factory=Medium)

    def check(self) -> None:
        """`InputError` for impossible values; the other classes check the rest."""
        Channel(self.box, self.flow)
        for name, most in (("cells", MOST_CELLS), ("snapshots", MOST_SNAPSHOTS)):
            number = getattr(self, name)
            require(1 <= number <= most, f"{name} must be from 1 to {most}, but it is {number}.")
        in_range("interval", self.period, 1e-12, 1e3, unit="seconds")
        require(0 <= self.warm_up <= 1e3, f"warm_up must be from 0 to 1000 s, but it is {self.warm_up}.")
        in_range("tolerance", self.tolerance, 1e-8, 0.1)
        require_device(self.device)

    @property
    def period(self) -> float:
        """Time between snapshots [s]."""
        return TRAVEL / self.flow if self.interval is None else self.interval

    def instant(self, snapshot: int) -> float:
        """Time of a snapshot since the start [s]."""
        return self.warm_up + snapshot * self.period

    def suspension(self) -> Suspension:
        """The cells' membrane in the channel."""
        membrane = Membrane(resting_cell(self.frequency, self.diameter), self.elasticity, self.device)
        return Suspension(membrane, Channel(self.box, self.flow), self.medium)

    def placed(self, suspension: Suspension) -> Tensor:
        """Resting cells [C, P, 3] [m] at random in the channel, clear of walls and of each other."""
        mesh, margin = suspension.membrane.mesh, suspension.repulsion.range_
        found = place_cells(self.cells, self.box, self.seed, self.diameter, 0.0, margin, "box", shuffles=SHUFFLES)
        nodes = np.stack([mesh.vertices @ cell.rotation.T + cell.centre for cell in found])
        return torch.from_numpy(nodes + 0.5 * np.asarray(self.box)).to(self.device)


@dataclass(frozen=True)
class Grown:
    """The result: the state at the last snapshot, the greatest relative changes of any cell's volume and area at a
    snapshot of this run, and the snapshots in the folder."""

    state: State
    volume: float
    area: float
    snapshots: int


class SeriesFolder:
    """`grow.json` (the options), `rbcCC_TTT.vtp` (cell, snapshot; µm), `cells.pvd` (opens as a time series),
    `state.npz` (where to go on). Every file is written whole or not at all, the state last."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.options = self.path / "grow.json"
        self.collection = self.path / "cells.pvd"
        self.state = self.path / "state.npz"

    def file(self, cell: int, snapshot: int) -> Path:
        """The mesh of a cell, counted from 0, at a snapshot."""
        return self.path / f"rbc{cell:02d}_{snapshot:03d}.vtp"

    def create(self, growth: Growth) -> None:
        """Make the folder."""
        try:
            self.path.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.path} must be writable, but making it failed: {error}.") from None
        write_json(self.options, {"format": FORMAT, **_plain(growth)})

    def require_same(self, growth: Growth) -> None:
        """`InputError` unless the folder was begun with the same options; only `snapshots` may differ."""
        require(self.options.is_file(), f"--resume needs a folder that grow began, but {self.path} is none.")
        wanted = {"format": FORMAT, **_plain(growth)}
        found = read_json(self.options)
        for name in wanted:
            same = name == "snapshots" or found.get(name) == wanted[name]
            require(same, f"--resume must be with the options of the start, but {name} was {found.get(name)}.")

    def write_snapshot(self, growth: Growth, suspension: Suspension, snapshot: int, state: State) -> None:
        """Add a snapshot: its meshes, the collection, and the state."""
        kept, faces = state.nodes.cpu(), suspension.membrane.mesh.faces
        if growth.compact:
            with atomic_path(self.path / COMPACT.format(snapshot)) as temporary:
                time = growth.instant(snapshot) - growth.warm_up
                np.savez_compressed(temporary, nodes=kept.numpy(), faces=faces, time=np.array(time))
        else:
            for cell, nodes in enumerate(suspension.channel.folded(kept).numpy()):
                write_mesh(self.file(cell, snapshot), TriangleMesh(nodes, faces))
            steps = [
                TimeStep(growth.instant(n) - growth.warm_up, tuple(self.file(c, n) for c in range(growth.cells)))
                for n in range(snapshot + 1)
            ]
            write_pvd(self.collection, steps)
        with atomic_path(self.state) as temporary:
            np.savez(
                temporary,
                nodes=kept.numpy(),
                numbers=np.array([state.time, state.step]),
                counts=np.array([snapshot, state.taken, state.refused]),
            )

    def read_state(self, growth: Growth, suspension: Suspension) -> tuple[int, State] | None:
        """The last snapshot and the state at it; None if there is none yet."""
        if not self.state.is_file():
            return None
        file = read_archive(self.state, what="a state that grow wrote")
        wanted = (growth.cells, len(suspension.membrane.mesh.vertices), 3)
        with as_written(self.state, "a state that grow wrote"):
            nodes, numbers, counts = file["nodes"], file["numbers"].tolist(), file["counts"].tolist()
            require(nodes.shape == wanted and bool(np.isfinite(nodes).all()), f"{self.state} is damaged; start anew.")
            (time, step), (snapshot, taken, refused) = numbers, counts
            good = step > 0 and 0 <= time < np.inf and min(snapshot, taken, refused) >= 0
            require(good and step < np.inf, f"{self.state} is damaged; start anew.")
        return snapshot, State(torch.from_numpy(nodes).to(growth.device), time, step, taken, refused)


def read_compact(folder: SeriesFolder) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes [T, C, P, 3] [m], not folded, faces [F, 3] and times [T] [s] of a folder of `grow --compact`; `InputError`
    for any other."""
    files = sorted(folder.path.glob(COMPACT.replace("{:03d}", "*")))
    require(len(files) > 0, f"{folder.path} must hold what grow --compact wrote, but there is no cells_000.npz.")
    found = [read_archive(file, what="a snapshot of grow --compact") for file in files]
    with as_written(folder.path, "what grow --compact wrote"):
        nodes, times = np.stack([one["nodes"] for one in found]), np.array([float(one["time"]) for one in found])
        faces = np.asarray(found[0]["faces"])
        require(nodes.ndim == 4 and nodes.shape[-1] == 3 and bool(np.isfinite(nodes).all()), "nodes are not [C, P, 3].")
    return nodes, faces, times


def grow(
    growth: Growth,
    out: str | Path,
    resume: bool = False,
    on_progress: Advance = lambda fraction: None,
) -> Grown:
    """Let cells flow, and write a time series of meshes to the folder `out` (see `SeriesFolder`).

    Ctrl-C is held back until a step is done, then raised; `resume` goes on behind the last snapshot, to the same
    nodes, bit by bit, as without the interruption. `InputError` for options that do not fit, and where a cell's volume
    or area would change by more than 1 % or 5 %.
    """
    growth.check()
    folder = SeriesFolder(out)
    suspension = growth.suspension()
    (folder.require_same(growth) if resume else require_new(out, "choose another --out, or add --resume"))
    reached = folder.read_state(growth, suspension) if resume else None
    if reached is None:
        first = FIRST_STEP / suspension.channel.shear_rate()
        reached = -1, State(growth.placed(suspension), 0.0, first)
    if not resume:
        folder.create(growth)
    last, state = reached
    require(last < growth.snapshots, f"{folder.path} has {last + 1} snapshots already; ask for more of them.")
    end = growth.instant(growth.snapshots - 1)
    stepper = Stepper(suspension.velocity, growth.tolerance * float(suspension.membrane.rest.length.mean()))
    worst = _greatest(suspension.membrane, state.nodes)
    with interrupts_held() as release:

        def between(nodes: Tensor, time: float) -> None:
            release()
            on_progress(time / end if end > 0 else 1.0)
            _require_kept(suspension.membrane, nodes, time)

        for snapshot in range(last + 1, growth.snapshots):
            state = stepper.advance(state, growth.instant(snapshot), between)
            folder.write_snapshot(growth, suspension, snapshot, state)
            worst = np.maximum(worst, _greatest(suspension.membrane, state.nodes))
    return Grown(state, float(worst[0]), float(worst[1]), growth.snapshots)


def _changes(membrane: Membrane, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """Relative changes of volume and area against rest, each [C]."""
    return (
        membrane.volume(nodes) / membrane.rest.volume - 1,
        membrane.surface(nodes) / membrane.rest.surface - 1,
    )


def _greatest(membrane: Membrane, nodes: Tensor) -> np.ndarray:
    """The greatest relative changes [2] of any cell's volume and area."""
    return np.array([float(change.abs().max()) for change in _changes(membrane, nodes)])


def _require_kept(membrane: Membrane, nodes: Tensor, time: float) -> None:
    volume, area = _changes(membrane, nodes)
    for name, change, most, modulus in (
        ("volume", volume, MOST_VOLUME, "--volume"),
        ("area", area, MOST_AREA, "--global-area"),
    ):
        cell = int(change.abs().argmax())
        require(
            abs(float(change[cell])) <= most,
            f"the {name} of a cell must stay within {100 * most:g} % of that at rest, but that of cell {cell} changed "
            f"by {in_percent(float(change[cell]))} at {time:.4g} s; raise {modulus}, or lower --flow.",
        )


def _plain(growth: Growth) -> dict[str, Any]:
    """The options as JSON has them."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(growth).items()}
