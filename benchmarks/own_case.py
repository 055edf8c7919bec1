"""A case of one's own for the benchmark: two red cells, in the text of its TOML file."""

from __future__ import annotations

CASE = """summary = "Two cells of a benchmark of one's own"
prior = "known"
[specimen]
kind = "red cells"
count = 2
diameter = {diameter}
box = [{width}, {height}, {width}]
[matter]
material = "haemoglobin"
[beam]
energy_kev = 20.0
distance = 0.1
[detector]
rows = {rows}
columns = {columns}
pixel_size = {pixel}
psf_sigma_px = 0.05
[views]
kind = "between"
train = {train}
test = 2
"""


def two_cells(rows: int, columns: int, pixel: float, diameter: float, train: int) -> str:
    """The case on so many pixels of `pixel` [m], with cells of `diameter` [m] and `train` views to fit."""
    told = {"rows": rows, "columns": columns, "pixel": pixel, "diameter": diameter, "train": train}
    return CASE.format(width=columns * pixel, height=rows * pixel, **told)
