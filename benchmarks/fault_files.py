"""Files that are damaged, altered or hostile, values that no experiment has, and two writers of one folder."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import time
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from fault_kills import sentence
from fault_shop import BEAM, WRITERS, Shop, copied_run, is_whole
from forked import run

from holosplat.checks import InputError
from holosplat.io import read_scan
from holosplat.io.objects import read_object
from holosplat.workflows.evaluate import render
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder, check


def flipped(shop: Shop, rng: random.Random, folder: Path) -> str:
    """A bit flips in a file of a run, or in a scan: `check` says so, or nothing that is read has changed."""
    run_folder = copied_run(shop, folder)
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
    if sentence(ended) or ended.code != 0:
        return sentence(ended)
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
    """An entry of config.json or summary.json is another one, or gone, or values of object.h5 are: `check` says so, and
    what reads the run refuses it, or predicts the frames that it predicted before."""
    found = RunFolder(copied_run(shop, folder))
    before = _predicted(shop, found)
    path = rng.choice([found.config, found.summary, found.object])
    content = path.read_bytes()
    if path == found.object:
        with h5py.File(path, "r+") as file:
            _garble(file, rng)
    else:
        _alter(path, rng)
    try:
        if path.read_bytes() != content and not check(found.path)[1]:
            return "silent"
        after = _predicted(shop, found)
    except InputError as error:
        return "" if str(error) else "traceback"
    except Exception:
        return "traceback"
    return "" if np.array_equal(before, after) else "silent"


def _predicted(shop: Shop, found: RunFolder) -> np.ndarray:
    """The frames that a run predicts."""
    return render(load_reconstruction(found), read_scan(shop.scan).exposures)


def _alter(path: Path, rng: random.Random) -> None:
    """Put a value that nothing has in the place of one of a JSON file, or take it away."""
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
        copied = copied_run(shop, folder)
        shutil.copy(path, copied / "object.h5")
        command = ["export", copied, "--volume", folder / "out.h5"]
    return sentence(run(command))


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
    "simulate": "energy-kev distance pixel-size psf-sigma-px views frames pulses photons-per-pixel seed misalign-shift "
    "density",
    "reconstruct": "seed bin axis-column delta-beta density distance uncertain-shift",
    "grow": "cells flow snapshots interval viscosity diameter frequency",
    "record": "flats darks photons-per-pixel seed gain bits",
}
VALUES = ("nan", "inf", "-inf", "-1", "1e30", "-1e30", str(2**70), str(10**9), str(10**12), "", "x", "1e-300", "\udc80")

MEANT = {(flag, value) for flag in ("seed", "photons-per-pixel") for value in (str(10**9), str(10**12))}
MEANT |= {(flag, "1e-300") for flag in ("psf-sigma-px", "misalign-shift", "uncertain-shift", "axis-column")}
"""What is no odd value: seeds are as large as they like, so many photons give no noise, so small a length is none, and
--axis-column may say that the axis is anywhere."""


def odd(shop: Shop, rng: random.Random, folder: Path) -> str:
    """A value that no experiment has: one sentence. By turns of an option in `FLAGS`, or of any number that any command
    takes; of these, no value is tried that a longer job may have."""
    if rng.random() < 0.5:
        name = rng.choice(list(FLAGS))
        flag, value = f"--{rng.choice(FLAGS[name].split())}", rng.choice(VALUES)
        command = {"grow": ["grow", "--out", folder / "out"], "simulate": shop.simulate(folder / "out.nxs")}
        command |= {"record": shop.record(folder / "out.nxs"), "reconstruct": shop.reconstruct(folder / "out")}
        said = command[name]
    else:
        said = rng.choice([one for one in WRITERS if one.name not in SEVERAL]).command(shop, folder)
        flag, value = rng.choice(_numbers(str(said[0]))), rng.choice(ABSURD)
    ended = run([*said, flag, value])
    silent = ended.code == 0 and (flag.removeprefix("--"), value) not in MEANT
    if sentence(ended) or silent:
        print(*said, flag, repr(value), flush=True)
    return sentence(ended) or ("silent" if silent else "")


SEVERAL = ("run", "bench", "series")
"""Commands that have acts, or take no numbers."""
ABSURD = ("nan", "inf", "-inf", "1e30", "-1e30", str(2**70), "9" * 400, "", "x", "\udc80")


@cache
def _numbers(name: str) -> list[str]:
    """The options of a command that take one number, by its help."""
    return sorted(set(re.findall(r"(--[a-z-]+) (?:FLOAT|INT)\s", run([name, "--help-all"]).said))) or ["--none"]


def two(shop: Shop, rng: random.Random, folder: Path) -> str:
    """A second run into the folder of one that goes on is refused, and the first is as without it."""
    child = os.fork()
    if child == 0:
        first = run(shop.reconstruct(folder / "out"), limit=LONG)
        os._exit(ENDS.index(first.verdict or ("" if first.code == 0 else "lost")))
    while not (folder / "out" / ".lock").exists():
        if os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            break
        time.sleep(0.01)
    second = run(shop.reconstruct(folder / "out"), limit=LONG)
    first = ENDS[os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])]
    if first or sentence(second) or second.code == 0:
        return first or sentence(second) or "silent"
    same = read_object(folder / "out/object.h5").state(), read_object(shop.run / "object.h5").state()
    return "" if is_whole(folder / "out") and all(map(_alike, same[0].values(), same[1].values())) else "lost"


LONG = 600.0
"""Seconds from which on a run hangs beside another one, under any load."""
ENDS = ("", "lost", "traceback", "hang", "crash")
"""How the first one ends."""


def _alike(one: Any, other: Any) -> bool:
    return bool(np.array_equal(one, other)) if hasattr(one, "numpy") else one == other
