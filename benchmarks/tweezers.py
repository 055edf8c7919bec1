"""Red cells in optical tweezers: diameters at ten forces, against those measured: the test of every membrane model.

    python benchmarks/tweezers.py                    # prints the tables, writes docs/data and docs/images

Two beads stick to opposite ends of the rim and are pulled apart (Dao, Lim & Suresh 2003, J. Mech. Phys. Solids 51,
2259; Mills et al. 2004, Mech. Chem. Biosyst. 1, 169). The cell is so slow to be pulled that it is always at rest:
at each force the shape is the one of least energy, found from the shape at the force before.

Measured: both, mean diameters and bounds. Two membranes: Skalak's in-plane law (the
defaults), and springs alone as the object-in-fluid model has them. No random numbers. About two minutes on two cores.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch
from machine import commit
from scipy.optimize import minimize

from holosplat.checks import InputError, in_range, require
from holosplat.io.atomic import atomic_path
from holosplat.specimens.membrane.model import Elasticity, Membrane
from holosplat.specimens.membrane.rest import resting_cell

matplotlib.use("Agg")
from matplotlib import pyplot as plt

DOCS = Path(__file__).resolve().parents[1] / "docs"
FORCES_PN = (16, 31, 47, 68, 88, 109, 130, 151, 173, 193)
AXIAL = (
    (9.26, 8.35, 10.10), (10.53, 9.62, 11.39), (11.86, 10.82, 12.97), (12.87, 11.88, 13.87), (13.77, 12.58, 14.98),
    (14.35, 12.87, 15.82), (15.19, 13.89, 16.62), (15.60, 14.43, 16.87), (16.07, 14.26, 17.88), (16.30, 14.49, 18.02),
)  # fmt: skip
TRANSVERSE = (
    (6.20, 5.58, 6.81), (5.72, 5.13, 6.32), (5.07, 4.29, 5.83), (4.64, 3.94, 5.36), (4.64, 4.00, 5.27),
    (4.60, 3.98, 5.23), (4.53, 3.88, 5.19), (4.35, 3.78, 4.99), (4.60, 4.08, 5.05), (4.39, 3.75, 4.94),
)  # fmt: skip
"""Mean, lower and upper bound [µm] at each force."""


@dataclass(frozen=True)
class Model:
    """A membrane to be tried, and the fraction of nodes pulled at either end."""

    name: str
    elasticity: Elasticity
    patch: float = 0.05


MODELS = (
    Model("Skalak", Elasticity()),
    Model(
        "springs",
        Elasticity(skalak_shear=0.0, springs=2e-6, linear_springs=5.5e-6, bending=5e-19, local_area=1.1e-4),
        patch=0.1,
    ),
    Model("softening springs", Elasticity(skalak_shear=0.0, springs=1.3e-5, local_area=1e-5)),
)

LENGTH, ENERGY = 1e-6, 1e-18
"""Units of the search: µm and pN µm."""
OPTIONS = {"maxiter": 20_000, "maxfun": 40_000, "maxcor": 30, "ftol": 0.0, "gtol": 1e-3}
RESTARTS = 10
RESIDUAL = 5e-15
"""Greatest force left on a node of a cell at rest [N]; the loads are some pN a node."""


@dataclass(frozen=True)
class Stretched:
    """A cell under one force: force [N]; axial and transverse: its extents along and across the pull [m], as seen
    along its axis; area and volume: relative changes against rest; residual: greatest force left on a node [N]."""

    force: float
    axial: float
    transverse: float
    area: float
    volume: float
    residual: float
    nodes: torch.Tensor


def stretch(membrane: Membrane, forces: Sequence[float], patch: float = 0.05) -> list[Stretched]:
    """`membrane`, a cell with its axis along z, pulled along ±x by each of `forces` [N] in turn, which must rise.

    patch: the fraction of nodes at either end that share the force evenly. `InputError` where the search for the shape
    at rest fails.
    """
    pulls = np.array([in_range("force", force, 1e-14, 1e-8, unit="newtons") for force in forces])
    require(len(pulls) > 0 and bool(np.all(np.diff(pulls) > 0)), "forces must rise, at least one of them; sort them.")
    in_range("patch", patch, 1e-3, 0.5)
    nodes = torch.from_numpy(membrane.mesh.vertices.copy())
    direction = _patches(nodes, patch)
    found = []
    for force in pulls:
        nodes, residual = _at_rest(membrane, nodes, force * direction)
        extent = (nodes.max(0).values - nodes.min(0).values).tolist()
        area = float(membrane.surface(nodes) / membrane.rest.surface) - 1
        volume = float(membrane.volume(nodes) / membrane.rest.volume) - 1
        found.append(Stretched(float(force), extent[0], extent[1], area, volume, residual, nodes))
    return found


def _patches(nodes: torch.Tensor, fraction: float) -> torch.Tensor:
    """[P, 3]: +x over the nodes at one end and -x at the other, each end's sum 1."""
    count = max(1, round(fraction * len(nodes)))
    order = torch.argsort(nodes[:, 0], stable=True)
    direction = torch.zeros_like(nodes)
    direction[order[-count:], 0] = 1 / count
    direction[order[:count], 0] = -1 / count
    return direction


def _at_rest(membrane: Membrane, start: torch.Tensor, load: torch.Tensor) -> tuple[torch.Tensor, float]:
    """Nodes of least energy under the dead load [P, 3] [N], by L-BFGS, and the greatest force left [N]."""

    def potential(flat: np.ndarray) -> tuple[float, np.ndarray]:
        nodes = LENGTH * torch.from_numpy(flat.reshape(-1, 3).copy())
        energy = membrane.energy(nodes) - (load * (nodes - start)).sum()
        pull = membrane.forces(nodes) + load
        return float(energy) / ENERGY, -(pull.reshape(-1) * (LENGTH / ENERGY)).numpy()

    point, residual = (start / LENGTH).reshape(-1).numpy(), np.inf
    for _ in range(RESTARTS):  # where its line search is lost in rounding, the method starts anew from there
        found = minimize(potential, point, jac=True, method="L-BFGS-B", options=OPTIONS)
        point, residual = found.x, float(np.abs(found.jac).max()) * ENERGY / LENGTH
        if residual <= RESIDUAL:
            return LENGTH * torch.from_numpy(point.reshape(-1, 3)), residual
    raise InputError(
        f"the cell must come to rest under the load, but {1e12 * residual:.2g} pN are left on a node after "
        f"{RESTARTS} searches; take smaller steps of force, or other moduli."
    )


def within(found: list[Stretched]) -> tuple[int, int]:
    """How many axial and transverse diameters lie within the bounds."""
    axial = sum(low <= 1e6 * s.axial <= high for s, (_, low, high) in zip(found, AXIAL))
    transverse = sum(low <= 1e6 * s.transverse <= high for s, (_, low, high) in zip(found, TRANSVERSE))
    return axial, transverse


def run(model: Model, frequency: int, forces_pn: tuple[float, ...] = FORCES_PN) -> list[Stretched]:
    """The cell at each force."""
    return stretch(Membrane(resting_cell(frequency), model.elasticity), [1e-12 * f for f in forces_pn], model.patch)


def table(found: list[Stretched]) -> list[str]:
    """Markdown; bold where a value lies outside its bounds."""
    lines = ["| force / pN | axial / µm | measured | transverse / µm | measured | area | volume |", "| --- " * 7 + "|"]
    for pn, s, axial, transverse in zip(FORCES_PN, found, AXIAL, TRANSVERSE):
        cells = [str(pn)]
        for value, (mean, low, high) in ((1e6 * s.axial, axial), (1e6 * s.transverse, transverse)):
            mark = "" if low <= value <= high else "**"
            cells += [f"{mark}{value:.2f}{mark}", f"{mean:.2f} ({low:.2f}–{high:.2f})"]
        lines.append("| " + " | ".join([*cells, f"{100 * s.area:+.2f} %", f"{100 * s.volume:+.2f} %"]) + " |")
    return lines


def write_rows(rows: list[tuple[str, int, list[Stretched]]]) -> None:
    """All values as docs/data/tweezers.csv."""
    with atomic_path(DOCS / "data" / "tweezers.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["model", "nodes", "force_n", "axial_m", "transverse_m", "area_change", "volume_change"])
        for name, nodes, found in rows:
            for s in found:
                numbers = (s.force, s.axial, s.transverse, s.area, s.volume)
                writer.writerow([name, nodes, *(f"{number:.6g}" for number in numbers)])


def draw(rows: list[tuple[str, int, list[Stretched]]], frequency: int) -> None:
    """docs/images/tweezers.png: diameters over force, and the stretched cell seen along its axis."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), width_ratios=(1.3, 1), constrained_layout=True)
    for measured, label in ((AXIAL, "measured, with bounds"), (TRANSVERSE, None)):
        mean, low, high = np.array(measured).T
        left.errorbar(FORCES_PN, mean, (mean - low, high - mean), fmt="o", color="0.4", ms=4, capsize=3, label=label)
    for (name, _, found), style in zip(rows, ("-", "--", ":")):
        for n, diameters in enumerate(([s.axial for s in found], [s.transverse for s in found])):
            label = None if n else name
            left.plot([0, *FORCES_PN], 1e6 * np.array([7.82e-6, *diameters]), style, color=f"C{n}", label=label)
    left.set(xlabel="force / pN", ylabel="axial and transverse diameter / µm")
    left.legend(frameon=False, fontsize=8)
    faces = resting_cell(frequency).faces
    for offset, s in zip((0.0, 9.0, 16.5), (rows[0][2][i] for i in (0, 4, 9))):
        x, y, z = 1e6 * s.nodes.numpy().T
        right.tripcolor(x, y - offset, faces[z[faces].mean(1) > 0], z, shading="gouraud", cmap="Reds_r", vmin=-1)
        right.text(-9.5, -offset + 1.5, f"{1e12 * s.force:.0f} pN", fontsize=8)
    right.set(aspect="equal", xlabel="x / µm", yticks=[], xlim=(-10, 10))
    right.set_title("Skalak", fontsize=9)
    with atomic_path(DOCS / "images" / "tweezers.png") as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": None})


def main() -> None:
    """All models on one mesh, and the first on several."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frequency", type=int, default=6, help="resolution of the mesh: 10 f² + 2 nodes")
    parser.add_argument("--others", type=int, nargs="*", default=[4, 8], help="resolutions to compare with")
    options = parser.parse_args()
    print(f"commit {commit()}\n")
    rows = []
    for model, frequency in [*((m, options.frequency) for m in MODELS), *((MODELS[0], f) for f in options.others)]:
        began = time.perf_counter()
        found = run(model, frequency)
        rows.append((model.name, 10 * frequency**2 + 2, found))
        axial, transverse = within(found)
        seconds = time.perf_counter() - began
        print(f"{model.name}, {rows[-1][1]} nodes: {axial} of 10 axial and {transverse} of 10 transverse diameters "
              f"within the bounds ({seconds:.0f} s)")  # fmt: skip
        print(f"{model.elasticity}, patch {model.patch:g}\n")
        print(*table(found), "", sep="\n", flush=True)
    write_rows(rows)
    draw(rows[: len(MODELS)], options.frequency)


if __name__ == "__main__":
    main()
