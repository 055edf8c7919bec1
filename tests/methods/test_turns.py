"""Surfaces and the volume that agrees with the frames, in turns."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.nn.functional import avg_pool3d

from helpers.noisy_cells import MATTER, PITCH, SHAPE, error, mesh_of, occupancy, task_of
from holosplat.baselines import HolographicTV
from holosplat.baselines.holographic_tv import agreed
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.geometry import Grid
from holosplat.methods import Gaussians, SurfaceOptions, Task
from holosplat.methods.coarse import CoarseToFine
from holosplat.methods.first_surfaces import cut_as_seen, in_turns
from holosplat.methods.method import quiet
from holosplat.methods.start import cloud_of_surfaces
from holosplat.methods.surface_fit import FINEST, Extraction, SurfaceFit, cut_surfaces
from holosplat.methods.surfaces import BodiesStage
from holosplat.representations import SurfaceMesh

OPTIONS = Gaussians(coarse=CoarseToFine(coarse_steps=20, views=1))
HOW = SurfaceOptions(fit=SurfaceFit(schedule=Schedule(steps=20)))


@pytest.fixture(scope="module")
def noisy() -> Task:
    """Of frames about half of whose contrast is noise."""
    return task_of(2000.0)


def volume_of(task: Task, count: int) -> torch.Tensor:
    """What agrees with the frames, begun with so many cells."""
    start = torch.as_tensor(occupancy(mesh_of(count)), dtype=torch.float32)
    found, grid = agreed(task.scan, MATTER, start, HolographicTV().in_noise(), quiet)
    assert grid.shape == tuple(start.shape) == (SHAPE[1], *SHAPE)
    return found


def test_rounds_that_begin_without_a_cell_find_most_of_it(noisy):
    lost = occupancy(mesh_of()) - occupancy(mesh_of(3)) > 0.9
    assert lost.sum() > 300
    found = volume_of(noisy, 3).numpy()
    assert found[lost].mean() > 0.6
    assert error(found) < error(mesh_of(3))


def test_rounds_that_begin_with_the_truth_stay_with_it(noisy):
    from_nothing = torch.zeros(SHAPE[1], *SHAPE)
    found, _ = agreed(noisy.scan, MATTER, from_nothing, HolographicTV().in_noise(), quiet)
    assert error(volume_of(noisy, 4).numpy()) < min(0.3, error(found.numpy()))


def test_surfaces_find_a_cell_again(noisy):
    found = in_turns(noisy, mesh_of(3), OPTIONS, HOW)
    assert len(found.bodies()) == 4
    assert error(found) < 0.2 < 0.4 < error(mesh_of(3))


@pytest.mark.parametrize(
    "none",
    [replace(OPTIONS, coarse=replace(OPTIONS.coarse, turns=0)), replace(OPTIONS, volume=HolographicTV(corrections=0))],
    ids=["no turns", "no rounds"],
)
def test_without_turns_surfaces_stay(none, noisy):
    start = mesh_of(3)
    assert in_turns(noisy, start, none, HOW) is start


@pytest.mark.parametrize(("share", "wrong"), [(0.55, 0.5), (1.3, 0.2)])
def test_frames_choose_the_level_of_a_volume(share, wrong, noisy):
    """Half of the matter's level is none where the volume is too faint, or too dense."""
    blurred = avg_pool3d(torch.as_tensor(occupancy(mesh_of()))[None, None], 3, 1, 1)[0, 0].float() * share
    grid = Grid.of_views(noisy.scan.views)
    cut = partial(cut_surfaces, blurred, grid, PITCH, mesh_of().matter)
    chosen = cut_as_seen(noisy, cut, HOW)
    other = cut(replace(HOW.extraction, level=wrong))
    assert error(chosen) < 0.9 * error(other)


def test_a_volume_below_all_levels_has_no_surface(noisy):
    grid = Grid.of_views(noisy.scan.views)
    cut = partial(cut_surfaces, torch.full(grid.shape, 0.1), grid, PITCH, mesh_of().matter)
    with pytest.raises(InputError, match="no surface"):
        cut_as_seen(noisy, cut, HOW)


@pytest.mark.parametrize("asked", [0.5, 0.6])
def test_gaussians_are_cut_at_the_level_that_frames_call_for(asked, noisy, monkeypatch):
    """The lowest has all cells, as thin bodies do; another level that options ask for scales those that are tried."""
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: pytest.fail("not asked for"))
    monkeypatch.setattr("holosplat.methods.surfaces.with_missing_bodies", lambda *given: None)
    explained = replace(OPTIONS, coarse=replace(OPTIONS.coarse, missing_matter=0.3))
    levels, how = list[float](), replace(HOW, extraction=replace(HOW.extraction, level=asked))

    def cut(at: Extraction) -> SurfaceMesh:
        levels.append(at.level)
        return mesh_of(4 if at.level < 0.5 * asked else 1)

    found = BodiesStage(explained, surfaces=how).best_cut(noisy, cloud_of_surfaces(mesh_of(4), noisy), cut)
    assert torch.equal(found.vertices, mesh_of(4).vertices)
    assert levels == pytest.approx([share * asked for share in (0.4, 0.6, 0.8, 1.0, 1.2)])


def test_finer_voxels_leave_out_bodies_of_the_same_size():
    assert Extraction().finer() == Extraction(spacing=0.5, least_volume=64.0)
    assert Extraction(spacing=0.4).finer().spacing == FINEST
    assert Extraction(spacing=FINEST).finer() == Extraction(spacing=FINEST)


# --- when turns end -----------------------------------------------------------------------------------------


def turned(left: list[float], noisy: Task, monkeypatch: pytest.MonkeyPatch, turns: int = 6) -> tuple[int, int]:
    """Which of the surfaces is returned, and how many were judged, if they leave so much in turn."""
    judged, meshes = list[int](), [mesh_of(1) for _ in left]
    count = {id(mesh): k for k, mesh in enumerate(meshes)}

    def cut_again(*given) -> object:
        return meshes[len(judged)]

    def leaves(task: Task, found: object, surfaces: SurfaceOptions) -> float:
        judged.append(count[id(found)])
        return left[judged[-1]]

    monkeypatch.setattr("holosplat.methods.first_surfaces.settled", lambda task, start, surfaces, how: start)
    monkeypatch.setattr("holosplat.methods.first_surfaces._cut_again", cut_again)
    monkeypatch.setattr("holosplat.methods.first_surfaces._left", leaves)
    options = replace(OPTIONS, coarse=replace(OPTIONS.coarse, turns=turns, turn_gain=0.01))
    return count[id(in_turns(noisy, meshes[0], options, HOW))], len(judged)


@pytest.mark.parametrize(
    ("left", "taken", "asked"),
    [
        ([1.0, 0.9, 0.8, 0.799, 0.1], 3, 4),  # a gain too small for another turn is taken
        ([1.0, 0.9, 0.95, 0.1], 1, 3),  # a loss is not
        ([1.0, 1.0, 0.1], 0, 2),
    ],
)
def test_turns_go_on_as_long_as_they_gain(left, taken, asked, noisy, monkeypatch):
    assert turned(left, noisy, monkeypatch) == (taken, asked)


def test_turns_are_bounded(noisy, monkeypatch):
    assert turned([1.0, 0.5, 0.25, 0.1], noisy, monkeypatch, turns=2) == (2, 3)


def test_a_volume_without_a_surface_ends_them(noisy, monkeypatch):
    def none(*given) -> object:
        raise InputError("no surface")

    monkeypatch.setattr("holosplat.methods.first_surfaces.settled", lambda task, start, surfaces, how: start)
    monkeypatch.setattr("holosplat.methods.first_surfaces._cut_again", none)
    start = mesh_of(2)
    assert in_turns(noisy, start, OPTIONS, HOW) is start
