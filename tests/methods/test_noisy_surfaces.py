"""Small noisy frames of closed bodies: where Gaussians explain these badly, surfaces of a volume take their place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.bumpy import bumpy, surfaces
from helpers.noisy_cells import CELLS, MATTER, PITCH, SHAPE, error, mesh_of, occupancy, task_of
from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.geometry import Views
from holosplat.inference import Decision, Score
from holosplat.materials import HAEMOGLOBIN, WATER
from holosplat.matter import MaterialPrior, Matter
from holosplat.mesh import TriangleMesh
from holosplat.methods import Gaussians, SurfaceOptions, Surfaces, Task
from holosplat.methods import first_surfaces as first_surfaces_module
from holosplat.methods.coarse import CoarseToFine, Way, begun_surfaces, first_of, missing_matter, settled
from holosplat.methods.cross_validation import BY_FISSION, BY_VIEWS
from holosplat.methods.first_surfaces import first_surfaces, is_noisy, surfaces_of_volume, with_missing_bodies
from holosplat.methods.gaussian_options import FitOptions
from holosplat.methods.illumination import prepared
from holosplat.methods.method import quiet
from holosplat.methods.start import cloud_of_surfaces
from holosplat.methods.surface_fit import Extraction, SurfaceFit, extract_surfaces
from holosplat.methods.surfaces import BODIES, MORE, BodiesStage
from holosplat.optics.background import LightOptions
from holosplat.representations import SurfaceMesh
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene
from holosplat.tables import with_entries
from holosplat.workflows.reconstruct import reconstruct

OPTIONS = Gaussians(
    approximate_steps=5,
    fit=FitOptions(schedule=Schedule(steps=5)),
    coarse=CoarseToFine(coarse_steps=10, views=1),
)
HOW = SurfaceOptions(fit=SurfaceFit(schedule=Schedule(steps=20)))


@pytest.fixture(scope="module")
def noisy() -> Task:
    """Of frames about half of whose contrast is noise."""
    task = task_of(2000.0)
    assert is_noisy(task, OPTIONS)
    return task


def test_what_is_missing_is_told_beyond_noise(noisy):
    assert missing_matter(mesh_of(), noisy, HOW) < 0.1
    assert missing_matter(mesh_of(3), noisy, HOW) > 0.3
    assert missing_matter(surfaces(bumpy(1, 0.01), unit=PITCH), noisy, HOW) > 0.9


def test_rounds_of_agreement_in_noise_are_more_and_smoother():
    usual = HolographicTV(corrections=5, weight=0.2)
    assert usual.in_noise() == replace(usual, noisy=1.0, corrections=10, weight=1.0)
    assert replace(usual, weight=2.0).in_noise().weight == 2.0


def test_a_volume_that_agrees_with_noisy_frames_is_nearer_to_the_truth():
    """The volume before had an error of 0.24 where phase retrieval trusted noise at low frequencies, and 0.19 after."""
    noisy, errors = task_of(1000.0), list[float]()
    for how in (HolographicTV(), HolographicTV().in_noise()):
        found, _ = holographic_tv(noisy.scan, MATTER, replace(how, refine=1), quiet)
        errors.append(error(found.numpy()))
    assert errors[0] < 0.21
    assert errors[1] < min(0.9 * errors[0], 0.175)


# --- which way is gone --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("left", "asked", "taken"),
    [((0.05, 0.01), 1, 0), ((0.5, 0.05), 2, 1), ((0.3, 0.5), 2, 0), ((0.5,), 1, 0)],
    ids=["the first explains", "the second does", "none does", "there is one"],
)
def test_the_next_way_is_gone_where_the_first_explains_badly(noisy, left, asked, taken, monkeypatch):
    cells, tried = [mesh_of(1 + k) for k in range(len(left))], list[int]()
    judged = {len(mesh.faces): share for mesh, share in zip(cells, left)}

    def way(k: int) -> Way:
        def gone(before: SurfaceMesh | None) -> SurfaceMesh:
            assert (None if before is None else len(before.faces)) == (len(cells[k - 1].faces) if k else None)
            tried.append(k)
            return cells[k]

        return gone

    monkeypatch.setattr("holosplat.methods.coarse.missing_matter", lambda mesh, task, how: judged[len(mesh.faces)])
    how = CoarseToFine(coarse_steps=1, chord=0.0)
    found = first_of(noisy, [way(k) for k in range(len(left))], HOW, how)
    assert found is not None
    assert len(found.faces) == len(cells[taken].faces)
    assert tried == list(range(asked))


def test_gaussians_come_first_in_noise_and_a_way_without_surfaces_is_none(noisy):
    asked = list[str]()

    def fitted(task: Task):
        asked.append("Gaussians")
        raise InputError("no matter")

    gaussians, _ = first_surfaces(noisy, OPTIONS, HOW, fitted)
    assert gaussians(None) is None
    assert asked == ["Gaussians"]


def test_without_much_noise_surfaces_take_turns_with_what_explains_badly(monkeypatch):
    clean, before, given, better = task_of(1e7), mesh_of(3), list[SurfaceMesh](), [mesh_of(4)]
    monkeypatch.setattr(
        "holosplat.methods.first_surfaces.in_turns", lambda task, before, *rest: (given.append(before), better[0])[1]
    )
    _, turns = first_surfaces(clean, OPTIONS, HOW, lambda task: pytest.fail("no Gaussians are wanted"))
    assert turns(None) is None
    assert turns(before) is better[0]
    assert given == [before]
    better[0] = before
    assert turns(before) is None


@pytest.fixture
def nothing_missing(monkeypatch):
    """Bodies that are missing are for other tests."""
    monkeypatch.setattr("holosplat.methods.surfaces.with_missing_bodies", lambda *given: None)


EXPLAINED = replace(OPTIONS, coarse=replace(OPTIONS.coarse, missing_matter=0.3))
"""What so few noisy pixels tell."""
LONGER = replace(EXPLAINED, coarse=replace(EXPLAINED.coarse, coarse_steps=20))  # a body grows from what others leave


def best_cut(task: Task, count: int, options: Gaussians = EXPLAINED) -> tuple[SurfaceMesh, int]:
    """What surfaces begin with after Gaussians of so many cells, and on how many spacings of voxels these were cut."""
    cuts, cloud = set[float](), cloud_of_surfaces(mesh_of(count), task)
    stage = BodiesStage(options, surfaces=HOW)
    found = stage.best_cut(task, cloud, lambda how: (cuts.add(how.spacing), mesh_of(count))[1])
    return found, len(cuts)


@pytest.mark.usefixtures("nothing_missing")
def test_gaussians_that_explain_the_frames_are_cut(noisy, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: pytest.fail("not asked for"))
    found, cuts = best_cut(noisy, 4)
    assert cuts == 1
    assert torch.equal(found.vertices, mesh_of().vertices)


@pytest.fixture(scope="module")
def of_two(noisy) -> tuple[SurfaceMesh, int]:
    """What takes the place of Gaussians that have two of the four cells."""
    return best_cut(noisy, 2)


def test_gaussians_that_lost_cells_give_way_to_the_volume(of_two):
    """Beside those of a volume there are those cut on finer voxels, which lack the same cells."""
    found, cuts = of_two
    assert cuts == 2
    assert error(found) < 0.25 < error(mesh_of(3))


@pytest.mark.usefixtures("nothing_missing")
def test_of_two_that_explain_little_the_better_is_taken(noisy, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: mesh_of(1))
    found, _ = best_cut(noisy, 3)
    assert len(found.faces) == len(mesh_of(3).faces)
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: None)
    found, _ = best_cut(noisy, 1)
    assert torch.equal(found.vertices, mesh_of(1).vertices)


@pytest.mark.usefixtures("nothing_missing")
def test_gaussians_without_a_surface_give_way(noisy, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: mesh_of(2))

    def none(how: Extraction) -> SurfaceMesh:
        raise InputError("no surface")

    cloud = cloud_of_surfaces(mesh_of(4), noisy)  # which lacks nothing
    stage = BodiesStage(EXPLAINED, surfaces=HOW)
    assert len(stage.best_cut(noisy, cloud, none).faces) == len(mesh_of(2).faces)
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: None)
    with pytest.raises(InputError, match="no surface"):
        stage.best_cut(noisy, cloud, none)


@pytest.mark.usefixtures("nothing_missing")
@pytest.mark.parametrize(("poor", "cut"), [(4, 2), (2, 4)], ids=["of the volume", "of Gaussians"])
def test_of_the_surfaces_of_clean_frames_those_that_explain_more_are_taken(poor, cut, monkeypatch):
    """Gaussians that began because surfaces explained the frames badly may explain them worse: then these are taken."""
    monkeypatch.setattr(BodiesStage, "near_surfaces", lambda *given: pytest.fail("they are there"))
    clean = task_of(1e7)
    stage, cloud = (
        BodiesStage(OPTIONS, surfaces=HOW, poor=[(clean.scan, mesh_of(poor))]),
        cloud_of_surfaces(mesh_of(cut), clean),
    )
    assert len(stage.best_cut(clean, cloud, lambda how: mesh_of(cut)).faces) == len(mesh_of().faces)


@pytest.mark.usefixtures("nothing_missing")
def test_where_clean_frames_had_no_first_surfaces_gaussians_that_lack_matter_give_way(monkeypatch):
    """Of a crack, whose mean chord is a few pixels, there are none, and Gaussians may lose it."""
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: mesh_of(4))
    monkeypatch.setattr(BodiesStage, "near_surfaces", lambda *given: pytest.fail("it was asked"))
    clean = task_of(1e7)
    stage, cloud = BodiesStage(EXPLAINED, surfaces=HOW, poor=[(clean.scan, None)]), cloud_of_surfaces(mesh_of(2), clean)
    assert torch.equal(stage.best_cut(clean, cloud, lambda how: mesh_of(2)).vertices, mesh_of(4).vertices)


@pytest.mark.usefixtures("nothing_missing")
@pytest.mark.parametrize("there", [True, False])
def test_a_resumed_run_of_clean_frames_makes_its_first_surfaces_anew(there, monkeypatch):
    def near(stage: BodiesStage, task: Task, surfaces: SurfaceOptions) -> None:
        stage.poor[:] = [(task.scan, mesh_of(4) if there else None)]

    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: None)
    monkeypatch.setattr(BodiesStage, "near_surfaces", near)
    found, _ = best_cut(task_of(1e7), 2)
    assert len(found.faces) == len(mesh_of(4 if there else 2).faces)


@pytest.mark.usefixtures("nothing_missing")
def test_surfaces_of_a_random_start_have_no_rivals_but_finer_ones(monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: pytest.fail("not asked for"))
    monkeypatch.setattr(BodiesStage, "near_surfaces", lambda *given: pytest.fail("not asked for"))
    at_random = replace(EXPLAINED, start="random")
    assert best_cut(task_of(2000.0), 1, at_random)[1] == 2


# --- missing bodies -----------------------------------------------------------------------------------------


def test_a_body_that_is_missing_joins(noisy, monkeypatch):
    """Without a volume of all matter, one of four cells comes out of what three leave of the frames, in its place."""
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: None)
    told = list[Decision]()
    task = replace(noisy, on_start=lambda decision, guess: told.append(decision))
    found, _ = best_cut(task, 3, LONGER)
    cells = [body for body in found.bodies() if body.volume > 0.3 * CELLS[3].volume]
    assert len(cells) == 4
    assert error(found) < 0.5 * error(mesh_of(3))
    assert (told[-1].name, told[-1].choice, told[-1].by) == (BODIES, MORE, BY_VIEWS)


def test_where_none_is_missing_none_joins(noisy):
    found, _ = best_cut(noisy, 4)
    assert torch.equal(found.vertices, mesh_of().vertices)


def test_a_body_that_unseen_views_do_not_show_does_not_join(noisy, monkeypatch):
    """Training frames may prefer one that makes up for their noise. Folds have the frames' own pixels, for coarse ones
    show no small body, and are scored by frames that they have not fitted."""
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: None)
    monkeypatch.setattr("holosplat.methods.cross_validation.WIDTH", SHAPE[1] // 2)
    views, own, told, seen = len(noisy.scan), BodiesStage._score, list[Decision](), list[set[bytes]]()

    def frames(task: Task) -> set[bytes]:
        return {frame.tobytes() for frame in task.scan.frames}

    def bodies(task: Task, *rest) -> tuple[float, SurfaceMesh]:
        assert task.scan.views.shape == SHAPE
        if len(task.scan) < views:
            seen.append(frames(task))
        return 0.2, mesh_of(1 if len(task.scan) < views else 4)

    def score(stage: BodiesStage, found: SurfaceMesh, task: Task) -> Score:
        assert not seen or not frames(task) & seen[-1]
        return own(stage, found, task)

    monkeypatch.setattr("holosplat.methods.surfaces.with_missing_bodies", bodies)
    monkeypatch.setattr(BodiesStage, "_score", score)
    task = replace(noisy, on_start=lambda decision, guess: told.append(decision))
    found, _ = best_cut(task, 3)
    assert torch.equal(found.vertices, mesh_of(3).vertices)
    assert [each.choice for each in told[-2:]] == [MORE, "as found"]
    assert seen


def test_what_is_too_much_is_not_made_up_for_elsewhere(noisy):
    """Beside bodies that are 1.15 times as large none joins that makes them much worse."""
    balls = [(body, body.vertices.mean(0)) for body in mesh_of().bodies()]
    large = surfaces(*(replace(b, vertices=(m + 1.15 * (b.vertices - m)) / PITCH) for b, m in balls), unit=PITCH)
    assert 0.4 < error(large) < 0.8
    longer = replace(LONGER.coarse, coarse_steps=60)
    made = with_missing_bodies(noisy, large, HOW, longer)
    assert made is None or error(made[1]) < 1.15 * error(settled(noisy, large, HOW, longer))


def test_missing_bodies_are_additions_to_what_is_there(noisy, monkeypatch):
    """The occupancy of the surfaces changes, which may fall, too; from nothing on it could not."""
    given, own = list[torch.Tensor](), first_surfaces_module.sirt

    def sirt(*arguments, start: torch.Tensor, **options) -> torch.Tensor:
        given.extend((start, own(*arguments, start=start, **options)))
        return given[-1]

    monkeypatch.setattr(first_surfaces_module, "sirt", sirt)
    with_missing_bodies(noisy, mesh_of(3), HOW, OPTIONS.coarse, (0.2,))
    start, changed = given
    assert torch.allclose(start, torch.from_numpy(occupancy(mesh_of(3))).float(), atol=1e-5)
    assert 0 <= changed.min() <= changed.max() <= 1
    assert (changed - start).min() < -0.1


def test_where_no_body_keeps_a_voxel_there_are_none(noisy, monkeypatch):
    small = surfaces(bumpy(1, 0.4), unit=PITCH)
    monkeypatch.setattr("holosplat.methods.first_surfaces.settled", lambda *given: small)
    assert with_missing_bodies(noisy, mesh_of(3), HOW, OPTIONS.coarse) is None
    inside_out = SurfaceMesh(small.vertices, small.faces.flip(1), PITCH, small.matter)
    monkeypatch.setattr("holosplat.methods.first_surfaces.settled", lambda *given: inside_out)
    assert with_missing_bodies(noisy, mesh_of(3), HOW, OPTIONS.coarse) is None


@pytest.mark.parametrize("views", [[0, 4], [0, 1, 3, 4, 6]])
def test_few_views_are_judged_by_data_fission(noisy, views, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: None)
    monkeypatch.setattr("holosplat.methods.surfaces.with_missing_bodies", lambda *given: (0.2, mesh_of(4)))
    told = list[Decision]()
    task = replace(noisy.of_views(np.array(views)), on_start=lambda decision, guess: told.append(decision))
    found, _ = best_cut(task, 2)
    assert (told[-1].name, told[-1].choice, told[-1].by, told[-1].compared[0].least) == (BODIES, MORE, BY_FISSION, 0.0)
    assert torch.equal(found.vertices, mesh_of(4).vertices)


@pytest.mark.parametrize(("count", "joins"), [(2, True), (4, True), (4, False)])
def test_large_frames_get_none_and_small_ones_where_none_shall_join(noisy, count, joins, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.with_missing_bodies", lambda *given: pytest.fail("not asked for"))
    monkeypatch.setattr(BodiesStage, "_small", lambda *given: not joins)
    found, _ = best_cut(noisy, count, with_entries(EXPLAINED, {"join_missing": joins}))
    assert torch.equal(found.vertices, mesh_of(count).vertices)


def test_bodies_of_several_materials_get_none(noisy):
    one, two = mesh_of(), Matter.several(MATTER, WATER.delta_beta(20.0))
    two = SurfaceMesh(one.vertices, one.faces, PITCH, two, parts=(len(one.faces) // 2,) * 2)
    assert with_missing_bodies(noisy, two, HOW, OPTIONS.coarse) is None


# --- thin bodies --------------------------------------------------------------------------------------------


def rods(radius: float) -> tuple[Task, SurfaceMesh]:
    """Frames without much noise of three long ellipsoids of water, and these, in pixels."""
    points, faces = icosphere(4)
    ends = ((radius, 14.0, radius), (radius, radius, 14.0), (14.0, radius, radius))
    places = ((-10.0, 0.0, 0.0), (0.0, 6.0, 0.0), (4.0, -7.0, 8.0))
    meshes = [TriangleMesh(points * np.array(half) + np.array(at), faces) for half, at in zip(ends, places)]
    true, matter = surfaces(*meshes, unit=1e-6), HAEMOGLOBIN.delta_beta(20.0)
    scene = MeshScene.of_one_material([replace(one, vertices=1e-6 * one.vertices) for one in meshes], matter)
    exposures = Exposures.of(Views.evenly_spaced(8, (33, 46), 1e-6), 20.0, 0.1)
    scan = simulate(scene, exposures, photons_per_pixel=1e5, seed=1, is_test=np.zeros(8, dtype=bool))
    return prepared(Task(scan, MaterialPrior.known(matter), light=LightOptions("even", noise="white"))), true


@pytest.mark.parametrize("radius", [1.1, 3.0], ids=["thin", "thick"])
def test_thin_bodies_are_cut_on_finer_voxels(radius):
    """Of rods whose Gaussians are blurred by as much as their radius pixels' voxels lose a third of the matter."""
    task, true = rods(radius)
    cloud, cuts = cloud_of_surfaces(true, task), set[float]()

    def cut(how: Extraction) -> SurfaceMesh:
        cuts.add(how.spacing)
        return extract_surfaces(cloud, task.scan, how)

    found = BodiesStage(OPTIONS, surfaces=HOW).best_cut(task, cloud, cut)
    volumes = [sum(body.volume for body in mesh.bodies()) for mesh in (found, true)]
    assert cuts == ({1.0, 0.5} if radius < 2 else {1.0})
    assert volumes[0] == pytest.approx(volumes[1], rel=0.06)


def test_where_a_network_is_asked_gaussians_give_way_as_without(noisy, of_two):
    found, _ = best_cut(noisy, 2, replace(OPTIONS, start="learned"))
    assert torch.equal(found.vertices, of_two[0].vertices)


def test_surfaces_of_the_volume_explain_noisy_frames(noisy):
    found = begun_surfaces(noisy, lambda task: surfaces_of_volume(task, OPTIONS, HOW), HOW, OPTIONS.coarse)
    assert found is not None
    assert missing_matter(found, noisy, HOW) < 0.3 * missing_matter(mesh_of(3), noisy, HOW)
    assert error(found) < 0.25


def test_a_run_ends_with_them(noisy, unjudged_runs, plain_light):
    """Gaussians of five steps explain nothing."""
    method = Surfaces(fit=HOW.fit, gaussians=OPTIONS)
    found = reconstruct(noisy.scan, noisy.prior, method, light=noisy.light, matter="levels").object
    assert isinstance(found, SurfaceMesh)
    assert error(found) < 0.25
