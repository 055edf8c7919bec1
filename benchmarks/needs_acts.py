"""What commands beside `reconstruct` and `simulate` are said to take beside what they take: the estimates of
`holosplat.planning.acts` against the peak memory of each command in a process of its own.

python benchmarks/needs_acts.py --csv docs/data/needs_acts.csv [--acts track align]

Steps are few, for arrays are as large in the first as in the last. Wanted: within a factor of 1.3.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
from collections.abc import Callable
from pathlib import Path

import machine
import numpy as np
from forked import run as run_here
from needs import START, peak
from own_case import two_cells
from rows import read, write

from holosplat.align import PoseOptions
from holosplat.beamline.simulate import Simulation
from holosplat.geometry import Views
from holosplat.io.vtk import write_mesh
from holosplat.mesh import TriangleMesh
from holosplat.methods import METHODS, Gaussians, SurfaceOptions
from holosplat.motion.fit import MotionFit
from holosplat.motion.flow_reconstruction import FlowOptions
from holosplat.motion.track_linking import TrackOptions
from holosplat.planning import acts
from holosplat.planning.needs import Needs, of_fit, of_reconstruction
from holosplat.planning.needs import Sizes as NeedsSizes
from holosplat.scan import Exposures
from holosplat.specimens.membrane.rest import nodes_of
from holosplat.specimens.red_cells import random_cells
from holosplat_bench.cli.learn import _needs
from holosplat_bench.suite.case import planned_frames
from holosplat_bench.suite.methods import METHODS as BENCH_METHODS
from holosplat_bench.suite.methods import of_methods
from holosplat_bench.training.options import Ranges, TrainOptions
from holosplat_bench.training.train import trainer_of

PIXEL, STEP = 3.2e-6, 1e-4
"""Of frames [m], and between two times [s]."""
KNOWN = ["--material", "haemoglobin"]
FEW = [part for change in START for part in ("--set", change)]
ONE_STEP = ["--set", "approximate_steps=2", "--set", "fit.schedule.steps=6"]
COMPARED = ("paganin-tv", "holographic-tv")
SCENES = 3
SHORT_TRACK = ["--effort", 0.05, "--pieces", 1, "--rounds", 0]
Sizes = dict[str, int]


def prepare(command: list[object]) -> None:
    """Run what a measured command needs."""
    ended = run_here(command, limit=3600)
    if ended.code != 0:
        raise SystemExit(ended.said)


def scan(folder: Path, sizes: Sizes) -> Path:
    """Frames of four cells, which move half a pixel from one time to the next, and what else `sizes` says."""
    rows, columns, times = sizes["rows"], sizes["columns"], sizes.get("times", 1)
    extents = (columns * PIXEL, rows * PIXEL, columns * PIXEL)
    files = []
    for cell in random_cells(4, extents, 1, min(rows, columns) * PIXEL / 3.2):
        for time in range(times):
            place = cell.vertices + [0.0, 0.5 * (time - times / 2) * PIXEL, 0.0]
            files.append(folder / f"{cell.name}_{time:03d}.vtk")
            write_mesh(files[-1], TriangleMesh(place, cell.faces), "um")
    beam = ["--detector", rows, columns, "--pixel-size", PIXEL, "--views", sizes["views"], "--test-every", 0]
    when = ["--snapshot-interval", STEP, "--frame-rate", 1 / STEP] if times > 1 else []
    out = folder / "scan.nxs"
    prepare(["simulate", *files, "--length-unit", "um", *KNOWN, *beam, *when, "--out", out])
    return out


def run(folder: Path, sizes: Sizes) -> tuple[Path, Path]:
    """A run of Gaussians, and its scan."""
    seen, out = scan(folder, sizes), folder / "run"
    few = [*FEW, *ONE_STEP]
    prepare(["reconstruct", seen, "--out", out, *KNOWN, "--matter", "levels", "--method", "gaussians", *few])
    return out, seen


def tracked(folder: Path, sizes: Sizes) -> Path:
    """A run of track."""
    out = folder / "run"
    prepare(["track", scan(folder, sizes), "--out", out, *KNOWN, *SHORT_TRACK, "--no-intervals"])
    return out


def track(folder: Path, sizes: Sizes) -> list[object]:
    """Bodies through times."""
    return ["track", scan(folder, sizes), "--out", folder / "out", *KNOWN, *SHORT_TRACK]


def forecast(folder: Path, sizes: Sizes) -> list[object]:
    """The same at later times."""
    return ["forecast", tracked(folder, sizes), "--out", folder / "out", "--times", 3, "--effort", 0.05]


def align(folder: Path, sizes: Sizes) -> list[object]:
    """Poses of beams."""
    return ["align", scan(folder, sizes), "--out", folder / "out.nxs", *KNOWN]


def moving(folder: Path, sizes: Sizes) -> list[object]:
    """Matter in motion."""
    seen = scan(folder, sizes)
    return ["reconstruct", seen, "--out", folder / "out", *KNOWN, "--matter", "continuous", "--time-frame", "all"]


def pinn(folder: Path, sizes: Sizes) -> list[object]:
    """A field of space and time."""
    few = ["--set", "fit.schedule.steps=3", "--set", "fit.flow_steps=2", *FEW]
    seen = scan(folder, sizes)
    return ["reconstruct", seen, "--out", folder / "out", *KNOWN, "--method", "pinn", "--time-frame", "all", *few]


def each(folder: Path, sizes: Sizes) -> list[object]:
    """Each time by itself."""
    how = ["--matter", "levels", "--method", "gaussians", *FEW, *ONE_STEP]
    return ["reconstruct", scan(folder, sizes), "--out", folder / "out", *KNOWN, "--time-frame", "each", *how]


def surface(folder: Path, sizes: Sizes) -> list[object]:
    """Surfaces cut out of voxels."""
    made, seen = run(folder, sizes)
    return ["surface", made, "--scan", seen, "--out", folder / "out", "--steps", 3]


def export(ending: str) -> Callable[[Path, Sizes], list[object]]:
    """A volume of so many voxels along each edge."""

    def command(folder: Path, sizes: Sizes) -> list[object]:
        made, _ = run(folder, {"rows": 40, "columns": 48, "views": 4})
        edge = sizes["edge"]
        shape = ["--shape", edge, edge, edge, "--voxel-size", 48 * PIXEL / edge]
        return ["export", made, "--volume", folder / f"out{ending}", *shape]

    return command


def grow(folder: Path, sizes: Sizes) -> list[object]:
    """Cells in a channel."""
    channel = ["--box", 20e-6 + 2.5e-6 * sizes["cells"], 30e-6, 30e-6, "--interval", 1e-7]
    made = ["--cells", sizes["cells"], "--frequency", sizes["frequency"], "--snapshots", sizes["snapshots"]]
    return ["grow", "--out", folder / "out", *made, *channel]


def dataset(folder: Path, sizes: Sizes) -> list[object]:
    """Scenes for learning."""
    frames = ["--rows", sizes["rows"], "--columns", sizes["columns"], "--views", sizes["views"]]
    return ["dataset", "--out", folder / "out", "--count", SCENES, *frames]


def train(network: str) -> Callable[[Path, Sizes], list[object]]:
    """A network."""

    def command(folder: Path, sizes: Sizes) -> list[object]:
        scenes = ["--rows", sizes["rows"], "--columns", sizes["columns"], "--views", sizes["views"]]
        prepare(["dataset", "--out", folder / "scenes", "--count", SCENES, *scenes])
        few = ["--steps", 6, "--validation", 1, "--views", sizes["views"], "--rows", sizes["rows"]]
        return ["train", folder / "scenes", "--out", folder / "out", "--network", network, *few]

    return command


def case(folder: Path, sizes: Sizes) -> Path:
    """A case of the benchmark."""
    rows, columns = sizes["rows"], sizes["columns"]
    path = folder / "own.toml"
    path.write_text(two_cells(rows, columns, PIXEL, min(rows, columns) * PIXEL / 3, sizes["views"]))
    return path


def bench(folder: Path, sizes: Sizes) -> list[object]:
    """Two methods on a case."""
    how = ["--methods", *COMPARED]
    return ["bench", "run", "--cases", case(folder, sizes), *how, "--out", folder / "out"]


def learned(folder: Path, sizes: Sizes) -> list[object]:
    """Gaussians that begin with a network's guess."""
    return _reconstructed(folder, sizes, "gaussians", [*FEW, *ONE_STEP], ["--start", "learned"])


def onix(folder: Path, sizes: Sizes) -> list[object]:
    """A pixel-aligned network."""
    return _reconstructed(folder, sizes, "onix", ["--set", "fit.schedule.steps=2"], [])


def _reconstructed(folder: Path, sizes: Sizes, method: str, few: list[object], more: list[object]) -> list[object]:
    how = ["--out", folder / "out", *KNOWN, "--matter", "levels", "--method", method]
    return ["reconstruct", scan(folder, sizes), *how, *few, *more]


# --- what they are said to take -----------------------------------------------------------------------------


def frames(sizes: Sizes) -> Exposures:
    """The exposures of a scan of such sizes."""
    views = Views.evenly_spaced(sizes["views"], (sizes["rows"], sizes["columns"]), PIXEL)
    return Exposures.of(views, 20.0, 0.1).repeated(STEP * np.arange(sizes.get("times", 1)))


def said_of_bench(sizes: Sizes) -> Needs:
    """Of the two methods on a case."""
    with tempfile.TemporaryDirectory() as name:
        planned = planned_frames(case(Path(name), sizes))
    samples = Simulation().samples(planned[0])
    return of_methods(*planned, samples, [BENCH_METHODS[method].options for method in COMPARED])


def said_of_dataset(sizes: Sizes) -> Needs:
    """Of scenes with two frames that are held out."""
    return _needs(Ranges(rows=sizes["rows"], columns=sizes["columns"], views=sizes["views"]), SCENES, 1)


def said_of_training(network: str) -> Callable[[Sizes], Needs]:
    """Of a network."""
    how, needs = TrainOptions(network=network, steps=6), trainer_of(network).needs
    return lambda sizes: needs((sizes["rows"], sizes["columns"]), sizes["views"], how)


def said_of_start(sizes: Sizes) -> Needs:
    """Of Gaussians that begin with a guess."""
    needs = of_reconstruction(NeedsSizes.of(frames(sizes)), Gaussians(start="learned"), "levels")
    assert needs is not None
    return needs


def said_of_method(method: str) -> Callable[[Sizes], Needs]:
    """Of a method for frames of one time, or of each of several."""

    def said(sizes: Sizes) -> Needs:
        needs = acts.of_each_time(frames(sizes), METHODS[method], "levels")
        assert needs is not None
        return needs

    return said


def said_of_series(sizes: Sizes) -> Needs:
    """Of a method of all times."""
    needs = of_fit(NeedsSizes.of(frames(sizes)), METHODS["pinn"])
    assert needs is not None
    return needs


def said_of_growth(sizes: Sizes) -> Needs:
    """Of cells in flow."""
    return acts.of_growth(sizes["cells"], nodes_of(sizes["frequency"]), sizes["snapshots"], 5e-9)


def said_of_export(suffix: str) -> Callable[[Sizes], Needs]:
    """Of a volume."""
    return lambda sizes: acts.of_export((sizes["edge"], sizes["edge"], sizes["edge"]), suffix)


ACTS: dict[str, tuple[Callable[[Path, Sizes], list[object]], Callable[[Sizes], Needs]]] = {
    "track": (track, lambda sizes: acts.of_track(frames(sizes), TrackOptions())),
    "forecast": (forecast, lambda sizes: acts.of_forecast(frames(sizes), MotionFit().schedule.views_per_step)),
    "align": (align, lambda sizes: acts.of_alignment(frames(sizes), PoseOptions())),
    "matter in motion": (moving, lambda sizes: acts.of_motion(frames(sizes), FlowOptions())),
    "pinn": (pinn, said_of_series),
    "each time": (each, said_of_method("gaussians")),
    "surface": (surface, lambda sizes: acts.of_surfaces(frames(sizes), SurfaceOptions())),
    "export .h5": (export(".h5"), said_of_export(".h5")),
    "export .ome.tif": (export(".ome.tif"), said_of_export(".tif")),
    "export .ome.zarr": (export(".ome.zarr"), said_of_export(".zarr")),
    "grow": (grow, said_of_growth),
    "dataset": (dataset, said_of_dataset),
    "train start": (train("start"), said_of_training("start")),
    "train onix": (train("onix"), said_of_training("onix")),
    "bench": (bench, said_of_bench),
    "start learned": (learned, said_of_start),
    "onix": (onix, said_of_method("onix")),
}
"""What runs a command, and what is said of it."""
JOBS = (
    ("track", {"rows": 48, "columns": 56, "views": 4, "times": 4}),
    ("track", {"rows": 96, "columns": 100, "views": 4, "times": 6}),
    ("forecast", {"rows": 48, "columns": 56, "views": 4, "times": 6}),
    ("forecast", {"rows": 96, "columns": 100, "views": 4, "times": 6}),
    ("align", {"rows": 64, "columns": 72, "views": 6}),
    ("align", {"rows": 128, "columns": 128, "views": 4}),
    ("matter in motion", {"rows": 32, "columns": 36, "views": 4, "times": 4}),
    ("matter in motion", {"rows": 40, "columns": 48, "views": 3, "times": 6}),
    ("pinn", {"rows": 40, "columns": 48, "views": 4, "times": 4}),
    ("pinn", {"rows": 72, "columns": 80, "views": 4, "times": 8}),
    ("each time", {"rows": 48, "columns": 56, "views": 4, "times": 3}),
    ("each time", {"rows": 128, "columns": 128, "views": 4, "times": 2}),
    ("surface", {"rows": 64, "columns": 72, "views": 6}),
    ("surface", {"rows": 160, "columns": 160, "views": 3}),
    ("export .h5", {"edge": 160}),
    ("export .h5", {"edge": 320}),
    ("export .ome.tif", {"edge": 160}),
    ("export .ome.tif", {"edge": 256}),
    ("export .ome.zarr", {"edge": 160}),
    ("export .ome.zarr", {"edge": 256}),
    ("grow", {"cells": 4, "frequency": 6, "snapshots": 4}),
    ("grow", {"cells": 2, "frequency": 16, "snapshots": 2}),
    ("dataset", {"rows": 48, "columns": 48, "views": 4}),
    ("dataset", {"rows": 112, "columns": 128, "views": 8}),
    ("train start", {"rows": 48, "columns": 48, "views": 3}),
    ("train start", {"rows": 80, "columns": 96, "views": 4}),
    ("train onix", {"rows": 48, "columns": 48, "views": 3}),
    ("train onix", {"rows": 80, "columns": 96, "views": 4}),
    ("bench", {"rows": 48, "columns": 56, "views": 6}),
    ("bench", {"rows": 120, "columns": 128, "views": 8}),
    ("start learned", {"rows": 64, "columns": 64, "views": 3}),
    ("start learned", {"rows": 96, "columns": 112, "views": 4}),
    ("onix", {"rows": 48, "columns": 56, "views": 4}),
    ("onix", {"rows": 80, "columns": 80, "views": 6}),
    ("onix", {"rows": 80, "columns": 80, "views": 3}),
    ("onix", {"rows": 64, "columns": 64, "views": 8}),
    ("onix", {"rows": 48, "columns": 56, "views": 10}),
    ("onix", {"rows": 96, "columns": 96, "views": 4}),
    ("onix", {"rows": 128, "columns": 128, "views": 3}),
)
"""Commands and their sizes."""


def row(act: str, sizes: Sizes) -> dict[str, object]:
    """What a command takes, and is said to take."""
    with tempfile.TemporaryDirectory() as name:
        command = ACTS[act][0](Path(name), sizes)
        measured = peak(command) / 1e6
    return {"act": act, "sizes": json.dumps(sizes)} | compared(act, sizes, measured)


def compared(act: str, sizes: Sizes, measured: float) -> dict[str, object]:
    """The estimate beside what was measured [MB]."""
    estimate = ACTS[act][1](sizes).memory / 1e6
    return {"estimate_mb": round(estimate), "measured_mb": round(measured), "ratio": round(estimate / measured, 2)}


def again(path: Path) -> list[dict[str, object]]:
    """The table with the same measurements and estimates made anew."""
    rows: list[dict[str, object]] = [dict(found) for found in read(path)]
    for found in rows:
        found |= compared(str(found["act"]), json.loads(str(found["sizes"])), float(str(found["measured_mb"])))
    return rows


def main() -> None:
    """All jobs that the table lacks, and the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, required=True)
    parser.add_argument("--acts", nargs="*", default=list(ACTS))
    parser.add_argument("--again", action="store_true", help="estimates anew, beside the measurements of the table")
    given = parser.parse_args()
    rows = again(given.csv)
    there = {(str(found["act"]), str(found["sizes"])) for found in rows}
    wanted = [(act, sizes) for act, sizes in JOBS if act in given.acts and (act, json.dumps(sizes)) not in there]
    for act, sizes in wanted if not given.again else ():
        rows.append(row(act, sizes) | {"machine": f"{os.cpu_count()} × {platform.machine()}"})
        rows[-1]["commit"] = machine.commit()
        print(rows[-1], flush=True)
        write(rows, given.csv)
    write(rows, given.csv)


if __name__ == "__main__":
    main()
