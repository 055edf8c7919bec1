"""Gaussians that fill closed surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.bumpy import DELTA, bumpy, poses, surfaces
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.mesh import TriangleMesh
from holosplat.methods import Task
from holosplat.methods import start as coarse_cloud
from holosplat.methods.start import cloud_of_surfaces, matter_in_cells, regions
from holosplat.metrics import fourier_ring_correlation
from holosplat.projectors.surface import surface_occupancy
from holosplat.representations import GaussianCloud, SurfaceMesh
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures
from holosplat.specimens.scene import MeshScene

PITCH = 0.5e-6
ORIGIN = (0.2 * PITCH, -0.3 * PITCH, 0.0)


def turned_inside_out(mesh: TriangleMesh) -> TriangleMesh:
    return replace(mesh, faces=mesh.faces[:, ::-1].copy())


def volume(*bodies: TriangleMesh) -> float:
    """In pixels."""
    return sum(each.volume for each in bodies)


def task_of(*bodies: TriangleMesh, shape=(45, 39)) -> Task:
    scene = MeshScene.of_one_material(
        [replace(each, vertices=PITCH * each.vertices) for each in bodies], HAEMOGLOBIN.delta_beta(20.0)
    )
    scan = simulate(scene, Exposures.of(poses(3, shape, 3, PITCH), 20.0, 0.05, 0.3), seed=1)
    return Task(scan, MaterialPrior.known(HAEMOGLOBIN.delta_beta(20.0)))


def sorted_by_place(parts) -> list[torch.Tensor]:
    order = np.lexsort(parts[1].round().T.numpy())
    return [values[torch.from_numpy(order)] for values in parts]


def test_bodies_apart_have_boxes_of_their_own():
    mesh = surfaces(bumpy(3, 4.0, (-9.0, 1.0, 0.0)), bumpy(3, 3.0, (8.0, 0.0, 2.0)), unit=PITCH)
    found = regions(mesh.vertices.detach(), mesh.faces)
    assert len(found) == 2
    assert sum(len(faces) for *_, faces in found) == len(mesh.faces)
    for first, stop, faces in found:
        corners = mesh.vertices.detach()[faces].reshape(-1, 3).numpy()
        assert (corners >= first - 0.5).all()
        assert (corners <= stop - 0.5).all()
        assert (stop - first < 12).all()


def test_boxes_that_come_to_overlap_become_one():
    """The third box lies in what the first two span together, and in neither of them."""
    row = [bumpy(2, 3.0, (0.0, 0.0, 0.0)), bumpy(2, 3.0, (5.0, 5.0, 5.0)), bumpy(2, 1.0, (-1.0, 7.0, 0.0))]
    mesh = surfaces(*row, unit=PITCH)
    assert len(regions(mesh.vertices.detach(), mesh.faces)) == 1


def test_the_mass_of_a_hollow_body():
    outer, inner = bumpy(4, 8.0, (1.2, -0.8, 0.6), depth=0.1), bumpy(4, 5.0, (1.2, -0.8, 0.6), depth=0.1)
    mesh = surfaces(outer, turned_inside_out(inner), bumpy(3, 3.0, (20.0, 0.0, 0.0)), unit=PITCH)
    mass, centre, _ = matter_in_cells(mesh, PITCH, ORIGIN)
    wanted = volume(outer, bumpy(3, 3.0)) - volume(inner)
    assert float(mass.sum()) == pytest.approx(wanted, rel=4e-3)
    hollow = (centre - torch.tensor([1.0, -0.5, 0.6]).double()).norm(dim=1) < 3.0
    assert not hollow.any()


def test_some_rows_at_a_time(monkeypatch):
    mesh, heights = surfaces(bumpy(4, 5.0, (1.2, -0.8, 0.6)), unit=PITCH), list[int]()
    whole = sorted_by_place(matter_in_cells(mesh, PITCH, ORIGIN))

    def few(points, faces, shape, lines):
        heights.append(shape[1])
        assert len(faces) < len(mesh.faces)
        return surface_occupancy(points, faces, shape, lines)

    monkeypatch.setattr(coarse_cloud, "MOST_VOXELS", 8 * 3 * 12 * 12)
    monkeypatch.setattr(coarse_cloud, "surface_occupancy", few)
    parts = sorted_by_place(matter_in_cells(mesh, PITCH, ORIGIN))
    assert len(heights) >= 4
    assert set(heights[:-1]) == {6}
    for found, wanted in zip(parts, whole):
        assert torch.allclose(found, wanted, atol=1e-6)


def test_too_many_gaussians_become_larger_ones(monkeypatch):
    body = bumpy(4, 9.0, (1.2, -0.8, 0.6), depth=0.2)
    mesh, task = surfaces(body, unit=PITCH), task_of(body)
    fine = cloud_of_surfaces(mesh, task)
    monkeypatch.setattr(coarse_cloud, "MOST_GAUSSIANS", len(fine) // 2)
    coarse = cloud_of_surfaces(mesh, task)
    assert len(fine) / 9 < len(coarse) < len(fine) / 3
    for cloud in (fine, coarse):
        assert float(cloud.masses().sum()) == pytest.approx(volume(body), rel=4e-3)
        grid = Grid.centred((40, 40, 40), PITCH)
        true, found = (obj.voxelise(grid).delta > 0.5 * DELTA for obj in (mesh, cloud))
        assert 2 * (true & found).sum() / (true.sum() + found.sum()) > (0.99 if cloud is fine else 0.97)


def test_projections_are_those_of_the_surfaces_up_to_the_pixels_limit():
    """In views that look along no axis of the cells, correlation of all rings but the corners'; Gaussians in the
    middles of cells, as wide, reach less."""
    body = bumpy(4, 9.0, (1.2, -0.8, 0.6), depth=0.2)
    mesh, task = surfaces(body, unit=PITCH), task_of(body)
    true = mesh.project(task.scan.views)[1].detach().numpy()

    def worst(cloud: GaussianCloud) -> float:
        found = cloud.project(task.scan.views)[1].detach().numpy()
        pairs = [fourier_ring_correlation(one, other) for one, other in zip(true, found)]
        return min(float(curve[frequency <= 0.4].min()) for frequency, curve in pairs)

    cloud = cloud_of_surfaces(mesh, task)
    middle = Grid.of_views(task.scan.views).origin
    lattice = cloud.with_parameters(
        {
            "centres": (cloud.centres - torch.tensor(middle) / PITCH).round().float() + torch.tensor(middle) / PITCH,
            "log_scales": cloud.log_scales * 0 + 0.5 * np.log(1 / 6),
            "raw_amplitudes": raw_of(cloud.masses() / (2 * np.pi / 6) ** 1.5),
        }
    )
    assert worst(cloud) > 0.97
    assert worst(lattice) < 0.95


def test_nothing_to_fill_is_refused():
    body = bumpy(3, 9.0)
    tiny = SurfaceMesh(1e-2 * surfaces(body).vertices, surfaces(body).faces, PITCH, surfaces(body).matter)
    with pytest.raises(InputError, match="there is no matter in the surfaces"):
        cloud_of_surfaces(tiny, task_of(body))
