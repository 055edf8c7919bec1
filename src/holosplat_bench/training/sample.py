"""One scene for learning: drawn from ranges, imaged, with retrieved thickness; also as a scan."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import torch

from holosplat.beamline.light import UnevenLight
from holosplat.beamline.misalignment import Misalignment
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.learning.start import retrieved_thickness
from holosplat.matter import DeltaBeta
from holosplat.optics.noise import noise_levels
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import DIAMETER, evans_fung_cell
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavelength
from holosplat.volume import Volume

from ..declaration import Beam, Case, Declaration, Detector, Listed, Matter, Substance, case_of
from ..specimens.matter import Capsules, CrowdedCells, Declarable, FoamDrop, RedCells, SoftCells
from .options import Kind, Ranges

PURPOSE = 2101
"""Keeps the numbers that are drawn here apart from those that other parts draw with the same seed."""
FITS = 0.97
"""Share of the field of view within which a scene lies in every view."""
MOST_BODIES = 60
"""Bodies of a scene: more of them take longer to place than to image."""
LEAST_GAP = 0.35
"""Least distance of two free directions, in the distance of even ones."""
THICKEST = 0.33
"""Thickness of a resting red cell at most, in diameters (Evans & Fung 1972)."""


def draw_scene(ranges: Ranges, seed: int, index: int) -> Declaration:
    """The scene number `index` of `seed`; the same for ever, whatever else is drawn."""
    rng = np.random.default_rng([PURPOSE, seed, index])
    kind = ranges.kinds[index % len(ranges.kinds)]
    diameter = DIAMETER * rng.uniform(0.9, 1.1)
    pixel = diameter / rng.uniform(*ranges.across)
    tilted = rng.random() < ranges.tilted
    room = _room(rng, ranges, pixel, tilted)
    specimen = SPECIMENS[kind](rng, ranges, diameter, room)
    energy = _log(rng, ranges.energy_kev)
    distance = pixel**2 / (wavelength(energy) * _log(rng, ranges.fresnel))
    phase = _log(rng, ranges.phase)
    delta = phase * wavelength(energy) / (2 * math.pi * THICKEST * diameter)
    contrast = DeltaBeta(delta, delta / _log(rng, ranges.ratio))
    directions = _directions(rng, ranges, tilted)
    quiet = rng.random() < ranges.noiseless
    photons = (_log(rng, ranges.noise) * phase) ** -2
    return Declaration(
        summary=f"{kind} drawn for learning",
        specimen=specimen,
        matter=_matter(np.random.default_rng([PURPOSE, seed, index, 2]), ranges, kind, contrast),
        beam=Beam(energy, distance),
        detector=Detector(ranges.rows, ranges.columns, pixel, rng.uniform(*ranges.blur_px)),
        views=Listed(directions[: ranges.views], directions[ranges.views :]),
        prior="known",
        photons=None if quiet else photons,
        light=UnevenLight(light_smooth=rng.uniform(*ranges.uneven)),
        misalignment=Misalignment(shift_px=rng.uniform(*ranges.misaligned_px)),
    )


def _matter(rng: np.random.Generator, ranges: Ranges, kind: Kind, contrast: DeltaBeta) -> Matter:
    """Matter that differs from its medium by `contrast`, or by its δ and less absorption; what is inside of it.

    rng: of its own, so that what was drawn before there were media stays as it was.
    """
    inside, share = rng.uniform(*ranges.core), CORES.get(kind)
    if share is None and kind == "filled-capsules":
        share = inside
    medium = Substance("vacuum")
    outside = DeltaBeta(0.0, 0.0)
    if rng.random() < ranges.medium:
        outside = DeltaBeta(rng.uniform(1, 10) * contrast.delta, 2 * contrast.beta)
        medium = Substance(delta=outside.delta, beta=outside.beta)
        contrast = DeltaBeta(contrast.delta, -contrast.beta)
    core = None if share is None else _against(outside, contrast, share)
    return Matter(_against(outside, contrast, 1.0), core, medium)


def _against(medium: DeltaBeta, contrast: DeltaBeta, share: float) -> Substance:
    """What differs from `medium` by a share of `contrast`."""
    return Substance(delta=medium.delta + share * contrast.delta, beta=medium.beta + share * contrast.beta)


@dataclass(frozen=True)
class Room:
    """The room for bodies: extents `(x, y, z)` [m] about the origin, a box or a cylinder about y."""

    box: tuple[float, float, float]
    shape: Literal["box", "cylinder"]

    @property
    def volume(self) -> float:
        """[m³]."""
        x, y, z = self.box
        return x * y * z if self.shape == "box" else math.pi / 4 * min(x, z) ** 2 * y

    @property
    def least(self) -> float:
        """The shortest extent [m]."""
        return min(self.box)


def _room(rng: np.random.Generator, ranges: Ranges, pixel: float, tilted: bool) -> Room:
    """Within the field of view in every direction; tilted beams see a ball of its smaller side."""
    across, high = FITS * ranges.columns * pixel, FITS * ranges.rows * pixel
    if tilted:
        across = high = min(across, high) / math.sqrt(2)
    high *= rng.uniform(0.7, 1.0)
    if rng.random() < 0.4:
        side = across * rng.uniform(0.5, 1.0)
        return Room((side, high, side), "cylinder")
    x, z = rng.uniform(0.3, 1.0, 2)
    scale = across / math.hypot(x, z) * rng.uniform(0.7, 1.0)
    return Room((x * scale, high, z * scale), "box")


def _directions(rng: np.random.Generator, ranges: Ranges, tilted: bool) -> tuple[tuple[float, float], ...]:
    """Angles and tilts [degrees]. The angles of half of the scenes are even over half a turn, the others' random with a
    least distance; there, the first two views are nearly at right angles, so that there are such pairs."""
    count = ranges.views + ranges.held_out
    first = rng.uniform(0, 180)
    if tilted or rng.random() < 0.5:
        angles = first + np.arange(count) * (180 / count)
        rng.shuffle(angles)
    else:
        least = 180 / count * LEAST_GAP
        gaps = least + (180 - count * least) * rng.dirichlet(np.ones(count))
        angles = first + np.concatenate([[0.0], np.cumsum(gaps)[:-1]])
        rng.shuffle(angles[1:])
        angles = angles
        angles[1] = first + rng.uniform(80, 100)
    tilts = rng.uniform(-ranges.tilt, ranges.tilt, count) if tilted else np.zeros(count)
    return tuple((float(angle % 180), float(tilt)) for angle, tilt in zip(angles, tilts))


def _log(rng: np.random.Generator, pair: tuple[float, float]) -> float:
    """Evenly in the logarithm."""
    return float(math.exp(rng.uniform(*np.log(pair))))


def _cells(rng: np.random.Generator, ranges: Ranges, diameter: float, room: Room) -> Declarable:
    """As many red cells as fill the drawn share of the room, of those that found a place one after the other."""
    one = evans_fung_cell(diameter).volume
    count = min(MOST_BODIES, max(1, round(_log(rng, ranges.filled) * room.volume / one)))
    deform, stretch = rng.uniform(*ranges.deform), rng.uniform(*ranges.stretch)
    return RedCells(count, diameter, room.box, room.shape, deform, 0, stretch)


def _capsules(rng: np.random.Generator, ranges: Ranges, diameter: float, room: Room) -> Declarable:
    """Shells about nothing, or about another material."""
    count = min(MOST_BODIES, max(1, round(_log(rng, ranges.filled) * room.volume / (0.5 * diameter**3))))
    return Capsules(count, (0.6 * diameter, diameter), diameter * rng.uniform(0.08, 0.2), room.box)


def _foam(rng: np.random.Generator, ranges: Ranges, diameter: float, room: Room) -> Declarable:
    """A drop as large as the room with bubbles."""
    return FoamDrop(0.95 * room.least, int(rng.integers(5, 25)), rng.uniform(0.3, 0.6) * diameter)


def _soft_cells(rng: np.random.Generator, ranges: Ranges, diameter: float, room: Room) -> Declarable:
    """Continuous cells with nuclei and vacuoles."""
    count = min(MOST_BODIES, max(1, round(_log(rng, ranges.filled) * room.volume / (0.5 * diameter**3))))
    return SoftCells(count, (0.7 * diameter, 1.3 * diameter), room.box, 0.1 * diameter)


def _crowd(rng: np.random.Generator, ranges: Ranges, diameter: float, room: Room) -> Declarable:
    """Red cells in a cylinder, which is made smaller where they would be too many."""
    share, x, y = rng.uniform(*ranges.crowded), min(room.box[0], room.box[2]), room.box[1]
    count = share * math.pi / 4 * x**2 * y / evans_fung_cell(diameter).volume
    smaller = min(1.0, (MOST_BODIES / count) ** (1 / 3))
    return CrowdedCells(share, diameter, (smaller * x, smaller * y, smaller * x), rng.uniform(*ranges.deform))


def _ellipsoids(rng: np.random.Generator, ranges: Ranges, diameter: float, room: Room) -> Declarable:
    """Solid, flattened by half at most: capsules of which the core is the shell's material."""
    count = min(MOST_BODIES, max(1, round(_log(rng, ranges.filled) * room.volume / (0.4 * diameter**3))))
    return Capsules(count, (0.6 * diameter, diameter), 0.1 * diameter, room.box, rng.uniform(0, 0.5))


CORES: Mapping[Kind, float] = {"capsules": 0.0, "foam": 0.0, "ellipsoids": 1.0}
"""What is inside bodies with cores, as a share of the material's contrast."""
SPECIMENS: Mapping[Kind, Callable[[np.random.Generator, Ranges, float, Room], Declarable]] = {
    "red-cells": _cells,
    "crowd": _crowd,
    "ellipsoids": _ellipsoids,
    "capsules": _capsules,
    "filled-capsules": _capsules,
    "foam": _foam,
    "soft-cells": _soft_cells,
}


FEWER = 0.8
"""Remaining share of the bodies where not all found a place."""


@dataclass(frozen=True)
class Sample:
    """A scene and its frames, those for training first; V frames of H × W pixels.

    contrast: [V, H, W] float16, relative intensity less one
    thickness: [V, H, W] float16, retrieved projected thickness of the material [pixels]; of each frame by itself
    noise: [V] float32, standard deviation of the noise of frames
    rotations, shifts: [V, 3, 3] and [V, 2] [pixels] float64, as `Views` has them
    is_test: [V] bool, frames without noise that are held out
    occupancy: [Z, Y, X] uint8, share of matter in voxels of a pixel, 255 for all; Z = X = W, Y = H; of two materials δ
        over that of the denser one
    facts: [8] float64: pixel size [m], photon energy [keV], distance [m], standard deviation of the point-spread
        function [pixels], photons a pixel (inf: no noise), δ, β (against the medium), and
        the bodies' number or 0
    """

    contrast: np.ndarray
    thickness: np.ndarray
    noise: np.ndarray
    rotations: np.ndarray
    shifts: np.ndarray
    is_test: np.ndarray
    occupancy: np.ndarray
    facts: np.ndarray

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The arrays."""
        return tuple(field.name for field in fields(cls))


def drawn_case(ranges: Ranges, seed: int, index: int) -> Case:
    """The scene number `index` of `seed` as a case; where not all of its bodies find a place, with fewer of them."""
    declared = draw_scene(ranges, seed, index)
    own = int(np.random.default_rng([PURPOSE, seed, index, 1]).integers(2**31))
    while True:
        try:
            return case_of(declared, f"{seed}-{index}", own)
        except InputError:
            if getattr(declared.specimen, "count", 2) == 1:
                raise
            declared = replace(declared, specimen=_fewer(declared.specimen))


def _fewer(specimen: Declarable) -> Declarable:
    """The same with fewer bodies."""
    if isinstance(specimen, CrowdedCells):
        return replace(specimen, haematocrit=FEWER * specimen.haematocrit)
    count: int = getattr(specimen, "count")  # noqa: B009 (all others have one)
    return replace(specimen, count=max(1, int(FEWER * count)))  # type: ignore[call-arg]


def sample_of(ranges: Ranges, seed: int, index: int) -> Sample:
    """The scene number `index` of `seed`: equal for equal arguments, but for rounding on other machines."""
    case = drawn_case(ranges, seed, index)
    scan, material = case.scan(), case.prior.materials[0]
    frames, views, exposures = torch.from_numpy(scan.frames), scan.views, scan.exposures
    pixel = views.pixel_size
    thickness = retrieved_thickness(frames, exposures, material) / pixel
    truth = case.scene.voxelise(Grid.of_views(views)).delta / material.delta
    photons = math.inf if case.photons is None else case.photons
    optics = (exposures.energy_kev[0], exposures.distance[0], exposures.psf_sigma_px[0])
    return Sample(
        contrast=(scan.frames - 1).astype(np.float16),
        thickness=thickness.numpy().astype(np.float16),
        noise=noise_levels(frames).numpy().astype(np.float32),
        rotations=views.rotations,
        shifts=views.shifts / pixel,
        is_test=scan.is_test,
        occupancy=np.rint(255 * truth.clip(0, 1)).astype(np.uint8),
        facts=np.array([pixel, *optics, photons, *material, _bodies(case)], dtype=np.float64),
    )


def _bodies(case: Case) -> int:
    """How many closed meshes a case has, those of cores among them; 0 where there are none."""
    return len(case.scene.meshes) if isinstance(case.scene, MeshScene) else 0


@dataclass(frozen=True)
class SampleScan:
    """scan: all frames, as exact as their half precision; truth: on the field of view, at the detector's pitch;
    thickness: [N, H, W] float32, retrieved of each frame [m]; material: δ and β of full matter."""

    scan: Scan
    truth: Volume
    thickness: np.ndarray
    material: DeltaBeta


def as_scan(sample: Sample) -> SampleScan:
    """`sample` as the rest of the program has scans."""
    pixel, energy, distance, blur, photons, delta, beta, bodies = (float(value) for value in sample.facts)
    rotations, shifts = sample.rotations, sample.shifts * pixel
    views = Views(rotations, shifts, sample.contrast.shape[1:], pixel)
    frames = 1 + sample.contrast.astype(np.float32)
    told = {"photons_per_pixel": f"{photons:g}"} if math.isfinite(photons) else {}
    told |= {"bodies": f"{bodies:.0f}"} if bodies else {}
    exposures = Exposures.of(views, energy, distance, blur)
    share = sample.occupancy.astype(np.float32) / 255
    truth = Volume(share * delta, share * beta, Grid.of_views(views))
    thickness = sample.thickness.astype(np.float32) * pixel
    return SampleScan(Scan(frames, exposures, sample.is_test, told), truth, thickness, DeltaBeta(delta, beta))
