"""A fit that goes on from what another run found: bodies and volumes that have moved a little."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.moving_ellipsoids import true_paths
from holosplat.beamline.simulate import simulate
from holosplat.bodies.rest_shape import moments
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.io.objects import write_object
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.mesh import TriangleMesh
from holosplat.methods import Auto, Gaussians, SmoothVolume, Surfaces, Task
from holosplat.methods.continued import Continued, Effort
from holosplat.methods.illumination import prepared
from holosplat.methods.method import run_quietly, run_stages
from holosplat.representations import Stored, SurfaceMesh, VoxelGrid, approximate, cloud_from_volume
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene

MATERIAL, PIXEL, RADIUS = DeltaBeta(7e-7, 3e-10), 1e-6, 6.0
SHAPE = (23, 31)
MOVED = np.array([0.6, -0.5, 0.4])
"""How far the ball has moved since the other run [pixels]."""
SPHERE, FACES = icosphere(3)
GRID = Grid.centred((SHAPE[1], SHAPE[0], SHAPE[1]), PIXEL)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """Four views of the ball where it is now."""
    exposures = Exposures.of(Views.from_angles([0.0, 45.0, 90.0, 135.0], SHAPE, PIXEL), 20.0, 0.05)
    scene = MeshScene.of_one_material([TriangleMesh(PIXEL * (RADIUS * SPHERE + MOVED), FACES, "ball")], MATERIAL)
    return simulate(scene, exposures, is_test=np.zeros(4, dtype=bool))


def before(kind: str):
    """The ball where it was, as the other run found it."""
    matter = Matter.one(*MATERIAL)
    surface = SurfaceMesh(torch.from_numpy(RADIUS * SPHERE), torch.tensor(FACES), PIXEL, matter)
    if kind == "surfaces":
        return surface
    z, y, x = places()
    inside = np.clip(RADIUS + 0.5 - np.sqrt(x**2 + y**2 + z**2), 0, 1)
    values = torch.from_numpy(inside.astype(np.float32))
    if kind == "voxels":
        return VoxelGrid(values[None], GRID, matter)
    cloud = cloud_from_volume(values, GRID, MATERIAL, 2 * PIXEL, PIXEL, 2000, 0.05)
    return approximate(cloud, values, GRID, 20, lambda stage, share: None)


def places() -> np.ndarray:
    """z, y and x of the voxels [pixels]."""
    return np.indices(GRID.shape) - (np.array(GRID.shape)[:, None, None, None] - 1) / 2


def middle(found) -> np.ndarray:
    """Its centre of mass [pixels]."""
    if isinstance(found, SurfaceMesh):
        return moments(found.mesh())[1] / PIXEL
    delta, (z, y, x) = found.voxelise(GRID).delta, places()
    return np.array([(delta * v).sum() for v in (x, y, z)]) / delta.sum()


ROUNDS = ("round 2 of the fit", "round 3 of the fit")


def seen(method: Continued, task: Task, last: list) -> list[tuple[str, Stored]]:
    """The states of a run, the last one also in `last`."""
    states = []
    last[:] = [run_stages(method, task, lambda name, found, *rest: states.append((name, found))).object]
    return states


@pytest.mark.parametrize(("kind", "left"), [("surfaces", 0.1), ("gaussians", 0.5), ("voxels", 0.5)])
def test_matter_follows_its_frames_in_few_steps(scan, tmp_path, kind, left):
    """Of the way that the ball has gone, at most the share `left` is left; it began with what the other run found."""
    write_object(tmp_path / "object.h5", before(kind))
    method = Continued.of(Auto(), tmp_path / "object.h5")
    task = prepared(Task(scan, MaterialPrior.known(MATERIAL)))
    stage = method.stages()[0]
    start = stage.start(task, None)
    assert middle(start) == pytest.approx(0, abs=0.02)
    fit = stage.fit(task, start)
    assert fit is not None
    found = run_quietly(fit, lambda share: None, Stored)
    assert found.kind == start.kind
    assert np.linalg.norm(middle(found) - MOVED) < left * np.linalg.norm(MOVED)


def test_rounds_follow_each_other_as_long_as_they_are_of_use(scan, tmp_path):
    """Short ones of a ball that has moved: as many as there may be. Of one that has not: one, which is of no use."""
    write_object(tmp_path / "moved.h5", before("gaussians"))
    task = prepared(Task(scan, MaterialPrior.known(MATERIAL)))
    ways, last = Continued.of(Auto(), tmp_path / "moved.h5", Effort(3, gaussians=6)), []
    assert [name for name, _ in seen(ways, task, last)] == ["start", "fit from before", *ROUNDS]
    seen(Continued.of(Auto(), tmp_path / "moved.h5", Effort(3, gaussians=80)), task, last)
    write_object(tmp_path / "right.h5", last[0])
    again = seen(Continued.of(Auto(), tmp_path / "right.h5", Effort(3, gaussians=4)), task, last)
    assert [name for name, _ in again] == ["start", "fit from before"]


def test_methods_hand_their_options_on():
    surfaces, path = Surfaces(), Path("object.h5")
    effort = Effort(surfaces=3)
    assert Continued.of(surfaces, path, effort).surfaces.fit == surfaces.fit
    assert Continued.of(Gaussians(random_count=7), path).gaussians.random_count == 7
    assert Continued.of(SmoothVolume(rounds=2), path).volume.rounds == 2
    assert Continued.of(Auto(), path, effort).effort.surfaces == 3


def test_other_objects_and_files_are_refused(scan, tmp_path):
    write_object(tmp_path / "moving.h5", true_paths())
    task = Task(scan, MaterialPrior.known(MATERIAL))
    for name, said in (
        ("moving.h5", "surfaces, Gaussians or voxels to go on from, but it holds moving-surfaces"),
        ("none.h5", "none.h5"),
    ):
        with pytest.raises(InputError, match=said):
            Continued(tmp_path / name).stages()[0].start(task, None)
