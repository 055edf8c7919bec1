"""Every file of a command says where it comes from; none is replaced without --force; --resume RUN alone goes on."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import shutil
from pathlib import Path
from typing import Any

import h5py
import pytest

from helpers.cli import Workshop, holosplat, known, refused, worked
from holosplat.cli import entry
from holosplat.cli.entry import is_made_by
from holosplat.io import hdf5_guard, provenance
from holosplat.io.provenance import from_home, home_safe, records

pytestmark = pytest.mark.usefixtures("unjudged_runs")

TAKEN = "must be new or empty, but it holds something already"


def attribute(path: Path) -> dict[str, Any]:
    with h5py.File(path) as file:
        return json.loads(file.attrs["provenance"])


@pytest.fixture
def place(shop: Workshop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to be in, with a scan and its true volume."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(shop.scan, "scan.nxs")
    shutil.copy(shop.truth, "truth.h5")
    return tmp_path


@pytest.fixture
def begun(shop: Workshop, place: Path) -> Path:
    """A run in it."""
    worked(holosplat("reconstruct", "scan.nxs", "--out", "run", *known(shop), "--seed", 5, "--log", "run.log"))
    return place / "run"


def test_files_say_command_version_and_what_was_read(shop, place):
    worked(holosplat("align", "scan.nxs", "--axis-only", "--out", "a.nxs", "--geometry-out", "g.toml"))
    scan = {"path": "scan.nxs", "relative": "scan.nxs", "bytes": shop.scan.stat().st_size}
    scan["sha256"] = hashlib.sha256(shop.scan.read_bytes()).hexdigest()
    for said in (attribute(Path("a.nxs")), json.loads(Path("g.toml.provenance.json").read_text())):
        assert said["command"] == "holosplat align scan.nxs --axis-only --out a.nxs --geometry-out g.toml"
        assert said["version"]
        assert said["date"]
        assert said["inputs"] == [scan]
        assert said["folder"] == str(place)
    assert not Path("a.nxs.provenance.json").exists()


def test_folders_have_a_record_of_each_command(shop, begun):
    first = records(begun)
    assert [one["command"].split()[1] for one in first] == ["reconstruct"]
    assert attribute(begun / "object.h5")["command"] == first[0]["command"]
    worked(holosplat("evaluate", "run", "--truth", "truth.h5"))
    last = records(begun)[-1]
    assert last["command"] == "holosplat evaluate run --truth truth.h5"
    assert [one["path"] for one in last["inputs"]] == ["truth.h5"]  # not the folder that is written to
    worked(holosplat("check", "run"))
    worked(holosplat("convert", "scan.nxs", "frames", "--to", "tiff"))
    assert [one["command"] for one in records(Path("frames"))] == ["holosplat convert scan.nxs frames --to tiff"]
    assert not list(begun.parent.glob("*/*.provenance.json"))


def test_many_and_large_inputs_have_one_hash(tmp_path, monkeypatch):
    for n in range(3):
        (tmp_path / f"{n}").write_bytes(bytes([n]) * 100)
    digests = [hashlib.sha256(bytes([n]) * 100).hexdigest() for n in range(3)]
    whole = hashlib.sha256("".join(digests).encode()).hexdigest()
    assert provenance.fingerprint(tmp_path) == {"bytes": 300, "sha256": whole}
    assert provenance.fingerprint(tmp_path / "1") == {"bytes": 100, "sha256": digests[1]}
    monkeypatch.setattr(provenance, "MOST_BYTES", 150)
    said = provenance.fingerprint(tmp_path)
    assert said.keys() == {"bytes", "sha256_of_ends"}
    with (tmp_path / "2").open("r+b") as file:
        file.write(b"x")
    assert provenance.fingerprint(tmp_path) != said
    command = provenance.Command(["x"], [("--files", tmp_path / f"{n % 3}") for n in range(9)], [])
    assert [one["files"] for one in command.record(tmp_path)["inputs"]] == [9]


def test_no_path_names_ones_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "me"))
    for text, safe in ((f"{tmp_path}/me/a b", "~/a b"), (f"--x={tmp_path}/me/c", "--x=~/c")):
        assert home_safe(text) == safe
        assert from_home(safe) == text
    assert home_safe(f"{tmp_path}/mean") == f"{tmp_path}/mean"
    (tmp_path / "me").mkdir()
    (tmp_path / "me" / "a b").write_text("")
    command = provenance.Command(["x", f"{tmp_path}/me/a b"], [("X", tmp_path / "me" / "a b")], [], folder=tmp_path)
    said = json.dumps(command.record(tmp_path / "elsewhere"))
    assert "/me/" not in said
    assert "holosplat x ~/'a b'" in said


def test_a_long_command_line_fits_into_an_attribute(tmp_path, monkeypatch):
    with provenance.carried_out(provenance.Command(["plan"] * 50000, [], [tmp_path / "a.h5"])):
        assert len(provenance.attribute(tmp_path / "a.h5")) < 2 * provenance.MOST_TEXT


SURVEY = ("--material", "red cell", "--medium", "plasma", "--energy-range", "10", "20", "--points", "2", "2")
OVER = {
    "align": ("align", "scan.nxs", "--axis-only", "--out", "old"),
    "its geometry": ("align", "scan.nxs", "--axis-only", "--out", "new", "--geometry-out", "old"),
    "export": ("export", "{run}", "--volume", "old.h5"),
    "export of times": ("export", "{run}", "--volume", "timed.h5"),
    "a file beside it": ("export", "{run}", "--volume", "new.mrc"),
    "a comparison": ("compare", "{run}", "{run}", "--out", "old"),
    "a picture": ("info", "scan.nxs", "--picture", "old.png"),
    "render": ("render", "{run}", "--scan", "scan.nxs", "--out", "old"),
    "join": ("join", "scan.nxs", "scan.nxs", "--out", "old"),
    "retrieve": ("retrieve", "scan.nxs", "--material", "haemoglobin", "--out", "old.h5"),
    "convert": ("convert", "scan.nxs", "old", "--to", "nxtomo"),
    "plan": ("plan", "--material", "red cell", "--medium", "plasma", "--energy-range", "10", "20", "--out", "old.png"),
    "its table": (
        "plan",
        "--material",
        "red cell",
        "--medium",
        "plasma",
        "--energy-range",
        "10",
        "20",
        "--out",
        "table.png",
    ),
    "a run": ("reconstruct", "scan.nxs", "--out", "kept"),
    "surfaces": ("surface", "{run}", "--out", "kept"),
    "a demo": ("demo", "--out", "kept"),
}


@pytest.mark.parametrize("what", OVER)
def test_nothing_is_replaced_without_force(shop, place, what):
    for name in ("old", "old.h5", "old.png", "table.csv", "timed_t0003.h5", "new.beta.mrc", "kept/mine"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("mine")
    said = holosplat(*(word.format(run=shop.run) for word in OVER[what]))
    refused(said, "--force", "must be new")
    assert {path.read_text() for path in place.rglob("*") if path.is_file() and path.suffix != ".nxs" and
            path.name != "truth.h5"} == {"mine"}  # fmt: skip


def test_files_are_replaced_with_force(place):
    for name in ("a.nxs", "p.png", "p.csv"):
        Path(name).write_text("old")
    worked(holosplat("align", "scan.nxs", "--axis-only", "--out", "a.nxs", "--force"))
    assert attribute(Path("a.nxs"))["command"].endswith("--force")
    worked(holosplat("plan", *SURVEY, "--out", "p.png", "--force"))
    assert "old" not in Path("p.csv").read_text()
    assert Path("p.csv.provenance.json").is_file()


def test_files_of_other_programs_say_where_they_come_from(shop, place):
    for name in ("v.vti", "v.nrrd", "v.mrc", "v.tif", "p.html", "p.png"):
        Path(name).write_text("old")
        command = {".html": ("compare", shop.run, shop.run, "--out"), ".png": ("info", "scan.nxs", "--picture")}
        words = command.get(Path(name).suffix, ("export", shop.run, "--volume"))
        worked(holosplat(*words, name, "--force"))
        said = json.loads(Path(f"{name}.provenance.json").read_text())
        assert said["command"].endswith(f"{name} --force")
        assert said["inputs"]
        assert Path(name).read_bytes() != b"old"
    assert Path("v.beta.mrc.provenance.json").is_file()


def test_folders_of_ours_alone_are_replaced_with_force(place):
    worked(holosplat("convert", "scan.nxs", "frames", "--to", "tiff"))
    Path("frames/more").write_text("")
    worked(holosplat("convert", "scan.nxs", "frames", "--to", "tiff", "--force"))
    assert not Path("frames/more").exists()
    Path("mine").mkdir()
    Path("mine/a").write_text("")
    refused(holosplat("convert", "scan.nxs", "mine", "--to", "tiff", "--force"), "folders that holosplat made", "mine")
    shutil.copy("scan.nxs", "frames/scan.nxs")
    refused(holosplat("convert", "frames/scan.nxs", "frames", "--to", "tiff", "--force"), "in frames")
    assert {path.name for path in place.iterdir()} == {"scan.nxs", "truth.h5", "frames", "mine"}


def test_what_force_would_replace_comes_back_where_a_command_fails(place):
    worked(holosplat("convert", "scan.nxs", "frames", "--to", "tiff"))
    before = sorted(Path("frames").iterdir())
    refused(holosplat("convert", "none.nxs", "frames", "--to", "tiff", "--force"), "none.nxs")
    assert sorted(Path("frames").iterdir()) == before
    assert not Path("frames.replaced").exists()
    Path("frames.replaced").mkdir()
    refused(holosplat("convert", "scan.nxs", "frames", "--to", "tiff", "--force"), "frames.replaced", "rename it back")


@pytest.mark.parametrize("link", [False, True])
def test_pipes_and_devices_are_not_replaced(shop, place, link):
    """With --force neither, nor by a link to one."""
    for name in ("a.nxs", "a.png", "a.vti", "a.h5"):
        pipe = place / (f"pipe_{name}" if link else name)
        os.mkfifo(pipe)
        if link:
            Path(name).symlink_to(pipe.name)
        words = {".nxs": ("align", "scan.nxs", "--axis-only", "--out"), ".png": ("info", "scan.nxs", "--picture")}
        refused(
            holosplat(*words.get(Path(name).suffix, ("export", shop.run, "--volume")), name, "--force"),
            f"{name} must be a file to write, but it is a pipe or a device",
        )
        assert pipe.is_fifo()


def test_a_link_to_a_folder_is_replaced_with_force(place):
    worked(holosplat("convert", "scan.nxs", "frames", "--to", "tiff"))
    Path("link").symlink_to("frames")
    before = sorted(Path("frames").iterdir())
    worked(holosplat("convert", "scan.nxs", "link", "--to", "tiff", "--force"))
    assert not Path("link").is_symlink()
    assert sorted(Path("frames").iterdir()) == before
    assert {path.name for path in place.iterdir()} == {"scan.nxs", "truth.h5", "frames", "link"}


@pytest.mark.parametrize("force", [(), ("--force",)])
def test_what_others_keep_beside_a_file_is_not_replaced(shop, place, force):
    Path("v.vti.provenance.json").write_text("theirs")
    refused(holosplat("export", shop.run, "--volume", "v.vti", *force), "v.vti.provenance.json must be new")
    assert Path("v.vti.provenance.json").read_text() == "theirs"
    assert not Path("v.vti").exists()


GARBLED = {
    "nested": "[" * 100_000,
    "a number of many digits": '{"records": [{"command": ' + "9" * 5000 + "}]}",
    "other kinds": '{"records": [{"command": 5, "folder": [], "inputs": {}}]}',
    "no list": '{"records": 5}',
    "no text": b"\xff\xfe",
}


@pytest.mark.parametrize("kind", [*GARBLED, "a pipe"])
def test_records_that_are_garbled_are_none(tmp_path, kind):
    """And no pipe is waited for."""
    for place in (tmp_path / "provenance.json", tmp_path / "file.provenance.json"):
        if kind == "a pipe":
            os.mkfifo(place)
        else:
            text = GARBLED[kind]
            place.write_bytes(text if isinstance(text, bytes) else text.encode())
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file"):
        assert not is_made_by(path, ["reconstruct"])
    with h5py.File(tmp_path / "file.h5", "w") as file:
        file.attrs["provenance"] = "[" * 10_000
    assert not is_made_by(tmp_path / "file.h5", ["reconstruct"])


def test_a_run_does_not_allow_itself_values_of_other_files(shop, place):
    """Whoever reads it does, whatever its files say."""
    shutil.copytree(shop.run, "run")
    with h5py.File("scan.nxs", "r+") as file, h5py.File("other.h5", "w") as other:
        name = "entry/instrument/detector/data"
        other["frames"] = file[name][()]
        del file[name]
        file[name] = h5py.ExternalLink("other.h5", "/frames")
    said = json.loads(Path("run/source.json").read_text())
    said |= {"scan": str(place / "scan.nxs"), "reading": said["reading"] | {"allow_external": True}}
    Path("run/source.json").write_text(json.dumps(said))
    for words in (
        ("evaluate", "run"),
        ("convert", "run", "out", "--to", "tiff"),
        ("compare", "run", "run", "--out", "page.html"),
    ):
        refused(holosplat(*words), "must hold its own values", "add --allow-external")
        worked(holosplat(*words, "--allow-external"))
        hdf5_guard._vouched.clear()
    record = records(Path("run"))[0] if records(Path("run")) else {}
    record |= {"command": "holosplat reconstruct scan.nxs --allow-external --out run", "inputs": [], "folder": "."}
    Path("run/provenance.json").write_text(json.dumps({"records": [record]}))
    refused(holosplat("reconstruct", "--resume", "run"), "must hold its own values", "add --allow-external")


def test_force_and_resume_exclude_each_other(place):
    refused(holosplat("reconstruct", "scan.nxs", "--out", "run", "--resume", "--force"), "--force begins anew")


def cut_off(run: Path) -> None:
    for name in ("summary.json", "report.html", "manifest.json"):
        (run / name).unlink()


def test_resume_alone_takes_scan_and_options_from_the_run(begun):
    """From any folder, and after both were moved."""
    cut_off(begun)
    (begun.parent / "moved").mkdir()
    for name in ("scan.nxs", "run", "quick.json"):
        if Path(name).exists():
            shutil.move(name, "moved")
    worked(holosplat("reconstruct", "--resume", "moved/run"))
    assert Path("moved/run/summary.json").is_file()
    commands = [one["command"] for one in records(Path("moved/run"))]
    assert commands[1:] == ["holosplat reconstruct --resume moved/run"]
    cut_off(Path("moved/run"))
    worked(holosplat("reconstruct", "--resume=moved/run", "--no-strict"))


def test_resume_with_scan_and_options_goes_on_as_before(shop, begun):
    cut_off(begun)
    worked(holosplat("reconstruct", "scan.nxs", "--out", "run", *known(shop), "--seed", 5, "--resume"))
    assert (begun / "summary.json").is_file()


def test_resume_alone_refuses_what_it_cannot_know(begun):
    refused(holosplat("track", "--resume", "run"), "was begun by holosplat reconstruct")
    refused(holosplat("reconstruct", "--resume", "none"), "none")
    Path("empty").mkdir()
    refused(holosplat("reconstruct", "--resume", "empty"), "provenance.json", "give the scan")
    Path("scan.nxs").rename("elsewhere.nxs")
    refused(holosplat("reconstruct", "--resume", "run"), "scan.nxs", "gone", "bring it back")
    shutil.copy("truth.h5", "scan.nxs")
    refused(holosplat("reconstruct", "--resume", "run"), "another scan.nxs", "changed")
    (begun / "provenance.json").write_text('{"records": [{"command": 5}]}')
    refused(holosplat("reconstruct", "--resume", "run"), "provenance.json")


def test_every_command_has_a_log_and_those_that_write_have_force():
    acts = {name: entry.command(name) for name in entry.COMMANDS if name not in ("bench", "series", "data")}
    for name, function in acts.items():
        options = inspect.signature(function).parameters
        writes = name not in ("backends", "check", "doctor", "evaluate", "init", "materials", "rehearse", "run", "view")
        assert ("log" in options, "force" in options) == (True, writes), name
