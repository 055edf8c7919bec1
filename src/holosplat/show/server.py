"""The live view: viser's server, on the loopback address only and behind a token."""

from __future__ import annotations

import hmac
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from io import StringIO
from typing import Any, Literal
from urllib.parse import parse_qs, urlsplit

import numpy as np

from ..checks import InputError, require
from ..mesh import TriangleMesh
from ..progress import PICTURE
from ..representations import Stored
from ..units import format_length
from .parts import COLOUR, HALF_EDGE, Frame, Shown, Splats, legend, shown


def require_viser() -> Any:
    """The package viser; `InputError` where it is not installed."""
    try:
        import viser
    except ImportError:
        raise InputError('The live view needs viser; install it by pip install "holosplat[view]".') from None
    return viser


LEGEND = (
    '<div style="margin: 0 1em; font-size: 0.85em"><div style="height: 0.8em; background: linear-gradient(to right, '
    '{colours})"></div>{said}</div>'
)
"""A bar of the colours of what is shown, and what they mean."""


class LiveView:
    """A page in the browser that shows an object, a description, and sliders.

    port: the first that is tried; the next free one is taken. Errors: `InputError` without the package viser, or for a
    version of it that starts its server in another way, which could not be guarded.
    """

    def __init__(self, title: str, port: int = 8080) -> None:
        viser = require_viser()
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # of connections that browsers break off
        self.guard = Guard(secrets.token_urlsafe(24))
        with _guarded(self.guard) as started, redirect_stdout(StringIO()):  # it prints addresses without the token
            self._server = viser.ViserServer(host=HOST, port=port, verbose=False)
        if not started:
            self._server.stop()
            raise InputError(
                'This version of viser cannot be guarded by a token; pip install "holosplat[view]" has one.'
            )
        self._server._websock_server.unregister_handler(viser._messages.ShareUrlRequest)  # a way out of this machine
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        self._server.scene.set_up_direction("-y")
        self._server.initial_camera.position = (0.0, -6.0, -24.0)
        self._server.initial_camera.look_at = (0.0, 0.0, 0.0)
        self._words = self._server.gui.add_markdown(_escaped(title))
        self._legend = self._server.gui.add_html("")
        self._title, self._part = title, None
        self._scaled: Frame | None = None
        self.frame: Frame | None = None

    @property
    def url(self) -> str:
        """The address to open, with the token."""
        return f"http://{HOST}:{self.port}/?token={self.guard.token}"

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return int(self._server.get_port())

    @property
    def watched(self) -> bool:
        """Whether a browser shows it now."""
        return len(self._server.get_clients()) > 0

    def tell(self, *lines: str) -> None:
        """Show lines of text below the title."""
        self._words.content = "  \n".join(map(_escaped, (self._title, *lines)))

    def show(self, part: Shown) -> None:
        """Show Gaussians or triangles in place of what was there; `frame` must be set."""
        assert self.frame is not None
        scene = self._server.scene
        if isinstance(part, TriangleMesh):
            scene.add_mesh_simple(
                "/object", self.frame.places(part.vertices), part.faces.astype(np.uint32), color=COLOUR, side="double"
            )
        else:
            self._show_splats(part)
        if self._part is not None and self._part is not type(part):
            scene.remove_by_name("/splats" if self._part is Splats else "/object")
        self._part = type(part)
        said, colours = legend(part)
        self._legend.content = LEGEND.format(colours=colours, said=said)
        if self._scaled is not self.frame:
            self._show_scale()

    def _show_scale(self) -> None:
        """Three bars of one length along x, y and z, at the near lower left corner."""
        assert self.frame is not None
        self._scaled, edge = self.frame, HALF_EDGE
        corner, length = np.array([-edge, edge, -edge]), self.frame.bar * self.frame.scale
        ends = corner + length * np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
        bars = np.stack([np.broadcast_to(corner, (3, 3)), ends], axis=1)
        self._server.scene.add_line_segments("/scale", bars.astype(np.float32), (255, 255, 255), thickness=0.08)
        for axis, said, end in zip("xyz", (f"x, {format_length(self.frame.bar)}", "−y", "z"), ends):
            self._server.scene.add_label(f"/scale/{axis}", said, position=end)

    def _show_splats(self, part: Splats) -> None:
        assert self.frame is not None
        self._server.scene.add_gaussian_splats(
            "/splats",
            self.frame.places(part.centres),
            part.covariances * self.frame.scale**2,
            part.colours,
            part.opacities[:, None],
        )

    def slider(self, label: str, steps: int, on_step: Any, first: int = 0) -> None:
        """A slider from 0 to `steps` - 1; `on_step(k)` is called when it is moved."""
        require(steps > 1, f"a slider needs two steps at least, but {label} has {steps}.")
        handle = self._server.gui.add_slider(label, min=0, max=steps - 1, step=1, initial_value=first)
        handle.on_update(lambda event: on_step(int(event.target.value)))

    def close(self) -> None:
        """End the server; browsers show that it is gone."""
        with redirect_stdout(StringIO()):
            self._server.stop()


def _escaped(text: str) -> str:
    """Text without what Markdown or HTML would take for marks."""
    return "".join(f"&#{ord(c)};" if c in "<>&*_`[]()#|\\!~" else c for c in text)


@contextmanager
def _guarded(guard: Guard) -> Iterator[list[bool]]:
    """While it lasts, servers of the package websockets, on which viser's stands, ask `guard` before they answer; the
    list then holds something. viser itself has no place for such a question."""
    from websockets.asyncio import server as module

    original, started = module.serve, list[bool]()

    def serve(*args: Any, process_request: Any = None, **rest: Any) -> Any:
        started.append(True)
        return original(*args, process_request=_asking(guard, process_request), **rest)

    module.serve = serve
    try:
        yield started
    finally:
        module.serve = original


def _asking(guard: Guard, otherwise: Any) -> Any:
    """A function that answers requests as `otherwise` does, where the guard lets them pass."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    fixed = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "Content-Type": "text/plain; charset=utf-8"}

    def answer(connection: Any, request: Any) -> Any:
        headers: dict[str, list[str]] = {}
        for name, value in request.headers.raw_items():
            headers.setdefault(name.lower(), []).append(value)
        found = guard.answer(request.path, headers)
        if found == "pass":
            return otherwise(connection, request)
        if found == "enter":
            said = Headers({**fixed, "Location": "/", "Set-Cookie": guard.set_cookie(), "Content-Length": "0"})
            return Response(303, "See Other", said, b"")
        body = REFUSED.encode()
        return Response(403, "Forbidden", Headers({**fixed, "Content-Length": str(len(body))}), body)

    return answer


HOST = "127.0.0.1"
"""The address that the view is bound to: nothing outside of this machine reaches it."""
NAMES = (HOST, "localhost")
"""Names that a request may call this machine by. Another one may be a foreign page's, made to point here."""
REFUSED = "This view is private: open the address, with its token, that holosplat printed.\n"
Answer = Literal["pass", "enter", "refuse"]


@dataclass(frozen=True)
class Guard:
    """The token of a view."""

    token: str

    @property
    def cookie(self) -> str:
        """The name of its cookie, another one for each view: cookies do not tell ports apart."""
        return f"holosplat-{self.token[:6]}"

    def set_cookie(self) -> str:
        """The header that gives it."""
        return f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def answer(self, path: str, headers: Mapping[str, Sequence[str]]) -> Answer:
        """What a request of `path` gets: `pass`; `enter`, the cookie, where the token is in the address; or `refuse`.

        headers: by name in lower case, each with all its values. A request must name this machine as its host, and
        where it says which page it comes from, that must be of this very server.
        """
        hosts, origins = headers.get("host", ()), headers.get("origin", ())
        if len(hosts) != 1 or urlsplit(f"//{hosts[0]}").hostname not in NAMES:
            return "refuse"
        if any(origin != f"http://{hosts[0]}" for origin in origins):
            return "refuse"
        if any(self._is(token) for token in parse_qs(urlsplit(path).query).get("token", ())):
            return "enter"
        return "pass" if any(self._is(token) for token in self._cookies(headers)) else "refuse"

    def _cookies(self, headers: Mapping[str, Sequence[str]]) -> list[str]:
        found = []
        for text in headers.get("cookie", ()):
            try:
                cookies = SimpleCookie(text)
            except CookieError:
                continue
            found += [cookies[self.cookie].value] if self.cookie in cookies else []
        return found

    def _is(self, token: str) -> bool:
        return hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode())


INTERVAL_S = 1.0
"""Seconds between updates, at least."""
SHARE = 0.01
"""Share of the time that updates may take by what they cost in this process; sending them comes beside it."""


class Watch:
    """Callbacks from a fit to a view: `on_progress` and `on_state` of `reconstruct`.

    The object is taken at the end of a step, of the first one of a stage always, and drawn by another thread. The next
    update waits until the last one's cost is `SHARE` of the time. While no browser is there, only words are kept, and
    nothing is drawn but the coarse volume before all work, which a browser that comes later finds.
    """

    def __init__(self, view: LiveView) -> None:
        self._view = view
        self._next, self._cost, self._stage, self._coarse = 0.0, 0.0, "", True
        self._busy = threading.Event()

    def on_progress(self, stage: str, fraction: float, record: dict[str, float]) -> None:
        """A stage that goes on, as words."""
        if not record and time.perf_counter() >= self._next:
            self._next = time.perf_counter() + INTERVAL_S
            self._view.tell(f"{stage}: {fraction:.0%}")

    def on_state(self, stage: str, fraction: float, record: dict[str, float], state: Callable[[], Stored]) -> None:
        """A step of a fit: words, and the object where a browser looks."""
        now = time.perf_counter()
        if (now < self._next and stage == self._stage) or self._busy.is_set():
            return
        self._stage, self._next = stage, now + INTERVAL_S
        self._view.tell(*words(stage, fraction, record))
        if not (self._view.watched or stage == PICTURE):
            return
        began = time.thread_time()
        found = state()
        self._cost = time.thread_time() - began
        self._busy.set()
        threading.Thread(target=self._draw, args=(found, stage == PICTURE), daemon=True).start()

    def _draw(self, found: Stored, coarse: bool) -> None:
        began = time.thread_time()
        try:
            if self._coarse:  # nothing yet, or what fills its whole grid
                self._view.frame, self._coarse = Frame.around(found.enclosing_grid(1)), coarse
            self._view.show(shown(found))
        except InputError as error:  # there is no surface
            self._view.tell(str(error))
        finally:
            cost = 0.0 if coarse else self._cost + time.thread_time() - began
            self._next = time.perf_counter() + max(INTERVAL_S, cost / SHARE)
            self._busy.clear()


def words(stage: str, fraction: float, record: dict[str, float]) -> list[str]:
    """The description of a step."""
    numbers = {name: record[name] for name in ("loss", "count") if name in record}
    said = [f"{stage}: {fraction:.0%}"]
    said += [f"step {record['step']:.0f}"] if "step" in record else []
    said += [f"loss {numbers['loss']:.4g}"] if "loss" in numbers else []
    return said + ([f"{numbers['count']:.0f} Gaussians"] if "count" in numbers else [])
