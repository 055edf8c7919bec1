"""`holosplat data`: the list, fetching from a server that runs here, and folders that stand in for it."""

from __future__ import annotations

import functools
import hashlib
import http.server
import shlex
import socket
import threading
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from helpers.cli import holosplat, refused, worked
from holosplat.io import samples as registry
from holosplat.io.nxtomo import read_scan
from holosplat.io.samples import Sample, fetched, samples


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("HOLOSPLAT_DATA", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(tmp_path):
    """The address of a server of the files in tmp_path / "remote", and that folder."""
    folder = tmp_path / "remote"
    folder.mkdir()
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as made:
        threading.Thread(target=made.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{made.server_port}", folder
        made.shutdown()


def a_sample(file: Path, url: str | None, **more: object) -> Sample:
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    made = Sample("made here", file.name, "nowhere", "none", digest, 1, "known", "holosplat convert {data}", url=url)
    return replace(made, **more)  # type: ignore[arg-type]


def image(path: Path) -> Path:
    tifffile.imwrite(path, np.full((12, 15), 0.5, np.float32))
    return path


def test_the_list_names_source_licence_and_facts():
    said = worked(holosplat("data", "list")).out
    for name, sample in samples().items():
        for words in (name, sample.source, sample.licence, sample.facts):
            assert words in said
        assert len(sample.sha256) == 64
        assert "{data}" in sample.next


def test_a_sample_is_fetched_once_and_goes_straight_into_a_command(server, monkeypatch, tmp_path, cache):
    address, folder = server
    options = ("--energy-kev", "11", "--distance", "0.08", "--pixel-size", "1e-7")
    made = a_sample(image(folder / "hair.tiff"), f"{address}/hair.tiff", options=options)
    monkeypatch.setattr(registry, "samples", lambda: {"hair": made})
    first = worked(holosplat("data", "fetch", "hair"))
    assert "go on: holosplat convert $(holosplat data fetch hair)" in first.err
    assert Path(first.out.split()[0]) == cache / "hair.tiff"
    (folder / "hair.tiff").unlink()
    again = worked(holosplat("data", "fetch", "hair"))
    assert again.out == first.out
    worked(holosplat("convert", *shlex.split(again.out), tmp_path / "scan.nxs", "--to", "nxtomo"))
    found = read_scan(tmp_path / "scan.nxs")
    assert (found.exposures.one_energy("it"), found.views.pixel_size) == (11, 1e-7)


def test_a_damaged_file_in_the_cache_is_fetched_anew(server, cache):
    address, folder = server
    made = a_sample(image(folder / "hair.tiff"), f"{address}/hair.tiff")
    cache.mkdir()
    (cache / "hair.tiff").write_bytes((folder / "hair.tiff").read_bytes()[:100])
    path, _ = fetched(made)
    assert path.read_bytes() == (folder / "hair.tiff").read_bytes()


def test_what_cannot_be_fetched_is_said_and_leaves_nothing(server, monkeypatch, cache):
    address, folder = server
    made = a_sample(image(folder / "hair.tiff"), f"{address}/hair.tiff")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = f"http://127.0.0.1:{free.getsockname()[1]}/hair.tiff"
    for sample, words in (
        (replace(made, sha256="0" * 64), ("SHA-256 0000000000000000…", "nothing was kept")),
        (replace(made, url=f"{address}/other.tiff"), ("the server answers", "404")),
        (replace(made, url=nobody), ("cannot be reached", "--from")),
        (replace(made, url=None), ("is not to be fetched whole", "--from")),
    ):
        monkeypatch.setattr(registry, "samples", lambda sample=sample: {"hair": sample})
        refused(holosplat("data", "fetch", "hair"), *words)
        assert not cache.exists() or list(cache.iterdir()) == []
    refused(holosplat("data", "fetch", "tooht"), "no sample 'tooht'", "hair")


def test_a_folder_stands_in_for_the_network(tmp_path):
    file = image(tmp_path / "mine.tiff")
    made = replace(a_sample(file, None, local="mine.tiff"), file="theirs.tiff")
    assert fetched(made, tmp_path)[0] == file
    with pytest.raises(registry.InputError, match=r"must hold theirs\.tiff or mine\.tiff"):
        fetched(made, tmp_path / "empty")
    file.write_bytes(b"other")
    with pytest.raises(registry.InputError, match="damaged or another file"):
        fetched(made, tmp_path)


def test_an_archive_is_unpacked_and_its_angles_written(tmp_path, cache):
    with zipfile.ZipFile(tmp_path / "bed.zip", "w") as archive:
        archive.write(image(tmp_path / "a.tif"), "inner/a.tif")
    path, options = fetched(a_sample(tmp_path / "bed.zip", None, inner="inner", angles=(0.0, 7.5)), tmp_path)
    assert [file.name for file in path.iterdir()] == ["a.tif"]
    assert options[-2] == "--angles"
    assert Path(options[-1]).read_text() == "0\n7.5\n"
    assert path.is_relative_to(cache)


SHARED = Path(__file__).resolve().parents[3] / "shared/data/real"


@pytest.mark.skipif(not SHARED.is_dir(), reason="the measured data is not here")
@pytest.mark.parametrize(
    ("name", "more", "frames", "shape"),
    [
        ("spider-hair", (), 1, (512, 512)),
        ("packed-bed", ("--distance", "0.001", "--views", "0,2,3,4,6,8,9,10"), 8, (100, 150)),
        ("capsule", ("--distance", "0.02", "--crop", "0:40,:"), 91, (40, 80)),
        ("tooth", ("--energy-kev", "25", "--distance", "0.001", "--pixel-size", "1e-5"), 181, (2, 320)),
    ],
)
def test_measured_data_is_read_with_what_is_known_of_it(tmp_path, name, more, frames, shape):
    said = worked(holosplat("data", "fetch", name, "--from", SHARED))
    out = tmp_path / "scan.nxs"
    worked(holosplat("convert", *shlex.split(said.out), *more, out, "--to", "nxtomo"))
    found = read_scan(out)
    assert (len(found), found.views.shape) == (frames, shape)
    assert 0.1 < np.median(found.frames) < 1.2
