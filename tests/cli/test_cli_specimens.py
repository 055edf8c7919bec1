"""`holosplat simulate` of generated matter and of volumes, `holosplat materials`, and what they refuse."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from helpers.cli import Outcome, holosplat, worked
from holosplat.checks import InputError
from holosplat.cli.options import PriorOptions
from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan
from holosplat.io.volumes import read_volume
from holosplat.io.vtk import read_meshes
from holosplat.materials import parse_material
from holosplat_bench.specimens.matter import CHANGING, MATTER

pytestmark = pytest.mark.usefixtures("unjudged_runs")

FIELD: list[object] = ["--detector", 21, 30, "--pixel-size", "2e-6", "--views", 4]


def ran(*arguments: object) -> Outcome:
    return worked(holosplat(*arguments))


KINDS = {
    "soft-cells": ["--specimen-count", 3],
    "round-cell": [],
    "tissue": [],
    "head-phantom": [],
    "coated-droplets": ["--core", "paraffin", "--specimen-count", 3],
    "body-with-absorber": ["--core", "iron"],
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_generated(kind, tmp_path):
    scan, truth = tmp_path / "s.nxs", tmp_path / "t.h5"
    ran("simulate", "--specimen", kind, "--material", "PMMA", *KINDS[kind], *FIELD, "--out", scan, "--truth", truth)
    found, volume = read_scan(scan), read_volume(truth)
    assert found.frames.shape == (4, 21, 30)
    assert found.frames.std() > 0.01
    assert found.provenance["specimen"] == kind
    assert volume.grid.shape == (30, 21, 30)
    assert volume.delta.max() > 4e-7


def test_a_volume_gives_the_frames_of_what_it_was_made_of(tmp_path):
    """A cell, and its true volume of half a pixel, as HDF5 and as TIFF images; granules of a pixel lose fringes."""
    out = {name: tmp_path / f"{name}.nxs" for name in ("cells", "volume", "tiff")}
    truth, fine = tmp_path / "t.h5", tmp_path / "fine.h5"
    generate = ["--specimen", "round-cell", "--specimen-size", "36e-6", "--material", "PMMA", "--medium", "water"]
    ran("simulate", *generate, *FIELD, "--out", out["cells"], "--truth", truth)
    half = ["--detector", 42, 60, "--pixel-size", "1e-6", "--views", 1, "--test-every", 0]
    ran("simulate", *generate, *half, "--out", tmp_path / "x.nxs", "--truth", fine)
    ran("simulate", fine, *FIELD, "--out", out["volume"], "--truth", tmp_path / "t2.h5")
    volume = read_volume(fine)
    ratio = volume.delta.sum(dtype=float) / volume.beta.sum(dtype=float)
    tifffile.imwrite(tmp_path / "fine.tif", volume.delta.transpose(1, 0, 2) / 1e-7, photometric="minisblack")
    says = ["--voxel-size", "1e-6", "--value-delta", "1e-7", "--value-delta-beta", ratio]
    ran("simulate", tmp_path / "fine.tif", *says, *FIELD, "--out", out["tiff"])
    frames = {name: read_scan(path).frames for name, path in out.items()}
    contrast = frames["cells"].std()
    assert contrast > 0.005
    assert np.sqrt(np.mean((frames["volume"] - frames["cells"]) ** 2)) < 0.2 * contrast
    assert np.sqrt(np.mean((frames["tiff"] - frames["volume"]) ** 2)) < 0.01 * contrast
    again = read_volume(tmp_path / "t2.h5")
    assert again.grid == read_volume(truth).grid == Grid.centred((30, 21, 30), 2e-6)
    assert np.linalg.norm(again.delta - read_volume(truth).delta) < 0.03 * np.linalg.norm(again.delta)
    assert read_scan(out["tiff"]).provenance["volume"] == "fine.tif"


def test_light_is_in_the_frames_and_in_the_file(tmp_path):
    out = tmp_path / "s.nxs"
    light = ["--light-smooth", 0.02, "--light-grain", 0.004, "--photons-per-pixel", 1e6]
    ran(
        "simulate",
        "--specimen",
        "round-cell",
        "--medium",
        "haemoglobin",
        "--material",
        "red cell",
        *light,
        *FIELD,
        "--out",
        out,
    )
    scan = read_scan(out)
    assert scan.provenance["light_grain"] == "0.004"
    assert 0.005 < scan.frames[:, 0].std() < 0.05


def test_vacuum_replaces_the_medium_that_is_usual_for_a_kind(tmp_path):
    scan, truth = tmp_path / "s.nxs", tmp_path / "t.h5"
    drops = ["--specimen", "bubbles", "--material", "water", "--medium", "vacuum"]
    ran("simulate", *drops, *FIELD, "--out", scan, "--truth", truth)
    assert read_scan(scan).provenance["medium"] == "vacuum"
    water = parse_material("water").delta_beta(20.0)
    assert read_volume(truth).delta.max() == pytest.approx(water.delta, rel=1e-6)
    told = PriorOptions(material=("water",), medium="vacuum")
    assert told.prior(20.0, "tube:4e-5:5e-5:glass:vacuum") == PriorOptions(material=("water",)).prior(20.0)
    assert told.prior(20.0).against == ""
    with pytest.raises(InputError, match="--medium-density needs a --medium other than vacuum"):
        replace(told, medium_density=1.0).prior(20.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "needs mesh files, a volume, or --specimen"),
        (["--specimen", "tissue", "a.vtk"], "give it or files, not both"),
        (["--specimen", "coated-droplets"], "needs --core"),
        (["--specimen", "tissue", "--core", "iron"], "--core is not of the tissue"),
        (["--specimen", "coated-droplets", "--core-density", 1], "needs --core"),
        (["--specimen", "tissue", "--frame-rate", 100], "--frame-rate is of moving meshes"),
        (["--specimen", "stirred-blob"], "moves; give --frame-rate"),
        (["--specimen", "stirred-blob", "--frame-rate", 100], "--frames of two or more"),
        (["--specimen", "stirred-blob", "--frame-rate", 1, "--frames", 2, "--start", 1], "leave --start"),
        (["--specimen", "tissue", "--specimen-motion", 3], "--specimen-motion is of matter that moves"),
        (["--specimen", "tissue", "--bandwidth", 0.01], "a spectrum needs meshes of files"),
        (["--specimen", "tissue", "--specimen-seed", -1], "specimen-seed must not be negative"),
        (["--specimen", "tissue", "--light-drift-px", 3], "light_drift_px moves the pattern"),
        (["a.vtk", "--voxel-size", "1e-6"], "of TIFF images, not of meshes"),
        (["a.vtk", "b.h5"], "meshes or a volume, but there are both"),
        (["a.tif"], "a.tif"),
        (["a.tif", "--value-delta", "1e-7"], "--value-delta needs --voxel-size"),
        (["a.tif", "--voxel-size", "1e-6", "--value-delta-beta", 100], "--value-delta-beta needs --value-delta"),
        (["a.h5", "--voxel-size", "1e-6"], "are of TIFF images, but a.h5 is none"),
    ],
)
def test_requests_that_cannot_be_are_refused(arguments, said, tmp_path):
    outcome = holosplat("simulate", *arguments, *FIELD, "--out", tmp_path / "s.nxs")
    assert outcome.code == 2
    assert re.search(r"\W+".join(re.findall(r"\w+", said)), outcome.said)
    assert not (tmp_path / "s.nxs").exists()


@pytest.mark.parametrize("suffix", [".vti", ".mrc"])
def test_the_truth_in_other_formats_is_imaged_again(suffix, tmp_path):
    truth, field = tmp_path / f"t{suffix}", ["--detector", 12, 15, "--pixel-size", "2e-6", "--views", 1]
    ran("simulate", "--specimen", "round-cell", *field, "--out", tmp_path / "s.nxs", "--truth", truth)
    ran("simulate", truth, *field, "--out", tmp_path / "again.nxs")
    first, again = (read_scan(tmp_path / name).frames for name in ("s.nxs", "again.nxs"))
    assert np.corrcoef(first.ravel(), again.ravel())[0, 1] > 0.9
    outcome = holosplat("simulate", "--specimen", "round-cell", *field, "--out", tmp_path / "x.nxs", "--truth", "t.raw")
    assert outcome.code == 2
    assert "truth must be a file whose name ends with .h5" in outcome.said
    assert not (tmp_path / "x.nxs").exists()


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        ("stirred-blob", ("--specimen-motion", 90)),
        ("collapsing-foam", ("--specimen-motion", 0.3, "--specimen-count", 2)),
    ],
)
def test_specimens_that_move_give_series(kind, how, tmp_path):
    out, truth = tmp_path / "series.nxs", tmp_path / "truth.h5"
    moving = ["--specimen", kind, *how, "--frame-rate", 1e5, "--frames", 3]
    field = ["--detector", 20, 23, "--pixel-size", "2e-6", "--views", 2, "--material", "PMMA", "--test-every", 0]
    ran("simulate", *moving, *field, "--out", out, "--truth", truth, "--truth-frames", 0, 2)
    scan = read_scan(out)
    assert scan.is_series
    assert scan.instants == pytest.approx([0, 1e-5, 2e-5], abs=0)
    first, last = (read_volume(truth.with_stem(f"truth_t000{k}")).delta for k in (0, 2))
    assert last.sum() == pytest.approx(first.sum(), rel=0.03)
    assert np.abs(last - first).max() > 0.05 * first.max()


def test_materials_are_listed():
    everything = ran("materials").out.splitlines()
    assert len(everything) > 50
    bone = [line for line in ran("materials", "bone", "--energy-kev", 30).out.splitlines() if line.startswith("cort")]
    assert "ICRU-44" in bone[0]
    assert "1.92" in bone[0]
    refused = holosplat("materials", "kryptonite")
    assert refused.code == 2
    assert "kryptonite is in none" in refused.err


def test_bubbles_are_generated_against_their_medium(tmp_path):
    """Air in water: δ and β of the truth are below zero, and frames are those of holes."""
    scan, truth = tmp_path / "s.nxs", tmp_path / "t.h5"
    drawn = ["--specimen-count", 5, "--specimen-radii", "3e-6", "8e-6", "--specimen-overlap"]
    ran("simulate", "--specimen", "bubbles", "--medium", "water", *drawn, *FIELD, "--out", scan, "--truth", truth)
    found, volume = read_scan(scan), read_volume(truth)
    assert found.provenance["specimen"] == "bubbles"
    assert found.provenance["specimen_count"] == "5"
    assert found.provenance["medium"] == "water"
    assert found.provenance["material"] == "air"
    size = float(found.provenance["specimen_size"])
    radii = [float(share) * size for share in found.provenance["specimen_radii"].split()]
    assert radii == pytest.approx([3e-6, 8e-6], rel=1e-4)
    assert volume.delta.min() == pytest.approx(-5.75e-7, rel=0.01)
    assert volume.delta.max() == 0
    assert volume.beta.min() < 0
    stray = ["--specimen-overlap", *FIELD, "--out", tmp_path / "x.nxs"]
    refused = holosplat("simulate", "--specimen", "tissue", *stray)
    assert "--specimen-radii and --specimen-overlap are of bubbles, not of tissue" in refused.err
    assert not (tmp_path / "x.nxs").exists()
    equal = ["--material", "water", "--medium", "water", "--out", tmp_path / "run"]
    refused = holosplat("reconstruct", scan, *equal)
    assert refused.code != 0
    assert "the material must differ from its medium in δ, but the difference is 0" in refused.err
    assert not (tmp_path / "run").exists()


def test_matter_that_fills_the_field_is_written_with_its_parts(tmp_path):
    """A cuvette: materials and parameters, the usual ones or those that are named, the true parts and surfaces."""
    scan, truth, surfaces = (tmp_path / name for name in ("s.nxs", "t.h5", "t.stl"))
    says = ["--specimen", "cuvette", "--core", "ethanol", "--specimen-set", "wall=0.2", "--specimen-count", 2]
    outcome = ran(
        "simulate", *says, *FIELD, "--out", scan, "--truth", truth, "--truth-regions", "--truth-mesh", surfaces
    )
    assert "goes on beyond the field of view" in outcome.err
    assert "enlarge --detector" not in outcome.err
    facts = read_scan(scan).provenance
    assert facts["specimen_wall"] == "0.2"
    assert (facts["material"], facts["core"], facts["medium"]) == ("glass", "ethanol", "vacuum")
    assert facts["specimen_drawn"] == "a cuvette with 2 bubbles, seed 0"
    volume, wall, bubbles = (read_volume(p) for p in (truth, tmp_path / "t_wall.h5", tmp_path / "t_bubbles.h5"))
    glass, ethanol = (parse_material(name).delta_beta(20.0).delta for name in ("glass", "ethanol"))
    assert volume.delta[wall.delta > 0.99999] == pytest.approx(glass, rel=1e-4)
    assert wall.delta.max() == bubbles.delta.max() == pytest.approx(1)
    liquid = (volume.delta > 0.1 * ethanol) & (wall.delta == 0) & (bubbles.delta == 0)
    assert volume.delta[liquid] == pytest.approx(ethanol, rel=1e-4)
    (found,) = read_meshes(surfaces, "um")
    assert len(found.faces) == 2 * 12 + 2 * 5120  # wall, liquid and two bubbles


@pytest.mark.parametrize("kind", [name for name in MATTER if name not in ("bubbles", "cuvette")])
def test_every_kind_that_may_fill_the_field_is_generated(kind, tmp_path):
    scan, truth = tmp_path / "s.nxs", tmp_path / "t.h5"
    ran("simulate", "--specimen", kind, "--specimen-seed", 1, *FIELD, "--out", scan, "--truth", truth)
    found, volume = read_scan(scan), read_volume(truth)
    assert found.frames.std() > 0.004
    assert found.provenance["specimen"] == kind
    assert found.provenance["medium"] == (MATTER[kind].named[2] or "vacuum")
    assert float(found.provenance["specimen_size"]) == pytest.approx(MATTER[kind].extent * 42e-6, rel=1e-4)
    assert np.abs(volume.delta).max() > 4e-8


@pytest.mark.parametrize("kind", CHANGING)
def test_every_kind_that_changes_is_generated_at_its_times(kind, tmp_path):
    """The first and the last time differ, and so do their truths and named parts; an exposure may be long."""
    scan, truth = tmp_path / "s.nxs", tmp_path / "t.h5"
    timed = ["--frame-rate", 1000, "--frames", 2, "--exposure", "1e-4", "--pulses", 2, "--truth-frames", 0, 1]
    ran(
        *("simulate", "--specimen", kind, *FIELD[:-1], 1, "--test-every", 0, *timed, "--out", scan),
        *("--truth", truth, "--truth-regions"),
    )
    found = read_scan(scan)
    assert found.instants == pytest.approx([0.0, 1e-3])
    assert abs(found.frames[1] - found.frames[0]).max() > 0.01
    volumes = [read_volume(tmp_path / f"t_t000{n}.h5").delta for n in range(2)]
    assert abs(volumes[1] - volumes[0]).max() > 2e-8
    for n in range(2):
        (part,) = tmp_path.glob(f"t_t000{n}_*.h5")
        assert 0.5 < read_volume(part).delta.max() < 1.001


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--specimen", "collapse"], "collapse moves; give --frame-rate"),
        (["--specimen", "jet", "--specimen-set", "wall=0.1"], "the setting wall is not known; use one of size, count"),
        (["--specimen", "jet", "--specimen-set", "amplitude=0.9"], "amplitude must be below 0.7"),
        (["--specimen", "jet", "--core", "iron"], "--core is not of the jet"),
        (["--specimen", "jet", "--specimen-motion", 3], "--specimen-motion is of matter that moves"),
        (["--specimen", "jet", "--specimen-edge", "1e-6"], "--specimen-edge is not of the jet"),
        (["--specimen", "jet", "--bandwidth", 0.01], "a spectrum needs meshes of files"),
        (["--specimen", "crack", "--specimen-count", 3], "--specimen-count is not of the crack"),
        (["--specimen", "tissue", "--specimen-set", "wall=0.1"], "the setting wall is not known"),
        (["--specimen", "tissue", "--truth", "t.h5", "--truth-regions"], "--truth-regions is of matter that may fill"),
        (["--specimen", "bubbles", "--truth-regions"], "--truth-regions needs --truth"),
        (["--specimen", "bubbles", "--truth-mesh", "b.stl"], "--truth-mesh needs a still truth of surfaces"),
        (["--specimen", "jet", "--truth-mesh", "b.obj"], "--truth-mesh must be a file whose name ends with .stl"),
        (["--specimen", "keyhole", "--specimen-radii", "1e-6", "2e-6"], "are of bubbles, not of keyhole"),
    ],
)
def test_requests_of_matter_in_the_field_that_cannot_be_are_refused(arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = holosplat("simulate", *arguments, *FIELD, "--out", tmp_path / "s.nxs")
    assert outcome.code == 2
    assert re.search(r"\W+".join(re.findall(r"\w+", said)), outcome.said)
    assert list(tmp_path.iterdir()) == []
