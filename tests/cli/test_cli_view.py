"""`view` and `reconstruct --view`, with a page that nobody opens."""

from __future__ import annotations

from typing import ClassVar

import pytest

from helpers.cli import holosplat, known, refused, worked
from holosplat.cli import view as commands
from holosplat.io.compact import Steps
from holosplat.io.objects import read_object
from holosplat.io.series import write_series
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
