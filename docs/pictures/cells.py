"""The picture of docs/cells.md: `python docs/figures.py cells FOLDER`, after

holosplat grow --cells 16 --box 80e-6 34e-6 26e-6 --flow 0.058 --snapshots 50 --out FOLDER
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.collections import PolyCollection

from holosplat.io.atomic import atomic_path
from holosplat.io.paraview import read_pvd
from holosplat.io.vtk import read_meshes
from holosplat.mesh import TriangleMesh
from holosplat.report.surface import camera

from .drawing import in_few_colours

matplotlib.use("Agg")
from matplotlib import pyplot as plt

BAR, DPI, COLOURS = 10, 200, 128
"""Length of the scale bar [µm], resolution, and colours that the file keeps."""
LIGHT = np.array([-0.4, -0.7, -0.6])
RED = np.array([0.85, 0.16, 0.13])


def seen(meshes: list[TriangleMesh], rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangles [N, 3, 2] [µm] that face the camera, the farthest first, and their colours [N, 3]."""
    corners = np.concatenate([1e6 * mesh.vertices[mesh.faces] for mesh in meshes]) @ rotation.T
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    order = np.argsort(-corners[..., 2].mean(1))
    order = order[normals[order, 2] < 0]
    light = np.clip(normals[order] @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    return corners[order, :, :2], np.clip((0.35 + 0.65 * light[:, None]) * RED + 0.25 * light[:, None] ** 12, 0, 1)


def main(folder: Path) -> None:
    """Draw docs/images/cells.png: the first, a middle and the last snapshot."""
    steps = read_pvd(folder / "cells.pvd")
    rotation = camera(20.0, 25.0)
    figure, axes = plt.subplots(3, 1, figsize=(6.4, 9.0), constrained_layout=True, sharex=True, sharey=True)
    for letter, axis, step in zip("abc", axes, (steps[0], steps[len(steps) // 2], steps[-1])):
        triangles, colours = seen(read_meshes(step.files, "um"), rotation)
        axis.add_collection(PolyCollection(list(triangles), facecolors=colours, edgecolors=colours, linewidths=0.2))
        axis.autoscale_view()
        axis.set(aspect="equal", xticks=[], yticks=[])
        axis.set_title(letter, loc="left", fontsize=9, fontweight="bold")
        axis.set_title(f"{1e6 * step.time:.0f} µs", fontsize=9)
    axes[0].invert_yaxis()
    left, bottom = axes[0].get_xlim()[0] + 3, axes[0].get_ylim()[0] - 3
    axes[0].plot([left, left + BAR], [bottom, bottom], "k", lw=2, solid_capstyle="butt")
    axes[0].text(left + BAR / 2, bottom - 1, f"{BAR} µm", ha="center", va="bottom", fontsize=8)
    with atomic_path(Path(__file__).parents[1] / "images" / "cells.png") as temporary:
        figure.savefig(temporary, dpi=DPI, metadata={"Software": None})
        in_few_colours(temporary, temporary, COLOURS)
