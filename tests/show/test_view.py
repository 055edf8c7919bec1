"""The live view: who is let in, what is drawn, and what a watched fit is told."""

from __future__ import annotations

import builtins
import http.client
import time
from contextlib import nullcontext
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from helpers.splats import cloud
from holosplat.checks import InputError
from holosplat.matter import DeltaBeta, Matter
from holosplat.mesh import TriangleMesh
from holosplat.report.style import format_length
from holosplat.representations import GaussianCloud, MovingSurfaces, SurfaceMesh, TimeBasis
from holosplat.representations.gaussians import raw_of
from holosplat.show import server
from holosplat.show.parts import Frame, Splats, at_times, cut, shown
from holosplat.show.server import Guard, LiveView, Watch
from holosplat.specimens.red_cells import icosphere

MATTER = Matter((DeltaBeta(4e-7, 2e-10),))
GUARD = Guard("secret-token")
COOKIE = f"{GUARD.cookie}=secret-token"


def gaussians() -> GaussianCloud:
    centres, scales, quaternions, amplitudes = cloud("ordinary", 1, 50)
    return GaussianCloud((centres, scales.log(), quaternions, raw_of(amplitudes.abs() + 0.1)), 2e-6, MATTER)


def ball() -> SurfaceMesh:
    points, faces = icosphere(2)
    return SurfaceMesh(torch.from_numpy(9.0 * points), torch.from_numpy(faces.copy()), 2e-6, MATTER)


# --- the guard ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "headers", "answer"),
    [
        ("/", {}, "refuse"),
        ("/?token=secret-toke", {}, "refuse"),
        ("/?token=secret-token", {}, "enter"),
        ("/", {"cookie": [COOKIE]}, "pass"),
        ("/", {"cookie": ["a=b; " + COOKIE]}, "pass"),
        ("/", {"cookie": [f"{GUARD.cookie}=secret"]}, "refuse"),
        ("/", {"cookie": ["token=secret-token"]}, "refuse"),
        ("/", {"cookie": [COOKIE], "origin": ["http://127.0.0.1:8080"]}, "pass"),
        ("/", {"cookie": [COOKIE], "origin": ["http://127.0.0.1:9999"]}, "refuse"),
        ("/", {"cookie": [COOKIE], "origin": ["https://example.org"]}, "refuse"),
        ("/", {"cookie": [COOKIE], "host": ["example.org:8080"]}, "refuse"),
        ("/?token=secret-token", {"host": ["example.org"]}, "refuse"),
        ("/?token=secret-token", {"host": []}, "refuse"),
        ("/?token=secret-token", {"host": ["localhost:8080"]}, "enter"),
        ("/?token=t%C3%B6ken", {}, "refuse"),
    ],
)
def test_only_the_token_opens_the_view(path, headers, answer):
    assert GUARD.answer(path, {"host": ["127.0.0.1:8080"]} | headers) == answer


@pytest.fixture(scope="module")
def page():
    view = LiveView("a <run>", 18080)
    yield view
    view.close()


def asked(page: LiveView, path: str, **headers: str) -> tuple[int, http.client.HTTPMessage, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)
    connection.request("GET", path, headers=headers)
    found = connection.getresponse()
    return found.status, found.headers, found.read()


def test_the_server_asks_for_the_token_before_it_says_anything(page):
    assert page._server.get_host() == "127.0.0.1"
    for path in ("/", "/index.html", "/?token=wrong"):
        code, _, body = asked(page, path)
        assert (code, b"private" in body, b"<html" in body) == (403, True, False)
    code, headers, body = asked(page, page.url.partition(str(page.port))[2])
    assert (code, headers["Location"], body) == (303, "/", b"")
    given = headers["Set-Cookie"]
    assert "HttpOnly" in given
    assert "SameSite=Strict" in given
    code, _, body = asked(page, "/", Cookie=given.partition(";")[0])
    assert (code, b"<!doctype html>" in body[:200].lower()) == (200, True)


def test_web_sockets_need_the_cookie_too(page):
    import viser

    where, kind = f"ws://127.0.0.1:{page.port}", [f"viser-v{viser.__version__}"]
    cookie = page.guard.set_cookie().partition(";")[0]
    for headers in ({}, {"Cookie": cookie, "Origin": "http://127.0.0.1:1"}):
        with pytest.raises(InvalidStatus, match="403"):
            connect(where, subprotocols=kind, additional_headers=headers, proxy=None)
    with connect(where, subprotocols=kind, additional_headers={"Cookie": cookie}, proxy=None) as socket:
        assert len(socket.recv(timeout=20)) > 0


def test_a_server_that_would_not_ask_is_not_opened(monkeypatch):
    """Such as that of another version of viser."""
    from websockets.asyncio import server as module

    original = module.serve
    monkeypatch.setattr(server, "_guarded", lambda guard: nullcontext([]))
    with pytest.raises(InputError, match="cannot be guarded"):
        LiveView("a run", 18090)
    assert module.serve is original


def test_without_its_package_a_sentence_says_how_to_get_it(monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name == "viser":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"holosplat\[view\]"):
        LiveView("a run")


# --- what is drawn ------------------------------------------------------------------------------------------


def test_gaussians_are_drawn_with_their_covariances():
    obj = gaussians()
    part = shown(obj)
    assert isinstance(part, Splats)
    np.testing.assert_allclose(part.centres, 2e-6 * obj.centres.numpy(), rtol=1e-6)
    wanted = np.sort((2e-6 * obj.scales.numpy()) ** 2, axis=1)
    np.testing.assert_allclose(np.linalg.eigvalsh(part.covariances), wanted, rtol=1e-4)
    assert part.opacities.min() > 0
    assert part.opacities.max() <= 0.99


def test_the_scene_has_ten_units_to_each_side_and_cuts_leave_the_far_part():
    obj = ball()
    part = shown(obj)
    assert isinstance(part, TriangleMesh)
    places = Frame.around(obj.enclosing_grid(10**6)).places(part.vertices)
    assert np.abs(places).max() == pytest.approx(10 * 9 / 11, rel=0.05)
    half = cut(part, 2, 0.5)
    assert len(half.faces) == pytest.approx(0.5 * len(part.faces), rel=0.05)
    assert half.vertices[half.faces].mean(axis=1)[:, 2].min() > -1e-6
    assert cut(part, 2, 0.0) is part
    assert len(cut(shown(gaussians()), 2, 1.0).centres) >= 1


def test_the_view_has_a_legend_and_a_scale(page):
    """Bars of a round length along three axes; colours by what they mean, in a unit."""
    for obj, words in ((gaussians(), "opacity: thickness"), (ball(), "surface of the matter, z from")):
        page.frame = Frame.around(obj.enclosing_grid(10**6))
        page.show(shown(obj))
        assert words in page._legend.content
        assert "µm" in page._legend.content
        names = page._server.scene._handle_from_node_name
        assert {"/scale", "/scale/x", "/scale/y", "/scale/z"} <= set(names)
        assert names["/scale/x"].text == f"x, {format_length(page.frame.bar)}"
        assert 0.1 < page.frame.bar * page.frame.scale / 20 <= 0.28


def test_a_moving_object_is_shown_at_the_times_of_its_frames():
    still = ball()
    paths = torch.stack([still.vertices, still.vertices + 2])
    body = torch.zeros(len(still.faces), dtype=torch.int64)
    obj = MovingSurfaces(paths, still.faces, body, TimeBasis(0.0, 1e-5, 1), 2e-6, MATTER)
    found = at_times(obj, [0.0, 5e-6, 1e-5])
    assert list(found) == ["0 µs", "5 µs", "10 µs"]
    assert float((found["5 µs"].vertices - still.vertices).mean()) == pytest.approx(1.0)
    assert len(at_times(obj, ())) == 48
    assert list(at_times(still, ())) == [""]


# --- a watched fit ------------------------------------------------------------------------------------------


@dataclass
class Page:
    """A view without a browser."""

    watched: bool = True
    frame: Frame | None = None
    lines: list[tuple[str, ...]] = field(default_factory=list)
    parts: list[object] = field(default_factory=list)

    def tell(self, *lines: str) -> None:
        self.lines.append(lines)

    def show(self, part: object) -> None:
        self.parts.append(part)


def until(true) -> None:
    end = time.monotonic() + 20
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_updates_come_seldom_and_nothing_is_drawn_for_nobody():
    page, taken = Page(), []

    def state() -> GaussianCloud:
        taken.append(1)
        return gaussians()

    watch = Watch(page)  # type: ignore[arg-type]
    for step in range(500):
        watch.on_state("fit", step / 500, {"step": step, "loss": 0.125, "count": 50}, state)
    until(lambda: page.parts)
    assert len(taken) == len(page.parts) == 1
    assert page.frame is not None
    assert page.lines == [("fit: 0%", "step 0", "loss 0.125", "50 Gaussians")]
    alone = Page(watched=False)
    Watch(alone).on_state("fit", 0.0, {"step": 1}, state)  # type: ignore[arg-type]
    assert (len(alone.lines), len(taken), alone.parts) == (1, 1, [])
