"""Our cells in flow against those of an ESPResSo run, from the same start.

    python benchmarks/espresso_flow.py DATA          # prints the table, writes docs/data and docs/images

DATA holds params.json, vtk/rbcCC_TTT.vtk and burst64_1p128MHz.npz (the rest shape). The cells start as they are in the
first snapshot, with ESPResSo's rest shape, moduli and viscosity, in the analytic flow that its force density drives
through the empty channel (`--peak` sets another).
ESPResSo: lattice-Boltzmann fluid with walls and inertia; here: Stokes flow without the walls' answer. Nothing random.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch
from machine import commit

from holosplat.io.atomic import atomic_path
from holosplat.io.vtk import read_meshes
from holosplat.mesh import TriangleMesh
from holosplat.specimens.flow.suspension import Channel, Medium, State, Stepper, Suspension
from holosplat.specimens.membrane.model import Elasticity, Membrane
from holosplat.specimens.repair import closed

matplotlib.use("Agg")
from matplotlib import pyplot as plt

DOCS = Path(__file__).resolve().parents[1] / "docs"
WALL = 1e-6
"""Thickness of the walls at y and z inside ESPResSo's box [m]."""
TOLERANCE = 1e-3
VOLUME = 3e3
"""Our modulus of volume [N/m²]; ESPResSo's, 900, would let 1 % leak through the finite mesh."""


def gyration_axes(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root-mean-square extents [..., 3] [m] along the principal axes, rising, and these axes [..., 3, 3] (columns)."""
    local = nodes - nodes.mean(axis=-2, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("...pi,...pj->...ij", local, local) / nodes.shape[-2])
    return np.sqrt(np.maximum(values, 0)), axes


def elongation(nodes: np.ndarray) -> np.ndarray:
    """(longest - middle)/(longest + middle) [...] of the extents: 0 for a cell at rest, towards 1 for a thread."""
    extents, _ = gyration_axes(nodes)
    return (extents[..., 2] - extents[..., 1]) / (extents[..., 2] + extents[..., 1])


def shape_change(nodes: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Root-mean-square distance [...] [m] of nodes from a `reference` [..., P, 3], moved and turned to fit best.

    The rotation is Kabsch's (1976, Acta Cryst. A 32, 922).
    """
    first = nodes - nodes.mean(axis=-2, keepdims=True)
    second = np.broadcast_to(reference - reference.mean(axis=-2, keepdims=True), first.shape)
    left, values, right = np.linalg.svd(np.einsum("...pi,...pj->...ij", first, second))
    values[..., 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    squares = (first**2).sum((-2, -1)) + (second**2).sum((-2, -1)) - 2 * values.sum(-1)
    return np.sqrt(np.maximum(squares, 0) / nodes.shape[-2])


@dataclass(frozen=True)
class Run:
    """Times [T] [s]; nodes [T, C, P, 3] [m], x unfolded; the parameters; the rest shape."""

    times: np.ndarray
    nodes: np.ndarray
    parameters: dict
    rest: TriangleMesh

    @classmethod
    def read(cls, folder: Path, most: int | None = None) -> Run:
        """ESPResSo's run, `most` of its snapshots or all."""
        parameters = json.loads((folder / "params.json").read_text(encoding="utf-8"))
        with np.load(folder / "burst64_1p128MHz.npz") as burst:
            rest = closed(TriangleMesh(1e-6 * burst["rest"].astype(np.float64), burst["tri"].astype(np.int64), "rest"))
        cells, count = parameters["n_cells"], most or parameters["n_snapshots"]
        files = [[folder / "vtk" / f"rbc{c:02d}_{t:03d}.vtk" for c in range(cells)] for t in range(count)]
        nodes = np.stack([[mesh.vertices for mesh in read_meshes(of_time, "um")] for of_time in files])
        times = np.array([1e-6 * float(re.search(rb" t=([0-9.]+)us", f[0].read_bytes()[:200])[1]) for f in files])
        period = 1e-6 * parameters["box_um"][0]
        centre = nodes[..., 0].mean(-1)
        nodes[..., 0] += (np.unwrap(centre, axis=0, period=period) - centre)[..., None]
        return cls(times - times[0], nodes, parameters, rest)

    def suspension(self, peak: float | None) -> Suspension:
        """Our twin of it; ESPResSo's units are µm, µs and 1e-15 kg, so that forces are nN.

        peak: velocity of the undisturbed flow on the axis [m/s] (default: the one that the force density drives).
        """
        p, of = self.parameters, self.parameters["mech"]
        # its areas pull at corners towards the middles, of even triangles half as hard as our gradients
        elasticity = Elasticity(
            skalak_shear=0.0,
            springs=1e-3 * of["ks"],
            bending=1e-15 * of["kb"],
            local_area=0.5e-3 * of["kal"],
            global_area=0.5e-3 * of["kag"],
            volume=VOLUME,
        )
        length, *widths = (1e-6 * b for b in p["box_um"])
        box, viscosity = (length, *(w - 2 * WALL for w in widths)), 1e-3 * p["density"] * p["kin_visc"]
        driven = 1e9 * p["force_density"] / Channel(box, 1.0).pressure_gradient(viscosity)
        channel = Channel(box, driven if peak is None else peak)
        return Suspension(Membrane(self.rest, elasticity), channel, Medium(viscosity))


def ours(run: Run, suspension: Suspension) -> tuple[np.ndarray, State]:
    """Nodes [T, C, P, 3] [m] from ESPResSo's first snapshot on, and the last state."""
    offset = torch.tensor([0.0, WALL, WALL], dtype=torch.float64)
    stepper = Stepper(suspension.velocity, TOLERANCE * float(suspension.membrane.rest.length.mean()))
    state = State(torch.from_numpy(run.nodes[0]) - offset, 0.0, 1e-7)
    found = []
    for instant in run.times:
        state = stepper.advance(state, float(instant))
        found.append((state.nodes + offset).numpy())
    return np.stack(found), state


def statistics(nodes: np.ndarray, membrane: Membrane, times: np.ndarray) -> dict[str, np.ndarray]:
    """Of each cell: drift speed [C] [m/s]; over time [T, C]: shape change [m], elongation, volume, area."""
    tensor = torch.from_numpy(nodes)
    return {
        "drift": (nodes[-1].mean(1) - nodes[0].mean(1))[:, 0] / times[-1],
        "change": shape_change(nodes, nodes[0]),
        "elongation": elongation(nodes),
        "volume": (membrane.volume(tensor) / membrane.rest.volume - 1).numpy(),
        "area": (membrane.surface(tensor) / membrane.rest.surface - 1).numpy(),
    }


def write_rows(run: Run, fluid: np.ndarray, theirs: dict[str, np.ndarray], here: dict[str, np.ndarray]) -> None:
    """A row a cell as docs/data/espresso_flow.csv."""
    columns = {"fluid_m_s": fluid}
    for whose, found in (("espresso", theirs), ("here", here)):
        columns[f"{whose}_drift_m_s"] = found["drift"]
        columns[f"{whose}_shape_change_m"] = found["change"][-1]
        columns[f"{whose}_elongation"] = found["elongation"].mean(0)
        columns[f"{whose}_mean_shape_change_m"] = found["change"].mean(0)
        columns[f"{whose}_greatest_shape_change_m"] = found["change"].max(0)
        columns[f"{whose}_greatest_elongation"] = found["elongation"].max(0)
        for name in ("volume", "area"):  # against rest
            columns[f"{whose}_least_{name}"] = found[name].min(0)
            columns[f"{whose}_greatest_{name}"] = found[name].max(0)
    with atomic_path(DOCS / "data" / "espresso_flow.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["cell", *columns, "commit"])
        for cell in range(run.nodes.shape[1]):
            writer.writerow([cell, *(f"{values[cell]:.5g}" for values in columns.values()), commit()])


def draw(run: Run, nodes: np.ndarray, theirs: dict[str, np.ndarray], here: dict[str, np.ndarray]) -> None:
    """docs/images/espresso_flow.png: drift speeds, shape changes over time, and the last shapes of three cells."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10.5, 3.4), constrained_layout=True)
    left.plot(1e3 * theirs["drift"], 1e3 * here["drift"], "o", ms=4)
    ends = 1e3 * np.array([theirs["drift"].min(), theirs["drift"].max()])
    left.plot(ends, ends, "0.6", lw=1)
    left.set(xlabel="ESPResSo / mm/s", ylabel="here / mm/s", title="drift speed of each cell")
    for found, style, name in ((theirs, "-", "ESPResSo"), (here, "--", "here")):
        middle.plot(1e6 * run.times, 1e6 * found["change"].mean(1), style, color="C0", label=f"mean, {name}")
        middle.plot(1e6 * run.times, 1e6 * found["change"].max(1), style, color="C1", label=f"greatest, {name}")
    middle.set(xlabel="time / µs", ylabel="µm", title="shape change since the start")
    middle.legend(frameon=False, fontsize=7)
    order = np.argsort(theirs["change"][-1])
    for n, cell in enumerate(order[[0, len(order) // 2, -1]]):
        x, _, z = 1e6 * (run.nodes[-1, cell] - run.nodes[-1, cell].mean(0)).T
        right.tripcolor(x, z - 8.5 * n, run.rest.faces, 0 * x, cmap="Greys", vmin=-1, vmax=2, shading="gouraud")
        x, _, z = 1e6 * (nodes[-1, cell] - nodes[-1, cell].mean(0)).T
        right.triplot(x, z - 8.5 * n, run.rest.faces, color="C3", lw=0.25)
    right.plot([], [], "s", color="0.65", label="ESPResSo")
    right.plot([], [], color="C3", label="here")
    right.set(aspect="equal", xlabel="along the flow / µm", yticks=[], title="three cells at the end", ylim=(-23, 8.5))
    right.legend(frameon=False, fontsize=7, loc="upper left", ncols=2)
    with atomic_path(DOCS / "images" / "espresso_flow.png") as temporary:
        figure.savefig(temporary, dpi=100, metadata={"Software": None})


def main() -> None:
    """Run, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--peak", type=float, help="peak velocity of the undisturbed flow [m/s]; writes no files")
    options = parser.parse_args()
    run = Run.read(options.data)
    suspension = run.suspension(options.peak)
    began = time.process_time(), time.perf_counter()
    nodes, state = ours(run, suspension)
    seconds = time.process_time() - began[0], time.perf_counter() - began[1]
    theirs, here = (statistics(n, suspension.membrane, run.times) for n in (run.nodes, nodes))
    start = torch.from_numpy(run.nodes[0].mean(1)) - torch.tensor([0.0, WALL, WALL], dtype=torch.float64)
    fluid = suspension.channel.speed(start).numpy()
    print(f"commit {commit()}; {state.taken} steps, {state.refused} refused, {seconds[0]:.0f} s of processor time, "
          f"{seconds[1]:.0f} s by the clock")  # fmt: skip
    path = (nodes[-1] - run.nodes[-1]).mean(1)
    shape = shape_change(nodes[-1], run.nodes[-1])
    print(f"\ndrift speed, rms difference {1e3 * np.sqrt(((here['drift'] - theirs['drift']) ** 2).mean()):.2f} mm/s, "
          f"relative {np.sqrt(((here['drift'] / theirs['drift'] - 1) ** 2).mean()):.3f}; "
          f"undisturbed fluid at the start: {1e3 * fluid.mean():.2f} mm/s in the mean, "
          f"{1e3 * suspension.channel.peak:.2f} mm/s on the axis")  # fmt: skip
    print(f"centres at the end, rms distance {1e6 * np.sqrt((path**2).mean(0)).round(8)} µm along x, y, z")
    print(f"shapes at the end, rms distance of nodes after the best rigid motion: mean {1e6 * shape.mean():.2f} µm, "
          f"greatest {1e6 * shape.max():.2f} µm")  # fmt: skip
    correlation = np.corrcoef(here["change"][-1], theirs["change"][-1])[0, 1]
    print(f"correlation of the cells' shape changes: {correlation:.3f}")
    if options.peak is None:
        write_rows(run, fluid, theirs, here)
        draw(run, nodes, theirs, here)


if __name__ == "__main__":
    main()
