"""Scenes for learning in the layouts that other programs train on: NeRF-synthetic, R²-Gaussian, and ONIX'."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from holosplat.checks import require
from holosplat.io.atomic import atomic_folder, write_json
from holosplat.progress import Advance
from holosplat.units import wavenumber

from ..formats.nerf_synthetic import camera_poses, write_nerf_synthetic
from ..formats.r2_gaussian import R2Options, write_r2_gaussian
from .folder import Dataset
from .sample import SampleScan, as_scan

Format = Literal["nerf-synthetic", "r2-gaussian", "onix"]
"""Layouts of other programs."""
ONIX_FORMAT = "holosplat ONIX 1"
ONIX_WORLD = np.diag([1.0, -1.0, -1.0])
"""`x_world = ONIX_WORLD x_obj`: y goes up and z towards the first camera, as in its `get_world_mat(0, 0, 0)`."""


@dataclass(frozen=True)
class Exported:
    """folder: what was written; count: its scenes; left_out: numbers of those that the layout cannot hold."""

    folder: Path
    count: int
    left_out: tuple[int, ...] = ()


def export(dataset: Dataset, layout: Format, on_progress: Advance = lambda fraction: None) -> Exported:
    """Write the scenes of `dataset` in the layout of another program, into a folder of its own beside them.

    The folder appears when all of it is written. Errors: `InputError` where files are missing, where the folder is
    there already, and where no scene fits the layout.
    """
    dataset.require_whole()
    target = dataset.folder / layout
    require(not target.exists(), f"{target} is there already; remove it, or choose another --out.")
    if layout == "onix":
        return _onix(dataset, target, on_progress)
    return _scenes_of(dataset, target, on_progress, layout)


def _scenes_of(dataset: Dataset, target: Path, on_progress: Advance, layout: Format) -> Exported:
    """A folder for each scene."""
    left_out = []
    with atomic_folder(target) as folder:
        for number in range(dataset.count):
            found = as_scan(dataset.sample(number))
            path = folder / f"scene-{number:06d}"
            if layout == "nerf-synthetic":
                write_nerf_synthetic(path, found.scan, thickness=found.thickness)
            elif not found.scan.views.shares_axis or found.scan.views.shifts.any():
                left_out.append(number)
            else:
                truth = R2Options(found.truth)
                write_r2_gaussian(path, found.scan, found.thickness, found.material.delta, truth)
            on_progress((number + 1) / dataset.count)
        require(
            len(left_out) < dataset.count,
            f"{layout} has views about one axis, but no scene of {dataset.folder} has; draw some with --tilted 0.",
        )
    return Exported(target, dataset.count - len(left_out), tuple(left_out))


def _onix(dataset: Dataset, target: Path, on_progress: Advance) -> Exported:
    """One array of all scenes, views for training first, with its poses and the truth."""
    found = []
    for number in range(dataset.count):
        scene = as_scan(dataset.sample(number))
        found.append((_channels(scene), _poses(scene), scene.truth.delta / scene.material.delta, _description(scene)))
        on_progress((number + 1) / dataset.count)
    projections, poses, volumes, told = zip(*found)
    training = int((~dataset.sample(0).is_test).sum())
    with atomic_folder(target) as folder:
        np.save(folder / "projections.npy", np.stack(projections))
        np.save(folder / "poses.npy", np.stack(poses))
        np.save(folder / "volumes.npy", np.stack(volumes).astype(np.float32))
        write_json(
            folder / "onix.json",
            {
                "format": ONIX_FORMAT,
                "projections": "[scene, view, channel, row, column] float32; channels: attenuation 2kβT, phase kδT",
                "poses": "[scene, view, 4, 4] camera to world, parallel beams along -z; the field is 1 wide",
                "volumes": "[scene, z, y, x] share of full matter, in the axes of docs/conventions.md",
                "training_views": training,
                "scenes": told,
            },
        )
    return Exported(target, dataset.count)


def _channels(scene: SampleScan) -> np.ndarray:
    """[V, 2, H, W] float32: attenuation and phase [rad] of the retrieved thickness, views for training first."""
    k, material = wavenumber(scene.scan.exposures.reference_energy), scene.material
    both = [2 * k * material.beta * scene.thickness, k * material.delta * scene.thickness]
    return np.stack(both, 1).astype(np.float32)[_order(scene)]


def _poses(scene: SampleScan) -> np.ndarray:
    """[V, 4, 4] in units of the field's width, from a camera one unit upstream."""
    views = scene.scan.views
    poses = camera_poses(views, 1.0)
    aside = views.shifts[:, :1] * views.rotations[:, 0] + views.shifts[:, 1:] * views.rotations[:, 1]
    poses[:, :3, 3] = aside / views.width - views.rotations[:, 2]
    poses[:, :3] = ONIX_WORLD @ poses[:, :3]
    return poses[_order(scene)]


def _order(scene: SampleScan) -> np.ndarray:
    return np.argsort(scene.scan.is_test, kind="stable")


def _description(scene: SampleScan) -> dict[str, float]:
    exposures, pixel = scene.scan.exposures, scene.scan.views.pixel_size
    return {
        "pixel_size_m": pixel,
        "energy_kev": exposures.reference_energy,
        "distance_m": float(exposures.distance[0]),
        "delta": scene.material.delta,
        "beta": scene.material.beta,
    }
