"""The picture of howto/droplets.md, from docs/data/droplets.csv alone: `python docs/figures.py droplets`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from holosplat.motion.particles import Particle, link_particles
from holosplat.report.style import WIDTH, letter, new_figure, styled

DOCS = Path(__file__).resolve().parents[1]
PIXEL, KNOWN, HALF, LEAST = 10e-6, 24, 256, 8
"""Size of a pixel [m], times that a forecast knows, half the frame [pixels], sightings of a path that is shown."""


@styled
def main() -> None:
    """Draw docs/images/droplets.png: sightings at 30 times, and paths by the first 24, across and along the beam."""
    with (DOCS / "data" / "droplets.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found: list[list[Particle]] = [[] for _ in range(max(int(row["time"]) for row in rows))]
    units = np.array([PIXEL, PIXEL, 1e-3, 1e-6])
    for row in rows:
        place = units * [float(row[name]) for name in ("x_px", "y_px", "z_mm", "radius_um")]
        error = units * [
            float(row[f"{n}_error_{u}"]) for n, u in zip(("x", "y", "z", "radius"), ("px", "px", "mm", "um"))
        ]
        found[int(row["time"]) - 1].append(Particle(place[:3], float(place[3]), error))
    times = np.arange(len(found), dtype=np.float64)
    later = times[KNOWN - 1 :]
    figure: Figure = new_figure(WIDTH, 3.4)
    for index, (axes, other, unit) in enumerate(zip(figure.subplots(1, 2), (0, 2), (PIXEL, 1e-3))):
        seen = np.array([[one.centre[other] / unit, one.centre[1] / PIXEL] for several in found for one in several])
        inside = np.abs(seen[:, 1]) < HALF
        axes.plot(*seen[inside].T, ".", ms=2, color="0.6", label="sightings")
        for path in link_particles(found[:KNOWN], times[:KNOWN]):
            if len(path.times) < LEAST:
                continue
            places, _ = path.at(path.times)
            ahead, errors = path.at(later)
            axes.plot(places[:, other] / unit, places[:, 1] / PIXEL, lw=0.8, color="C0")
            bars = {"xerr": 2 * errors[:, other] / unit, "yerr": 2 * errors[:, 1] / PIXEL}
            axes.errorbar(ahead[:, other] / unit, ahead[:, 1] / PIXEL, **bars, fmt="none", lw=0.8, color="C1")
        axes.plot([], [], lw=0.8, color="C0", label="paths of times 1 to 24")
        axes.plot([], [], lw=0.8, color="C1", label="forecast of times 25 to 30, ± 2 standard errors")
        axes.set(ylabel="y (pixels)", ylim=(HALF, -HALF))
        letter(axes, index, "")
    figure.axes[0].set(xlabel="x (pixels)", xlim=(-HALF, HALF))
    figure.axes[1].set(xlabel="z along the beam (mm)", xlim=(-40, 10))
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=6, loc="outside lower center", ncols=3)
    figure.savefig(DOCS / "images" / "droplets.png", dpi=160, metadata={"Software": None})
