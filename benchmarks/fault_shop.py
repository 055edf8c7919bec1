"""What commands read in `faults.py`, and the commands that write: small enough that each takes a second or a few."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from forked import run
from own_case import two_cells

from holosplat.checks import InputError
from holosplat.io.formats import read, read_volume_file
from holosplat.io.paraview import read_pvd
from holosplat.io.vtk import read_meshes, write_mesh
from holosplat.learning.start import read_weights
from holosplat.mesh import TriangleMesh
from holosplat.specimens.red_cells import random_cells
from holosplat.workflows.run_folder import check
from holosplat_bench.training.folder import Dataset

PIXEL, ROWS, COLUMNS = 3.2e-6, 18, 20
MATERIAL = ["--material", "haemoglobin"]
BEAM = ["--length-unit", "um", *MATERIAL, "--pixel-size", PIXEL, "--detector", ROWS, COLUMNS]
QUICK = {
    "kind": "gaussians",
    "approximate_steps": 2,
    "spacing_px": 2.0,
    "volume": {"retrieval": 8, "iterations": 10, "corrections": 1, "inner": 4, "refine": 1},
    "fit": {"objective": {"tv_volume": 0.05}, "schedule": {"steps": 12}},
}
METHODS = ("paganin-sirt", "paganin-tv")
XDMF = re.compile(r">([^<>]*):/")
"""Files that an XDMF file names."""
TIMES, STEP = 3, 1e-4
"""Moments of the scan in which the cells move, and seconds between two."""


@dataclass(frozen=True)
class Shop:
    """A folder with what commands read: two cells, their scan, its raw counts, a run, and a scan of them in motion."""

    path: Path
    cells: tuple[Path, ...]

    @property
    def scan(self) -> Path:
        """Six frames of the cells at rest."""
        return self.path / "scan.nxs"

    @property
    def raw(self) -> Path:
        """The same as raw counts."""
        return self.path / "raw.nxs"

    @property
    def moving(self) -> Path:
        """Frames of the cells in motion."""
        return self.path / "moving.nxs"

    @property
    def run(self) -> Path:
        """A run on the scan."""
        return self.path / "run"

    @property
    def track(self) -> Path:
        """A run of `track` on that."""
        return self.path / "track"

    @property
    def quick(self) -> Path:
        """Options of that."""
        return self.path / "quick.json"

    @property
    def scenes(self) -> Path:
        """Scenes of `dataset`."""
        return self.path / "scenes"

    @property
    def case(self) -> Path:
        """A case of the benchmark."""
        return self.path / "own.toml"

    @classmethod
    def made(cls, path: Path) -> Shop:
        """All of it, made in an empty folder."""
        cells = random_cells(2, (COLUMNS * PIXEL, ROWS * PIXEL, COLUMNS * PIXEL), 1, 10 * PIXEL)
        files = tuple(path / f"{cell.name}.vtk" for cell in cells)
        for cell, file in zip(cells, files):
            write_mesh(file, cell, "um")
        shop = cls(path, files)
        shop.quick.write_text(json.dumps(QUICK))
        shop.case.write_text(two_cells(ROWS, COLUMNS, PIXEL, 24e-6, 5))
        for command in (
            shop.simulate(shop.scan),
            shop.record(shop.raw),
            shop.reconstruct(shop.run),
            shop.in_motion(cells),
            ["track", shop.moving, "--out", shop.track, *TRACK],
            ["dataset", "--out", shop.scenes, *SCENES],
        ):
            ended = run(command, limit=600)
            if ended.code != 0:
                raise SystemExit(f"{command[0]} must work before it is disturbed, but: {ended.said}")
        return shop

    def simulate(self, out: Path) -> list[object]:
        """Six frames."""
        return ["simulate", *self.cells, *BEAM, "--views", 6, "--out", out]

    def short(self, *command: object) -> list[object]:
        """A command that reconstructs, with the options of a short run."""
        return [*command, *MATERIAL, "--matter", "levels", "--config", self.quick]

    def in_motion(self, cells: list[TriangleMesh]) -> list[object]:
        """Four frames at each of three times; the cells go half a pixel from one to the next."""
        files = list[Path]()
        for time in range(TIMES):
            for cell in cells:
                moved = TriangleMesh(cell.vertices + [0.0, 0.5 * time * PIXEL, 0.0], cell.faces)
                files.append(self.path / f"moving_{cell.name}_{time:03d}.vtk")
                write_mesh(files[-1], moved, "um")
        when = ["--snapshot-interval", STEP, "--frame-rate", 1 / STEP]
        return ["simulate", *files, *BEAM, "--views", 4, *when, "--test-every", 0, "--out", self.moving]

    def record(self, out: Path) -> list[object]:
        """Their raw counts."""
        return ["record", self.scan, "--out", out, "--flats", 4, "--darks", 2]

    def reconstruct(self, out: Path) -> list[object]:
        """A short run."""
        return self.short("reconstruct", self.scan, "--out", out)


@dataclass(frozen=True)
class Writer:
    """A command that writes `out` in a folder. again: what the command needs where `out` is begun, that is, has one of
    the files `begun`, or in any case where there are none; goes_on: whether the command goes on with what is there as
    it is; alone: the command that goes on with `out`, where it is another one."""

    name: str
    command: Callable[[Shop, Path], list[object]]
    out: str
    again: tuple[object, ...] = ()
    begun: tuple[str, ...] = ("config.json", "grow.json")
    goes_on: bool = False
    alone: Callable[[Path], list[object]] | None = None


def pipeline(shop: Shop, out: Path) -> str:
    """A pipeline file: counts are corrected, a scan is reconstructed and exported, to paths that begin with `out`."""
    stages = {
        "correct": {"raw": shop.raw, "out": f"{out}.nxs"},
        "reconstruct": {
            "scan": shop.scan,
            "out": f"{out}_run",
            "material": "haemoglobin",
            "matter": "levels",
            "config": shop.quick,
        },
        "export": {"volume": f"{out}.vti"},
    }
    tables = ([f"[{name}]", *(f'{key} = "{value}"' for key, value in keys.items())] for name, keys in stages.items())
    return "\n".join(line for table in tables for line in table) + "\n"


def hidden_in(folder: Path) -> list[Path]:
    """Hidden files in a folder: what a command had not finished, or a lock."""
    return [path for path in folder.rglob(".*") if path.is_file()]


def copied_run(shop: Shop, folder: Path) -> Path:
    """A copy of the run in `folder`."""
    if not (folder / "run").exists():
        shutil.copytree(shop.run, folder / "run")
    return folder / "run"


GROWTH = ["--cells", 1, "--box", "30e-6", "20e-6", "20e-6", "--snapshots", 4, "--frequency", 3, "--interval", "1e-6"]
TRACK = [*MATERIAL, "--effort", 0.05, "--pieces", 1, "--rounds", 0, "--no-intervals"]
SURFACE = ["--steps", 8]
SCENES = ["--count", 3, "--rows", 64, "--columns", 64, "--views", 3, "--held-out", 1]
NETWORK = ["--steps", 4, "--volume", 4, 8, 8, "--keep-every", 2, "--validation", 1]


def _piped(shop: Shop, folder: Path) -> list[object]:
    (folder / "pipeline.toml").write_text(pipeline(shop, folder / "out"))
    return ["run", folder / "pipeline.toml"]


def _planned(shop: Shop, folder: Path) -> list[object]:
    ended = run(shop.short("series", "plan", shop.moving, "--window", 2, "--out", folder / "out"))
    if ended.code != 0:
        raise SystemExit(f"series plan must work before series run is disturbed, but: {ended.said}")
    return ["series", "run", folder / "out"]


def _watched(shop: Shop, folder: Path) -> list[object]:
    (folder / "come").mkdir(exist_ok=True)
    shutil.copy(shop.scan, folder / "come")
    times = ["--poll", 0.1, "--settle", 0.1, "--idle", 1]
    return shop.short("watch", folder / "come", "--out", folder / "out", *times)


def _exported(name: str, *options: object, moving: bool = False) -> Writer:
    """Files of several times, or two files, are begun anew by --force."""
    suffix = {".pvd": ".vtu", ".xdmf": ".h5"}.get(Path(name).suffix, Path(name).suffix)

    def command(shop: Shop, folder: Path) -> list[object]:
        file = (folder / name).with_suffix(suffix)
        return ["export", shop.track if moving else shop.run, *options[:1], file, *options[1:]]

    return Writer(f"export {Path(name).suffix}", command, name, ("--force",), ())


EVERY = ("--time-frame", "all")
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
    *(_exported(f"out{suffix}", "--volume") for suffix in (".vti", ".nrrd", ".mrc", ".tif")),
    _exported("out.vtu", "--bodies", moving=True),
    _exported("out.pvd", "--bodies", *EVERY, moving=True),
    _exported("out.xdmf", "--volume", *EVERY, moving=True),
    Writer("compare", lambda shop, folder: ["compare", shop.run, shop.run, "--out", folder / "out.html"], "out.html"),
    Writer("info", lambda shop, folder: ["info", shop.scan, "--picture", folder / "out.png"], "out.png"),
    Writer("run", _piped, "out_run", goes_on=True),
    Writer(
        "reconstruct",
        lambda shop, folder: [*shop.reconstruct(folder / "out"), "--log", folder / "log.txt"],
        "out",
        ("--resume",),
    ),
    Writer(
        "resume RUN",
        lambda shop, folder: shop.reconstruct(folder / "out"),
        "out",
        ("--resume",),
        ("provenance.json",),
        alone=lambda out: ["reconstruct", "--resume", out],
    ),
    Writer("evaluate", lambda shop, folder: ["evaluate", copied_run(shop, folder)], "run"),
    Writer("grow", lambda shop, folder: ["grow", "--out", folder / "out", *GROWTH], "out", ("--resume",)),
    Writer("track", lambda shop, folder: ["track", shop.moving, "--out", folder / "out", *TRACK], "out", ("--resume",)),
    Writer("align", lambda shop, folder: ["align", shop.scan, "--out", folder / "out.nxs", *MATERIAL], "out.nxs"),
    Writer(
        "surface",
        lambda shop, folder: ["surface", shop.run, "--scan", shop.scan, "--out", folder / "out", *SURFACE],
        "out",
    ),
    Writer("retrieve", lambda shop, folder: ["retrieve", shop.scan, *MATERIAL, "--out", folder / "out"], "out"),
    Writer(
        "calibrate",
        lambda shop, folder: [
            *("calibrate", shop.scan, "--phantom", shop.cells[0], *MATERIAL, "--out", folder / "out.toml")
        ],
        "out.toml",
    ),
    Writer(
        "plan",
        lambda shop, folder: [
            *("plan", "--mesh", shop.cells[0], "--energy-range", 10, 20, *MATERIAL, "--out", folder / "out.png")
        ],
        "out.png",
        ("--force",),
        (),
    ),
    Writer(
        "forecast",
        lambda shop, folder: ["forecast", shop.track, "--out", folder / "out", "--times", 1, "--no-half-sets"],
        "out",
        ("--force",),
    ),
    Writer("dataset", lambda shop, folder: ["dataset", "--out", folder / "out", *SCENES], "out", goes_on=True),
    Writer(
        "train",
        lambda shop, folder: ["train", shop.scenes, "--out", folder / "out", *NETWORK],
        "out",
        ("--resume",),
        ("train.json", "checkpoint.pt"),
    ),
    Writer("series", _planned, "out", goes_on=True),
    Writer("watch", _watched, "out", goes_on=True),
    Writer(
        "bench",
        lambda shop, folder: (["bench", "run", "--cases", shop.case, "--methods", *METHODS, "--out", folder / "out"]),
        "out",
        begun=("bench.json",),
        goes_on=True,
    ),
)


LOOKERS = tuple(
    Writer(" ".join(map(str, words)), lambda shop, folder, words=words: list(words), "none")
    for words in (("doctor",), ("backends",), ("init",), ("materials",), ("data", "list"))
) + (
    Writer("check", lambda shop, folder: ["check", shop.run], "none"),
    Writer("info RUN", lambda shop, folder: ["info", shop.run], "none"),
)
"""Commands that write nothing."""


def is_whole(out: Path) -> bool:
    """Whether a file, a run folder, or another folder that a command makes, is what it is when it is done."""
    if out.is_dir() and not (out / "config.json").is_file():
        return reads(out)
    try:
        return _is_sound(out) if out.suffix in SOUND else not check(out)[1]
    except InputError:
        return False


SOUND = (".toml", ".vti", ".nrrd", ".mrc", ".tif", ".vtu", ".pvd", ".xdmf", ".html", ".png")
"""Suffixes of files of other programs, which `check` does not know."""


def _is_sound(out: Path) -> bool:
    """Whether a file of another program is complete, and so are those that it names."""
    if out.suffix in (".html", ".png"):
        return out.suffix == ".png" or out.read_bytes().rstrip().endswith(b"</html>")  # pictures stay blank
    if out.suffix == ".toml":
        return "view" in tomllib.loads(out.read_text(encoding="utf-8"))
    if out.suffix == ".xdmf":
        return all(not check(out.parent / name)[1] for name in XDMF.findall(out.read_text(encoding="utf-8")))
    if out.suffix in (".vtu", ".pvd"):
        files = [file for step in read_pvd(out) for file in step.files] if out.suffix == ".pvd" else [out]
        return len(read_meshes(files, "um")) > 0
    return read_volume_file(out).delta.size > 0


def reads(out: Path) -> bool:
    """Whether a folder of images, of meshes, of scenes, of weights, or of several runs, is whole."""
    if (out / "bench.json").is_file():
        return run(["bench", "report", out]).code == 0 and len(list((out / "rows").glob("*.json"))) >= len(METHODS)
    if (out / "series.json").is_file():
        return run(["series", "collect", out]).code == 0
    try:
        if (out / "maps.json").is_file():
            return all(len(tifffile.imread(out / f"{name}.tif")) == 6 for name in ("phase", "thickness"))
        if (out / "dataset.json").is_file():
            return not Dataset.read(out).missing()
        if (out / "train.json").is_file():
            return bool(read_weights(out / "weights.safetensors"))
        if (out / "watch.json").is_file():
            return all(not check(file.parent)[1] for file in (out / "scans").rglob("config.json"))
        if list(out.glob("*.vt[kp]")):
            read_meshes([out], "um")
        else:
            read_scan_of(out)
    except InputError:
        return False
    return True


def read_scan_of(path: Path) -> np.ndarray:
    """The frames of a scan of any format."""
    return np.asarray(read(path).in_memory().frames)


def snapshots(out: Path) -> int:
    """Snapshots of a folder of `grow` whose state is there."""
    return len(list(out.glob("rbc00_*.vtp"))) if (out / "state.npz").is_file() else 0
