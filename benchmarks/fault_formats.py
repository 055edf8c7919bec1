"""Files of all formats that commands read, altered at random: what reads them says one sentence, or reads them."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import tifffile
from fault_kills import sentence
from fault_shop import BEAM, MATERIAL, PIXEL, Shop, copied_run, hidden_in, pipeline
from fault_values import NUMBERS, WORDS
from forked import run

NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])", re.IGNORECASE)
HEADER = 1024
"""Bytes at the beginning of a binary file that say what it holds."""
DEEP = 50_000
"""Parts that no honest table or document is nested in."""

Reads = Callable[[Shop, Path, Path], list[object]]
"""The command that reads a file, from the shop, the file, and a folder for what it writes."""


def _simulated(shop: Shop, file: Path, out: Path) -> list[object]:
    beam = ["--pixel-size", PIXEL, "--detector", 18, 20, "--views", 2]
    return ["simulate", file, *beam, "--out", out / "out.nxs"]


def _cells(shop: Shop, file: Path, out: Path) -> list[object]:
    return ["simulate", file, *BEAM, "--views", 2, "--out", out / "out.nxs"]


def _truth(shop: Shop, file: Path, out: Path) -> list[object]:
    return ["evaluate", copied_run(shop, out), "--truth", file]


def _about(shop: Shop, file: Path, out: Path) -> list[object]:
    return ["info", file]


def _converted(shop: Shop, file: Path, out: Path) -> list[object]:
    return ["convert", file, out / "out", "--to", "tiff"]


def _told(shop: Shop, file: Path, out: Path) -> list[object]:
    return [*_converted(shop, file, out), "--energy-kev", 20, "--distance", 0.1, "--pixel-size", 1e-6]


def _with(*words: str) -> Reads:
    return lambda shop, file, out: [*shop.reconstruct(out / "out"), *words, file]


def _of_run(*before: str, written: str = "") -> Reads:
    return lambda shop, file, out: [*before, file.parent, *([written, out / "out.h5"] if written else [])]


def _compared(shop: Shop, file: Path, out: Path) -> list[object]:
    return ["compare", file.parent, shop.run, "--out", out / "page.html"]


def _resumed(shop: Shop, file: Path, out: Path) -> list[object]:
    return ["reconstruct", "--resume", file.parent]


VOLUMES = (_simulated, _truth, _about)
TABLES: dict[str, tuple[Reads, ...]] = {
    "angles.txt": (lambda shop, file, out: ["convert", shop.scan, out / "out", "--to", "tiff", "--angles", file],),
    "geometry.toml": (lambda shop, file, out: ["convert", shop.scan, out / "o", "--to", "tiff", "--exposures", file],),
    "options.json": (_with("--config"),),
    "options.toml": (_with("--config"),),
    "pipeline.toml": (lambda shop, file, out: ["run", file],),
    "case.toml": (lambda shop, file, out: ["bench", "run", "--cases", file, "--out", out / "out"],),
    "series.json": (
        lambda shop, file, out: ["series", "status", file.parent],
        lambda shop, file, out: ["series", "collect", file.parent],
    ),
}
MESHES: tuple[Reads, ...] = (
    _about,
    _cells,
    lambda shop, file, out: ["plan", "--mesh", file, "--energy-range", 10, 20, *MATERIAL],
    lambda shop, file, out: ["calibrate", shop.scan, "--phantom", file, *MATERIAL, "--out", out / "geometry.toml"],
)
OF_A_RUN: tuple[Reads, ...] = (
    _of_run("info"),
    _of_run("check"),
    _of_run("evaluate"),
    _of_run("export", written="--volume"),
    _of_run("export", written="--compact"),
    _compared,
    _resumed,
)
READERS: dict[str, tuple[Reads, ...]] = {
    **dict.fromkeys(("volume.vti", "volume.nrrd", "volume.mrc", "volume.h5", "volume.ome.tif"), VOLUMES),
    **dict.fromkeys(("bodies.vtu", "bodies.pvd", "cell.vtk", "bodies.stl"), MESHES),
    **dict.fromkeys(("scan.nxs", "raw.nxs"), (_about, _converted)),
    "frames.tif": (_about, _told),
    "arrays.npz": (_about, _told),
    **TABLES,
}
"""What reads a sample, by its name (`made`)."""


def made(shop: Shop) -> Path:
    """A folder with a sound file of each of `READERS`; made once."""
    folder = shop.path / "formats"
    if folder.is_dir():
        return folder
    folder.mkdir()
    for name in ("volume.vti", "volume.nrrd", "volume.mrc", "volume.h5", "volume.ome.tif"):
        _require(["export", shop.run, "--volume", folder / name])
    if shop.track.is_dir():
        for name in ("bodies.vtu", "bodies.stl"):
            _require(["export", shop.track, "--bodies", folder / name])
        _require(["export", shop.track, "--bodies", folder / "moved.vtu", "--time-frame", "all"])
        (folder / "moved.pvd").rename(folder / "bodies.pvd")
    for file, name in ((shop.cells[0], "cell.vtk"), (shop.scan, "scan.nxs"), (shop.raw, "raw.nxs")):
        if file.is_file():
            shutil.copy(file, folder / name)
    frames = np.random.default_rng(1).uniform(0.9, 1.1, (6, 18, 20)).astype(np.float32)
    tifffile.imwrite(folder / "frames.tif", frames)
    np.savez(folder / "arrays.npz", counts=frames, angles_deg=np.arange(6.0), flats=frames[:2])
    (folder / "angles.txt").write_text("".join(f"{30 * k}\n" for k in range(6)))
    _require(
        ["align", shop.scan, *MATERIAL, "--out", folder / "aligned.nxs", "--geometry-out", folder / "geometry.toml"]
    )
    shutil.copy(shop.quick, folder / "options.json")
    (folder / "options.toml").write_text("[fit.schedule]\nsteps = 3\n")
    (folder / "case.toml").write_text(shop.case.read_text())
    (folder / "pipeline.toml").write_text(pipeline(shop, folder / "pipe"))
    _require(
        ["series", "plan", shop.moving if shop.moving.is_file() else shop.scan, *MATERIAL, "--out", folder / "plan"]
    )
    shutil.copy(folder / "plan" / "series.json", folder / "series.json")
    return folder


def _require(command: list[object]) -> None:
    ended = run(command, limit=600)
    if ended.code != 0:
        raise SystemExit(f"{command[0]} must work before its files are altered, but: {ended.said}")


def formats(shop: Shop, rng: random.Random, folder: Path) -> str:
    """A file of any format that commands read is altered, or is no file: one sentence, or it is read."""
    samples = made(shop)
    name = rng.choice([each for each in READERS if (samples / each).exists()])
    file = folder / name
    for beside in samples.glob(f"{name.split('.')[0]}*"):
        if beside.is_file():
            shutil.copy(beside, folder / beside.name)
    for moved in samples.glob("moved_*") if name == "bodies.pvd" else ():
        shutil.copy(moved, folder / moved.name)
    if name in ("volume.mrc", "volume.nrrd") and rng.random() < 0.5:
        altered(file.with_suffix(f".beta{file.suffix}"), rng, samples)
    else:
        altered(file, rng, samples)
    out = folder / "made"
    out.mkdir()
    return _judged(rng.choice(READERS[name])(shop, file, out), folder)


def records(shop: Shop, rng: random.Random, folder: Path) -> str:
    """Likewise of a file of a run folder, by what reads runs."""
    found = copied_run(shop, folder)
    file = found / rng.choice(sorted(each.name for each in found.iterdir() if each.is_file()))
    altered(file, rng, made(shop))
    out = folder / "made"
    out.mkdir()
    return _judged(rng.choice(OF_A_RUN)(shop, file, out), folder)


def _judged(command: Sequence[object], folder: Path) -> str:
    left = set(hidden_in(folder))
    verdict = sentence(run(list(command), first=lambda: os.chdir(folder)))
    if verdict:
        print(" ".join(map(str, command)), flush=True)
    return verdict or ("torn" if set(hidden_in(folder)) - left else "")


def altered(file: Path, rng: random.Random, samples: Path) -> None:
    """Alter `file` in one of many ways."""
    content = file.read_bytes()
    is_text = b"\0" not in content[:HEADER] and content[:1] != b"\x89"
    ways = [_flipped, _cut, _garbled, _numbered if is_text else _declared, _numbered, _emptied, _nested]
    way = rng.choice([*ways, *([_worded] if is_text else []), *([_entered] if _is_json(file) else []), None])
    if way is not None:
        file.write_bytes(way(content, rng))
        return
    file.unlink()
    kind = rng.choice(["pipe", "folder", "circle", "other"])
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "folder":
        file.mkdir()
    elif kind == "circle":
        file.symlink_to(file.name)
    else:
        shutil.copy(rng.choice([each for each in sorted(samples.iterdir()) if each.is_file()]), file)


def _is_json(file: Path) -> bool:
    return file.suffix == ".json"


def _flipped(content: bytes, rng: random.Random) -> bytes:
    found = bytearray(content)
    for _ in range(rng.choice([1, 1, 8])):
        if found:
            found[rng.randrange(min(len(found), rng.choice([HEADER, len(found)])))] ^= 1 << rng.randrange(8)
    return bytes(found)


def _cut(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(1 + len(content))]


def _garbled(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(1 + min(len(content), rng.choice([HEADER, len(content) + 1])))
    return content[:start] + rng.randbytes(rng.choice([1, 16, 64])) + content[start + 16 :]


def _emptied(content: bytes, rng: random.Random) -> bytes:
    return rng.choice([b"", b"\n", b"\0" * 100, b"{}", b"[]", b"null", b"\xff\xfe\x00", b"words\n"])


def _numbered(content: bytes, rng: random.Random) -> bytes:
    """One number in a text, or in the beginning of a binary file, becomes another one."""
    head = content[:4096] if b"\0" in content else content
    found = list(NUMBER.finditer(head))
    if not found:
        return _garbled(content, rng)
    place = rng.choice(found)
    return content[: place.start()] + rng.choice(NUMBERS).encode() + content[place.end() :]


def _declared(content: bytes, rng: random.Random) -> bytes:
    """A whole number of four or eight bytes in a header becomes another one."""
    form, value = rng.choice([("<i", -1), ("<i", 2**31 - 1), ("<i", 0), ("<q", -1), ("<q", 2**62), (">i", 2**31 - 1)])
    start = 4 * rng.randrange(1 + min(len(content), HEADER) // 4)
    packed = struct.pack(form, value)
    return content[:start] + packed + content[start + len(packed) :]


def _worded(content: bytes, rng: random.Random) -> bytes:
    """A word of a text goes, comes twice, or becomes another one."""
    words = re.split(rb"(\W)", content)
    place = rng.randrange(len(words))
    words[place] = rng.choice([b"", words[place] * 2, *(word.encode() for word in WORDS)])
    return b"".join(words)


def _nested(content: bytes, rng: random.Random) -> bytes:
    deep = rng.choice([b"[", b'{"a":', b"<a>", b"a = " + b"[" * DEEP + b"]" * DEEP, b"a."])
    return deep * DEEP if len(deep) < 10 else deep


def _entered(content: bytes, rng: random.Random) -> bytes:
    """An entry of a JSON table is of another kind, or gone."""
    table = json.loads(content)
    place = table
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            return content
        key = rng.choice(keys)
        inner = place[key]
        if isinstance(inner, dict | list) and inner and rng.random() < 0.8:
            place = inner
            continue
        break
    value = rng.choice([None, [], {}, "", "x", "\0", -1, 1e300, True, [[]], {"kind": "x"}, 10**18, "gone"])
    if value == "gone":
        del place[key]
    else:
        place[key] = value
    return json.dumps(table).encode()
