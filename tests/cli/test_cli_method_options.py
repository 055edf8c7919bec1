"""`--method`, `--preset`, `--config`, `--set` and `--backend`: which method they name, and what they refuse."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import tyro
from tyro.conf import OmitArgPrefixes

from holosplat.checks import InputError
from holosplat.cli.options import MethodOptions
from holosplat.methods import METHODS, Auto, Gaussians
from holosplat.methods.presets import preset
from holosplat.tables import overridden, to_table


def chosen(*arguments: object):
    """The method that the command line `arguments` name."""

    return tyro.cli(MethodOptions, args=[str(a) for a in arguments], config=(OmitArgPrefixes,)).chosen()


def test_without_options_it_is_auto():
    assert chosen() == Auto()
    assert chosen("--preset", "default") == chosen("--method", "gaussians") == Gaussians()


@pytest.mark.parametrize("name", METHODS)
def test_every_method_has_its_name(name):
    assert chosen("--method", name) == METHODS[name]


def test_single_fields_are_set_one_after_another():
    assert chosen("--method", "gaussians", "--set", "fit.schedule.steps=7", "--set", "max_start=5") == overridden(
        Gaussians(), ["fit.schedule.steps=7", "max_start=5"]
    )
    assert chosen("--set", "gaussians.fit.steps=7").gaussians.fit.schedule.steps == 7
    assert chosen("--preset", "fast", "--set", "steps=7") == overridden(preset("fast"), ["fit.schedule.steps=7"])
    assert chosen("--set", "steps=7", "--set", "steps=8", "--method", "gaussians").fit.schedule.steps == 8
    assert chosen("--method", "paganin-tv", "--set", "retrieval=ctf") == METHODS["ctf-tv"]


def test_a_random_start_has_the_settings_of_its_preset_unless_others_are_named():
    at_random = preset("random")
    assert chosen("--start", "random", "--method", "gaussians") == at_random
    assert chosen("--start", "random", "--set", "gaussians.fit.steps=7") == Auto(
        gaussians=overridden(at_random, ["fit.steps=7"])
    )
    assert chosen("--start", "random", "--preset", "fast") == replace(preset("fast"), start="random")
    assert chosen("--start", "learned") == Auto(gaussians=replace(Gaussians(), start="learned"))


def test_a_file_and_a_change_of_it(tmp_path):
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"schema_version": 2, "method": to_table(preset("fast"))}))
    assert chosen("--config", path) == preset("fast")
    assert chosen("--config", path, "--set", "steps=3").fit.schedule.steps == 3


def test_the_backend_is_that_of_fit_and_start():
    auto = chosen("--backend", "reference")
    found = chosen("--backend", "reference", "--method", "gaussians")
    assert auto.gaussians == found
    assert auto.volume.volume.backend == auto.surfaces.fit.backend == "reference"
    assert (found.fit.backend, found.volume.backend) == ("reference", "reference")
    assert chosen("--set", "gaussians.fit.backend=reference").gaussians.volume.backend == "auto"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--preset", "fast", "--config", "a.json"],
            "give one of --method, .*but there are --preset and --config",
        ),
        (["--preset", "fast", "--method", "voxels"], "but there are --method and --preset"),
        (["--method", "magic"], "method must be one of auto, gaussians, .*voxels.*but it is 'magic'"),
        (["--preset", "magic"], "preset must be one of default, fast, random, thesis, but it is 'magic'"),
        (
            ["--method", "gaussians", "--set", "fit.schedule.stepz=3"],
            r"the setting fit.schedule.stepz is not known; did you mean fit",
        ),
        (["--set", "fit.steps=3"], "may mean gaussians.fit.schedule.steps, surfaces.fit.schedule.steps; write one"),
        (["--preset", "default", "--set", "steps=-1"], r"fit\.schedule: steps must not be negative, but it is -1"),
        (["--set", "steps"], "a setting must read PATH=VALUE"),
        (["--method", "voxels", "--set", "start=phase"], "the setting start is not known"),
        (["--method", "paganin-tv", "--backend", "cpu"], "the method per-view runs on the CPU only"),
    ],
)
def test_what_cannot_be_is_said(arguments, message):
    with pytest.raises(InputError, match=message):
        chosen(*arguments)


def test_a_backend_that_cannot_be_used_is_refused_at_once(monkeypatch):
    monkeypatch.setattr("holosplat.backends.missing", lambda name: "no device" if name == "cuda" else "")
    with pytest.raises(InputError, match="'cuda' cannot be used here"):
        chosen("--backend", "cuda")
