"""Faults of all kinds, at random: what commands do when they are killed, have no room, or read what is no good.

python benchmarks/faults.py --trials 200 --csv docs/data/faults.csv

Each trial is one command (or two: the next one), counted as a traceback, a hang (more than 60 s), a crash (a signal
that nobody sent), a wrong result taken silently, or something lost: a file that was whole before and is no more, or a
folder that no next command takes. Trials are drawn from the seed, and repeat with it but for moments of a kill.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import random
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import machine
import numpy as np
from forked import Ended, loaded, run, size_of

from holosplat.checks import InputError
from holosplat.io import read_scan
from holosplat.io.objects import read_object
from holosplat.io.vtk import read_meshes, write_mesh
from holosplat.specimens.red_cells import random_cells
from holosplat.workflows.check import check
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder

PIXEL, ROWS, COLUMNS = 3.2e-6, 18, 20
BEAM = ["--length-unit", "um", "--material", "haemoglobin", "--pixel-size", PIXEL, "--detector", ROWS, COLUMNS]
QUICK = {
    "method": {
        "kind": "gaussians",
        "approximate_steps": 2,
        "spacing_px": 2.0,
        "volume": {"retrieval": 8, "iterations": 10, "corrections": 1, "inner": 4, "refine": 1},
        "fit": {"objective": {"tv_volume": 0.05}, "schedule": {"steps": 12}},
    }
}
OUTCOMES = ("traceback", "hang", "crash", "silent", "lost")


@dataclass(frozen=True)
class Shop:
    """A folder with what commands read: two cells, their scan, raw counts of it, and a run."""

    path: Path
    cells: tuple[Path, ...]
    scan: Path
    raw: Path
    run: Path
    quick: Path

    @classmethod
    def made(cls, path: Path) -> Shop:
        """All of it, made in an empty folder."""
        cells = random_cells(2, (COLUMNS * PIXEL, ROWS * PIXEL, COLUMNS * PIXEL), 1, 10 * PIXEL)
        files = tuple(path / f"{cell.name}.vtk" for cell in cells)
        for cell, file in zip(cells, files):
            write_mesh(file, cell, "um")
        shop = cls(path, files, path / "scan.nxs", path / "raw.nxs", path / "run", path / "quick.json")
        shop.quick.write_text(json.dumps(QUICK["method"]))
        for command in (shop.simulate(shop.scan), shop.record(shop.raw), shop.reconstruct(shop.run)):
            ended = run(command, limit=600)
            if ended.code != 0:
                raise SystemExit(f"{command[0]} must work before it is disturbed, but: {ended.said}")
        return shop

    def simulate(self, out: Path) -> list[object]:
        """Six frames."""
        return ["simulate", *self.cells, *BEAM, "--views", 6, "--out", out]

    def record(self, out: Path) -> list[object]:
        """Their raw counts."""
        return ["record", self.scan, "--out", out, "--flats", 4, "--darks", 2]

    def render(self, out: Path) -> list[object]:
        """Frames of the run."""
        return ["render", self.run, "--scan", self.scan, "--out", out]

    def reconstruct(self, out: Path) -> list[object]:
        """A short run."""
        known = ["--material", "haemoglobin", "--matter", "levels", "--config", self.quick]
        return ["reconstruct", self.scan, "--out", out, *known]


# --- kills --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Writer:
    """A command that writes `out` in a folder. again: what comes next to the command where `out` is there already."""

    name: str
    command: Callable[[Shop, Path], list[object]]
    out: str
    again: tuple[object, ...] = ()


def _copied_run(shop: Shop, folder: Path) -> Path:
    if not (folder / "run").exists():
        shutil.copytree(shop.run, folder / "run")
    return folder / "run"


WRITERS = (
    Writer("simulate", lambda shop, folder: shop.simulate(folder / "out.nxs"), "out.nxs"),
    Writer("record", lambda shop, folder: shop.record(folder / "out.nxs"), "out.nxs"),
    Writer("correct", lambda shop, folder: ["correct", shop.raw, "--out", folder / "out.nxs"], "out.nxs"),
    Writer("join", lambda shop, folder: ["join", shop.scan, shop.scan, "--out", folder / "out.nxs"], "out.nxs"),
    Writer("convert", lambda shop, folder: ["convert", shop.scan, folder / "out", "--to", "tiff"], "out"),
    Writer(
        "render", lambda shop, folder: ["render", shop.run, "--scan", shop.scan, "--out", folder / "out.nxs"], "out.nxs"
    ),
    Writer("export", lambda shop, folder: ["export", shop.run, "--volume", folder / "out.h5"], "out.h5"),
    Writer("reconstruct", lambda shop, folder: shop.reconstruct(folder / "out"), "out", ("--resume",)),
    Writer("evaluate", lambda shop, folder: ["evaluate", _copied_run(shop, folder)], "run"),
    Writer("grow", lambda shop, folder: ["grow", "--out", folder / "out", *GROWTH], "out", ("--resume",)),
)
GROWTH = ["--cells", 1, "--box", "30e-6", "20e-6", "20e-6", "--snapshots", 4, "--frequency", 3, "--interval", "1e-6"]


def killed(shop: Shop, writer: Writer, seconds: float, rng: random.Random, folder: Path) -> str:
    """Kill a command at a random moment of its `seconds`, and let the next one follow; what went wrong."""
    command = writer.command(shop, folder)
    first = run(command, kill_after=rng.uniform(0.0, 1.1 * seconds))
    if first.verdict:
        return first.verdict
    out = folder / writer.out
    if out.is_file() and not _is_whole(out):
        return "lost"
    begun = any((out / name).is_file() for name in ("config.json", "grow.json"))
    done = writer.again and (first.code == 0 or ((out / "grow.json").is_file() and _snapshots(out) == 4))
    if done:
        return ""
    following = [*command, *writer.again] if writer.again and begun else command
    if writer.out == "out" and not writer.again and out.exists():  # a folder that is there is whole
        return "" if first.code == 0 or _reads(out) else "lost"
    second = run(following)
    if second.verdict:
        return second.verdict
    if second.code != 0 or _left(folder):
        return "lost"
    return "" if _is_whole(out) else "lost"


def _snapshots(out: Path) -> int:
    return len(list(out.glob("rbc00_*.vtp"))) if (out / "state.npz").is_file() else 0


def _left(folder: Path) -> list[Path]:
    """Hidden files that the next command should have cleared, or a lock."""
    return [path for path in folder.rglob(".*") if path.is_file()]


def _is_whole(out: Path) -> bool:
    if out.is_dir() and not (out / "config.json").is_file():
        return _reads(out)
    try:
        return not check(out)[1]
    except InputError:
        return False


def _reads(out: Path) -> bool:
    """Whether a folder of images, or of meshes, is whole."""
    try:
        read_meshes([out], "um") if (out / "grow.json").is_file() else read_scan_of(out)
    except InputError:
        return False
    return True


def read_scan_of(path: Path) -> np.ndarray:
    """The frames of a scan of any format."""
    from holosplat.io.formats import read

    return np.asarray(read(path).in_memory().frames)


# --- a full disk --------------------------------------------------------------------------------------------


def full(shop: Shop, writer: Writer, largest: int, rng: random.Random, folder: Path) -> str:
    """No file grows beyond a random size: one sentence, and what is there is whole."""
    ended = run(writer.command(shop, folder), file_size=rng.randrange(largest + 1))
    return _sentence(ended) or ("lost" if (folder / "out.nxs").is_file() and not _is_whole(folder / "out.nxs") else "")


def _sentence(ended: Ended) -> str:
    """What is wrong with how a command ended: it must work, or say one sentence."""
    if ended.verdict or ended.code == 0:
        return ended.verdict
    return "" if "holosplat: " in ended.said or "helptext" in ended.said else "traceback"


# --- damaged and hostile files ------------------------------------------------------------------------------


def flipped(shop: Shop, rng: random.Random, folder: Path) -> str:
    """A bit flips in a file of a run, or in a scan: `check` says so, or nothing that is read has changed."""
    run_folder = _copied_run(shop, folder)
    names = sorted(path for path in run_folder.iterdir() if path.is_file() and path.name != "manifest.json")
    path = rng.choice([*names, shop.scan])
    if path == shop.scan:
        path = Path(shutil.copy(shop.scan, folder / "scan.nxs"))
    content = bytearray(path.read_bytes())
    if not content:
        return ""
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    ended = run(["check", path if path.suffix == ".nxs" else run_folder])
    if _sentence(ended) or ended.code != 0:
        return _sentence(ended)
    return "" if path.suffix == ".nxs" and _unharmed(path, shop.scan) else "silent"


def _unharmed(path: Path, original: Path) -> bool:
    """Whether what is read of a scan is what it was, or is refused."""
    try:
        found, wanted = read_scan(path), read_scan(original)
    except InputError:
        return True
    views = np.array_equal(found.views.rotations, wanted.views.rotations)
    same = np.array_equal(found.frames, wanted.frames) and np.array_equal(found.is_test, wanted.is_test)
    return same and views and np.array_equal(found.exposures.distance, wanted.exposures.distance)


ODD: tuple[object, ...] = (None, -5, 1e300, "", "x", [], {}, [None], True, 10**30)


def tampered(shop: Shop, rng: random.Random, folder: Path) -> str:
    """An entry of config.json, summary.json or object.h5 is another one, or gone: refused, or of no importance."""
    found = RunFolder(_copied_run(shop, folder))
    path = rng.choice([found.config, found.summary])
    table = json.loads(path.read_text())
    place = table
    while True:
        name = rng.choice(list(place))
        if isinstance(place[name], dict) and place[name] and rng.random() < 0.7:
            place = place[name]
            continue
        break
    value = rng.choice([*ODD, "gone"])
    if value == "gone":
        del place[name]
    else:
        place[name] = value
    path.write_text(json.dumps(table))
    try:
        load_reconstruction(found)
    except InputError as error:
        return "" if str(error) else "traceback"
    except Exception:
        return "traceback"
    return ""


def hostile(shop: Shop, rng: random.Random, folder: Path) -> str:
    """Numbers in headers that are huge, zero or negative, and bytes at random: refused in time and memory, or read."""
    kind = rng.choice(["mesh", "object", "scan", "bytes"])
    path = folder / {"mesh": "a.vtk", "object": "object.h5", "scan": "a.nxs", "bytes": "b.nxs"}[kind]
    shutil.copy({"mesh": shop.cells[0], "object": shop.run / "object.h5"}.get(kind, shop.scan), path)
    if kind == "mesh":
        content = path.read_bytes()
        words = content.split(b" ")
        numbers = [i for i, word in enumerate(words) if word.isdigit()]
        if numbers:
            words[rng.choice(numbers)] = rng.choice([b"1000000000000", b"0", b"-1", b"99999999999999999999"])
        path.write_bytes(b" ".join(words))
    elif kind == "bytes":
        content = bytearray(path.read_bytes())
        start = rng.randrange(len(content))
        content[start : start + 64] = rng.randbytes(64)
        path.write_bytes(content)
    else:
        with h5py.File(path, "r+") as file:
            _garble(file, rng)
    command = ["convert", path, folder / "out", "--to", "tiff"]
    if kind == "mesh":
        command = ["simulate", path, *BEAM, "--views", 2, "--out", folder / "out.nxs"]
    if kind == "object":
        copied = _copied_run(shop, folder)
        shutil.copy(path, copied / "object.h5")
        command = ["export", copied, "--volume", folder / "out.h5"]
    return _sentence(run(command))


def _garble(file: h5py.File, rng: random.Random) -> None:
    """Another value, size or kind of one dataset, or of an attribute."""
    names = list[str]()
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    name = rng.choice(names)
    found = file[name]
    assert isinstance(found, h5py.Dataset)
    shape, attributes = found.shape, dict(found.attrs)
    del file[name]
    act = rng.randrange(4)
    if act == 0:
        file.create_dataset(name, data=np.full(shape, rng.choice([np.nan, np.inf, 1e30, -1.0]), "f8"))
    elif act == 1:
        file.create_dataset(name, (10**12, 3, 3), "f4", chunks=(1000, 3, 3))
    elif act == 2:
        file.create_dataset(name, data="text")
    if name in file:
        file[name].attrs.update(attributes)


FLAGS = {
    "simulate": "energy-kev distance pixel-size psf-sigma-px views photons-per-pixel seed misalign-shift density",
    "reconstruct": "seed bin axis-column delta-beta density distance uncertain-shift",
    "grow": "cells flow snapshots interval viscosity diameter",
    "record": "flats darks photons-per-pixel seed gain bits",
}
VALUES = ("nan", "inf", "-inf", "-1", "1e30", "-1e30", str(2**70), str(10**12), "", "x", "1e-300", "\udc80")


def odd(shop: Shop, rng: random.Random, folder: Path) -> str:
    """A value that no experiment has: one sentence."""
    name = rng.choice(list(FLAGS))
    flag = f"--{rng.choice(FLAGS[name].split())}"
    command = {"grow": ["grow", "--out", folder / "out"], "simulate": shop.simulate(folder / "out.nxs")}
    command |= {"record": shop.record(folder / "out.nxs"), "reconstruct": shop.reconstruct(folder / "out")}
    ended = run([*command[name], flag, rng.choice(VALUES)])
    silent = ended.code == 0 and flag not in ("--axis-column",)
    return _sentence(ended) or ("silent" if silent else "")


def two(shop: Shop, rng: random.Random, folder: Path) -> str:
    """A second run into the folder of one that goes on is refused, and the first is as without it."""
    child = os.fork()
    if child == 0:
        run(shop.reconstruct(folder / "out"))
        os._exit(0)
    deadline = time.perf_counter() + 60
    while not (folder / "out" / ".lock").exists() and time.perf_counter() < deadline:
        time.sleep(0.01)
    second = run(shop.reconstruct(folder / "out"))
    os.waitpid(child, 0)
    if _sentence(second) or second.code == 0:
        return _sentence(second) or "silent"
    same = read_object(folder / "out/object.h5").state(), read_object(shop.run / "object.h5").state()
    return "" if _is_whole(folder / "out") and all(map(_alike, same[0].values(), same[1].values())) else "lost"


def _alike(one: Any, other: Any) -> bool:
    return bool(np.array_equal(one, other)) if hasattr(one, "numpy") else one == other


# --- all of them --------------------------------------------------------------------------------------------

SINGLE: dict[str, Callable[[Shop, random.Random, Path], str]] = {
    "bit flips": flipped,
    "tampered runs": tampered,
    "hostile files": hostile,
    "odd values": odd,
    "two writers": two,
}


def timed(shop: Shop, writer: Writer) -> tuple[float, int]:
    """Seconds that a command takes, and bytes of the largest file that it writes."""
    with tempfile.TemporaryDirectory() as name:
        ended = run(writer.command(shop, Path(name)), limit=600)
        return ended.seconds, size_of(Path(name) / writer.out)


def trials(
    shop: Shop, kind: str, count: int, rng: random.Random, writers: tuple[Writer, ...] = WRITERS, seconds: float = 1e9
) -> Counter:
    """`count` trials of a kind, or as many as begin within `seconds`: how many there were, and how many ended in each
    of `OUTCOMES`."""
    found, cost, begun = Counter[str](), {}, time.perf_counter()
    for number in range(count):
        if time.perf_counter() - begun > seconds:
            break
        writer = writers[number % len(writers)]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            if kind in SINGLE:
                outcome = SINGLE[kind](shop, rng, folder)
            else:
                cost[writer.name] = cost.get(writer.name) or timed(shop, writer)
                lasts, largest = cost[writer.name]
                act, measure = (full, largest) if kind == "full disk" else (killed, lasts)
                outcome = act(shop, writer, measure, rng, folder)
        found.update(["trials", *([outcome] if outcome else [])])
        if outcome:
            print(f"{kind} {number} ({writer.name}): {outcome}", file=sys.stderr, flush=True)
    return found


def main() -> None:
    """All kinds, and a table of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200, help="of each kind")
    parser.add_argument("--kinds", nargs="*", default=["kill -9", "full disk", *SINGLE])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e9, help="of each kind, at most")
    parser.add_argument("--csv", type=Path)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    loaded()
    with tempfile.TemporaryDirectory() as name:
        shop, rows = Shop.made(Path(name)), []
        for kind in given.kinds:
            found = trials(shop, kind, given.trials, random.Random(f"{given.seed} {kind}"), seconds=given.seconds)
            row = {"kind": kind, "trials": found["trials"], **{name: found[name] for name in OUTCOMES}}
            rows.append(row | {"machine": f"{os.cpu_count()} × {platform.machine()}", "seed": given.seed})
            rows[-1]["commit"] = machine.commit()
            print(rows[-1], flush=True)
            if given.csv:
                with given.csv.open("w", newline="") as file:
                    writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
                    writer.writeheader()
                    writer.writerows(rows)


if __name__ == "__main__":
    main()
