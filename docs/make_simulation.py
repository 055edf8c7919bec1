"""The pictures of docs/simulation.md: `python docs/figures.py simulation` takes minutes, and writes their numbers.

Generated red cells (seed 3) of 8 µm, 20 keV, 10 cm, 0.5 µm pixels, PSF 0.5 px, haemoglobin known, preset `fast`.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from drawing import commit
from matplotlib.axes import Axes

import holosplat as hs
from holosplat.beamline.misalignment import Misalignment
from holosplat.beamline.poses import Directions
from holosplat.beamline.simulate import Shutter
from holosplat.specimens.mesh_series import MeshSeries

IMAGES = Path(__file__).parent / "images"
TABLE = Path(__file__).parent / "data" / "simulation_imperfections.csv"
SCORES = ("ssim", "dice", "relative_error_delta")
SEED, PIXEL, SHAPE = 3, 0.5e-6, (72, 72)
SPEED = 0.05
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
CONTRAST = {"cmap": "gray", "vmin": 0.55, "vmax": 1.6}


INNER = (slice(12, 60), slice(12, 60))
"""What is shown of a frame and of a slice: around is nothing."""


def scene(count: int, edge: float, seed: int = SEED) -> hs.MeshScene:
    """Red cells in a cube of `edge` [m]."""
    return hs.MeshScene.of_one_material(hs.specimens.random_cells(count, (edge,) * 3, seed, 8e-6), MATERIAL)


def drifting(still: hs.MeshScene, seconds: float) -> MeshSeries:
    """The cells, carried along x by the flow about where they are at time 0."""
    way = np.array([SPEED * seconds, 0, 0])
    return MeshSeries((still.moved(-way), still.moved(way)), np.array([-seconds, seconds]))


def exposures(directions: Directions, shape: tuple[int, int]) -> hs.Exposures:
    """How the frames are taken."""
    return hs.Exposures.of(directions.on(shape, PIXEL), 20.0, 0.1, 0.5)


def draw(axes: Axes, image: np.ndarray, title: str, **style: object) -> None:
    """One panel."""
    axes.imshow(image, interpolation="nearest", **style)  # type: ignore[arg-type]
    axes.set_title(title, fontsize=8)
    axes.set_xticks([])
    axes.set_yticks([])


def time_series() -> None:
    """Two beams × four times of cells in a channel."""
    shape, times = (48, 140), np.arange(4) * 100e-6
    groups = [scene(3, 17e-6, SEED + n).moved(np.array([at, 0, 0])) for n, at in enumerate((-18e-6, 0, 18e-6))]
    cells = hs.MeshScene.of_one_material([mesh for group in groups for mesh in group.meshes], MATERIAL)
    obj = drifting(cells, 200e-6).delayed(150e-6)
    scan = hs.simulate(obj, exposures(Directions(geometry="xmpi_2beam"), shape).repeated(times))
    figure, panels = plt.subplots(2, 4, figsize=(9, 2.3), layout="constrained")
    for n, (frame, time) in enumerate(zip(scan.frames, scan.exposures.time)):
        angle = (0.0, 23.8)[n % 2]
        draw(panels[n % 2, n // 2], frame, f"{angle:g}°, {1e6 * time:.0f} µs", **CONTRAST)
    figure.savefig(IMAGES / "simulation_series.png", dpi=110)


def imperfections() -> None:
    """What motion and misalignment do to a hologram, and to a reconstruction that does not know of them."""
    still = scene(5, 18e-6)
    told = exposures(Directions(views=16), SHAPE)
    grid = hs.Grid.of_views(told.views)
    truth = still.voxelise(grid)
    errors = Misalignment(shift_px=1.0, rotation_deg=1.0, distance=0.02, seed=SEED)
    true = errors.true_exposures(told)
    clean = hs.simulate(still, told)
    misaligned = replace(hs.simulate(still, true), exposures=told)
    exposure = 8 * PIXEL / SPEED
    blurred = hs.simulate(drifting(still, exposure), told, shutter=Shutter(exposure, 16))
    cases = {
        "as planned": ("as planned", clean),
        f"motion of 8 pixels in {1e6 * exposure:.0f} µs": (
            "cells move by 8 pixels (4 µm) while a frame is taken",
            blurred,
        ),
        "misaligned: 1 pixel, 1°, 2 %": ("views misaligned by 1 pixel, 1° and 2 % of the distance", misaligned),
        "misaligned, true exposures known": (
            "the same frames, reconstructed with the true exposures",
            replace(misaligned, exposures=true),
        ),
    }
    rows = []
    figure, panels = plt.subplots(2, 4, figsize=(9, 5), layout="constrained")
    middle = int(np.argmax(truth.delta.sum((1, 2))))
    for (name, (label, scan)), (above, below) in zip(cases.items(), panels.T):
        result = hs.reconstruct(scan, hs.MaterialPrior.known(MATERIAL), hs.preset("fast"))
        scores = hs.evaluate(result, scan, truth).headline()
        rows.append([label, *(f"{scores[score]:.6g}" for score in SCORES), commit()])
        draw(above, scan.frames[2][INNER], name, **CONTRAST)
        delta, outline = (v.delta[middle][INNER] / MATERIAL.delta for v in (result.object.voxelise(grid), truth))
        draw(below, delta, f"δ of a slice, Dice {scores['dice']:.2f}", cmap="magma", vmin=0, vmax=1)
        below.contour(outline, [0.5], colors="w", linewidths=0.6)
    figure.savefig(IMAGES / "simulation_imperfections.png", dpi=110)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([["case", *SCORES, "commit"], *rows])


def main() -> None:
    """Both pictures, and the table."""
    time_series()
    imperfections()


if __name__ == "__main__":
    main()
