"""The scene that `holosplat demo` shows: generated red cells, written as VTK files like anybody's."""

from __future__ import annotations

from pathlib import Path

from ..io.vtk import write_mesh
from ..specimens.red_cells import random_cells

CELLS, CELL_PX = 24, 20.0
DETECTOR, PIXEL_SIZE = (128, 128), 3.2e-6
SEED = 7


def write_demo_meshes(folder: Path) -> list[Path]:
    """24 cells of 20 pixels' diameter, as the thesis scales them, in a cylinder that every view sees.

    Written as legacy VTK files in µm, one a cell, into the existing `folder`; returns their paths.
    """
    rows, columns = (n * PIXEL_SIZE for n in DETECTOR)
    cells = random_cells(CELLS, (columns, rows, columns), SEED, CELL_PX * PIXEL_SIZE)
    paths = [folder / f"{cell.name}.vtk" for cell in cells]
    for cell, path in zip(cells, paths):
        write_mesh(path, cell, "um")
    return paths
