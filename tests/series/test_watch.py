"""Scans that appear: when they are complete, what is done with them, and that a watch goes on."""

from __future__ import annotations

import csv
import os
import shutil
from pathlib import Path

import pytest

from helpers.cli import holosplat, refused
from helpers.series import SETTINGS, known
from holosplat.checks import InputError
from holosplat.io.reading import Reading
from holosplat.series import watch as watching
from holosplat.series.folder import Folder
from holosplat.series.watch import Watch, WatchFolder, Watching


class World:
    """A clock that goes on when somebody sleeps; then the next thing happens."""

    def __init__(self, *happens) -> None:
        self.now, self.happens = 0.0, list(happens)

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        if self.happens:
            self.happens.pop(0)()


def watch(source: Path, out: Path, world: World, **how) -> tuple[int, list[str]]:
    said = list[str]()
    one = Watch(
        source, WatchFolder(out), SETTINGS, known, Reading(), Watching(**how), said.append, world.clock, world.sleep
    )
    return one.run({"settings": "these"}), said


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "series.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_file_is_complete_when_it_stays_as_it_is(tmp_path):
    """Not while it grows; links, pipes, folders, hidden names and other names are none."""
    folder = Folder(tmp_path, "*.nxs", settle=2.0)
    (tmp_path / "b.nxs").write_bytes(b"1")
    assert folder.complete(0.0) == []
    (tmp_path / "b.nxs").write_bytes(b"12")
    (tmp_path / "a.nxs").write_bytes(b"1")
    os.mkfifo(tmp_path / "pipe.nxs")
    os.symlink("a.nxs", tmp_path / "link.nxs")
    (tmp_path / "folder.nxs").mkdir()
    for name in (".c.nxs", "d.txt"):
        (tmp_path / name).write_bytes(b"1")
    assert folder.complete(1.0) == []
    assert folder.complete(2.5) == []
    assert [found.path.name for found in folder.complete(3.0)] == ["a.nxs", "b.nxs"]


def test_scans_are_reconstructed_as_they_appear(files, tmp_path):
    """Each begun with what the last one gave; what cannot be read is said once, and tried again when it changes."""
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    whole = (files.each / "scan10.nxs").read_bytes()
    world = World(
        lambda: shutil.copy(files.each / "scan9.nxs", source / "<b>1.nxs"),
        lambda: (source / "2.nxs").write_bytes(whole[:2000]),
        *[lambda: None] * 45,
        lambda: (source / "2.nxs").write_bytes(whole),
    )
    count, said = watch(source, out, world, stop_after=2)
    assert count == 2
    assert [row["begun"] for row in rows(out)] == ["cold", "warm"]
    assert [line.split(":")[0] for line in said] == ["<b>1.nxs", "cannot read 2.nxs (it is tried again)", "2.nxs"]
    page = (out / "live.html").read_text()
    assert "&lt;b&gt;1.nxs" in page
    assert "<b>1.nxs" not in page
    assert "const refresh = 0;" in page  # it has ended
    assert "Done: 2 times." in page

    # the same command goes on: what is done is not done again, what has come is
    shutil.copy(files.each / "scan11.nxs", source / "3.nxs")
    count, said = watch(source, out, World(), stop_after=1)
    assert [row["begun"] for row in rows(out)] == ["cold", "warm", "warm"]
    assert [row["number"] for row in rows(out)] == ["0", "1", "2"]
    assert watch(source, out, World(), idle=9.0) == (0, [])


def test_an_end_in_the_middle_loses_nothing(files, tmp_path, monkeypatch):
    """Ctrl-C after the first of two times: the page says that it has ended, and the next watch does the second."""
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    shutil.copy(files.scan, source)
    real = watching.reconstruct_time

    def interrupted(shot, *args):
        if shot.row.frame == 1:
            raise KeyboardInterrupt
        return real(shot, *args)

    monkeypatch.setattr(watching, "reconstruct_time", interrupted)
    with pytest.raises(KeyboardInterrupt):
        watch(source, out, World())
    assert "The watch has ended" in (out / "live.html").read_text()
    monkeypatch.setattr(
        watching, "reconstruct_time", lambda shot, *args: real(shot, *args) if shot.row.frame < 3 else 1 / 0
    )
    count, said = watch(source, out, World(), stop_after=1)
    assert count == 1
    assert [row["begun"] for row in rows(out)] == ["cold", "warm", "warm", "", ""]
    assert said[-1] == "moving.nxs, time 4: ZeroDivisionError: division by zero"
    assert "division by zero" in (out / "live.html").read_text()
    monkeypatch.setattr(watching, "reconstruct_time", real)
    assert watch(source, out, World(), stop_after=1)[0] == 1
    assert {row["status"] for row in rows(out)} == {"done"}


def test_the_page_says_that_somebody_looks(tmp_path):
    (tmp_path / "in").mkdir()
    pages = []
    page = tmp_path / "out" / "live.html"
    watch(tmp_path / "in", tmp_path / "out", World(*[lambda: pages.append(page.read_text())] * 3), idle=3.0)
    assert all("No scan has come yet." in text and f"Process {os.getpid()} on" in text for text in pages)
    assert all("const refresh = 5000;" in text for text in pages)


def test_what_a_watch_cannot_be(files, done, tmp_path):
    (tmp_path / "in").mkdir()
    out = ["--out", tmp_path / "out"]
    refused(holosplat("watch", tmp_path / "none", *out), "must be a folder to watch")
    refused(holosplat("watch", tmp_path / "in", "--out", done.path), "must be new, or hold a watch")
    refused(holosplat("watch", tmp_path / "in", *out, "--time-frame", 1), "takes all times")
    refused(holosplat("watch", tmp_path / "in", *out, "--poll", 0), "--poll must be a positive number")
    refused(holosplat("watch", tmp_path / "in", *out, "--method", "tikhonov-tv"), "can be gone on from")
    worked = holosplat("watch", tmp_path / "in", *out, "--idle", 0.01, "--poll", 0.01)
    assert (worked.code, "ended after 0 scans" in worked.err) == (0, True)
    refused(holosplat("watch", tmp_path / "in", *out, "--seed", 1), "was begun with another settings")
    with pytest.raises(InputError, match="must be a folder to watch"):
        watch(files.scan, tmp_path / "out2", World())
