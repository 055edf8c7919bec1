"""Large frames: surfaces on coarse pixels first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.bumpy import DELTA, bumpy, poses, surfaces
from holosplat.baselines import HolographicTV
from holosplat.beamline.simulate import simulate
from holosplat.fit.loop import Fit
from holosplat.fit.problem import Schedule
from holosplat.geometry import Grid
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.mesh import TriangleMesh
from holosplat.methods import Gaussians, Near, SurfaceOptions, Surfaces, Task, begun
from holosplat.methods.auto import Bodies
from holosplat.methods.coarse import STAGE as COARSE
from holosplat.methods.coarse import CoarseToFine, mean_chord, on_pixels, unexplained
from holosplat.methods.first_surfaces import first_surfaces
from holosplat.methods.gaussian_options import FitOptions
from holosplat.methods.gaussians import GaussianStage, nearby
from holosplat.methods.illumination import prepared
from holosplat.methods.method import run_quietly
from holosplat.methods.start import cloud_of_surfaces
from holosplat.methods.surface_fit import SurfaceFit, oversampling
from holosplat.methods.surfaces import refine_surfaces
from holosplat.model import measure
from holosplat.optics.background import LightOptions
from holosplat.optics.sampling import fringe_sampling
from holosplat.projectors.surface import surface_occupancy
from holosplat.representations import GaussianCloud, SurfaceMesh
from holosplat.scan import Exposures, Scan
from holosplat.specimens.scene import MeshScene
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("plain_light")

PITCH = 0.5e-6
QUICK = CoarseToFine(columns=32, coarse_steps=15, last_steps=10, views=1, fit_steps=3)
MATTER = HAEMOGLOBIN.delta_beta(20.0)
EVEN = LightOptions("even", noise="white")
"""What light decides is for other tests."""


def body(radius: float = 20.0, centre=(1.2, -0.8, 0.6)) -> TriangleMesh:
    """In pixels."""
    return bumpy(4, radius, centre, depth=0.2)


def scan_of(*bodies: TriangleMesh, shape=(67, 73), photons: float | None = None) -> Scan:
    """Six views from all directions of bodies in pixels."""
    scene = MeshScene.of_one_material([replace(b, vertices=PITCH * b.vertices) for b in bodies], MATTER)
    return simulate(scene, Exposures.of(poses(6, shape, 3, PITCH), 20.0, 0.05, 0.3), photons_per_pixel=photons, seed=1)


@pytest.fixture(scope="module")
def scan() -> Scan:
    return scan_of(body())


def quick(coarse: CoarseToFine = QUICK) -> Gaussians:
    """Gaussians with few steps."""
    few = Gaussians(
        approximate_steps=5, coarse=coarse, volume=HolographicTV(retrieval=10, iterations=30, corrections=0)
    )
    return replace(few, fit=replace(few.fit, schedule=replace(few.fit.schedule, steps=10)))


def task_of(scan: Scan) -> Task:
    return prepared(Task(scan, MaterialPrior.known(MATTER), light=EVEN))


def dice(found, *true: TriangleMesh) -> float:
    grid = Grid.centred((60, 60, 60), PITCH)
    a, b = (s.voxelise(grid).delta > 0.5 * DELTA for s in (found, surfaces(*true, unit=PITCH)))
    return float(2 * (a & b).sum() / (a.sum() + b.sum()))


# --- when, and what counts ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "factor"), [((128, 128), 1), ((255, 256), 1), ((256, 256), 2), ((512, 700), 4), ((1024, 1024), 8),
                          ((40, 4000), 1), ((64, 1024), 2), ((200, 400), 2)]
)  # fmt: skip
def test_only_large_frames_are_binned(shape, factor):
    assert CoarseToFine().factor(shape) == factor
    assert CoarseToFine(columns=0).factor(shape) == 1


def test_the_mean_chord_of_a_ball_is_four_thirds_of_its_radius():
    ball = surfaces(bumpy(4, 9.0, (3.0, 1.0, -2.0), depth=0.0), unit=1e-6)
    assert mean_chord(ball) == pytest.approx(12e-6, rel=0.01)
    two = surfaces(bumpy(4, 9.0, depth=0.0), bumpy(4, 3.0, (20.0, 0, 0), depth=0.0), unit=1e-6)
    expected = 4 / 3 * (9**3 + 3**3) / (9**2 + 3**2) * 1e-6
    assert mean_chord(two) == pytest.approx(expected, rel=0.01)


def test_surfaces_in_finer_pixels_are_where_they_were():
    coarse = surfaces(bumpy(2, 9.0, (0.5, 0.2, 0.0)), unit=1e-6)
    same = on_pixels(coarse, 0.5e-6, edge=100.0)
    assert torch.allclose(same.vertices * same.unit_length, coarse.vertices * coarse.unit_length)
    finer = on_pixels(coarse, 0.5e-6, edge=3.0)
    assert len(finer.faces) == 4 * len(coarse.faces)
    assert finer.mesh().volume == pytest.approx(coarse.mesh().volume, rel=0.03)


def test_fine_structure_tells_what_is_missing(scan):
    options = SurfaceOptions()
    true, larger = surfaces(body(), unit=PITCH), surfaces(body(21.5), unit=PITCH)
    assert unexplained(true, scan, options) < 0.02
    assert unexplained(larger, scan, options) > 0.25
    nothing = surfaces(bumpy(1, 0.01), unit=PITCH)
    assert unexplained(nothing, scan, options) == pytest.approx(1.0, abs=0.02)
    noisy = scan_of(body(), photons=50.0)
    assert unexplained(true, noisy, options) < 0.1
    flat = replace(scan, frames=np.random.default_rng(0).normal(1, 0.1, scan.frames.shape).astype(np.float32))
    assert unexplained(true, flat, options) == 0.0


@pytest.mark.parametrize(("missing", "rounds"), [(1.0, False), (0.0, True)])
def test_rounds_of_agreement_come_first_where_a_volume_explains_badly(scan, missing, rounds):
    """Of both volumes, the one whose surfaces leave less is taken."""
    stages, left = set[str](), dict[float, float]()
    task = replace(task_of(scan), on_progress=lambda stage, share: stages.add(stage))
    for most in (1.0, missing):
        volume = HolographicTV(retrieval=10, iterations=30, corrections=3)
        options = replace(quick(replace(QUICK, missing=most)), volume=volume)
        way, _ = first_surfaces(task, options, SurfaceOptions(), lambda task: pytest.fail("no Gaussians are wanted"))
        found = way(None)
        assert found is not None
        left[most] = unexplained(found, scan, SurfaceOptions())
    assert ("agreement with the holograms" in stages) == rounds
    assert left[missing] <= left[1.0]


@pytest.mark.parametrize("order", [(20.0, 16.0), (16.0, 20.0)], ids=["before the rounds", "after them"])
def test_of_the_volumes_before_and_after_rounds_the_better_is_cut(scan, order, monkeypatch):
    grid = Grid.of_views(scan.views)
    middle = 0.5 * (np.array(grid.shape[::-1]) - 1)
    before, after = (
        surface_occupancy(torch.from_numpy(mesh.vertices + middle), torch.tensor(mesh.faces), grid.shape)
        for mesh in (body(radius) for radius in order)
    )

    def volumes(scan, material, how, on_progress, light, wanted, lines):
        assert wanted(before, grid)
        return after, grid

    monkeypatch.setattr("holosplat.methods.first_surfaces.holographic_tv", volumes)
    options = quick(replace(QUICK, missing=0.0))
    way, _ = first_surfaces(
        task_of(scan), options, SurfaceOptions(), lambda task: pytest.fail("no Gaussians are wanted")
    )
    found = way(None)
    assert found is not None
    assert dice(found, body()) > 0.9  # 0.68 of the smaller one


def test_a_fit_near_its_end_takes_fewer_and_shorter_steps():
    usual, how = FitOptions(), CoarseToFine(fit_steps=7, fit_rate=0.25)
    short = nearby(usual, how, 3)
    assert short.schedule == replace(usual.schedule, steps=7, oversample=3)
    asked = replace(usual, schedule=replace(usual.schedule, oversample=2))
    assert nearby(asked, how, 3).schedule.oversample == 2
    assert vars(short.rates) == pytest.approx({name: 0.25 * rate for name, rate in vars(usual.rates).items()})


# --- from coarse to fine ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def near(scan):
    """What coarse pixels show, and the task then."""
    return begun(Bodies(quick(), SurfaceOptions()).stages()[0], task_of(scan), None)


def test_surfaces_of_coarse_pixels_are_near_those_of_fine_ones(near):
    start, task = near
    assert isinstance(start, SurfaceMesh)
    assert task.near
    assert start.unit_length == PITCH
    assert dice(start, body()) > 0.97


def test_few_steps_on_fine_pixels_end_it(scan, near):
    first, last = Bodies(quick(), SurfaceOptions()).stages()
    assert first.fit(near[1], near[0]) is None
    start, task = begun(last, near[1], near[0])
    assert task.near
    fit = last.fit(task, start)
    assert fit is not None
    found = run_quietly(fit, lambda share: None, SurfaceMesh)
    assert dice(found, body()) > 0.985
    left = measure(found, scan.exposures, 2) - torch.from_numpy(scan.frames)
    assert float(left.square().mean()) < 0.02 * float(np.square(scan.frames - 1).mean())


def test_gaussians_of_large_frames_fill_the_coarse_surfaces(scan):
    stage = quick().stages()[0]
    start, task = begun(stage, task_of(scan), None)
    assert isinstance(start, GaussianCloud)
    assert task.near
    assert dice(start, body()) > 0.97
    fit = stage.fit(task, start)
    assert isinstance(fit, Fit)
    assert fit.schedule.steps == QUICK.fit_steps
    assert fit.oversample == oversampling(scan) > fringe_sampling(scan.exposures)
    far = stage.fit(replace(task, near=False), start)
    assert isinstance(far, Fit)
    assert far.schedule.steps == 10


def test_surfaces_of_gaussians_in_large_frames_go_by_coarse_pixels(scan, monkeypatch):
    """To those of the body, in the few steps of near ones; by options of one's own they are cut out on fine pixels."""
    cloud, stages = cloud_of_surfaces(surfaces(body(19.7), unit=PITCH), task_of(scan)), list[str]()
    found = refine_surfaces(cloud, scan, on_progress=lambda stage, part: stages.append(stage), coarse=QUICK)
    assert dice(found, body()) > 0.985
    assert found.unit_length == PITCH
    assert f"{COARSE}: 2 × 2" in stages
    assert stages.count("surfaces") == QUICK.last_steps
    monkeypatch.setattr("holosplat.methods.surfaces.coarse_surfaces", lambda *given: pytest.fail("not asked for"))
    own = SurfaceOptions(fit=SurfaceFit(schedule=Schedule(steps=3)))
    stages.clear()
    fine = refine_surfaces(cloud, scan, own, lambda stage, part: stages.append(stage), QUICK)
    assert stages.count("surfaces") == 3
    assert len(fine.faces) > 2 * len(found.faces)
    small = CoarseToFine()  # to which these frames are small
    assert refine_surfaces(fine, scan, SurfaceOptions(), coarse=small).faces.shape == fine.faces.shape


def test_bodies_too_thin_for_coarse_pixels_start_on_their_own(scan):
    for coarse in (replace(QUICK, chord=1000.0), replace(QUICK, columns=0)):
        assert GaussianStage(quick(coarse)).coarse_surfaces(task_of(scan), SurfaceOptions()) is None


def test_small_bodies_beside_a_large_one_are_not_lost():
    """What coarse pixels do not show is in the fine structure of the frames, which then start on their own pixels."""
    specks = [bumpy(2, 1.6, centre, depth=0.0) for centre in np.random.default_rng(2).uniform(-24, 24, (60, 3))]
    task = task_of(scan_of(body(12.0), *specks))
    stage = GaussianStage(quick())
    assert stage.coarse_surfaces(task, SurfaceOptions()) is None
    ((_, poor),) = stage.poor  # the large body alone
    assert poor is not None
    assert unexplained(poor, task.scan, SurfaceOptions()) > quick().coarse.missing


def test_a_run_goes_on_from_a_near_start_with_as_few_steps(scan, near, tmp_path, monkeypatch, unjudged_runs):
    """Cut off in the fit of surfaces, it goes on without looking at coarse pixels again, to the same surfaces."""
    folder, prior = RunFolder(tmp_path / "run"), MaterialPrior.known(MATTER)
    method = Surfaces(gaussians=quick())
    monkeypatch.setattr(GaussianStage, "coarse_surfaces", lambda stage, task, how: near[0])
    whole = reconstruct(scan, prior, method, light=EVEN, matter="levels")

    def stop(stage, part, record):
        if stage == "surfaces" and record.get("step") == 4:
            raise KeyboardInterrupt

    cut = reconstruct(scan, prior, method, light=EVEN, matter="levels", folder=folder, on_progress=stop)
    assert not cut.finished
    monkeypatch.delattr(GaussianStage, "coarse_surfaces")
    again = reconstruct(scan, prior, method, light=EVEN, matter="levels", folder=folder, resume=True)
    assert again.finished
    assert isinstance(again.object, SurfaceMesh)
    assert isinstance(whole.object, SurfaceMesh)
    assert torch.equal(again.object.vertices, whole.object.vertices)
    rows = folder.metrics.read_text(encoding="utf-8").strip().splitlines()
    assert len(rows) == 1 + QUICK.last_steps
    assert isinstance(load_reconstruction(folder).object, SurfaceMesh)


def test_a_near_start_says_so(scan):
    class Stage:
        name = "s"

        def start(self, task, before):
            return before or Near(surfaces(body()))

        def fit(self, task, start):
            return None

    found, task = begun(Stage(), task_of(scan), None)
    assert task.near
    _, task = begun(Stage(), task, found)  # handed on
    assert task.near
    _, task = begun(Stage(), task, surfaces(body(3.0)))
    assert not replace(task, near=False).near


def test_fewer_frames_take_more_steps():
    how = CoarseToFine(coarse_steps=40, finer_steps=20, last_steps=30, views=12)
    few, many = how.of_views(4), how.of_views(24)
    assert (few.coarse_steps, few.finer_steps, few.last_steps) == (120, 60, 90)
    assert many == how
    assert few.fit_steps == how.fit_steps
