"""Cases of the benchmark: what each must be, and what files that declare them may say."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.bench_names import APART, BOTH_SIDES, MOST_VOXELS, NAMES, THIN
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.materials import DeltaBeta, parse_material
from holosplat.matter import MaterialPrior
from holosplat.scan import Exposures
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.scene import MeshScene
from holosplat.tables import merged
from holosplat_bench.specimens.rods import RodScene
from holosplat_bench.suite.case import FOLDER, Case, case_names, declared_names, load_case

SLOW = ("crowded12",)
"""Scenes that take seconds to make: that they follow their seed is tested on smaller ones (test_specimens_phantoms)."""


def near(value, rel=1e-6, abs=0.0):
    """pytest.approx without its absolute tolerance of 1e-12."""
    return pytest.approx(value, rel=rel, abs=abs)


@pytest.fixture(scope="module")
def loaded() -> dict[str, Case]:
    """Cases made so far, of seed 0."""
    return {}


@pytest.fixture(params=NAMES)
def case(request, loaded) -> Case:
    if request.param not in loaded:
        loaded[request.param] = load_case(request.param)
    return loaded[request.param]


def meshed(case: Case) -> MeshScene:
    """The scene of a case of meshes."""
    assert isinstance(case.scene, MeshScene)
    return case.scene


def vertices(case: Case) -> np.ndarray:
    """Vertices of meshes, centres of continuous elements, or ends of rods, [P, 3]."""
    if isinstance(case.scene, RodScene):
        return case.scene.ends.reshape(-1, 3)
    if isinstance(case.scene, ContinuousScene):
        return np.stack([element.centre for element in case.scene.elements])
    return np.concatenate([mesh.vertices for mesh in meshed(case).meshes])


# --- what every case must be --------------------------------------------------------------------------------


def test_the_suite_is_complete():
    assert case_names() == NAMES


def test_a_case_is_whole(case):
    """It fits its detector in every view, or is to go on beyond it, has frames of both kinds, and says what it is."""
    views = case.exposures.views
    assert case.name in NAMES
    assert case.scene.missing_field(views) <= 0 or case.goes_on
    assert np.count_nonzero(~case.is_test) >= 1
    assert np.count_nonzero(case.is_test) >= 4
    assert np.prod(Grid.of_views(views).shape) <= MOST_VOXELS.get(case.name, 1.65e6)
    assert 10 < len(case.summary) < 100
    assert not case.summary.endswith(".")
    assert "seed" in case.specimen
    directions = views.rotations[:, 2]
    between = np.abs(directions @ directions.T)[np.ix_(case.is_test, ~case.is_test)]
    assert between.max() < np.cos(
        np.deg2rad(APART.get(case.name, 2))
    )  # no held-out view is one of those for training, nor its reverse


@pytest.mark.parametrize("name", [name for name in NAMES if name not in SLOW])
def test_a_seed_is_a_scene(name, loaded):
    first = loaded.get(name) or load_case(name)
    again, other = load_case(name, 0), load_case(name, 1)
    assert np.array_equal(vertices(first), vertices(again))
    assert other.seed == 1
    same = vertices(first).shape == vertices(other).shape
    assert not same or np.mean(np.isclose(vertices(first), vertices(other))) < 0.7  # the foam's drop and y stay


def test_the_scene_is_matter_on_a_raster(case):
    """δ lies between that of the medium and the material's; the truth is neither empty nor full."""
    truth = case.truth()
    assert truth.grid.shape[1:] == case.exposures.views.shape
    extreme = float(truth.delta.flat[np.abs(truth.delta).argmax()])
    if case.prior.kind == "known" and case.name not in THIN:
        assert extreme == near(case.prior.materials[0].delta, rel=1e-5)
    assert (truth.delta / extreme).min() >= -BOTH_SIDES.get(case.name, 1e-6)
    share = np.mean(truth.delta / extreme > 0.5)
    assert (0.0005 if case.name in THIN else 0.002) < share < 0.4


@pytest.mark.parametrize("name", ["two_beam", "xmpi4", "shells8"])
def test_frames_for_training_are_noisy_and_held_out_ones_are_not(name):
    case = load_case(name)
    small = replace(case, exposures=case.exposures[[0, -1]], is_test=case.is_test[[0, -1]])
    noisy, clean = small.scan(), replace(small, photons=None).scan()
    held_out = small.is_test
    assert np.array_equal(noisy.frames[held_out], clean.frames[held_out])
    assert np.array_equal(noisy.is_test, held_out)
    assert noisy.provenance["case"] == name
    assert noisy.provenance["specimen"] == case.specimen
    assert clean.frames.std() > 0.01
    difference = noisy.frames - clean.frames
    if case.photons is None:
        assert not difference.any()
        assert "held_out_frames" not in noisy.provenance
        return
    assert difference[~held_out].var() == near(clean.frames[~held_out].mean() / case.photons, rel=0.05)
    assert noisy.provenance["photons_per_pixel"] == "2000"
    assert noisy.provenance["held_out_frames"] == "noise-free"
    assert np.array_equal(noisy.frames, small.scan().frames)
    assert not np.array_equal(noisy.frames, replace(small, seed=1).scan().frames)


# --- what single cases are ----------------------------------------------------------------------------------


def test_main12_with_seed_0_is_the_demonstration(loaded):
    from holosplat.specimens.red_cells import random_cells
    from holosplat.workflows.demo import CELL_PX, CELLS, DETECTOR, PIXEL_SIZE, SEED

    case = load_case("main12")
    rows, columns = (n * PIXEL_SIZE for n in DETECTOR)
    cells = random_cells(CELLS, (columns, rows, columns), SEED, CELL_PX * PIXEL_SIZE)
    assert vertices(case) == near(np.concatenate([cell.vertices for cell in cells]), rel=1e-12)
    assert case.exposures.views.shape == DETECTOR
    assert case.exposures.views.pixel_size == PIXEL_SIZE
    assert np.flatnonzero(case.is_test).tolist() == [3, 7, 11, 15]


def test_matter_of_plasma_shells_and_capsules():
    plasma, shells, capsules = (load_case(name) for name in ("plasma8-1e4", "shells8", "two_materials8"))
    assert plasma.prior.kind == "known"
    assert plasma.prior.materials[0].delta > 0 > plasma.prior.materials[0].beta
    assert plasma.photons == 1e4
    outer, core = meshed(shells).materials[0], meshed(shells).materials[-1]
    assert core == (-outer.delta, -outer.beta)
    assert shells.prior == MaterialPrior.known(outer)
    oil = parse_material("C16H34", 0.77).delta_beta(20.0)
    outer, core = meshed(capsules).materials[0], meshed(capsules).materials[-1]
    assert core.delta + outer.delta == near(oil.delta)
    assert core.beta + outer.beta == near(oil.beta)
    assert oil.ratio > 5 * outer.ratio
    assert capsules.prior == MaterialPrior.unknown()


def test_views_lie_as_declared():
    evenly, uneven, beams = load_case("cells6"), load_case("main4"), load_case("xmpi4")
    directions = evenly.exposures.views.rotations[:, 2]
    angles = np.rad2deg(np.arctan2(-directions[:, 0], directions[:, 2]))
    assert angles == near(np.array([0, 30, 60, 90, 120, 150, 15, 75, 105, 165]), abs=1e-9)
    assert uneven.exposures.views.shares_axis
    assert not beams.exposures.views.shares_axis
    train = beams.exposures.views.rotations[~beams.is_test]
    assert np.rad2deg(np.arcsin(train[:, 2, 1])) == near(np.array([0, 4, -6, 3]), abs=1e-9)  # out of the plane
    assert np.rad2deg(np.arctan2(-train[:, 2, 0], train[:, 2, 2])) == near(np.array([0, 23.8, 48, 90]), abs=1e-9)
    assert np.abs(np.linalg.det(train[[0, 1, 2], 2])) > 0.01  # not coplanar


def test_crowded12_has_a_haematocrit_of_20_percent(loaded):
    case = loaded.get("crowded12") or load_case("crowded12")
    volume = sum(mesh.volume for mesh in meshed(case).meshes)
    assert volume / (np.pi / 4 * (40e-6) ** 3) == near(0.2, rel=0.01)


def test_resolution_gives_its_balls():
    case = load_case("resolution")
    assert len(case.balls) == len(meshed(case).meshes) == 112
    for ball, mesh in zip(case.balls, meshed(case).meshes):
        assert isinstance(ball, Ball)
        assert mesh.volume == near(ball.volume)
        assert 0.5 * (mesh.bounds[0] + mesh.bounds[1]) == near(ball.centre, abs=0.01 * ball.diameter)
    sizes = np.array([ball.diameter for ball in case.balls]) / case.exposures.views.pixel_size
    assert sizes.min() == near(1.5)
    assert sizes.max() == near(12)
    assert load_case("main12").balls == ()


# --- snapshots ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "shape"), [("thesis16", (40, 104)), ("cells4", (48, 184))])
def test_snapshots_of_simulated_cells(name, shape, espresso_rbc):
    folder = espresso_rbc / "vtk"
    case, again = (load_case(name, seed, folder) for seed in (3, 53))
    assert case.specimen == "16 red cells, snapshot 003"
    assert np.array_equal(vertices(case), vertices(again))
    assert case.exposures.views.shape == shape
    low, high = case.scene.bounds
    assert low == near(-high)
    scale = 3.2 if name == "thesis16" else 1.0
    assert meshed(case).meshes[0].volume == near(90.75e-18 * scale**3, rel=0.01)
    assert load_case("xmpi4", 0, folder).specimen.startswith("40 generated")


def test_every_snapshot_fits(espresso_rbc):
    for seed in range(0, 50, 7):  # `Case` refuses those that do not
        load_case("cells4", seed, espresso_rbc / "vtk")


def test_folders_of_snapshots_are_checked(tmp_path):
    with pytest.raises(InputError, match=r"thesis\.toml, case thesis16: .* must hold snapshots named"):
        load_case("thesis16", 0, tmp_path)
    with pytest.raises(InputError, match="the folder of snapshots must exist, but"):
        load_case("thesis16", 0, tmp_path / "none")
    text = (FOLDER / "thesis.toml").read_text(encoding="utf-8").replace("[with_snapshots.specimen]", "[other]")
    file = written(tmp_path, re.sub(r"(?s)\[specimen\].*?\[other\]", "[specimen]", text))
    with pytest.raises(InputError, match="no folder of snapshots is given"):
        load_case(f"{file}:thesis8")


# --- files of one's own -------------------------------------------------------------------------------------

PLAIN = """
summary = "Two cells, for a test"
prior = "ratio"
[specimen]
kind = "red cells"
count = 2
diameter = 8e-6
box = [20e-6, 16e-6, 20e-6]
[matter]
material = { formula = "C5H8O2", density = 1.18 }
medium = "water"
[beam]
energy_kev = 15
distance = 0.05
[detector]
rows = 17
columns = 23
pixel_size = 1e-6
[views]
kind = "listed"
train = [[0, 0], [50.5, 10]]
test = [[20, 0]]
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_of_ones_own(tmp_path):
    path = written(tmp_path, PLAIN)
    case = load_case(path, 5)
    assert load_case(str(path)).name == case.name == "mine"
    assert case.seed == 5
    assert case.exposures.views.shape == (17, 23)
    assert case.exposures.one_energy("it") == 15.0
    assert case.is_test.tolist() == [False, False, True]
    assert case.photons is None
    contrast = parse_material("C5H8O2", 1.18).delta_beta(15.0).against(parse_material("water").delta_beta(15.0))
    assert meshed(case).materials == (contrast, contrast)
    assert case.prior == MaterialPrior.of_ratio(contrast.ratio)
    assert case.scan().frames.shape == (3, 17, 23)
    assert case.truth().grid.shape == (23, 17, 23)


def test_variants_say_what_differs(tmp_path):
    text = PLAIN + "[variants.bright]\nphotons = 1e5\n[variants.dim]\nphotons = 10\nspecimen.count = 1\n"
    path = written(tmp_path, text)
    assert declared_names(path) == ["bright", "dim"]
    bright, dim = (load_case(f"{path}:{name}") for name in ("bright", "dim"))
    assert (bright.photons, dim.photons) == (1e5, 10.0)
    assert (len(meshed(bright).meshes), len(meshed(dim).meshes)) == (2, 1)
    assert dim.name == "dim"
    with pytest.raises(InputError, match=r"declares several cases; choose one of .*mine\.toml:bright"):
        load_case(path)
    with pytest.raises(InputError, match=r"must be one of those in .*, bright, dim, but it is 'grey'"):
        load_case(f"{path}:grey")


def test_changes_merge_unless_they_are_of_another_kind():
    table = {"a": 1, "b": {"kind": "x", "c": 2, "d": {"e": 3}}}
    assert merged(table, {"b": {"d": {"f": 4}}}) == {"a": 1, "b": {"kind": "x", "c": 2, "d": {"e": 3, "f": 4}}}
    assert merged(table, {"b": {"kind": "y"}, "g": 5}) == {"a": 1, "b": {"kind": "y"}, "g": 5}
    assert table == {"a": 1, "b": {"kind": "x", "c": 2, "d": {"e": 3}}}


WRONG = [
    ("prior =", "colour = 1\nprior =", "colour is not known; remove it, or use one of summary, specimen"),
    ("count = 2", "count = 2\nnumber = 3", "specimen.number is not known; remove it, or use one of count, diameter"),
    ("count = 2", "", "specimen.count is missing; add it"),
    ("count = 2", "count = 2.5", "specimen.count must be a whole number, but it is 2.5"),
    ("count = 2", "count = true", "specimen.count must be a whole number, but it is True"),
    ("count = 2", "count = 0", "specimen: count must be at least 1"),
    ("diameter = 8e-6", 'diameter = "8 µm"', "specimen.diameter must be a number, but it is '8 µm'"),
    ("diameter = 8e-6", "diameter = nan", "specimen.diameter must be a number, but it is nan"),
    ("diameter = 8e-6", "diameter = 8.0", "diameter must be at most 1 metres, but it is 8"),
    ("20e-6, 16e-6, 20e-6", "20e-6, 16e-6", r"specimen.box must have 3 entries, but it is \[2e-05, 1.6e-05\]"),
    ("20e-6, 16e-6, 20e-6", '20e-6, "a", 20e-6', r"specimen.box\[1\] must be a number, but it is 'a'"),
    ("[20e-6, 16e-6, 20e-6]", "20e-6", "specimen.box must be a list, but it is 2e-05"),
    ('kind = "red cells"', "", "specimen.kind is missing; add one of red cells, crowded cells"),
    ('"red cells"', '"cats"', "specimen.kind must be one of red cells, .*, star of balls, .*, but it is 'cats'"),
    ('"red cells"', "3", "specimen.kind must be one of .*, but it is 3"),
    ("box =", 'shape = "cone"\nbox =', "specimen.shape must be one of cylinder, box, but it is 'cone'"),
    (", density = 1.18", "", "matter.material: material 'C5H8O2' is a formula and needs its density"),
    ("density = 1.18", "density = -1", "matter.material: density of C5H8O2 must be a positive number"),
    ('"water"', '"unobtainium"', "matter.medium: material 'unobtainium' must be a chemical formula"),
    (
        '"water"',
        '{ formula = "vacuum", density = 1 }',
        "matter.medium: vacuum, or delta and beta, have no density; remove it",
    ),
    (
        'medium = "water"',
        'core = "water"',
        "matter.core must be absent, as the specimen, red cells, has no cores; remove it",
    ),
    ('medium = "water"', 'medium = "C5H8O2"', "matter.medium: material 'C5H8O2' is a formula and needs its density"),
    ('medium = "water"', "medium = 3", "matter.medium must be a table, but it is 3"),
    ("energy_kev = 15", "energy_kev = 15e3", "energy must lie between 1e-06 and 1000 keV, but it is 15000"),
    ("distance = 0.05", "distance = -1", "beam: distance must not be negative, but it is -1"),
    ("rows = 17", "rows = 0", "detector: rows must be at least 1, but it is 0"),
    ("rows = 17", "rows = 9", r"mine \(seed 0\) must lie within the detector in every view, but it reaches"),
    ("pixel_size = 1e-6", "pixel_size = 1.0", "pixel size must lie between 1e-10 and 0.01 metres, but it is 1"),
    ("[50.5, 10]", "50.5", r"views.train\[1\] must be a list, but it is 50.5"),
    ('medium = "water"', "medium = { delta = 1e-8 }", "matter.medium: a substance must be given by its formula, or by"),
    (
        '"water"',
        '{ formula = "H2O", delta = 1e-8, beta = 0 }',
        "matter.medium: a substance must be given by its formula",
    ),
    ("[beam]", "[light]\nlight_smooth = 2\n[beam]", "light: light_smooth must be at most 0.2, but it is 2"),
    ("[[20, 0]]", "[]", "views: test must list at least one direction"),
    ('"listed"', '"interleaved"', "views.train is not known; remove it, or use one of count, hold_out_every"),
    ('"ratio"', '"guessed"', "prior must be one of known, ratio, free, but it is 'guessed'"),
    ('"ratio"', '"ratio"\nphotons = 0', "photons must be a positive number, but it is 0"),
    ("[matter]", "[matter", "mine.toml must be valid TOML"),
    ('summary = "Two cells, for a test"', "summary = 3", "summary must be a text, but it is 3"),
    ("[beam]", "[variants]\nx = 3\n[beam]", r"variants must be tables \[variants.NAME\]"),
    ("[specimen]", "with_snapshots = 3\n[specimen]", "with_snapshots must be a table, but it is 3"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG, ids=[w[2][:30] for w in WRONG])
def test_a_mistake_is_named_with_its_file_and_field(old, new, message, tmp_path):
    assert PLAIN.count(old) == 1, "the example no longer holds what the test changes"
    with pytest.raises(InputError, match=message) as caught:
        load_case(written(tmp_path, PLAIN.replace(old, new)))
    assert "mine" in str(caught.value)


def test_views_that_cannot_be(tmp_path):
    views = 'kind = "listed"\ntrain = [[0, 0], [50.5, 10]]\ntest = [[20, 0]]'
    for text, message in (
        ('kind = "interleaved"\ncount = 3', "views: hold_out_every must lie between 2 and count, 3, but it is 4"),
        ('kind = "between"\ntrain = 3\ntest = 4', "views: test must lie between 1 and train, 3, but it is 4"),
    ):
        with pytest.raises(InputError, match=message):
            load_case(written(tmp_path, PLAIN.replace(views, text)))


def test_names_and_seeds_are_checked(tmp_path):
    with pytest.raises(InputError, match=r"case must be one of main12, .*, or a TOML file, but it is 'main13'"):
        load_case("main13")
    with pytest.raises(InputError, match="must be a TOML file, but there is no such file"):
        load_case(tmp_path / "none.toml")
    with pytest.raises(InputError, match="seed must be 0 or more, but it is -1"):
        load_case("main12", -1)
    core = PLAIN.replace('kind = "red cells"\ncount = 2\ndiameter = 8e-6', 'kind = "foam"\ndrop = 1e-5\ncount = 1')
    core = core.replace("box = [20e-6, 16e-6, 20e-6]", "median = 2e-6")
    with pytest.raises(InputError, match=r"matter\.core is missing, which fills the cores of the specimen, foam"):
        load_case(written(tmp_path, core))


def test_a_case_has_frames_of_both_kinds():
    scene = MeshScene.of_one_material([Ball(np.zeros(3), 4e-6).mesh()], DeltaBeta(1e-6, 1e-9))
    exposures = Exposures.of(Views.evenly_spaced(3, (9, 9), 1e-6), 20.0, 0.1)
    for is_test in (np.zeros(3, dtype=bool), np.ones(3, dtype=bool)):
        with pytest.raises(InputError, match="frames for training and held-out ones"):
            Case("x", 0, scene, exposures, is_test, MaterialPrior.unknown())
    with pytest.raises(InputError, match="is_test must have the shape"):
        Case("x", 0, scene, exposures, np.zeros(2, dtype=bool), MaterialPrior.unknown())
