"""What a row keeps for the report's pictures: slices of δ, a held-out hologram, and the correlation curves."""

from __future__ import annotations

import numpy as np

from holosplat.metrics import robust_material_delta
from holosplat.scan import Scan
from holosplat.volume import Volume
from holosplat.workflows.evaluate import Scores

TRUTH = "truth"
"""The name of the true picture of a case."""
PLANES = {"xy": 0, "xz": 1, "zy": 2}
"""Orthogonal planes and the axis of [Z, Y, X] that each one fixes; a name's first letter runs along the columns."""
STORED = np.float16
"""Pictures need no more than three digits."""

Arrays = dict[str, np.ndarray]


def truth_picture(scan: Scan, truth: Volume) -> Arrays:
    """The true slices where most matter is, and a held-out frame.

    `xy`, `xz`, `zy`: δ in units of the material's; `material`: that δ; `planes`: voxels (z, y, x) of the slices;
    `voxel_size`: (dx, dy, dz) [m]; `frame`: the middle held-out frame [H, W], its number `index`; `pixel_size` [m].
    """
    mass = np.abs(truth.delta)
    planes = np.array([int(np.argmax(mass.sum(axis, dtype=np.float64))) for axis in ((1, 2), (0, 2), (0, 1))])
    material, test = robust_material_delta(truth), scan.test()
    index = (len(test) - 1) // 2
    return {
        **_slices(truth, planes, material),
        "material": np.array(material),
        "planes": planes,
        "voxel_size": np.array(truth.grid.voxel_size),
        "frame": test.frames[index].astype(STORED),
        "index": np.array(index),
        "pixel_size": np.array(scan.views.pixel_size),
    }


def method_picture(found: Volume, scores: Scores, truth: Arrays) -> Arrays:
    """The same slices and frame as in the `truth`'s picture, of a method, and its correlation curves.

    `frequency` [cycles/pixel], `frc`: mean over the held-out frames; `shells` [cycles/voxel], `fsc`, `pitch` [m];
    where a case is of balls, the runner adds `diameters` [m] and `contrast`.
    """
    assert scores.test is not None
    assert scores.volume is not None
    assert scores.predicted is not None
    return {
        **_slices(found, truth["planes"], float(truth["material"])),
        "frame": scores.predicted[int(truth["index"])].astype(STORED),
        "frequency": scores.test.frequency,
        "frc": scores.test.frc.mean(axis=0),
        "shells": scores.volume.frequency,
        "fsc": scores.volume.fsc,
        "pitch": np.array(scores.volume.pitch),
    }


def _slices(volume: Volume, planes: np.ndarray, material: float) -> Arrays:
    slices = {name: np.take(volume.delta, planes[axis], axis) / material for name, axis in PLANES.items()}
    slices["zy"] = slices["zy"].T  # [Z, Y] is shown with z along columns and y down
    return {name: np.clip(image, -1e4, 1e4).astype(STORED) for name, image in slices.items()}
