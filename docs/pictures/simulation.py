"""The pictures of docs/simulation.md: `python docs/figures.py simulation` takes minutes, and writes their numbers.

Generated red cells (seed 3) of 8 µm, 20 keV, 10 cm, 0.5 µm pixels, PSF 0.5 px, haemoglobin known, preset `fast`.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

import holosplat as hs
from holosplat.beamline.misalignment import Directions, Misalignment
from holosplat.beamline.simulate import Shutter
from holosplat.report.style import PanelGrid, image_panel, letter, scale_bar, styled
from holosplat.specimens.scene import MeshSeries

from .drawing import COMMIT

IMAGES = Path(__file__).parents[1] / "images"
TABLE = Path(__file__).parents[1] / "data" / "simulation_imperfections.csv"
SCORES = ("ssim", "dice", "relative_error_delta")
SEED, PIXEL, SHAPE = 3, 0.5e-6, (72, 72)
SPEED = 0.05
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
GREY, CONTRAST, DPI = "gray", (0.55, 1.6), 160
STILL = 5, 18e-6
"""Cells, and the edge of their cube [m]."""


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


@styled
def time_series() -> None:
    """Two beams × four times of cells in a channel."""
    shape, times = (48, 140), np.arange(4) * 100e-6
    groups = [scene(3, 17e-6, SEED + n).moved(np.array([at, 0, 0])) for n, at in enumerate((-18e-6, 0, 18e-6))]
    cells = hs.MeshScene.of_one_material([mesh for group in groups for mesh in group.meshes], MATERIAL)
    obj = drifting(cells, 200e-6).delayed(150e-6)
    scan = hs.simulate(obj, exposures(Directions(geometry="xmpi_2beam"), shape).repeated(times))
    grid = PanelGrid(2, [140.0] * 4, [48.0] * 4, (3,))
    for n, (frame, time) in enumerate(zip(scan.frames, scan.exposures.time)):
        axes, angle = grid.axes[n % 2][n // 2], (0.0, 23.8)[n % 2]
        drawn = image_panel(axes, frame, (PIXEL, PIXEL), GREY, CONTRAST)
        letter(axes, 4 * (n % 2) + n // 2, f"{angle:g}°, {1e6 * time:.0f} µs")
    scale_bar(grid.axes[0][0], shape[1] * PIXEL, beside=True)
    grid.bar(drawn, 3, (0, 1), "intensity", "both")
    grid.figure.savefig(IMAGES / "simulation_series.png", dpi=DPI, metadata={"Software": None})


def cases() -> dict[str, tuple[str, hs.Scan]]:
    """What is reconstructed: a title, what the table calls it, and the scan."""
    still, told = scene(*STILL), exposures(Directions(views=16), SHAPE)
    true = Misalignment(shift_px=1.0, rotation_deg=1.0, distance=0.02, seed=SEED).true_exposures(told)
    misaligned = replace(hs.simulate(still, true), exposures=told)
    exposure = 8 * PIXEL / SPEED
    blurred = hs.simulate(drifting(still, exposure), told, shutter=Shutter(exposure, 16))
    return {
        "as planned": ("as planned", hs.simulate(still, told)),
        f"moved by 8 px in {1e6 * exposure:.0f} µs": ("cells move by 8 pixels (4 µm) while a frame is taken", blurred),
        "misaligned": ("views misaligned by 1 pixel, 1° and 2 % of the distance", misaligned),
        "misaligned, known": (
            "the same frames, reconstructed with the true exposures",
            replace(misaligned, exposures=true),
        ),
    }


@styled
def imperfections() -> None:
    """What motion and misalignment do to a hologram, and to a reconstruction that does not know of them."""
    voxels = hs.Grid.of_views(exposures(Directions(views=16), SHAPE).views)
    truth, rows = scene(*STILL).voxelise(voxels), []
    grid = PanelGrid(2, [1.0] * 4, [1.0] * 4, (3,))
    middle = int(np.argmax(truth.delta.sum((1, 2))))
    for n, (title, (label, scan)) in enumerate(cases().items()):
        result = hs.reconstruct(scan, hs.MaterialPrior.known(MATERIAL), hs.preset("fast"))
        scores = hs.evaluate(result, scan, truth).headline()
        rows.append([label, *(f"{scores[score]:.6g}" for score in SCORES), COMMIT])
        above, below = grid.axes[0][n], grid.axes[1][n]
        frame = image_panel(above, scan.frames[2][INNER], (PIXEL, PIXEL), GREY, CONTRAST)
        letter(above, n, title)
        delta, outline = (v.delta[middle][INNER] for v in (result.object.voxelise(voxels), truth))
        slices = image_panel(below, 1e7 * delta, (PIXEL, PIXEL), "magma", (0, 1e7 * MATERIAL.delta))
        height, width = (size * PIXEL for size in delta.shape)
        below.contour(outline, [0.5 * MATERIAL.delta], colors="w", linewidths=0.6, extent=(0, width, 0, height))
        letter(below, 4 + n, f"Dice {scores['dice']:.2f}")
    scale_bar(grid.axes[0][0], delta.shape[1] * PIXEL)
    grid.bar(frame, 3, (0, 0), "intensity", "both")
    grid.bar(slices, 3, (1, 1), "δ (10⁻⁷)", "max")
    grid.figure.savefig(IMAGES / "simulation_imperfections.png", dpi=DPI, metadata={"Software": None})
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([["case", *SCORES, "commit"], *rows])


def main() -> None:
    """Both pictures, and the table."""
    time_series()
    imperfections()
