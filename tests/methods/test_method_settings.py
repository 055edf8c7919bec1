"""Settings of methods: presets with their reasons, partial files, config.json of today and of version 0.1.0."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from holosplat.checks import InputError
from holosplat.methods import METHODS, Gaussians, Method, Surfaces, Voxels
from holosplat.methods.presets import FOLDER, SCHEMA, method_called, method_of, preset, preset_names, read_method
from holosplat.tables import overridden, paths, to_table

DATA = Path(__file__).parent / "data"
FILES = sorted(FOLDER.glob("*.toml"))
NAMES = ("default", "fast", "random", "thesis")


def leaves(table: dict, before: str = "") -> dict[str, object]:
    """Dotted path → value of every entry that is no table."""
    found: dict[str, object] = {}
    for name, value in table.items():
        found |= leaves(value, f"{before}{name}.") if isinstance(value, dict) else {before + name: value}
    return found


# --- presets ------------------------------------------------------------------------------------------------


def test_the_presets_are_those():
    assert preset_names() == NAMES


def test_a_method_without_options_is_the_default_preset():
    assert preset("default") == Gaussians()


def test_the_default_preset_says_every_option():
    """A new option needs a line in the file, with its reason."""
    said = leaves(tomllib.loads((FOLDER / "default.toml").read_text(encoding="utf-8")))
    assert set(said) - {"kind"} == set(paths(Gaussians()))
    assert leaves(to_table(Gaussians())) == said


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_number_has_a_reason(file):
    lines = file.read_text(encoding="utf-8").splitlines()
    numbers = [line for line in lines if "=" in line and line.split("=")[1].strip()[:1].isdigit()]
    assert numbers
    bare = [line for line in numbers if len(line.partition("#")[2].strip()) < 4]
    assert bare == []


def test_what_the_other_presets_change():
    fast, random, thesis = (preset(name) for name in NAMES[1:])
    assert isinstance(fast, Gaussians)
    assert isinstance(thesis, Gaussians)
    assert isinstance(random, Gaussians)
    assert (fast.fit.schedule.steps, fast.volume.iterations) == (60, 80)
    assert fast.fit.objective == Gaussians().fit.objective
    assert (thesis.start, thesis.separate, thesis.fit.schedule.steps) == ("random", True, 30_000)
    assert (random.fit.objective.two_levels, random.fit.rates.centres) == (0.1, 0.1)


def test_an_unknown_preset_is_refused():
    with pytest.raises(InputError, match="preset must be one of default, fast, random, thesis, but it is 'quick'"):
        preset("quick")


# --- files --------------------------------------------------------------------------------------------------


def written(folder: Path, text: str, name: str = "mine.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_partial_file_changes_its_base(tmp_path):
    found = read_method(written(tmp_path, "max_start = 9\n[fit.schedule]\nsteps = 7\n"))
    assert found == overridden(Gaussians(), ["max_start=9", "fit.schedule.steps=7"])
    found = read_method(written(tmp_path, 'base = "fast"\n[fit]\nbackend = "reference"\n'))
    assert found == overridden(preset("fast"), ["fit.backend=reference"])
    found = read_method(written(tmp_path, json.dumps({"base": "thesis", "random_count": 5}), "mine.json"))
    assert found == overridden(preset("thesis"), ["random_count=5"])


def test_a_file_of_another_method_changes_that_ones_defaults(tmp_path):
    found = read_method(written(tmp_path, 'kind = "voxels"\n[fit]\nsteps = 3\n'))
    assert found == replace(Voxels(), fit=replace(Voxels().fit, steps=3))
    found = read_method(written(tmp_path, 'base = "paganin-fbp"\ntomography = "sirt"\n'))
    assert found == METHODS["paganin-sirt"]
    nested = read_method(written(tmp_path, 'base = "surfaces"\n[gaussians.fit.schedule]\nsteps = 4\n'))
    assert isinstance(nested, Surfaces)
    assert nested.gaussians.fit.schedule.steps == 4
    assert nested.fit == Surfaces().fit


@pytest.mark.parametrize("name", METHODS)
def test_methods_go_round_through_config_json(name, tmp_path):
    config = json.dumps(
        {"schema_version": SCHEMA, "method": to_table(METHODS[name])} | {"seed": 3, "scan_hash": "x"}, allow_nan=False
    )
    assert read_method(written(tmp_path, config, "config.json")) == METHODS[name]
    assert method_called(name) is METHODS[name]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("speed = 3", "options.speed is not known; remove it, or use one of start, spacing_px"),
        ("[fit.schedule]\nstepz = 3", r"options\.fit\.schedule\.stepz is not known"),
        ('[fit.schedule]\nsteps = "many"', r"options\.fit\.schedule\.steps must be a whole number, but it is 'many'"),
        ('start = "guess"', r"options\.start must be one of phase, learned, random, but it is 'guess'"),
        ("volume = 4", r"options\.volume must be a table, but it is 4"),
        ("[fit.schedule]\nsteps = -1", "steps must not be negative"),
        ("[fit.schedule]\ndecay = 0.0", "decay must be a positive number"),
        ("[volume]\niterations = 0", "iterations must be at least 1"),
        ("spacing_px = 0", "spacing_px must be a positive number"),
        ('kind = "mesh"', r"options\.kind must be one of auto, gaussians, surfaces, voxels"),
        ('base = "quick"', "base must be one of default, fast, random, thesis, auto, gaussians, surfaces.*'quick'"),
        ("base = 3", r"options\.base must be a name, but it is 3"),
        ('base = "fast"\nkind = "voxels"', "the base fast is of the kind gaussians, not voxels"),
        ("method = 3", "must hold a table of options, but it holds 3"),
        ("schema_version = 3\n[method]\n", rf"has the schema version 3, but this version reads 1 to {SCHEMA}"),
        ('schema_version = "2"\n[method]\n', "has the schema version '2'"),
    ],
)
def test_settings_that_are_none_are_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_method(written(tmp_path, text))


# --- version 0.1.0 ------------------------------------------------------------------------------------------


def of_version_0_1_0(name: str) -> Method:
    """The preset as version 0.1.0 had it: that of today, but for the start, which ran on the CPU, and what `thesis`
    has learnt of the thesis since."""
    today = preset(name)
    assert isinstance(today, Gaussians)
    today = replace(today, volume=replace(today.volume, backend="cpu"))
    if name != "thesis":
        return today
    objective = replace(today.fit.objective, frc_ramp=0.5, anisotropy=0.0)
    density = replace(today.fit.density, prune_stop=0.0, grow_gradient=0.0)
    return replace(today, fit=replace(today.fit, objective=objective, density=density))


@pytest.mark.parametrize("name", NAMES)
def test_a_config_of_version_0_1_0_is_the_same_method_today(name, tmp_path):
    """The files are what version 0.1.0 wrote for its four presets."""
    old = DATA / f"config_0_1_0_{name}.json"
    assert read_method(old) == of_version_0_1_0(name)
    settings = json.loads(old.read_text())["settings"]
    assert read_method(written(tmp_path, json.dumps(settings), "alone.json")) == of_version_0_1_0(name)


def test_rates_of_version_0_1_0_find_their_place():
    table = {"fit": {"schedule": {"rate_position": 1, "rate_scale": 2, "rate_rotation": 3, "rate_amplitude": 4}}}
    before = json.dumps(table)
    found = method_of(table)
    assert isinstance(found, Gaussians)
    rates = found.fit.rates
    assert (rates.centres, rates.log_scales, rates.quaternions, rates.raw_amplitudes) == (1, 2, 3, 4)
    assert json.dumps(table) == before, "the table that is read must stay as it is"
    with pytest.raises(InputError, match=r"options\.fit\.rates\.centres must be a number"):
        method_of({"fit": {"schedule": {"rate_position": "fast"}}})


def test_the_preset_random_starts_at_random_and_judges_on_no_training_frame():
    settings = preset("random")
    assert settings.start == "random"
    assert settings.fit.schedule.validation_views == 0
    assert settings.fit.density.every > 0
    assert settings.random_count <= 10_000
