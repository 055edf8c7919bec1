"""Measured droplets in two cameras, found, tracked, and forecast: docs/data/droplets.csv and droplets_forecast.csv.

    python benchmarks/droplets.py --data FILE      # half an hour on one core

FILE is droplets_two_cameras.npz: 30 times of settling water droplets in two in-line cameras (dainakai/phdemo, MIT).
The sightings of each time are found by themselves; times that are there are not made again. Paths of times 1 to 24 are
then compared with the sightings of times 25 to 30, which they never saw.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import machine, read, replaced, shown

from holosplat.motion.particles import Particle, ParticleOptions, find_particles, link_particles
from holosplat.optics.resampling import InLine, register
from holosplat.preprocess.pixels import fixed_background

DATA = Path(__file__).resolve().parents[1] / "docs" / "data"
WAVELENGTH, PIXEL, RATE = 0.6328e-6, 10e-6, 4000.0
PLATE = InLine(WAVELENGTH, PIXEL, (0.12965, 0.19445))
DROPLETS = InLine(WAVELENGTH, PIXEL, (0.19445, 0.12965))
"""The first camera is the nearer one to the plate, and the farther one to the droplets: both by what refocuses."""
OPTIONS = ParticleOptions(depth=(-0.04, 0.04))
KNOWN = 24
"""Times that a forecast knows."""


@dataclass(frozen=True)
class Sighting:
    """A droplet at one time: places from the frame's middle, and standard errors of the fit."""

    time: int
    number: int
    x_px: float
    y_px: float
    z_mm: float
    radius_um: float
    x_error_px: float
    y_error_px: float
    z_error_mm: float
    radius_error_um: float


@dataclass(frozen=True)
class Row:
    """A path of the known times, and how far later sightings are from where it leads.

    known: its sightings; later: those of times 25 to 30 within the frame; missed: the largest distance across the beam
    [pixels], missed_rms: its root mean square; missed_z: of depth [mm]; inside: share of coordinates within two errors
    """

    path: int
    known: int
    x_px: float
    y_px: float
    z_mm: float
    radius_um: float
    speed_mm_s: float
    later: int
    missed_px: float
    missed_rms_px: float
    missed_z_mm: float
    inside: float
    registered_px: float
    machine: str
    commit: str


def sightings(counts: np.ndarray, plate: np.ndarray, out: Path) -> float:
    """The sightings of all times, into `out`; returns the error of the registration [pixels]."""
    (registration,) = register(plate, PLATE)
    print(registration, f"turn {registration.turn:.5f}, magnification {registration.magnification:.5f}", flush=True)
    light, done = fixed_background(counts), {int(row["time"]) for row in read(out)}
    for time, pair in enumerate(counts, 1):
        if time in done:
            continue
        frames = pair / light
        frames[1] = registration.applied(frames[1])
        found = find_particles(frames, DROPLETS, OPTIONS)
        units = np.array([PIXEL, PIXEL, 1e-3, 1e-6])
        cells = [np.r_[[*one.centre, one.radius] / units, one.errors / units] for one in found]
        replaced(out, *(Sighting(time, k, *map(float, cell)) for k, cell in enumerate(cells)), key=2, digits=6)
        print(time, len(found), flush=True)
    return registration.error_px(counts.shape[2:])


def particles(rows: Sequence[dict[str, str]], times: int) -> list[list[Particle]]:
    """The sightings of each time [m]."""
    found: list[list[Particle]] = [[] for _ in range(times)]
    units = np.tile([PIXEL, PIXEL, 1e-3, 1e-6], 2)
    for row in rows:
        numbers = units * [float(row[field.name]) for field in fields(Sighting)[2:]]
        found[int(row["time"]) - 1].append(Particle(numbers[:3], float(numbers[3]), numbers[4:]))
    return found


def main() -> None:
    """Find, link, forecast."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="droplets_two_cameras.npz")
    parser.add_argument("--out", type=Path, default=DATA)
    options = parser.parse_args()
    torch.set_num_threads(1)
    data = np.load(options.data)
    counts = data["frames"]
    registered = sightings(counts, data["plate"], options.out / "droplets.csv")
    found = particles(read(options.out / "droplets.csv"), len(counts))
    times = np.arange(len(counts)) / RATE
    inside_field = 0.5 * PIXEL * np.array(counts.shape[:1:-1])
    page = options.out / "droplets_forecast.csv"
    page.unlink(missing_ok=True)
    whole = link_particles(found, times)
    for number, path in enumerate(link_particles(found[:KNOWN], times[:KNOWN]), 1):
        # the same droplet among the paths of all times: that which shares most sightings
        same = max(whole, key=lambda one: len(set(map(tuple, one.centres)) & set(map(tuple, path.centres))))
        later = same.times > times[KNOWN - 1]
        if not later.any() or len(path.times) < 8:
            continue
        places, errors = path.at(same.times[later])
        missed = same.centres[later] - places
        seen = np.all(np.abs(places[:, :2]) < inside_field, axis=1)
        if not seen.any():
            continue
        across = np.linalg.norm(missed[seen, :2], axis=1) / PIXEL
        speed = np.linalg.norm(np.diff(path.at(times[KNOWN - 2 : KNOWN])[0], axis=0)[0, :2]) * RATE
        x, y, z = path.at(times[[KNOWN - 1]])[0][0] / [PIXEL, PIXEL, 1e-3]
        within = float((np.abs(missed[seen]) < 2 * errors[seen]).mean())
        numbers = (float(across.max()), float(np.sqrt((across**2).mean())), float(1e3 * np.abs(missed[seen, 2]).max()))
        place = (float(x), float(y), float(z), 1e6 * path.radius, float(1e3 * speed))
        row = Row(number, len(path.times), *place, int(seen.sum()), *numbers, within, registered, machine(), commit())
        replaced(page, row, key=1)
        shown(row)


if __name__ == "__main__":
    main()
