"""`holosplat init` prints a pipeline that `holosplat run` carries out, once."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import socket
import tomllib
from pathlib import Path

import pytest

from helpers.cli import Workshop, everything_in, holosplat, refused, worked
from holosplat.cli.entry import OF_ONE_CALL, command
from holosplat.cli.help import options_of, parser_of
from holosplat.cli.pipeline import STAGES
from holosplat.io.provenance import records

pytestmark = pytest.mark.usefixtures("unjudged_runs")

CUT_SHORT = """
[reconstruct]
scan = "scan.nxs"
out = "run"
material = "haemoglobin"
matter = "levels"
config = "quick.json"
[export]
volume = "volume.h5"
shape = [20, 20, 20]
"""


@pytest.fixture
def place(shop: Workshop, tmp_path: Path):
    """The folder in which one works, with a scan."""
    shutil.copy(shop.scan, tmp_path / "scan.nxs")
    shutil.copy(shop.quick, tmp_path / "quick.json")
    with contextlib.chdir(tmp_path):
        yield tmp_path


def piped(text: str, *options: str):
    """What `holosplat run` says of a pipeline."""
    Path("run.toml").write_text(text)
    return holosplat("run", "run.toml", *options)


def done(err: str) -> list[str]:
    """The stages that were skipped."""
    return re.findall(r"\[(\w+)\] is done", err)


def test_the_printed_pipeline_runs_and_is_not_done_twice(place):
    worked(holosplat("record", "scan.nxs", "--out", "raw.nxs", "--flats", 8, "--darks", 4))
    Path("scan.nxs").unlink()
    text = worked(holosplat("init")).out
    for key, value in {"material": "haemoglobin", "matter": "levels", "config": "quick.json"}.items():
        text = re.sub(rf"^# {key} = .*$", f'{key} = "{value}"', text, flags=re.MULTILINE)
    first = worked(piped(text))
    assert re.findall(r"^\[(\w+)\] holosplat \1 ", first.err, re.MULTILINE) == list(STAGES)
    assert records(Path("run"))[0]["command"].startswith("holosplat reconstruct aligned.nxs --out run --material")
    assert {"scan.nxs", "aligned.nxs", "run", "volume.h5"} <= {path.name for path in place.iterdir()}
    before = everything_in(place)
    assert done(worked(piped(text)).err) == list(STAGES)
    assert {entry for entry in everything_in(place) ^ before if "run.toml" not in entry} == set()
    worked(holosplat("reconstruct", "--resume", "run"))  # as a run that was begun by hand


def test_what_is_missing_or_cut_off_is_done_again(place):
    worked(piped(CUT_SHORT))
    Path("volume.h5").unlink()
    again = worked(piped(CUT_SHORT))
    assert done(again.err) == ["reconstruct"]
    assert Path("volume.h5").is_file()
    Path("run/summary.json").unlink()
    again = piped(CUT_SHORT)
    assert "[reconstruct] holosplat reconstruct scan.nxs --out run" in again.err
    assert "--config quick.json --resume" in again.err
    assert done(worked(piped(CUT_SHORT, "--redo")).err)[:1] == ["reconstruct"]


@pytest.mark.parametrize("record", [False, True])
def test_a_stage_that_was_killed_as_it_began_begins_again(place, record):
    """All it left is a folder, its lock, and the record of other words."""
    Path("run").mkdir()
    Path("run/.lock").write_text(
        "{}" if not record else json.dumps({"host": socket.gethostname(), "process": 2**22 + 1})
    )
    if record:
        Path("run/provenance.json").write_text(
            json.dumps({"records": [{"command": "holosplat reconstruct other.nxs"}]})
        )
    text = CUT_SHORT[: CUT_SHORT.index("[export]")]
    if record:
        worked(piped(text))
        assert [one["command"].split()[2] for one in records(Path("run"))] == ["scan.nxs"]
    else:
        refused(piped(text), "must have one writer")


def test_a_run_that_was_killed_before_its_report_goes_on(place):
    """Its result is whole, but the lock of its process is there still."""
    text = CUT_SHORT[: CUT_SHORT.index("[export]")]
    worked(piped(text))
    Path("run/report.html").unlink()
    Path("run/.lock").write_text(json.dumps({"host": socket.gethostname(), "process": 2**22 + 1}))
    assert done(worked(piped(text)).err) == []
    assert Path("run/report.html").is_file()
    assert done(worked(piped(text)).err) == ["reconstruct"]


def test_a_file_is_not_there_without_its_record(place, monkeypatch):
    """Nor is one that is as another command left it taken for the own."""
    worked(piped(CUT_SHORT.replace("volume.h5", "volume.vti")))
    made = Path("volume.vti").read_bytes()
    record = Path("volume.vti.provenance.json").read_bytes()

    def killed(one: Path, other: Path) -> None:
        if other.name == "volume.vti":
            raise KeyboardInterrupt
        os.rename(one, other)

    Path("volume.vti").unlink()
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        assert holosplat("run", "run.toml").code == 130
    assert not Path("volume.vti").exists()
    assert Path("volume.vti.provenance.json").is_file()
    assert done(worked(holosplat("run", "run.toml")).err) == ["reconstruct"]
    assert Path("volume.vti").read_bytes() == made
    Path("volume.vti").write_bytes(made + b" ")
    Path("volume.vti.provenance.json").write_bytes(record)
    refused(holosplat("run", "run.toml"), "[export] must not replace volume.vti")


def test_other_options_replace_nothing_without_being_told(place):
    worked(piped(CUT_SHORT))
    before = everything_in(place)
    other = CUT_SHORT.replace("20, 20, 20", "10, 10, 10")
    refused(piped(other), "[export] must not replace volume.h5", "--redo")
    assert {entry for entry in everything_in(place) ^ before if "run.toml" not in entry} == set()
    assert done(worked(piped(other, "--redo")).err) == ["reconstruct"]
    assert done(worked(piped(other)).err) == ["reconstruct", "export"]
    refused(piped(CUT_SHORT.replace("[export]", "seed = 3\n[export]")), "[reconstruct] must not replace run")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("matter =", "mater ="), ["[reconstruct] of run.toml has the unknown key mater", "did you mean"]),
        (("[export]", "[exprot]"), ["run.toml has the unknown key exprot; did you mean export?"]),
        (("[export]", "log = 'a'\n[export]"), ["[reconstruct] of run.toml has the unknown key log"]),
        (('out = "run"\n', ""), ["[reconstruct] of run.toml must have the key out"]),
        (('scan = "scan.nxs"\n', ""), ["[reconstruct] of run.toml must have the key scan"]),
        (("[export]", "seed = true\n[export]"), ["seed in [reconstruct] of run.toml", "a text, number or list"]),
        (("[export]", "strict = 1\n[export]"), ["strict in [reconstruct] of run.toml must be true or false"]),
        (("[export]", "seed = -1\n[export]"), ["[reconstruct] of run.toml: --seed must not be negative"]),
        (("[20, 20, 20]", "[20, 20]"), ["[export] of run.toml must be options of holosplat export"]),
        (("[20, 20, 20]", "1979-05-27"), ["shape in [export] of run.toml", "a text, number or list"]),
        ((CUT_SHORT, "export = 1"), ["export of run.toml must be a table"]),
        ((CUT_SHORT, ""), ["run.toml must have a stage"]),
        ((CUT_SHORT, "[export"), ["run.toml must be valid TOML"]),
    ],
)
def test_a_wrong_pipeline_is_refused_before_anything_is_made(place, change, words):
    refused(piped(CUT_SHORT.replace(*change)), *words)
    assert {path.name for path in place.iterdir()} == {"scan.nxs", "quick.json", "run.toml"}


def test_what_a_stage_reads_must_be_there(place):
    refused(piped('[export]\nrun = "nowhere"\nvolume = "volume.h5"\n'), "nowhere")
    assert not Path("volume.h5").exists()


@pytest.mark.parametrize("name", STAGES)
def test_keys_are_the_options_of_the_command(name):
    """All of them with --all; the essential ones without."""
    whole, short = (worked(holosplat("init", *words)).out for words in (["--all"], []))
    section = whole.partition(f"[{name}]")[2].partition("\n[")[0]
    keys = re.findall(r"^(?:# )?([a-z-]+) = ", section, re.MULTILINE)
    wanted = [option.name.replace("_", "-") for option in options_of(parser_of(command(name), name))]
    assert keys == [key for key in wanted if f"--{key}" not in OF_ONE_CALL]
    assert len(short) < len(whole)
    assert list(tomllib.loads(short)) == list(tomllib.loads(whole)) == list(STAGES)


EATERS = {
    "what it reads": '[correct]\nraw = "raw.nxs"\nout = "a.nxs"\n[align]\nout = "raw.nxs"\n',
    "a table over it": '[correct]\nraw = "raw.nxs"\nout = "a.nxs"\n[align]\nout = "b.nxs"\ntable = "raw.nxs"\n',
    "itself": '[correct]\nraw = "raw.nxs"\nout = "run.toml"\n',
    "a stage's file": '[correct]\nraw = "raw.nxs"\nout = "a.nxs"\n[reconstruct]\nscan = "raw.nxs"\nout = "a.nxs"\n',
}


@pytest.mark.parametrize("kind", EATERS)
def test_no_stage_writes_over_what_the_pipeline_needs(place, kind):
    """With --redo neither."""
    shutil.copy("scan.nxs", "raw.nxs")
    before = Path("raw.nxs").read_bytes()
    for redo in ((), ("--redo",)):
        refused(piped(EATERS[kind], *redo), "run.toml: --", "name another")
        assert Path("raw.nxs").read_bytes() == before
        assert Path("run.toml").read_text() == EATERS[kind]
    assert {path.name for path in place.iterdir()} == {"scan.nxs", "raw.nxs", "quick.json", "run.toml"}
