"""`reconstruct --motion auto` as a new user has it, beside `--motion each`: rows of docs/data/chosen_motion.csv.

    python benchmarks/chosen_motion.py                          # all scenes: a quarter of an hour on one core
    python benchmarks/chosen_motion.py --scenes rest --folder runs

Six times of each scene, on 32 to 44 pixels, four even views; all by commands alone, told the material. Errors are those
of δ beside the true volumes that `simulate --truth` writes. Where auto has chosen `each`, it is that, which is not made
again.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from forked import run as forked
from machine import commit
from rows import machine, read, replaced, shown

from holosplat.io.formats import read_volume_file
from holosplat.io.objects import read_object
from holosplat.volume import Object
from holosplat.workflows.motion_choice import begun_motion

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "chosen_motion.csv"
TIMES, LONGEST = 6, 3000.0


@dataclass(frozen=True)
class Row:
    """One time of a scene. choice, gains: of the motion, and for each way 100 times the logarithm of the ratio of
    residuals of unseen frames, that of the best before over its own, with its standard error; error, each_error: of δ,
    by auto and by each time by itself; explained, each_explained: 1 where the frames of this time are; seconds: of the
    processor, of all times with the decision."""

    scene: str
    pixels: int
    seed: int
    number: int
    choice: str
    gains: str
    error: float
    each_error: float
    explained: str
    each_explained: str
    seconds: float
    machine: str
    commit: str


@dataclass(frozen=True)
class Scene:
    """What is imaged, on how many pixels [m], of which material; cells: velocity of the flow that carries red cells
    [m/s], None for a specimen, which is `words`."""

    pixels: int
    pixel: float
    material: str
    photons: int
    words: tuple[str, ...] = ()
    cells: float | None = None


SCENES = {
    "drops that merge": Scene(40, 1e-6, "water", 3000, ("--specimen", "merging-drops")),
    "a bubble that collapses": Scene(36, 1e-6, "water", 3000, ("--specimen", "collapse")),
    "cells that drift": Scene(44, 0.75e-6, "haemoglobin", 2000, cells=0.05),
    "cells at rest": Scene(44, 0.75e-6, "haemoglobin", 2000, cells=0.0),
    "a stirred blob": Scene(32, 0.5e-6, "soft tissue", 1000, ("--specimen", "stirred-blob")),
}


def command(*words: object) -> float:
    """Run a command to its end; seconds of the processor."""
    before = os.times()
    ended = forked([str(word) for word in words], limit=LONGEST)
    if ended.code != 0:
        raise SystemExit(ended.said)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def simulated(scene: Scene, seed: int, out: Path) -> Path:
    """The scan of a scene, beside its true volumes."""
    source: tuple[object, ...] = (*scene.words, "--specimen-seed", seed)
    if scene.cells is not None:
        grown = ("--cells", 3, "--box", 32e-6, 32e-6, 32e-6, "--flow", 0.05, "--snapshots", TIMES, "--seed", seed)
        command("grow", *grown, "--out", out / "cells")
        for path in (out / "cells").glob("*_000.vtp") if scene.cells == 0 else ():
            for number in range(1, TIMES):
                shutil.copy(path, path.with_name(path.name.replace("_000", f"_{number:03d}")))
        source = (out / "cells" / "cells.pvd",)
    field = ("--detector", scene.pixels, scene.pixels, "--pixel-size", scene.pixel, "--views", 4, "--test-every", 0)
    light = ("--photons-per-pixel", scene.photons, "--seed", seed, "--material", scene.material)
    when = ("--frame-rate", 5e4 if scene.cells is not None else 1e4, "--frames", TIMES)
    truth = ("--truth", out / "truth.h5", "--truth-frames", *range(TIMES))
    command("simulate", *source, *field, *light, *when, *truth, "--out", out / "scan.nxs")
    return out / "scan.nxs"


def found(out: Path, motion: str) -> tuple[Callable[[int, float], Object], list[dict[str, str]]]:
    """The object at each time, and the rows that say of each whether it is explained."""
    if motion == "each":
        return lambda k, time: read_object(out / "tasks" / "0000" / f"t{k:04d}" / "object.h5"), read(out / "series.csv")
    whole = read_object(out / "object.h5")
    return lambda k, time: whole.at(time), read(out / "times.csv")


def judged(out: Path, motion: str, truth: Path) -> list[tuple[float, str]]:
    """The error of δ of each time, and whether its frames are explained."""
    at, said = found(out, motion)
    errors = []
    for k, row in enumerate(said):
        true = read_volume_file(truth.with_name(f"truth_t{k:04d}.h5"))
        delta = at(k, float(row["time_s"])).voxelise(true.grid).delta
        errors.append((float(np.linalg.norm(delta - true.delta) / np.linalg.norm(true.delta)), row["explained"]))
    return errors


def made(name: str, seed: int, out: Path) -> list[Row]:
    """The rows of a scene."""
    scene = SCENES[name]
    scan, told = simulated(scene, seed, out), ("--material", scene.material)
    seconds = command("reconstruct", scan, "--motion", "auto", *told, "--out", out / "auto")
    decision = begun_motion(out / "auto")
    assert decision is not None
    auto = judged(out / "auto", decision.choice, out / "truth.h5")
    each = auto
    if decision.choice != "each":
        command("reconstruct", scan, "--motion", "each", *told, "--out", out / "each")
        each = judged(out / "each", "each", out / "truth.h5")
    gains = "; ".join(f"{one.name} {100 * one.gain:.1f} ± {100 * one.error:.1f}" for one in decision.compared)
    first = (name, scene.pixels, seed)
    return [
        Row(*first, k, decision.choice, gains, a, b, x, y, seconds, machine(), commit())
        for k, ((a, x), (b, y)) in enumerate(zip(auto, each))
    ]


def main() -> None:
    """Make the scenes that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--folder", type=Path, help="where runs are kept (default: nowhere)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for seed in options.seeds:
        for name in options.scenes:
            with tempfile.TemporaryDirectory() as temporary:
                out = (options.folder or Path(temporary)) / f"{name.replace(' ', '-')}-{seed}"
                out.mkdir(parents=True)
                rows = made(name, seed, out)
            replaced(options.out, *rows, key=4)
            for row in rows:
                shown(row)


if __name__ == "__main__":
    main()
