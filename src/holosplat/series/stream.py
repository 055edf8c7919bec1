"""Times from a socket (ZeroMQ), each written as a file that `watch` takes like those that appear in a folder.

Two formats of messages are known, both of many beamlines and without anything that is run when it is read:

- `array-1.0`: JSON headers, each followed by the bytes of its array (the areaDetector plugin ADZMQ, PSI's htypes);
- the Karabo bridge of the European XFEL, protocol 2.2: msgpack headers, each followed by values or an array
  (`karabo_bridge.deserialize`; older protocols, whose arrays may be pickled, are refused).
"""

from __future__ import annotations

import json
import math
import re
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..checks import InputError, MissingError, finite, require
from ..io.angles import read_angles
from ..io.atomic import atomic_path
from ..io.beams import read_beams
from ..io.euxfel import PIXELS
from ..io.reading import Reading, marked
from ..ranges import Natural, Positive, ranged
from ..tables import shown

SCHEME = "tcp://"
RECEIVED = "received"
"""The folder of the times that came, in that of the watch."""
MOST_PARTS = 4096
"""Parts of a message, at most: four thousand arrays are no time of a few views."""
MOST_HEADER = 1 << 20
"""Bytes of a header, at most."""
OPEN_TIMES, PATIENCE_S = 8, 5.0
"""Times that wait for views, at most, and how long they do [s]: cameras of one trigger answer within a second."""
REMEMBERED = 100_000
"""Times of which it is known that they came, or were given up."""
TELL_S = 10.0
"""How often refusals of one kind are said [s], with their count."""
WAKE_S = 0.2
"""How often the socket's thread looks whether it is to end [s]."""
ITEM = {"float": (4, 8), "uint": (1, 2, 4), "int": (1, 2, 4)}
TYPES = {f"{kind}{8 * size}": np.dtype(f"{kind[0]}{size}") for kind, sizes in ITEM.items() for size in sizes}
"""Types of numbers, as NumPy calls them."""
HEADER_VALUES = ("energy_kev", "distance", "pixel_size")
"""What a header may say as one number of all views, in the names and units of the options."""


@dataclass(frozen=True)
@ranged
class Streaming:
    """How times are taken from a socket, tcp://HOST:PORT in place of the folder (extra stream)."""

    socket: Literal["pull", "sub", "req"] = "pull"
    """Kind of the socket: pull from a push, which loses nothing; sub to a pub; req of a Karabo bridge that answers."""
    high_water: Natural = 100
    """Messages that are kept before they are read (ZeroMQ's high-water mark); a push then waits, a pub drops."""
    most_waiting: Natural = 10_000
    """Received times that wait for their reconstruction, at most; later ones are dropped, and counted."""
    most_mb: Positive = 256.0
    """Largest message [MB]; a larger part ends the connection, which is made again."""


@dataclass(frozen=True)
class Arrived:
    """A part of a time. key: train, or frame, and the pulse in it (-1: there is one); view: its number, None: all;
    frames: [H, W], or [V, H, W]; values: what the header says beside them."""

    key: tuple[int, int]
    view: int | None
    frames: np.ndarray
    values: Mapping[str, Any] = field(default_factory=dict)


def parsed(parts: Sequence[bytes], reading: Reading = Reading()) -> list[Arrived]:
    """The arrays of a message. reading: has the sources (`--sources`) and pulses (`--pulses`) of a Karabo bridge.

    Errors: `InputError`, one sentence, for whatever is not as the formats say.
    """
    even = 2 <= len(parts) <= MOST_PARTS and len(parts) % 2 == 0
    require(even, f"a message must be pairs of a header and an array, but it has {len(parts)} part(s).")
    longest = max(len(header) for header in parts[::2])
    require(longest <= MOST_HEADER, f"headers must have {MOST_HEADER} bytes at most, but one has {longest}.")
    if parts[0][:1] == b"{":
        return [_of_json(*pair) for pair in zip(parts[::2], parts[1::2])]
    return _of_karabo(parts, reading)


def _of_json(header: bytes, content: bytes) -> Arrived:
    """An array of the format array-1.0."""
    try:
        said = json.loads(header)
    except (ValueError, RecursionError):
        said = None
    require(isinstance(said, dict), f"a header must be a JSON object, but it is {shown(header[:60])}.")
    assert isinstance(said, dict)
    kind, name, shape = (said.get(key) for key in ("htype", "type", "shape"))
    require(kind == "array-1.0", f"htype of a header must be 'array-1.0', but it is {shown(kind)}.")
    known = isinstance(name, str) and name in TYPES
    require(known, f"type must be one of {', '.join(TYPES)}, but it is {shown(name)}.")
    whole = isinstance(shape, list) and len(shape) in (2, 3) and all(type(n) is int and n > 0 for n in shape)
    require(whole, f"shape must be [H, W] or [V, H, W], but it is {shown(shape)}.")
    assert isinstance(shape, list)
    order = said.get("encoding", "little")
    require(order in ("little", "big"), f"encoding must be 'little' or 'big', but it is {shown(order)}.")
    dtype = TYPES[str(name)].newbyteorder("<" if order == "little" else ">")
    size = math.prod(shape) * dtype.itemsize
    require(len(content) == size, f"an array {shape} of {name} must have {size} bytes, but it has {len(content)}.")
    train, pulse = _whole(said, "frame"), _whole(said, "pulse", -1)
    view = _whole(said, "view", 0) if len(shape) == 2 else None
    frames = np.frombuffer(content, dtype).reshape(shape).astype(dtype.newbyteorder("="))
    return Arrived((train, pulse), view, frames, _values(said))


def _values(said: Mapping[str, Any]) -> dict[str, Any]:
    found = dict[str, Any]()
    for name in (*HEADER_VALUES, "angles_deg"):
        if name not in said:
            continue
        values = said[name] if name == "angles_deg" and isinstance(said[name], list) else [said[name]]
        numbers = all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e30 for v in values)
        require(numbers and len(values) > 0, f"{name} of a header must be numbers, but it is {shown(said[name])}.")
        found[name] = finite(name, np.array(values, dtype=np.float64))
    return {name: value if name == "angles_deg" else value[0] for name, value in found.items()}


def _whole(said: Mapping[str, Any], name: str, default: int | None = None) -> int:
    value = said.get(name, default)
    good = type(value) is int and -1 <= value < 1 << 62
    require(good, f"{name} of a header must be a whole number from 0 on, but it is {shown(value)}.")
    return value  # type: ignore[return-value]


def _of_karabo(parts: Sequence[bytes], reading: Reading) -> list[Arrived]:
    """The pulses of a train of a Karabo bridge: the cameras' frames in the order of --sources."""
    from karabo_bridge import deserialize

    try:
        found: Any = deserialize(list(parts))
        data, meta = found
    except Exception as error:  # whatever a message that is none does to it
        said = f"{error!r:.80}"
        raise InputError(f"a message must be array-1.0 or of a Karabo bridge, but it is neither: {said}.") from None
    good = isinstance(data, dict) and all(isinstance(name, str) for name in data)
    require(good, "sources of a message must have names, but they have none.")
    having = sorted(name for name, values in data.items() if isinstance(values, dict) and PIXELS in values)
    wanted = [word.strip() for word in (reading.told.sources or "*").split(",")]
    names = [name for word in wanted for name in having if fnmatch(name, f"*{word}*")]
    one_each = reading.told.sources is None or len(names) == len(wanted)
    require(
        len(names) > 0 and len(set(names)) == len(names) and one_each,
        f"--sources must name one camera each of those with {PIXELS}, which are {', '.join(having) or 'none'}, but it "
        f"is {', '.join(wanted)}.",
    )
    frames: list[Any] = [data[name][PIXELS] for name in names]
    alike = all(isinstance(one, np.ndarray) and one.dtype.name in TYPES and one.ndim in (2, 3) for one in frames)
    alike = alike and len({(one.shape, one.dtype) for one in frames}) == 1
    require(alike, f"{PIXELS} must be numbers [H, W] or [P, H, W], alike of all cameras, but they are not.")
    trains = {_whole(meta.get(name) or {}, "timestamp.tid") for name in names}
    require(len(trains) == 1, f"cameras of a message must be of one train, but are of {sorted(trains)[:4]}.")
    joined, train = np.stack(frames), trains.pop()
    if joined.ndim == 3:
        return [Arrived((train, -1), None, joined)]
    pulses = np.flatnonzero(marked("--pulses", reading.told.pulses or ":", joined.shape[1]))
    return [Arrived((train, int(p)), None, joined[:, p]) for p in pulses]


def views_of(reading: Reading) -> tuple[int | None, np.ndarray | None]:
    """How many views a time has, and their angles [degrees], by --exposures or --angles; None: as the headers say.

    Of beams that do not turn about y alone the angles are the nearest ones; reading by --exposures has all of them.
    """
    if reading.told.exposures is not None:
        turns = np.array([each.matrix() for each in read_beams(reading.told.exposures).view])
        return len(turns), np.rad2deg(np.arctan2(turns[:, 0, 2], turns[:, 0, 0]))
    if reading.told.angles is not None:
        return len(angles := read_angles(reading.told.angles)), angles
    return None, None


class Assembly:
    """Puts the views of each time together. count: of them; None: a time is one message of all, or one view.

    `add` gives the times that are complete. What does not fit is an `InputError` and leaves the rest as it is.
    """

    def __init__(self, count: int | None, came: Callable[[tuple[int, int]], bool]) -> None:
        self._count, self._came = count, came
        self._open: OrderedDict[tuple[int, int], tuple[float, dict[int, Arrived]]] = OrderedDict()
        self._past, self._order = set[tuple[int, int]](), deque[tuple[int, int]]()
        self._like: tuple[tuple[int, ...], np.dtype] | None = None

    def add(self, part: Arrived, now: float) -> Arrived | None:
        """The time that `part` completes, if it does."""
        name = named(part.key)
        require(part.key not in self._past and not self._came(part.key), f"{name} came already, or came too late.")
        shape, like = part.frames.shape[-2:], (part.frames.shape[-2:], part.frames.dtype)
        if self._like is not None and like != self._like:
            (h, w), dtype = self._like
            had = f"{shape[0]} × {shape[1]} of {part.frames.dtype}"
            raise InputError(f"{name} must have frames of {h} × {w} pixels of {dtype}, as the first, but has {had}.")
        count = self._count or (len(part.frames) if part.view is None else 1)
        if part.view is None:
            require(len(part.frames) == count, f"{name} must have {count} views, but it has {len(part.frames)}.")
            require(part.key not in self._open, f"{name} came in single views, and as a whole.")
            return self._complete(part)
        require(part.view < count, f"{name}: views are counted from 0 to {count - 1}, but one is {part.view}.")
        views = self._open.setdefault(part.key, (now, {}))[1]
        require(part.view not in views, f"{name}: view {part.view} came twice.")
        same = not views or like == (next(iter(views.values())).frames.shape, next(iter(views.values())).frames.dtype)
        require(same, f"{name}: all views must have one shape and type, but view {part.view} has another.")
        views[part.view] = part
        if len(views) < count:
            return None
        del self._open[part.key]
        values = {name: value for one in views.values() for name, value in one.values.items()}
        frames = np.stack([views[v].frames for v in range(count)])
        return self._complete(replace(part, view=None, frames=frames, values=values))

    def _complete(self, part: Arrived) -> Arrived:
        self._like = part.frames.shape[-2:], part.frames.dtype
        self._pass(part.key)
        return part

    def _pass(self, key: tuple[int, int]) -> None:
        self._past.add(key)
        self._order.append(key)
        if len(self._order) > REMEMBERED:
            self._past.discard(self._order.popleft())

    def given_up(self, now: float) -> Iterator[str]:
        """A sentence for each time whose views do not come any more."""
        while self._open:
            key, (since, views) = next(iter(self._open.items()))
            if len(self._open) <= OPEN_TIMES and now - since < PATIENCE_S:
                return
            del self._open[key]
            self._pass(key)
            lacking = next(v for v in range(self._count or 1) if v not in views)
            yield f"{named(key)} lacks view {lacking} of {self._count}; it is left out."


def named(key: tuple[int, int]) -> str:
    """What messages call a time."""
    return f"train {key[0]}" + (f", pulse {key[1]}" if key[1] >= 0 else "")


class Stream(threading.Thread):
    """Takes times from the socket `address` into files of `folder`, in a thread, from `start` to `stop`.

    A file `train000000000017.npz` (`_p003` for a pulse) holds `counts` [V, H, W] as they came, and the angles and
    values that the header or --exposures say (`io.arrays`). waiting: how many of them are not done, by the watch's last
    look. Errors: `InputError` for an address that is none, and without the packages of the extra stream.
    """

    def __init__(
        self, address: str, how: Streaming, reading: Reading, folder: Path, say: Callable[[str], None] = print
    ) -> None:
        super().__init__(daemon=True, name="stream")
        _zmq()
        good = re.fullmatch(r"tcp://[^\s:/]+:\d{1,5}|tcp://\[[0-9a-fA-F:.]+\]:\d{1,5}", address) is not None
        require(good, f"a stream must be tcp://HOST:PORT, but it is {address}; correct the address.")
        self._reading, self._folder, self._say, self._how = reading, folder, say, how
        count, self._angles = views_of(reading)
        self._assembly = Assembly(count, lambda key: self._path(key).exists())
        self._address, self._ending = address, threading.Event()
        self.waiting = 0
        self._refused, self._told = Counter[str](), dict[str, float]()

    def stop(self) -> None:
        """End it."""
        self._ending.set()
        if self.ident is not None:
            self.join()
        for kind, count in self._refused.items():
            self._say(f"refused: {count} more like: {kind} …")

    def run(self) -> None:
        """See `threading.Thread.run`."""
        zmq = _zmq()
        self._context = zmq.Context()
        kinds = {"pull": zmq.PULL, "sub": zmq.SUB, "req": zmq.REQ}
        self._socket = self._context.socket(kinds[self._how.socket])
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.set_hwm(self._how.high_water)
        self._socket.setsockopt(zmq.MAXMSGSIZE, int(1e6 * self._how.most_mb))
        if self._how.socket == "sub":
            self._socket.setsockopt(zmq.SUBSCRIBE, b"")
        if self._how.socket == "req":  # a request whose answer is lost is made again
            self._socket.setsockopt(zmq.REQ_RELAXED, 1)
            self._socket.setsockopt(zmq.REQ_CORRELATE, 1)
            self._socket.setsockopt(zmq.IMMEDIATE, 1)
        self._events = self._socket.get_monitor_socket(zmq.EVENT_CONNECTED | zmq.EVENT_DISCONNECTED)
        try:
            self._receive(zmq)
        finally:
            self._socket.disable_monitor()
            self._context.destroy(linger=0)

    def _receive(self, zmq: Any) -> None:
        try:
            self._socket.connect(self._address)
        except zmq.ZMQError as error:
            self._say(f"{self._address} cannot be connected to: {error}")
            return
        poller, asked = zmq.Poller(), False
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._events, zmq.POLLIN)
        while not self._ending.is_set():
            if self._how.socket == "req" and not asked:
                with suppress(zmq.Again):  # nobody is there yet
                    self._socket.send(b"next", zmq.NOBLOCK)  # as a Karabo bridge has it
                    asked = True
            ready = dict(poller.poll(1000 * WAKE_S))
            if self._events in ready and self._socket not in ready:  # what came before is read first
                asked = self._connection() and asked
            if self._socket in ready:
                asked = False
                self.take(self._socket.recv_multipart())
            for sentence in self._assembly.given_up(time.monotonic()):
                self._refuse(sentence)

    def _connection(self) -> bool:
        """Say that it is there, or gone; which."""
        from zmq.utils.monitor import recv_monitor_message

        zmq = _zmq()
        came = recv_monitor_message(self._events)["event"] == zmq.EVENT_CONNECTED
        if not came:  # after a part that is too large ZeroMQ does not connect again by itself
            with suppress(zmq.ZMQError):
                self._socket.disconnect(self._address)
            self._socket.connect(self._address)
        text = "is connected" if came else f"is gone, or sent more than {self._how.most_mb:g} MB at once; it is awaited"
        self._say(f"{self._address} {text}")
        return came

    def take(self, parts: Sequence[bytes]) -> None:
        """Take in a message, or refuse it."""
        try:
            size = sum(map(len, parts))
            most = self._how.most_mb
            require(size <= 1e6 * most, f"a message must have {most:g} MB at most, but it has {1e-6 * size:.4g}.")
            for part in parsed(parts, self._reading):
                whole = self._assembly.add(part, time.monotonic())
                if whole is not None:
                    self._keep(whole)
        except InputError as error:
            self._refuse(str(error))

    def _keep(self, whole: Arrived) -> None:
        most = self._how.most_waiting
        require(self.waiting < most, f"{named(whole.key)} is dropped, for {most} times wait already (--most-waiting).")
        known = {} if self._angles is None else {"angles_deg": self._angles}
        with atomic_path(self._path(whole.key)) as temporary:
            np.savez(temporary, counts=whole.frames, **{**whole.values, **known})
        self.waiting += 1

    def _path(self, key: tuple[int, int]) -> Path:
        return self._folder / (f"train{key[0]:012d}" + (f"_p{key[1]:03d}" if key[1] >= 0 else "") + ".npz")

    def _refuse(self, sentence: str) -> None:
        """Say it, or count it where one that begins likewise was said a moment ago."""
        kind, now = " ".join(re.sub(r"[0-9]+", "", sentence).split()[:4]), time.monotonic()
        self._refused[kind] += 1
        if now - self._told.get(kind, -math.inf) >= TELL_S:
            self._told[kind] = now
            more = self._refused.pop(kind) - 1
            self._say(f"refused: {sentence}" + (f" ({more} more like it)" if more else ""))


def _zmq() -> Any:
    try:
        import karabo_bridge  # noqa: F401
        import zmq
    except ImportError:
        said = 'A stream needs pyzmq and karabo-bridge; install them by pip install "holosplat[stream]".'
        raise MissingError(said) from None
    return zmq
