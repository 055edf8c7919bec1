"""Sealed cases: scenes drawn from a seed, whose frames are made by a program that no contestant shares."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import fft

from holosplat.checks import in_range, require
from holosplat.geometry import Grid, Views
from holosplat.io.atomic import atomic_path, read_json, write_json
from holosplat.io.guard import read_archive
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.volumes import read_volume, write_volume
from holosplat.matter import DeltaBeta
from holosplat.optics.propagation import bin_pixels
from holosplat.scan import Exposures, Scan
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavelength, wavenumber
from holosplat.volume import Volume

from .. import multislice
from ..families import ENERGY, PIXEL, REFERENCE, SIMULATED, Room, log_uniform

FAMILIES = {
    "red-cells": "red cells",
    "soft-cells": "soft cells",
    "few-photons": "soft spheres, few photons",
    "round-cell": "round cell",
    "agarose": "agarose",
    "foam": "foam",
    "tissue": "tissue",
    "coated": "coated droplets",
    "absorbers": "absorbers",
    "crowd": "crowd",
    "capsules": "capsules",
    "star": "star of balls",
}
"""Case → family of `families.SIMULATED`: sharp and soft matter, of one material and of two, in even light."""
SEALED = 58
"""Keeps the numbers drawn here apart from those of other scripts with the same seed."""
VIEWS, HELD_OUT = 8, 2
"""Over half a turn, as few as holosplat is made for; and between them."""
SIZES = (16, 512)
"""Pixels along an edge: fewer hold no body, more take hours."""
FRESNEL, RATIO = (0.05, 0.5), (300.0, 3000.0)
"""Ends of the Fresnel number of a pixel and of δ/β: holographic to near field, light elements at 20 keV."""
SLABS = 1
"""Slabs of depth: tens of micrometres of matter are thin before decimetres of air (docs/data/propagation.csv)."""
FRINGE_SAMPLES, LEAST_SAMPLES, MOST_SAMPLES = 12, 8, 20
"""Of the other program, on the first fringe and on a pixel: half as many again as `simulate` takes, and more."""


@dataclass(frozen=True)
class SealedCase:
    """name: of the family; seed, size [pixels along an edge]; scan: noisy frames for training, held-out ones without
    noise; truth: the true volume; lines: true k∫δ dz [V, H, W] [rad] of the training views; ratio: δ/β, which all
    contestants know; facts: how it is measured, in words."""

    name: str
    seed: int
    size: int
    scan: Scan
    truth: Volume
    lines: np.ndarray
    ratio: float
    facts: str


def prepare_case(name: str, seed: int, size: int, folder: Path) -> SealedCase:
    """The case in `folder`, or else one that is drawn, simulated and written there.

    `InputError` for a size beyond `SIZES`, and where the folder holds another case.
    """
    in_range("size", size, *SIZES)
    record, scan_file, truth_file = (folder / n for n in ("case.json", "scan.nxs", "truth.h5"))
    key = {"case": name, "seed": seed, "size": size}
    if record.is_file():
        kept = read_json(record)
        same = all(kept.get(part) == value for part, value in key.items())
        require(same, f"{folder} holds a case of another size or seed; choose another --out.")
    else:
        folder.mkdir(exist_ok=True)
        case = _draw(name, seed, size)
        write_scan(scan_file, case.scan)
        write_volume(truth_file, case.truth)
        with atomic_path(folder / "lines.npz") as temporary:
            np.savez_compressed(temporary, allow_pickle=False, lines=case.lines)
        write_json(record, key | {"ratio": case.ratio, "facts": case.facts})  # last: a folder with it is complete
        kept = read_json(record)
    lines = read_archive(folder / "lines.npz", what="the true lines of a sealed case")["lines"]
    return SealedCase(
        name, seed, size, read_scan(scan_file), read_volume(truth_file), lines, kept["ratio"], kept["facts"]
    )


def _draw(name: str, seed: int, size: int) -> SealedCase:
    """Matter, geometry and noise from the seed, and the frames."""
    family = SIMULATED[FAMILIES[name]]
    rng = np.random.default_rng([SEALED, *name.encode(), seed])
    low, high = family.phase
    phase = log_uniform(rng, max(low, 0.3), min(high, 1.5))  # strong enough to be seen, without wraps
    fresnel, ratio = log_uniform(rng, *FRESNEL), log_uniform(rng, *RATIO)
    photons = log_uniform(rng, *(family.photons or (2e3, 1e5)))
    step = 180 / VIEWS
    held_out = (np.floor((np.arange(HELD_OUT) + 0.5) * VIEWS / HELD_OUT) + 0.5) * step
    angles = np.concatenate([np.arange(VIEWS) * step, held_out]) + rng.uniform(0, step)
    views = Views.from_angles(angles, (size, size), PIXEL)
    exposures = Exposures.of(views, ENERGY, PIXEL**2 / wavelength(ENERGY) / fresnel)
    edge = 0.9 * PIXEL * size
    matter = family.placed(rng, Room(rng.uniform(0.2, 0.4) * PIXEL * size, edge, edge, edge))
    k, thin = wavenumber(ENERGY), DeltaBeta(REFERENCE, REFERENCE / ratio)
    thickest = max(float(matter(thin).project(views[[n]])[1].max()) for n in range(len(views)))
    scene = matter(DeltaBeta(*(x * phase / (k * thickest) for x in thin)))
    frames = np.stack([multislice_frames(scene, exposures[[n]], (SLABS,))[0] for n in range(len(views))])
    is_test = np.arange(len(views)) >= VIEWS
    frames[:VIEWS] = rng.poisson(photons * np.maximum(frames[:VIEWS], 0)) / photons
    lines = k * bin_pixels(scene.project(views[np.arange(VIEWS)].refined(2))[1], 2)
    facts = f"Fresnel number {fresnel:.2f}, {phase:.2f} rad, {photons:,.0f} photons a pixel, δ/β = {ratio:.0f}"
    scan = Scan(frames.astype(np.float32), exposures, is_test)
    return SealedCase(name, seed, size, scan, scene.voxelise(Grid.of_views(views)), np.asarray(lines), ratio, facts)


# --- the other program ----------------------------------------------------------------------------------------


def raster(taken: Exposures) -> multislice.Raster:
    """The raster of the other program for one exposure: margins that hold the light of all but the finest fringes."""
    pixel, z = taken.views.pixel_size, float(taken.distance[0])
    spread = multislice.wavelength(float(taken.energy_kev[0])) * z
    fringe = math.sqrt(spread) or math.inf
    samples = min(MOST_SAMPLES, max(LEAST_SAMPLES, math.ceil(FRINGE_SAMPLES * pixel / fringe)))
    reach = math.ceil(spread * samples / (4 * pixel**2)) + 6  # of half the finest frequency of the raster
    margins = tuple(_margin(n, min(reach, n), samples) for n in taken.views.shape)
    sx, sy = taken.views.shifts[0]
    return multislice.Raster(taken.views.shape, pixel, samples, (margins[0], margins[1]), (float(sx), float(sy)))


def _margin(pixels: int, least: int, samples: int) -> int:
    """The least margin with which the transforms are fast."""
    while fft.next_fast_len((pixels + 2 * least) * samples) != (pixels + 2 * least) * samples:
        least += 1
    return least


def multislice_matter(
    scene: MeshScene | ContinuousScene, rotation: np.ndarray, on: multislice.Raster
) -> multislice.Matter:
    """A scene as the other program sees it."""
    if isinstance(scene, MeshScene):
        bodies = [(m.vertices, m.faces, of.delta, of.beta) for m, of in zip(scene.meshes, scene.materials)]
        return multislice.Surfaces.of(bodies, rotation, on)
    return multislice.Ellipsoids.of(scene.elements, rotation, on)


def multislice_frames(
    scene: MeshScene | ContinuousScene, taken: Exposures, counts: tuple[int, ...]
) -> list[np.ndarray]:
    """One frame [h, w] by the other program, for each of these numbers of slabs."""
    on, energy = raster(taken), float(taken.energy_kev[0])
    met = multislice_matter(scene, taken.views.rotations[0], on)
    radius = float(np.linalg.norm(scene.bounds, axis=1).max())
    made = []
    for count in counts:
        wave = multislice.behind(met, np.linspace(-radius, radius, count + 1).tolist(), energy, on)
        made.append(multislice.frame(wave, float(taken.distance[0]), energy, float(taken.psf_sigma_px[0]), on))
    return made
