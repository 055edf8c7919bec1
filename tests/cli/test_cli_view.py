"""`view` and `reconstruct --view`, with a page that nobody opens."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import pytest

from helpers.cli import holosplat, known, refused, worked
from holosplat.cli import view as commands
from holosplat.io.lock import sole_writer
from holosplat.io.objects import Steps, read_object, write_series
from holosplat.show import server


class Page:
    """What a view was told."""

    made: ClassVar[list[Page]] = []

    def __init__(self, title: str, port: int = 8080) -> None:
        self.title, self.port, self.url, self.watched = title, port, "http://127.0.0.1/?token=t", True
        self.frame, self.lines, self.parts, self.sliders, self.closed = None, [], [], {}, False
        Page.made.append(self)

    def tell(self, *lines: str) -> None:
        self.lines.append(lines)

    def show(self, part: object) -> None:
        assert self.frame is not None
        self.parts.append(part)

    def slider(self, label, steps, on_step) -> None:
        self.sliders[label] = (steps, on_step)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def pages(monkeypatch) -> list[Page]:
    """The pages that were made; waiting for Ctrl-C is over at once."""

    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(server, "LiveView", Page)
    monkeypatch.setattr(commands, "_until_interrupted", interrupt)
    monkeypatch.setattr(Page, "made", [])
    return Page.made


def test_a_run_is_shown_until_ctrl_c(shop, pages):
    done = worked(holosplat("view", shop.run, "--port", "9000"))
    assert "view: http://127.0.0.1/?token=t" in done.err
    (page,) = pages
    assert (page.title, page.port, page.closed) == ("run", 9000, True)
    assert "Gaussians" in page.lines[0][0]
    assert page.lines[0][1].startswith("step 6, loss ")
    steps, move = page.sliders["cut along z"]
    move(steps - 1)
    assert 0 < len(page.parts[1].centres) < len(page.parts[0].centres)


def test_a_series_of_objects_has_a_slider_of_time(shop, pages, tmp_path):
    obj = read_object(shop.run / "object.h5")
    half = obj.with_parameters({name: p[::2] for name, p in obj.parameters().items()})
    write_series(tmp_path / "s.h5", {"first": obj, "second": half}, Steps())
    worked(holosplat("view", tmp_path / "s.h5"))
    (page,) = pages
    steps, move = page.sliders["time"]
    assert steps == 2
    move(1)
    assert [len(part.centres) for part in page.parts] == [len(obj), len(half)]
    assert page.lines[-1] == ("2 objects", "second")


def test_what_cannot_be_shown_is_refused(shop, pages, tmp_path):
    refused(holosplat("view", tmp_path / "none"), "must be a run folder or an object file")
    refused(holosplat("view", tmp_path), "must hold a reconstruction")
    refused(holosplat("view", shop.run, "--port", "80"), "--port must be at least 1024")
    assert pages == []


@pytest.mark.usefixtures("unjudged_runs")
def test_a_fit_is_followed(shop, pages, tmp_path):
    worked(holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop), "--view"))
    (page,) = pages
    assert page.closed
    assert any(line[0].startswith("fit: ") and line[1].startswith("step ") for line in page.lines if len(line) > 1)


# --- a run that another process fits ------------------------------------------------------------------------


@pytest.fixture
def running(shop, tmp_path) -> Path:
    """The shop's run as it was before its end: without a result."""
    folder = tmp_path / "running"
    shutil.copytree(shop.run, folder)
    for name in ("object.h5", "summary.json", "report.html", "manifest.json"):
        (folder / name).unlink(missing_ok=True)
    return folder


def after_each_look(monkeypatch, *steps) -> None:
    """What happens in the folder after the first look at it, after the second one, and so on."""
    left = list(steps)
    monkeypatch.setattr(commands, "_pause", lambda: left.pop(0)())


def test_a_run_of_another_process_is_followed_to_its_end(shop, pages, running, monkeypatch):
    lock = sole_writer(running)
    lock.__enter__()

    def new_checkpoint() -> None:
        os.utime(running / "checkpoint.pt", (10**9, 10**9))

    def end() -> None:
        for name in ("object.h5", "summary.json"):
            shutil.copy(shop.run / name, running / name)
        lock.__exit__(None, None, None)

    after_each_look(monkeypatch, lambda: None, new_checkpoint, end)
    done = worked(holosplat("view", running))
    assert "view: http://127.0.0.1/?token=t" in done.err
    (page,) = pages
    assert page.closed
    assert page.lines[0][0] == "it has begun; nothing is kept yet"
    said = page.lines[1]
    assert "Gaussians" in said[0]
    assert said[1] == "stage: fit"
    assert said[2].startswith("step 6, loss ")
    assert said[3].startswith("kept at ")
    assert said[4].startswith(f"fitted by process {os.getpid()} on ")
    assert len(page.parts) == 3, "the state that was there, the new one, and the result; nothing anew where nothing is"
    assert page.lines[-1][-2:] == ("the run has ended", "")
    assert set(page.sliders) == {"cut along z"}
    page.sliders["cut along z"][1](25)
    assert len(page.parts[-1].centres) < len(page.parts[-2].centres)


def test_a_run_without_a_state_and_one_that_is_cut_off_say_so(pages, running, monkeypatch):
    for name in ("checkpoint.pt", "checkpoint_before.pt"):
        (running / name).unlink(missing_ok=True)
    lock = sole_writer(running)
    lock.__enter__()
    after_each_look(monkeypatch, lambda: lock.__exit__(None, None, None))
    worked(holosplat("view", running))
    (page,) = pages
    assert page.parts == []
    assert [line[0] for line in page.lines] == [
        "it has begun; nothing is kept yet",
        "the run was cut off; finish it with --resume",
    ]


def test_nothing_is_drawn_for_nobody_and_damage_is_waited_for(pages, running, monkeypatch):
    monkeypatch.setattr(Page, "watched", property(lambda self: False, lambda self, value: None), raising=False)
    whole = (running / "checkpoint.pt").read_bytes()
    lock = sole_writer(running)
    lock.__enter__()

    def damage() -> None:
        (running / "checkpoint.pt").write_bytes(b"half")
        (running / "checkpoint_before.pt").unlink(missing_ok=True)

    after_each_look(
        monkeypatch,
        damage,
        lambda: (running / "checkpoint.pt").write_bytes(whole),
        lambda: lock.__exit__(None, None, None),
    )
    worked(holosplat("view", running))
    (page,) = pages
    assert page.parts == []
    assert [line[0] for line in page.lines[1:3]] == ["stage: fit", "stage: fit"]


def test_the_lock_of_a_process_that_is_no_more_is_none_of_a_run(pages, running):
    """Of this machine: the run was killed, and is not followed."""
    code = (
        "import os, sys; from holosplat.io.lock import sole_writer; lock = sole_writer(sys.argv[1]); "
        "lock.__enter__(); os._exit(1)"
    )
    subprocess.run([sys.executable, "-c", code, running], check=False)
    assert (running / ".lock").is_file()
    refused(holosplat("view", running), "finish it with --resume")
    assert pages == []
