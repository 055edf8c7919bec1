"""Outputs that would replace what is there, and HDF5 files that bring values of other files."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from fault_kills import sentence
from fault_shop import BEAM, MATERIAL, PIXEL, Shop, copied_run, pipeline
from forked import run

PRECIOUS = b"what somebody else keeps here"
VOXELS = ["--pixel-size", PIXEL, "--detector", 18, 20, "--views", 2]


def _asked(shop: Shop) -> list[tuple[list[object], dict[str, str]]]:
    """Commands on the files of `_laid_out`, and the suffixes of what each of their options writes."""
    return [
        (["simulate", "cell.vtk", *BEAM, "--views", 2], {"--out": ".nxs", "--truth": ".mrc", "--true-exposures": ""}),
        (["simulate", "volume.mrc", *VOXELS], {"--out": ".nxs", "--truth": ".mrc"}),
        (["record", "scan.nxs", "--flats", 2, "--darks", 1], {"--out": ".nxs", "--truth": ".h5"}),
        (["correct", "raw.nxs"], {"--out": ".nxs"}),
        (["join", "scan.nxs", "other.nxs"], {"--out": ".nxs"}),
        (["align", "scan.nxs", *MATERIAL], {"--out": ".nxs", "--table": "", "--geometry-out": ".toml"}),
        (["render", "run", "--views", 2], {"--out": ".nxs"}),
        (["export", "run"], {"--volume": ".mrc", "--compact": ".h5", "--splats": ".ply"}),
        (["export", "run"], {"--volume": ".vti"}),
        (["info", "scan.nxs"], {"--picture": ".png"}),
        (["info", "run"], {"--log": ""}),
        (["compare", "run", "run"], {"--out": ""}),
        (["convert", "scan.nxs", "--to", "tiff"], {"": ""}),
        (["plan", "--mesh", "cell.vtk", "--energy-range", 10, 20, *MATERIAL], {"--out": ""}),
        (["run", "pipeline.toml"], {"--log": ""}),
    ]


def _laid_out(shop: Shop, folder: Path) -> list[str]:
    """Copies of what commands read, with links to them, a pipeline and files of somebody else; their names."""
    copied_run(shop, folder)
    for file, name in (
        *((shop.scan, "scan.nxs"), (shop.scan, "other.nxs"), (shop.raw, "raw.nxs"), (shop.cells[0], "cell.vtk")),
        *((shop.run / "config.json", "volume.vti.provenance.json"), (shop.quick, "notes.mrc.provenance.json")),
    ):
        if file.is_file():
            shutil.copy(file, folder / name)
    source = json.loads((folder / "run/source.json").read_text())
    (folder / "run/source.json").write_text(json.dumps(source | {"scan": str(folder / "scan.nxs")}))
    run(["export", folder / "run", "--volume", folder / "volume.mrc"])
    (folder / "link.nxs").symlink_to("scan.nxs")
    (folder / "pipeline.toml").write_text(pipeline(shop, folder / "pipe").replace(str(shop.raw), "raw.nxs"))
    (folder / "notes.txt").write_bytes(PRECIOUS)
    (folder / "theirs").mkdir()
    (folder / "theirs/letter.txt").write_bytes(PRECIOUS)
    return [str(path.relative_to(folder)) for path in sorted(folder.rglob("*"))]


def outputs(shop: Shop, rng: random.Random, folder: Path) -> str:
    """Outputs are named as what is there, or in it: what the command reads is as it was, and so is all else but what
    --force replaces."""
    names = _laid_out(shop, folder)
    command, options = rng.choice(_asked(shop))
    said, targets = list(command), list[str]()
    for option, suffix in options.items():
        if targets and rng.random() < 0.5:
            continue
        like = [name for name in names if name.endswith(suffix)] or names
        target = rng.choice([rng.choice(like), rng.choice(names), f"new{suffix}", "volume.vti", "notes.mrc"])
        said += [option, target] if option else [target]
        targets.append(target)
    forced = rng.random() < 0.6 and "--log" not in options
    said += ["--force"] * forced
    before = _sums(folder)
    ended = run(said, first=lambda: os.chdir(folder), limit=120)
    after = _sums(folder)
    changed = [name for name, value in before.items() if after.get(name) != value]
    reads = {str(word) for word in command} | {name for name in names if name.startswith("run/")}
    if "volume.mrc" in reads:
        reads.add("volume.beta.mrc")
    if "run" in reads:
        reads.add("scan.nxs")
    allowed = {each for target in targets if forced for each in _of(target, folder)} - reads
    real = {name: os.path.relpath((folder / name).resolve(), folder.resolve()) for name in changed}
    lost = [name for name in changed if not any(f"{real[name]}/".startswith(f"{one}/") for one in allowed)]
    if lost:
        print(" ".join(map(str, said)), "changed", lost, flush=True)
    return "lost" if lost else sentence(ended)


def _of(target: str, folder: Path) -> set[str]:
    """The names that an output may have: its own, what a link leads to, β, and the sidecar that is ours."""
    place = (folder / target).resolve()
    real = str(place.relative_to(folder.resolve())) if folder.resolve() in place.parents else target
    pair = f"{real.removesuffix('.mrc')}.beta.mrc"
    ours = ("volume.mrc", "volume.beta.mrc")
    return {target, real, pair, *(f"{name}.provenance.json" for name in (real, pair) if name in ours)}


def _sums(folder: Path) -> dict[str, str]:
    """SHA-256 of all files but locks, by their names."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def foreign(shop: Shop, rng: random.Random, folder: Path) -> str:
    """Values of a scan, a volume or a run are those of another file of this machine, whatever the folder of a run says
    of it: nothing reads them without --allow-external."""
    secret = np.random.default_rng(rng.randrange(1 << 30)).uniform(0.9, 1.1, 1 << 14).astype("<f4")
    (folder / "secret").write_bytes(secret.tobytes())
    with h5py.File(folder / "other.h5", "w") as file:
        file["values"] = secret
    copied, out = copied_run(shop, folder), folder / "out"
    kind = rng.choice(["scan", "raw", "volume", "object", "run", "resumed"])
    target = {"raw": folder / "raw.nxs", "object": copied / "object.h5", "volume": folder / "v.h5"}.get(
        kind, folder / "scan.nxs"
    )
    if kind == "volume":
        run(["export", copied, "--volume", target])
    elif kind != "object":
        shutil.copy(shop.raw if kind == "raw" and shop.raw.is_file() else shop.scan, target)
    _foreign(target, folder, rng)
    commands: dict[str, list[list[object]]] = {
        "scan": [["convert", target, out, "--to", "tiff"], ["info", target], shop.reconstruct(out)[:1] + [target]],
        "raw": [["convert", target, out, "--to", "tiff"], ["correct", target, "--out", out]],
        "volume": [["simulate", target, *VOXELS, "--out", out], ["evaluate", copied, "--truth", target]],
        "object": [["export", copied, "--compact", folder / "c.h5"], ["compare", copied, copied, "--out", out]],
        "run": [["evaluate", copied], ["convert", copied, out, "--to", "tiff"], ["compare", copied, copied]],
        "resumed": [["reconstruct", "--resume", copied]],
    }
    if kind == "run":
        _say_so(copied / "source.json", lambda said: said | {"scan": str(target), "reading": {"allow_external": True}})
    if kind == "resumed":
        command = f"holosplat reconstruct {target} --allow-external --out run {' '.join(MATERIAL)}"
        _say_so(copied / "provenance.json", lambda said: {"records": [said["records"][0] | {"command": command}]})
    if kind == "scan":
        commands["scan"][2] += ["--out", out, *MATERIAL]
    command = rng.choice(commands[kind])
    ended = run(command, first=lambda: os.chdir(folder))
    taken = ended.code == 0 and "problem  " not in ended.said
    if taken:
        print(" ".join(map(str, command)), flush=True)
    return sentence(ended) or ("let in" if taken else "")


def _say_so(path: Path, change: Callable[[dict], dict]) -> None:
    said = change(json.loads(path.read_text()))
    for record in said.get("records", []):
        record["inputs"] = []
    path.write_text(json.dumps(said))


def _foreign(path: Path, folder: Path, rng: random.Random) -> None:
    """Put values of another file in the place of one array of `path`, the largest one or any."""
    with h5py.File(path, "r+") as file:
        found = list[h5py.Dataset]()
        file.visititems(lambda name, item: found.append(item) if isinstance(item, h5py.Dataset) else None)
        arrays = sorted((one for one in found if one.size and one.dtype.kind in "fiu"), key=lambda one: one.size)
        item = arrays[-1] if rng.random() < 0.7 else rng.choice(arrays)
        name, shape, attributes = item.name, item.shape, dict(item.attrs)
        del file[name]
        way = rng.choice(["external", "virtual", "link"])
        if way == "external":
            file.create_dataset(name, shape, "<f4", external=[(str(folder / "secret"), 0, h5py.h5f.UNLIMITED)])
        elif way == "virtual":
            layout = h5py.VirtualLayout(shape, "<f4")
            with h5py.File(folder / "other.h5", "r+") as other:
                other["same"] = np.resize(other["values"], shape)
                layout[...] = h5py.VirtualSource(other["same"])
            file.create_virtual_dataset(name, layout)
        else:
            file[name] = h5py.ExternalLink(str(folder / "other.h5"), "/values")
        if way != "link":
            file[name].attrs.update(attributes)
