"""The default method on scenes that nobody chose: rows of docs/data/random_scenes.csv.

    python benchmarks/random_scenes.py --seed 1 --first 0 --count 44 [--write]     # about half a minute a scene

A scene is drawn by its seed and number: one of eleven kinds of matter, sharp and continuous, of one material or two,
in frames of 48 to 84 rows and columns, of 4, 6, 8 or 12 views, even or not, at a Fresnel number of 0.02 to 0.8 a pixel,
with a phase of 0.1 to 2 radians, blurred or not; three in ten have no noise and even light, the others 300 to 100 000
photons a pixel, and half of these uneven light. Of the matter everything, its ratio δ/β, or nothing is known. Numbers
of a scene that cannot be placed have no row. Two views or more between the others are never seen by the run.

A row: what was drawn; noise and uneven light over the rms contrast; what `reconstruct` made by default, or why it gave
up; its error of δ, Dice and total; what it left unexplained of the matter; and whether the verdict was good.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import read, write

import holosplat as hs
from holosplat.beamline.light import UnevenLight
from holosplat.geometry import Grid
from holosplat.metrics import volume_scores
from holosplat.units import wavelength
from holosplat_bench.declaration import (
    Beam,
    Case,
    Declaration,
    Detector,
    Listed,
    Matter,
    Substance,
    case_of,
)
from holosplat_bench.suite.families import KINDS, Draw, Room

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "random_scenes.csv"
PURPOSE = 99
"""Keeps the numbers drawn here apart from others of the same seed."""
HELD_OUT = 3


@dataclass(frozen=True)
class Row:
    """See the top; kept: which state of the run is its result."""

    seed: int
    number: int
    kind: str
    prior: str
    views: int
    rows: int
    columns: int
    fresnel: float
    phase: float
    noise: float
    uneven: float
    blur_px: float
    result: str
    kept: str
    error: float | str
    dice: float | str
    total: float | str
    unexplained: float | str
    good: str
    seconds: float
    machine: str
    commit: str


EMPTY, SECOND = ("capsules", "foam"), ("coated", "absorber")
"""Kinds with an empty core, and with a second material."""


def _log(rng: Draw, least: float, most: float) -> float:
    """Evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def _core(rng: Draw, kind: str, delta: float, ratio: float) -> Substance | None:
    if kind in EMPTY:
        return Substance("vacuum")
    if kind not in SECOND:
        return None
    ranges = ((2, 5), (20, 80)) if kind == "absorber" else ((0.3, 0.8), (0.2, 1.0))
    more, darker = (rng.uniform(*each) for each in ranges)
    return Substance(delta=delta * more, beta=delta / ratio * darker)


def _angles(rng: Draw, count: int) -> tuple[tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]]:
    """Directions for training and held out, even over half a turn or somewhat uneven."""
    whole = count + HELD_OUT
    angles = np.arange(whole) * (180 / whole) + rng.uniform(0, 180)
    if rng.random() < 0.3:
        angles += rng.uniform(-0.3, 0.3, whole) * 180 / whole
    out = set(np.linspace(1, whole - 2, HELD_OUT).round().astype(int).tolist())
    parts = [[(float(a % 180), 0.0) for n, a in enumerate(angles) if (n in out) is held] for held in (False, True)]
    return tuple(parts[0]), tuple(parts[1])


def declared(seed: int, number: int) -> tuple[str, Declaration, dict[str, float]]:
    """The kind, the declaration, and what of the draw it does not say."""
    rng = np.random.default_rng([PURPOSE, seed, number])
    kind = list(KINDS)[number % len(KINDS)]
    rows, columns = (int(n) for n in rng.integers(48, 84, 2))
    diameter = 8e-6 * 10 ** rng.uniform(-0.5, 1.5)
    pixel = diameter / rng.uniform(10, 26)
    room = Room(diameter, 0.9 * columns * pixel / np.sqrt(2), 0.9 * rows * pixel, 0.9 * columns * pixel)
    make, thickness = KINDS[kind]
    specimen, energy = make(rng, room), _log(rng, 8, 30)
    fresnel, phase, ratio = _log(rng, 0.02, 0.8), _log(rng, 0.1, 2), _log(rng, 150, 3000)
    delta = phase * wavelength(energy) / (2 * np.pi * thickness(room))
    matter = Matter(Substance(delta=delta, beta=delta / ratio), _core(rng, kind, delta, ratio))
    train, test = _angles(rng, int(rng.choice([4, 6, 8, 12])))
    quiet = rng.random() < 0.3
    smooth, offset = float(rng.choice([0, 0, 0.005, 0.02])), float(rng.choice([0, 0, 0.01]))
    prior = str(rng.choice(["known", "ratio", "free"] if kind not in SECOND else ["ratio", "free"]))
    made = Declaration(
        summary=f"{kind} drawn at random",
        specimen=specimen,
        matter=matter,
        beam=Beam(energy, pixel**2 / wavelength(energy) / fresnel),
        detector=Detector(rows, columns, pixel, float(rng.choice([0, 0, 0.5, 1.0]))),
        views=Listed(train, test),
        prior=prior,  # type: ignore[arg-type]
        photons=None if quiet else _log(rng, 300, 1e5),
        light=UnevenLight() if quiet else UnevenLight(light_smooth=smooth, light_offset=offset),
    )
    return kind, made, {"fresnel": fresnel, "phase": phase}


def placed(made: Declaration, name: str, seed: int) -> Case:
    """The case, with fewer bodies where not all find a place; errors: `InputError` where not one does."""
    while True:
        try:
            return case_of(made, name, seed)
        except hs.InputError:
            count = getattr(made.specimen, "count", 1)
            if count <= 1:
                raise
            made = replace(made, specimen=replace(made.specimen, count=count - 1))  # type: ignore[call-arg]


def measured(seed: int, number: int) -> Row | None:
    """The row of a scene; None for one that cannot be placed."""
    kind, made, facts = declared(seed, number)
    try:
        case = placed(made, f"{seed}-{number}", 1000 * seed + number)
    except hs.InputError as error:
        print(f"{number}: {error}")
        return None
    scan = case.scan()
    even = hs.simulate(case.scene, case.exposures).frames[~scan.is_test]
    noise = 0.0 if made.photons is None else made.photons**-0.5
    off = float(np.square(scan.frames[~scan.is_test] / even - 1).mean()) - noise**2
    light = max(0.0, off) ** 0.5 if not made.light.is_even else 0.0
    began = time.perf_counter()
    result = kept = good = ""
    error, dice, total, left = "", "", "", ""
    try:
        done = hs.reconstruct(scan.train(), case.prior)
        grid = Grid.of_views(scan.views)
        truth, found = case.scene.voxelise(grid), done.object.voxelise(grid)
        scores = volume_scores(found, truth)
        error, dice = f"{scores.relative_error_delta:.3f}", f"{scores.dice:.3f}"
        total = f"{float(found.delta.sum() / truth.delta.sum()):.3f}"
        result, kept = done.object.kind, done.choice.kept
        left = f"{done.choice.judged[kept]:.3f}"
        good = "" if done.verdict is None else str(done.verdict.good)
    except hs.InputError as refusal:
        result = str(refusal)
    shape, spread = scan.frames.shape[1:], float(even.std())
    return Row(
        *(seed, number, kind, made.prior, int((~scan.is_test).sum()), *shape),
        *(round(facts["fresnel"], 3), round(facts["phase"], 3), round(noise / spread, 3), round(light / spread, 3)),
        *(made.detector.psf_sigma_px, result, kept, error, dice, total, left, good),
        *(round(time.perf_counter() - began, 1), platform.machine(), commit()),
    )


def keep(row: Row) -> None:
    """Write `row` into the table, in place of an earlier one of the same scene."""
    new = {name: str(value) for name, value in asdict(row).items()}
    others = [each for each in read(PAGE) if (each["seed"], each["number"]) != (new["seed"], new["number"])]
    write([*others, new], PAGE)


def main() -> None:
    """Run the scenes that are asked for, and print and write their rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=44)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for number in range(options.first, options.first + options.count):
        row = measured(options.seed, number)
        if row is not None:
            print(row, flush=True)
            if options.write:
                keep(row)


if __name__ == "__main__":
    main()
