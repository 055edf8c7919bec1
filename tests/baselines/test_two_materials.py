"""Two materials at once: told apart by δ, their β by absorption, and Gaussians that are of one or of the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from helpers.cli import holosplat, refused, worked
from holosplat import native
from holosplat.baselines import HolographicTV
from holosplat.baselines.two_materials import Levels, Shares, absorption, at_one_ratio, told_apart, two_levels
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.terms import comparisons as terms
from holosplat.geometry import Grid, Views
from holosplat.io.atomic import read_json
from holosplat.io.nxtomo import write_scan
from holosplat.io.objects import read_object, write_object
from holosplat.materials import Compound, DeltaBeta
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods import Gaussians, Task
from holosplat.methods.presets import preset
from holosplat.methods.start import starting_cloud
from holosplat.methods.surface_fit import extract_surfaces
from holosplat.model import Instrument, measure
from holosplat.optics.background import LightOptions
from holosplat.representations import GaussianCloud, VoxelLines, approximate, cloud_from_shares
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.volume import LineIntegrals
from holosplat.workflows.evaluate import evaluate
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder
from holosplat_bench.specimens.phantoms import place_capsules

PIXEL = 1e-6
ROWS, COLUMNS = 43, 51
SILICA = Compound("SiO2", 2.2).delta_beta(20.0)
OIL = Compound("C16H34", 0.77).delta_beta(20.0)
BOTH = (SILICA, OIL)
PRIOR = MaterialPrior.known(OIL, SILICA)
EVEN = LightOptions("even", noise="white")
pytestmark = pytest.mark.usefixtures("plain_light", "unjudged_runs")


def capsules(seed: int = 1) -> MeshScene:
    """Three shells of silica around oil, in a field of 43 × 51 pixels."""
    found = place_capsules((15 * PIXEL, 20 * PIXEL), 3, (48 * PIXEL, 40 * PIXEL, 48 * PIXEL), 3.5 * PIXEL, seed)
    meshes = [c.outer(3, f"capsule{i}") for i, c in enumerate(found)]
    cores = [c.core(3, f"core{i}") for i, c in enumerate(found)]
    return MeshScene((*meshes, *cores), (SILICA,) * len(meshes) + (OIL.against(SILICA),) * len(cores))


def exposures(count: int = 8) -> Exposures:
    return Exposures.of(Views.evenly_spaced(count, (ROWS, COLUMNS), PIXEL), 20.0, 0.1)


@pytest.fixture(scope="module")
def scan() -> Scan:
    return simulate(capsules(), exposures(10))


@pytest.fixture(scope="module")
def grid() -> Grid:
    return Grid.of_views(exposures().views)


@pytest.fixture(scope="module")
def delta(grid) -> torch.Tensor:
    """δ of the capsules on voxels of a pixel, a little blurred, as tomography leaves it."""
    return torch.from_numpy(gaussian_filter(capsules().voxelise(grid).delta, 0.5))


@pytest.fixture(scope="module")
def shares(delta, grid) -> Shares:
    return Shares(told_apart(delta, (SILICA.delta, OIL.delta), 1), grid, BOTH)


# --- telling them apart -------------------------------------------------------------------------------------


def test_two_levels_are_found_where_there_are_two_materials(delta):
    high, low = two_levels(delta, 1)
    assert high == pytest.approx(SILICA.delta, rel=0.05)
    assert low == pytest.approx(OIL.delta, rel=0.10)


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_one_material_has_one_level_however_blurred(grid, noise):
    cells = random_cells(4, (45 * PIXEL, 38 * PIXEL, 45 * PIXEL), 2, 14 * PIXEL)
    volume = MeshScene.of_one_material(cells, SILICA).voxelise(grid).delta
    for blur in (0.4, 1.0):
        smooth = gaussian_filter(volume, blur)
        rough = noise * SILICA.delta * np.random.default_rng(3).standard_normal(smooth.shape)
        assert two_levels(torch.from_numpy((smooth + rough).clip(0).astype(np.float32)), 1) is None


def test_levels_that_are_near_each_other_pass_for_one(delta):
    core = (delta > 0.8 * OIL.delta) & (delta < 1.2 * OIL.delta)
    near = torch.where(core, delta * 0.8 * SILICA.delta / OIL.delta, delta)
    assert two_levels(near, 1) is None


def test_two_materials_need_all_four_signs_of_them():
    """Levels apart, near to all values, the lower one more than a rim, and level."""
    two = Levels(high=2.0, low=1.0, spread=0.25, share=0.5, deviation=0.15)
    assert two.are_two()
    for sign in ({"low": 1.5}, {"spread": 0.6}, {"share": 0.05}, {"deviation": 0.5}):
        assert not replace(two, **sign).are_two()


def test_voxels_are_of_the_material_that_they_are_full_of(shares, grid):
    """And what lies between the denser one and nothing is that one in part, not a rim of the lighter one."""
    denser, lighter = shares.values
    scene = capsules()
    cores = MeshScene.of_one_material(scene.meshes[3:], DeltaBeta(1.0, 0.0)).voxelise(grid).delta
    whole = MeshScene.of_one_material(scene.meshes[:3], DeltaBeta(1.0, 0.0)).voxelise(grid).delta
    assert 0.85 < float(lighter.sum()) / cores.sum() < 1.15
    assert float(lighter[torch.from_numpy(cores) == 0].sum()) < 0.05 * float(lighter.sum())
    assert float((denser * lighter).max()) == 0
    assert float(denser[torch.from_numpy(whole - cores) > 0.99].mean()) > 0.9


def test_a_layer_thinner_than_two_pixels_is_no_material_of_its_own():
    slab = torch.zeros(9, 11, 13)
    slab[:, 3:8] = 1.0
    slab[:, 2] = slab[:, 8] = 0.45  # voxels that the slab fills in part
    denser, lighter = told_apart(slab, (1.0, 0.45), 1)
    assert float(lighter.sum()) == 0
    torch.testing.assert_close(denser, slab)


# --- what they absorb ---------------------------------------------------------------------------------------


def test_absorption_is_that_of_the_frames(shares, grid):
    """Frames by the same optics from the same shares: both β to a per cent, though δ was never asked for."""
    shown = exposures()
    instrument = Instrument(shown, 1)
    frames = instrument.frames(LineIntegrals(VoxelLines(grid, instrument.views)(shares.values), BOTH))
    scan = Scan(frames.numpy(), shown, np.zeros(len(shown), dtype=bool))
    found = absorption(scan, shares.values, grid, [m.delta for m in BOTH])
    np.testing.assert_allclose(found, [SILICA.beta, OIL.beta], rtol=0.01, atol=1e-12)


def test_absorption_is_near_that_of_other_optics(scan, shares, grid):
    """Frames by the mesh projector; what oil absorbs, a fortieth of what silica does, drowns in the voxels' error."""
    silica, oil = absorption(scan.train(), shares.values, grid, [m.delta for m in BOTH])
    assert silica == pytest.approx(SILICA.beta, rel=0.2)
    assert 0 <= oil < 0.3 * SILICA.beta


def test_frames_at_one_ratio_are_those_of_matter_of_that_ratio(shares, grid):
    shown = exposures(3)
    instrument = Instrument(shown, 1)
    lines = VoxelLines(grid, instrument.views)(shares.values)
    test = np.zeros(len(shown), dtype=bool)
    scan = Scan(instrument.frames(LineIntegrals(lines, BOTH)).numpy(), shown, test)
    same = tuple((m.delta, m.delta / 700) for m in BOTH)
    expected = instrument.frames(LineIntegrals(lines, same)).numpy()
    assert np.abs(scan.frames - expected).max() > 1e-3
    np.testing.assert_allclose(at_one_ratio(scan, shares, 700).frames, expected, rtol=1e-5)


# --- Gaussians of two materials -----------------------------------------------------------------------------


def two_clouds() -> tuple[GaussianCloud, GaussianCloud, GaussianCloud]:
    """A cloud of two materials, and its two halves as clouds of one each."""
    draw = torch.Generator().manual_seed(5)
    n = 14
    centres = (torch.rand(n, 3, generator=draw) - 0.5) * 20
    shapes = (0.3 * torch.randn(n, 3, generator=draw) + 0.5, torch.randn(n, 4, generator=draw))
    amplitudes = torch.rand(n, 2, generator=draw) + 0.05
    one, other = (
        GaussianCloud((centres, *shapes, raw_of(amplitudes[:, [c]])), PIXEL, Matter.one(*material))
        for c, material in enumerate(BOTH)
    )
    return GaussianCloud((centres, *shapes, raw_of(amplitudes)), PIXEL, Matter.several(SILICA, OIL)), one, other


def test_a_cloud_of_two_materials_is_the_sum_of_two_clouds():
    both, one, other = two_clouds()
    views = Views.evenly_spaced(3, (21, 27), PIXEL)
    for channel in range(2):
        expected = one.project(views)[channel] + other.project(views)[channel]
        torch.testing.assert_close(both.project(views)[channel], expected, rtol=1e-4, atol=1e-9 * float(expected.max()))
    grid = Grid.of_views(views)
    for name in ("delta", "beta"):
        expected = getattr(one.voxelise(grid), name) + getattr(other.voxelise(grid), name)
        np.testing.assert_allclose(getattr(both.voxelise(grid), name), expected, rtol=1e-4, atol=1e-5 * expected.max())


def test_a_cloud_of_two_materials_keeps_them(tmp_path):
    both, _, _ = two_clouds()
    assert both.matter.occupancies
    assert not both.matter.single
    assert both.matter.channels == (SILICA, OIL)
    assert both.detached().on("reference").matter.others == (OIL,)
    write_object(tmp_path / "object.h5", both)
    found = read_object(tmp_path / "object.h5")
    assert isinstance(found, GaussianCloud)
    assert found.matter == both.matter
    for name, p in both.parameters().items():
        torch.testing.assert_close(found.parameters()[name], p, rtol=0, atol=0)


def test_gaussians_of_two_start_as_one_or_the_other(shares, grid):
    cloud = cloud_from_shares(shares.values, grid, BOTH, PIXEL, PIXEL)
    amplitudes = cloud.amplitudes
    assert bool(((amplitudes < 2e-4).sum(dim=1) == 1).all())
    learnt = approximate(cloud, shares.values, grid, 20, lambda stage, fraction: None)
    for c in range(2):
        difference = learnt.density(grid)[c] - shares.values[c]
        assert float(difference.norm() / shares.values[c].norm()) < 0.15


def test_a_material_that_is_not_there_is_named(shares, grid):
    alone = torch.stack([shares.values[0], torch.zeros(grid.shape)])
    with pytest.raises(InputError, match="nothing of the material of δ"):
        cloud_from_shares(alone, grid, BOTH, PIXEL, PIXEL)


def test_occupancies_of_two_are_bounded_together():
    half = torch.full((2, 3, 4, 5), 0.5)
    assert float(terms.overfull(half)) == 0
    assert float(terms.overfull(2 * half)) == pytest.approx(1)
    assert float(terms.two_levels(half)) == pytest.approx(0.5)
    pure = torch.stack([torch.ones(3, 4, 5), torch.zeros(3, 4, 5)])
    assert float(terms.two_levels(pure)) == 0


# --- what is known of them ----------------------------------------------------------------------------------


def test_the_denser_of_two_known_materials_comes_first():
    assert MaterialPrior.known(SILICA, OIL) == PRIOR
    assert PRIOR.materials == BOTH
    assert MaterialPrior.known(OIL).materials == (OIL,)
    assert MaterialPrior.of_ratio(300).materials == ()


def test_materials_that_delta_does_not_tell_apart_are_refused():
    with pytest.raises(InputError, match="told apart by δ, but theirs are"):
        MaterialPrior.known(SILICA, DeltaBeta(SILICA.delta, 0.0))


# --- reconstruction -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def truth(grid):
    return capsules().voxelise(grid)


def settings(refine: int = 0) -> Gaussians:
    quick = preset("default")
    schedule, volume = replace(quick.fit.schedule, steps=40), replace(quick.volume, refine=refine)
    return replace(quick, volume=volume, fit=replace(quick.fit, schedule=schedule))


def test_two_materials_are_found_where_nothing_is_known(scan, truth):
    """δ is right; β of the dense one is known to its order of magnitude only."""
    found = reconstruct(scan, MaterialPrior.unknown(), settings())
    assert found.object.matter.others
    (high, dark), (low, _) = found.object.matter.channels
    assert high == pytest.approx(SILICA.delta, rel=0.05)
    assert low == pytest.approx(OIL.delta, rel=0.25)
    assert 0.2 * SILICA.beta < dark < 1.35 * SILICA.beta
    scores = evaluate(found, scan, truth)
    assert scores.volume.relative_error_delta < 0.16
    assert "of 2; beside: δ " in scores.lines()[-1]
    assert "inf" not in scores.lines()[-1]
    assert scores.as_dict()["material"]["others"][0]["delta"] == pytest.approx(low)


def test_two_known_materials_are_taken_as_they_are(scan, truth):
    found = reconstruct(scan, PRIOR, settings(refine=1), light=EVEN)
    assert found.object.matter.channels == BOTH
    scores = evaluate(found, scan, truth)
    assert scores.volume.relative_error_delta < 0.18
    assert scores.volume.dice > 0.92


def test_delta_and_beta_apart_are_still_to_be_had(scan):
    cloud = starting_cloud(Task(scan.train(), MaterialPrior.unknown()), replace(settings(), separate=True))
    assert not cloud.matter.others
    assert not cloud.matter.occupancies


def test_a_second_material_is_not_looked_for_where_there_shall_be_one(scan):
    cloud = starting_cloud(Task(scan.train(), MaterialPrior.unknown()), replace(QUICK, most_materials=1))
    assert cloud.matter.single
    with pytest.raises(InputError, match="most_materials must be at most 2"):
        replace(QUICK, most_materials=3)


def test_a_random_start_of_two_known_materials_has_both(scan):
    cloud = starting_cloud(Task(scan.train(), PRIOR), preset("random"))
    assert cloud.matter.channels == BOTH


QUICK = Gaussians(
    spacing_px=2.0,
    approximate_steps=5,
    volume=HolographicTV(iterations=30, corrections=1, inner=5, refine=1),
    fit=replace(preset("default").fit, schedule=replace(preset("default").fit.schedule, steps=6)),
)


def test_a_run_of_two_materials_is_resumed_as_one(scan, tmp_path):
    """Interrupted and gone on with, it is the run that was never interrupted; and it is read back with both."""

    def stop(stage: str, fraction: float, record: dict[str, float]) -> None:
        if stage == "fit" and record["step"] == 3:
            raise KeyboardInterrupt

    whole, parts = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "parts")
    expected = reconstruct(scan, PRIOR, QUICK, light=EVEN, folder=whole).object
    assert not reconstruct(scan, PRIOR, QUICK, light=EVEN, folder=parts, on_progress=stop).finished
    reconstruct(scan, PRIOR, QUICK, light=EVEN, folder=parts, resume=True)
    found = load_reconstruction(parts).object
    assert found.matter.channels == BOTH
    for name, p in expected.parameters().items():
        torch.testing.assert_close(found.parameters()[name], p, rtol=0, atol=0)
    assert read_json(parts.summary)["other_materials"] == [{"delta": OIL.delta, "beta": OIL.beta}]


def test_the_plain_path_needs_no_kernels(scan, monkeypatch):
    monkeypatch.setattr(native, "call", lambda *_: pytest.fail("a kernel was called"))
    plain = replace(QUICK, volume=replace(QUICK.volume, backend="reference", iterations=8, retrieval=10))
    plain = replace(plain, spacing_px=4.0, approximate_steps=1, fit=replace(QUICK.fit, backend="reference"))
    cloud = starting_cloud(Task(scan.train()[[0, 3, 6]].cropped(slice(8, 35), slice(6, 45)), PRIOR), plain)
    assert cloud.matter.channels == BOTH
    values = torch.rand(2, 9, 11, 13, generator=torch.Generator().manual_seed(2))
    grid = Grid((9, 11, 13), (PIXEL,) * 3, (-6 * PIXEL, -5 * PIXEL, -4 * PIXEL))
    assert len(absorption(scan.train(), values, grid, [1e-6, 4e-7], "reference")) == 2


def test_surfaces_of_two_materials_are_refused(scan, tmp_path):
    cloud = starting_cloud(Task(scan.train(), PRIOR), QUICK)
    with pytest.raises(InputError, match="has several materials"):
        extract_surfaces(cloud, scan)


def test_frames_of_a_cloud_of_two_go_through_the_same_optics(scan):
    """`measure` of the start is near the frames: the materials reach the waves in metres, not in pixels."""
    cloud = starting_cloud(Task(scan.train(), PRIOR), settings(refine=1))
    with torch.no_grad():
        frames = measure(cloud, scan.train().exposures)
    misfit = np.square(frames.numpy() - scan.train().frames).mean() / scan.train().frames.var()
    assert misfit < 0.1


# --- command line -------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("undrawn_reports")
def test_two_materials_are_named_on_the_command_line(scan, tmp_path):
    write_scan(tmp_path / "scan.nxs", scan)
    run = tmp_path / "run"
    named = ("--material", "SiO2", "--density", 2.2, "--material", "C16H34", "--density", 0.77)
    few = ("volume.iterations=40", "volume.corrections=1", "approximate_steps=5", "fit.schedule.steps=6")
    quick = ("--preset", "fast", *(word for change in few for word in ("--set", change)))
    worked(holosplat("reconstruct", tmp_path / "scan.nxs", *named, *quick, "--out", run))
    assert read_object(run / "object.h5").matter.channels == pytest.approx(np.array(BOTH), rel=1e-6)
    shown = worked(holosplat("evaluate", run))
    assert "of 2" in shown.out
    refused(holosplat("surface", run, "--out", tmp_path / "surfaces"), "several materials")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--density", 1.1), "--density can only go with --material"),
        (("--delta-beta", 300, "--material", "water"), "give --material or --delta-beta, not both"),
        (("--material", "SiO2", *(3 * ("--density", 1.1))), "for each formula (1), but it is given 3"),
        (("--material", "water", "--material", "water"), "told apart"),
    ],
)
def test_what_does_not_go_together_is_refused(scan, tmp_path, options, words):
    write_scan(tmp_path / "scan.nxs", scan)
    out = tmp_path / "run"
    refused(holosplat("reconstruct", tmp_path / "scan.nxs", *options, "--out", out), words)
    assert not out.exists()


def test_one_material_is_enough_to_convert(scan, tmp_path):
    write_scan(tmp_path / "scan.nxs", scan)
    named = ("--material", "SiO2", "--density", 2.2, "--material", "water")
    command = ("convert", tmp_path / "scan.nxs", tmp_path / "out", "--to", "r2-gaussian", *named)
    refused(holosplat(*command), "one material")
