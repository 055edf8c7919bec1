"""Times from a socket: what a message says, how views become a time, what is refused, and that a watch goes on."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zmq
from karabo_bridge import ServerInThread, serialize

from helpers.cli import holosplat, refused
from helpers.series import SETTINGS, known
from holosplat.checks import InputError
from holosplat.io.beams import Beams, write_beams
from holosplat.io.formats import read_as, read_frames
from holosplat.io.nxtomo import read_scan
from holosplat.io.reading import Reading, Told
from holosplat.series import stream as streaming
from holosplat.series.stream import Arrived, Assembly, Stream, Streaming, parsed
from holosplat.series.watch import Watch, WatchFolder, Watching


def message(train: int, frames: np.ndarray, **more: object) -> list[bytes]:
    """One of the format array-1.0."""
    said = {"htype": "array-1.0", "type": frames.dtype.name, "shape": list(frames.shape), "frame": train, **more}
    return [json.dumps(said).encode(), frames.tobytes()]


def karabo(train: int, cameras: dict[str, np.ndarray]) -> list[bytes]:
    """One of a Karabo bridge."""
    data = {name: {"data.image.pixels": frames} for name, frames in cameras.items()}
    return [bytes(part) for part in serialize(data, {name: {"timestamp.tid": train} for name in data})]


FOUR = np.arange(4 * 3 * 5, dtype=np.uint16).reshape(4, 3, 5)

# --- messages -----------------------------------------------------------------------------------------------


def test_a_message_of_json_headers_is_read():
    (whole,) = parsed(message(7, FOUR, energy_kev=20, angles_deg=[0, 30, 60, 90]))
    assert (whole.key, whole.view, whole.frames.dtype) == ((7, -1), None, np.uint16)
    assert np.array_equal(whole.frames, FOUR)
    assert whole.values["energy_kev"] == 20.0
    assert whole.values["angles_deg"].tolist() == [0, 30, 60, 90]
    big = FOUR[0].astype(">u2")
    header = {"htype": "array-1.0", "type": "uint16", "shape": [3, 5], "frame": 7, "view": 2, "encoding": "big"}
    one, other = parsed([json.dumps(header).encode(), big.tobytes(), *message(7, FOUR[1], view=3, pulse=4)])
    assert (one.view, other.view, other.key) == (2, 3, (7, 4))
    assert np.array_equal(one.frames, FOUR[0])


def test_a_message_of_a_karabo_bridge_is_read():
    """Cameras in the order of --sources; the pulses of a train are times of their own."""
    cameras = {"B/CAM:out": FOUR[:2], "A/CAM:out": FOUR[2:]}
    reading = Reading(Told(sources="B/,A/", pulses="1"))
    (one,) = parsed(karabo(9, cameras), reading)
    assert one.key == (9, 1)
    assert np.array_equal(one.frames, FOUR[[1, 3]])
    assert [part.key for part in parsed(karabo(9, cameras))] == [(9, 0), (9, 1)]
    single = {name: frames[0] for name, frames in cameras.items()}
    assert parsed(karabo(9, single))[0].frames.shape == (2, 3, 5)


JSON = '{"htype":"array-1.0","type":"uint16","shape":[3,5],"frame":1'


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ([], "pairs of a header and an array, but it has 0"),
        ([b"x"], "but it has 1 part"),
        ([b"{}", b""] * 2049, "but it has 4098 part"),
        ([b"{" + b" " * (1 << 20) + b"}", b""], "headers must have 1048576 bytes at most"),
        ([b"{" + b'"a":{' * 100_000, b""], "must be a JSON object"),
        ([b"{\xff", b""], "must be a JSON object"),
        ([b'{"htype":"array-2"}', b""], "htype of a header must be 'array-1.0', but it is 'array-2'"),
        ([b'{"htype":"array-1.0","type":"object","shape":[3,5]}', b""], "type must be one of"),
        ([b'{"htype":"array-1.0","type":["u"],"shape":[3,5]}', b""], "type must be one of"),
        ([b'{"htype":"array-1.0","type":"uint16","shape":[3,-5]}', b""], "shape must be"),
        ([b'{"htype":"array-1.0","type":"uint16","shape":[3,true]}', b""], "shape must be"),
        ([(JSON + ',"encoding":"x"}').encode(), bytes(30)], "encoding must be"),
        ([(JSON + "}").encode(), bytes(29)], "must have 30 bytes, but it has 29"),
        ([b'{"htype":"array-1.0","type":"uint16","shape":[1099511627776,1099511627776]}', b""], "bytes, but it has 0"),
        ([(JSON.replace('"frame":1', '"frame":1.5') + "}").encode(), bytes(30)], "frame of a header must be a whole"),
        ([(JSON + ',"view":"a"}').encode(), bytes(30)], "view of a header must be a whole"),
        ([(JSON + ',"energy_kev":"a"}').encode(), bytes(30)], "energy_kev of a header must be numbers"),
        ([(JSON + ',"energy_kev":NaN}').encode(), bytes(30)], "energy_kev"),
        ([(JSON + ',"angles_deg":[]}').encode(), bytes(30)], "angles_deg of a header must be numbers"),
        ([b"\xc1", b"\xc1"], "it is neither"),
        ([b"\x80", b"\x80"], "it is neither"),
        (karabo(1, {"A": FOUR[0], "B": FOUR[0].astype(np.float32)}), "alike of all cameras"),
        (karabo(1, {"A": FOUR[0].astype(np.complex64)}), "alike of all cameras"),
        (serialize({"A": {"x": 1}}), "--sources must name one camera each"),
        (serialize({"A": {"data.image.pixels": FOUR[0]}}, {"A": {}}), "timestamp.tid of a header must be a whole"),
        (serialize({"A": {"data.image.pixels": FOUR[0]}}, protocol_version="1.0"), "but it has 1 part"),
    ],
)
def test_what_is_no_message_is_refused_in_a_sentence(parts, said):
    with pytest.raises(InputError, match=said.replace("[", r"\[").replace("(", r"\(")):
        parsed([bytes(part) for part in parts])


def test_an_array_that_would_be_unpickled_is_refused(tmp_path, monkeypatch):
    """msgpack_numpy unpickles arrays of objects where it decodes; nothing decodes by it here."""

    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "exploded"), "w"))

    bomb = {"A": {"data.image.pixels": np.array([Bomb()], dtype=object)}}
    (old,) = serialize(bomb, {"A": {}}, protocol_version="1.0")
    header = serialize({"A": {}}, {"A": {"timestamp.tid": 1}})[0]
    for parts in ([old], [header, old], [old, old]):
        with pytest.raises(InputError):
            parsed([bytes(part) for part in parts])
    assert not (tmp_path / "exploded").exists()


# --- views of a time ----------------------------------------------------------------------------------------


def part(train: int, view: int | None, frames: np.ndarray = FOUR[0]) -> Arrived:
    return Arrived((train, -1), view, frames)


def test_views_make_a_time_in_any_order():
    assembly = Assembly(2, lambda key: key[0] == 99)
    assert assembly.add(part(1, 1, FOUR[1]), 0.0) is None
    assert assembly.add(part(2, 0), 0.1) is None
    whole = assembly.add(part(1, 0, FOUR[0]), 0.2)
    assert whole is not None
    assert np.array_equal(whole.frames, FOUR[:2])
    refusals = {
        "train 1 came already": part(1, 0),
        "train 99 came already": part(99, 0),
        "view 0 came twice": part(2, 0),
        "counted from 0 to 1, but one is 2": part(3, 2),
        "must have 2 views, but it has 4": part(3, None, FOUR),
        "must have frames of 3 × 5 pixels of uint16": part(3, 0, FOUR[0].T),
        "must have frames of 3 × 5": part(3, 0, FOUR[0].astype(np.float32)),
        "in single views, and as a whole": part(2, None, FOUR[:2]),
    }
    for said, bad in refusals.items():
        with pytest.raises(InputError, match=said):
            assembly.add(bad, 0.3)
    assert list(assembly.given_up(4.0)) == []
    assert list(assembly.given_up(5.2)) == ["train 2 lacks view 1 of 2; it is left out."]
    with pytest.raises(InputError, match="train 2 came already, or came too late"):
        assembly.add(part(2, 1), 5.3)


def test_views_of_one_time_must_be_alike():
    assembly = Assembly(2, lambda key: False)
    assembly.add(part(1, 0), 0.0)
    with pytest.raises(InputError, match="all views must have one shape and type"):
        assembly.add(part(1, 1, FOUR[0].T), 0.0)


def test_times_that_stay_open_are_few():
    assembly = Assembly(2, lambda key: False)
    for train in range(20):
        assembly.add(part(train, 0), 0.0)
    assert len(list(assembly.given_up(0.0))) == 20 - streaming.OPEN_TIMES


# --- the socket ---------------------------------------------------------------------------------------------


@pytest.fixture
def beams(files, tmp_path) -> Path:
    """geometry.toml of the tiny series."""
    one = read_scan(files.each / "scan9.nxs")
    write_beams(tmp_path / "geometry.toml", Beams.of(one.exposures).with_pixel_size(one.views.pixel_size))
    return tmp_path / "geometry.toml"


@contextmanager
def sender(kind: int = zmq.PUSH) -> Iterator[tuple[zmq.Socket, str]]:
    """A bound socket, and its address."""
    context = zmq.Context()
    socket = context.socket(kind)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.SNDTIMEO, 60_000)  # a push waits until somebody is there
    try:
        yield socket, f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}"
    finally:
        context.destroy(linger=0)


def until(true) -> None:
    end = time.monotonic() + 60
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


@contextmanager
def received(address: str, reading: Reading, folder: Path, **how) -> Iterator[list[str]]:
    """What a stream says while it lasts."""
    said = list[str]()
    folder.mkdir(exist_ok=True)
    stream = Stream(address, Streaming(**how), reading, folder, said.append)
    stream.start()
    try:
        yield said
    finally:
        stream.stop()


def test_what_comes_becomes_files_that_are_scans(files, beams, tmp_path):
    """Whole times and single views; the files have the frames as they came, in the geometry of --exposures."""
    reading, folder = Reading(Told(exposures=beams)), tmp_path / "in"
    scans = [read_scan(files.each / f"scan{9 + k}.nxs") for k in range(2)]
    with sender() as (socket, address), received(address, reading, folder) as said:
        socket.send_multipart(message(5, scans[0].frames))
        for view in (2, 0, 3, 1):
            socket.send_multipart(message(6, scans[1].frames[view], view=view))
        until(lambda: len(list(folder.glob("train*.npz"))) == 2)
    assert [line.split()[-1] for line in said] == ["connected"]
    for train, scan in zip((5, 6), scans):
        found = read_as(folder / f"train{train:012d}.npz", reading)
        assert np.array_equal(found.frames, scan.frames)
        assert np.allclose(found.views.rotations, scan.views.rotations)
        assert np.allclose(found.exposures.distance, scan.exposures.distance)
        assert found.views.pixel_size == pytest.approx(scan.views.pixel_size)


def test_nothing_bad_ends_a_stream(beams, tmp_path):
    """Hostile messages, duplicates and large ones are said, seldom, and what is good still comes."""
    reading, folder = Reading(Told(exposures=beams)), tmp_path / "in"
    good = np.ones((4, 3, 5), np.float32)
    with sender() as (socket, address), received(address, reading, folder, most_mb=0.001) as said:
        for _ in range(500):
            socket.send(b"\x80\x04 junk")
        socket.send_multipart(message(1, good))
        socket.send_multipart(message(1, good))
        socket.send_multipart([b"{}", b"0" * 900, b"{}", b"0" * 900])
        until(lambda: any("must have 0.001 MB at most, but it has 0.001" in line for line in said))
        socket.send(b"0" * 100_000)  # more than the socket takes: the connection ends, and is made again
        until(lambda: sum("is connected" in line for line in said) == 2)
        trains = iter(range(2, 10_000))

        def comes() -> bool:  # what was under way to the old connection is lost
            socket.send_multipart(message(next(trains), good))
            return len(list(folder.glob("train*.npz"))) > 1

        until(comes)
    assert (folder / "train000000000001.npz").exists()
    assert sum("pairs of a header" in line for line in said) == 1
    assert any("499 more like" in line for line in said)
    assert any("train 1 came already" in line for line in said)
    assert any("is gone, or sent more" in line for line in said)
    assert len(said) < 14


def test_more_than_may_wait_is_dropped_and_counted(beams, tmp_path):
    reading, folder = Reading(Told(exposures=beams)), tmp_path / "in"
    with sender() as (socket, address), received(address, reading, folder, most_waiting=2) as said:
        for train in range(5):
            socket.send_multipart(message(train, np.ones((4, 3, 5), np.float32)))
        socket.send(b"last")
        until(lambda: any("pairs" in line for line in said))
    assert len(list(folder.glob("train*.npz"))) == 2
    assert any("train 2 is dropped, for 2 times wait already" in line for line in said)
    assert any("2 more like: train is dropped" in line for line in said)


def test_a_karabo_bridge_is_asked(beams, tmp_path):
    """Its own server, which answers requests; it starts after the stream."""
    folder, cameras = tmp_path / "in", [f"CAM{k}" for k in range(4)]
    with sender() as (_, address):
        pass  # its port is free now
    with received(address, Reading(Told(exposures=beams)), folder, socket="req"):
        server = ServerInThread(address)
        server.start()
        for train in (10, 11):
            server.feed(
                {name: {"data.image.pixels": FOUR[k]} for k, name in enumerate(cameras)},
                {name: {"timestamp.tid": train} for name in cameras},
            )
        until(lambda: len(list(folder.glob("train*.npz"))) == 2)
        server.stop()
    with np.load(folder / "train000000000011.npz") as found:
        assert np.array_equal(found["counts"], FOUR)


def test_a_publisher_is_heard(beams, tmp_path):
    with (
        sender(zmq.PUB) as (socket, address),
        received(address, Reading(Told(exposures=beams)), tmp_path, socket="sub"),
    ):
        train = iter(range(10_000))

        def heard() -> bool:
            socket.send_multipart(message(next(train), FOUR))
            return any(tmp_path.glob("train*.npz"))

        until(heard)


# --- a watch ------------------------------------------------------------------------------------------------


def watch(address: str, reading: Reading, out: Path, **how) -> tuple[int, list[str]]:
    said, folder = list[str](), out / streaming.RECEIVED
    stream = Stream(address, Streaming(), reading, folder, said.append)
    watching = Watching(settle=0.0, poll=0.05, **how)
    one = Watch(folder, WatchFolder(out), SETTINGS, known, reading, watching, said.append, stream=stream)
    return one.run({"settings": "these"}), said


def test_a_stream_is_reconstructed_latest_first_and_goes_on(files, beams, tmp_path, monkeypatch):
    """Three times wait when the watch begins: the latest is done first; after an end the same command does the rest."""
    out, reading = tmp_path / "out", Reading(Told(exposures=beams))
    frames = [read_scan(files.each / f"scan{9 + k}.nxs").frames for k in range(3)]
    with sender() as (socket, address):
        real = Watch._loop

        def later(self, running):
            for train, one in enumerate(frames):
                socket.send_multipart(message(train, one))
            until(lambda: len(list(self.source.glob("train*.npz"))) == 3)
            return real(self, running)

        monkeypatch.setattr(Watch, "_loop", later)
        count, said = watch(address, reading, out, stop_after=1)
        assert count == 1
        assert "train000000000002.npz" in said[-1]
        assert "s after it came, 2 wait" in said[-1]
        monkeypatch.setattr(Watch, "_loop", real)
        count, said = watch(address, reading, out, stop_after=2)
        assert [line.split(":")[0] for line in said if "came" in line] == [
            "train000000000001.npz",
            "train000000000000.npz",
        ]
    page = (out / "live.html").read_text()
    assert "Done: 3 times." in page
    assert "0 wait" in page
    assert read_frames(out / "received/train000000000000.npz", reading).frames.shape == frames[0].shape


def test_what_a_stream_cannot_be(beams, tmp_path):
    out = ["--out", tmp_path / "out"]
    refused(holosplat("watch", "tcp://nowhere", *out, "--exposures", beams), "must be tcp://HOST:PORT")
    refused(holosplat("watch", tmp_path, *out, "--socket", "sub"), "go with tcp://HOST:PORT")
    worked = holosplat(
        "watch", "tcp://127.0.0.1:1", *out, "--exposures", beams, "--idle", 0.01, "--poll", 0.01, "--pulses", "0"
    )
    assert (worked.code, "ended after 0 scans" in worked.err) == (0, True)
    refused(holosplat("watch", "tcp://127.0.0.1:2", *out, "--exposures", beams), "was begun with another folder")


@pytest.mark.parametrize("late", [False, True])
def test_a_picture_of_the_time_in_work_is_on_the_page(late, files, beams, tmp_path, monkeypatch):
    """Coarse at once, before the run has anything else; it is gone when the time is done. So for each scan. Of a stream
    it comes late where the page was written just before, for a browser has not read that yet."""
    import holosplat.series.watch as watching

    out, seen = tmp_path / "out", list[str]()
    real = watching.reconstruct_time

    def slow(shot, settings, run, before, on_progress, on_state):
        def look(stage, *rest):
            on_state(stage, *rest)
            seen.append((out / "live.html").read_text())

        return real(shot, settings, run, before, on_progress, look)

    monkeypatch.setattr(watching, "reconstruct_time", slow)
    incoming = tmp_path / "one"
    incoming.mkdir()
    for name in ("a.nxs", "b.nxs"):
        (incoming / name).write_bytes((files.each / "scan9.nxs").read_bytes())
    one = Watch(
        incoming, WatchFolder(out), SETTINGS, known, Reading(), replace(Watching(), settle=0.0, poll=0.01, stop_after=2)
    )
    if late:
        one.stream, now = SimpleNamespace(start=lambda: None, stop=lambda: None, waiting=0), itertools.count()
        one.clock, one.how = now.__next__, replace(one.how, refresh=20.0)
    assert one.run({}) == 2
    assert ("a.nxs, in work" in seen[0]) == ("data:image/png" in seen[0]) == (not late)
    if late:
        assert any("in work" in page for page in seen)
        return
    assert any("b.nxs, in work" in page for page in seen)
    page = (out / "live.html").read_text()
    assert "in work" not in page
    assert page.count("data:image/png") >= 1
    assert not list((out / "scans/0000").glob("*.npy"))
