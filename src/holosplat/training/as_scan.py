"""A scene for learning as a scan, with the truth and what phase retrieval says of each frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..scan import Exposures, Scan
from ..volume import Volume
from .sample import Sample


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
