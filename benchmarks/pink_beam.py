"""What a spectrum of finite width does to δ and to the mean energy, and whether its width can be found.

    python benchmarks/pink_beam.py --out docs/data/pink_beam.csv        # an hour on one core

Frames of red cells in many views are simulated with meshes, each energy of the spectrum with the tables' own δ and β.
A row is one question of one scene: `delta` is the occupancy found over that found in frames of one energy, and `energy`
or `bandwidth` the constant over the true one, with its interval and whether frames told it. `model` says whether the
fit knows the bandwidth. Seeds below 100 served to find errors; reported are others.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from machine import commit
from rows import written

import holosplat as hs
from holosplat.beamline.simulate import Filling, Simulation, polychromatic_frames, refilled, simulated_frames
from holosplat.geometry import Views
from holosplat.materials import parse_material
from holosplat.matter import MaterialPrior
from holosplat.methods import Task
from holosplat.methods.illumination import prepared
from holosplat.methods.profile import Profile, ProfileOptions
from holosplat.methods.uncertain import Uncertain, determine
from holosplat.optics.coherence import Spectrum
from holosplat.scan import Exposures, Scan
from holosplat.specimens.scene import MeshScene

COLUMNS = ("distance_m", "photons", "seed", "true_width", "model", "question", "value", "low", "high", "told", "commit")
ENERGY, SHAPE, PIXEL, VIEWS = 20.0, (35, 40), 0.5e-6, 7
FILLING = Filling(parse_material("haemoglobin"))
WIDTHS = (0.0, 0.03)
OPTIONS = ProfileOptions(iterations=15)
RANGES = {"energy_kev": (19.0, 21.2), "bandwidth": (0.005, 0.1)}


def scan(distance: float, photons: float, width: float, seed: int) -> Scan:
    """Frames of two cells; the spectrum has 15 energies, more than a fit takes."""
    material = FILLING.of("", ENERGY)
    box = (17e-6, 14e-6, 17e-6)
    scene = MeshScene.of_one_material(hs.specimens.random_cells(2, box=box, seed=seed), material)
    exposures = Exposures.of(Views.evenly_spaced(VIEWS, SHAPE, PIXEL), ENERGY, distance, 0.3)
    how = Simulation(photons, seed)
    if width:
        light = Spectrum.gaussian(ENERGY, width, 15)
        frames = polychromatic_frames(lambda energy: refilled(scene, FILLING, energy), light, exposures, how)
    else:
        frames = simulated_frames(scene, exposures, how)
    return Scan(np.stack(list(frames)), exposures, np.zeros(VIEWS, dtype=bool))


def with_width(measured: Scan, width: float) -> Scan:
    """The scan with a bandwidth."""
    return measured.taken(replace(measured.exposures, bandwidth=np.full(len(measured), width)))


def amount(measured: Scan) -> float:
    """The sum of the likeliest occupancies of matter whose δ/β is known."""
    material = FILLING.of("", ENERGY)
    at = {"delta_beta": material.ratio}
    return float(
        Profile(prepared(Task(measured, MaterialPrior.known(material))), material.ratio, at, [at], OPTIONS)
        .fitted(at)[0]
        .sum()
    )


def rows(distance: float, photons: float, seed: int) -> Iterator[dict[str, object]]:
    """All questions of one scene."""
    scans = {width: scan(distance, photons, width, seed) for width in WIDTHS}
    plain = amount(scans[0.0])
    for model, assumed in (("none", 0.0), ("told", WIDTHS[1])):
        found = amount(with_width(scans[WIDTHS[1]], assumed))
        numbers = (distance, photons, seed, WIDTHS[1], model, "delta", f"{found / plain:.4f}", "", "", "", commit())
        yield dict(zip(COLUMNS, numbers))
    for width in reversed(WIDTHS):
        one = (distance, photons, seed, width, "told")
        yield answer(one, with_width(scans[width], width), "energy_kev", ENERGY)
        yield answer((*one[:4], "found"), scans[width], "bandwidth", width or 1.0)


def answer(one: tuple[object, ...], measured: Scan, name: str, true: float) -> dict[str, object]:
    """A constant over its true value."""
    task = prepared(Task(measured, MaterialPrior.known(FILLING.of("", ENERGY))))
    (found,) = determine(task, Uncertain(**{name: RANGES[name]}), OPTIONS)
    numbers = (f"{value / true:.4f}" for value in (found.value, found.low, found.high))
    return dict(zip(COLUMNS, (*one, name, *numbers, found.told, commit())))


def main() -> None:
    """Write the table, line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--distances", nargs="+", type=float, default=[0.2])
    parser.add_argument("--photons", type=float, default=10_000)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    wanted = ((z, options.photons, seed) for z in options.distances for seed in options.seeds)
    written(options.out, COLUMNS, (row for one in wanted for row in rows(*one)))


if __name__ == "__main__":
    main()
