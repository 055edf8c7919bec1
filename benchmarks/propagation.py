"""The benchmark's frames beside those of other programs: does what simulates them compute what it says?

    python benchmarks/propagation.py --snapshots DIR --csv docs/data/propagation.csv   # minutes; rows are kept
    python benchmarks/propagation.py --summary docs/data/propagation.csv  # the table of docs/notebook/benchmark.md

Of every case of the suite (seed 101) two noise-free frames, the first for training and the first held out, are compared
with three others, each as the root mean square of the difference over that of the frame's contrast:

- `multislice`: `holosplat_bench/suite/multislice.py`, which knows the scene and the set-up, and shares no code with us:
  its own rays, slabs, waves and detector, on a raster of its own; `doubled`: from our frame on twice as fine a raster;
- `optics`: its waves and detector behind our line integrals, on our raster: what single precision and the paraxial
  approximation cost;
- `hotopy`: the same with the propagator of hotopy (GPL, extra `bench`), where it is installed.

`thin` is what eight slabs differ by from one, which is the approximation that all matter lies in one plane.
Cases that differ only in noise or light have the same frames before it, and stand in one row.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit
from rows import read, write

from holosplat.beamline.simulate import Simulation, simulated_frames
from holosplat.model import Instrument
from holosplat.scan import Exposures
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.scene import MeshScene
from holosplat_bench.declaration import Case
from holosplat_bench.suite import multislice as other
from holosplat_bench.suite.arena.cases import multislice_frames, raster
from holosplat_bench.suite.case import case_names, load_case

SEED, SLABS = 101, 8
NUMBERS = ("contrast", "multislice", "doubled", "thin", "optics", "hotopy")
COLUMNS = ("case", "also", "seed", "view", "held_out", "samples", *NUMBERS, "seconds", "machine", "commit")


def other_frames(scene: MeshScene | ContinuousScene, taken: Exposures) -> tuple[np.ndarray, np.ndarray]:
    """One frame [h, w] by the other program, of `SLABS` slabs and of one."""
    slabs, one = multislice_frames(scene, taken, (SLABS, 1))
    return slabs, one


def optics_alone(
    scene: MeshScene | ContinuousScene, taken: Exposures, samples: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """One frame [h, w] of our line integrals by the waves of the other program, and by those of hotopy."""
    ours = Instrument(taken, samples, torch.float64)
    beta, delta = (t[0].numpy() for t in scene.project(ours.views))
    energy, z, psf = float(taken.energy_kev[0]), float(taken.distance[0]), float(taken.psf_sigma_px[0])
    k = 2 * np.pi / other.wavelength(energy)
    wave = np.exp(-k * beta - 1j * k * delta)
    on = other.Raster(taken.views.shape, taken.views.pixel_size, samples, ours.margin)
    same = other.sampled(wave, z, energy, psf, on)
    holo = hotopy()
    if holo is None or z == 0:  # in contact it has no Fresnel number
        return same, None
    fresnel = on.pitch**2 / (other.wavelength(energy) * z)
    wave = holo.FresnelTFPropagator(wave.shape, fresnel, dtype=torch.float64)(wave)
    return same, other.sampled(wave, 0.0, energy, psf, on)


@cache
def hotopy() -> Any:
    """The module, or None, said once."""
    try:
        return importlib.import_module("hotopy.holo")
    except ImportError:
        print("hotopy is not installed, so that its column stays empty; pip install 'holosplat[bench]' brings it.")
        return None


def difference(found: np.ndarray | None, ours: np.ndarray) -> float:
    """Root mean square over that of the contrast; nan where there is nothing."""
    return math.nan if found is None else float(np.linalg.norm(found - ours) / np.linalg.norm(ours - 1))


def row(case: Case, view: int) -> dict[str, Any]:
    """One frame, compared."""
    began, exposures = time.perf_counter(), case.true_exposures()
    samples = Simulation().samples(exposures)
    taken = exposures[[view]]
    ours, finer = (
        next(simulated_frames(case.scene, taken, Simulation(oversample=n))).astype(np.float64)
        for n in (samples, 2 * samples)
    )
    slabs, one = other_frames(case.scene, taken)
    same, theirs = optics_alone(case.scene, taken, samples)
    contrast = float(np.sqrt(np.mean((ours - 1) ** 2)))
    programs = ((slabs, ours), (slabs, finer), (one, slabs), (same, ours), (theirs, ours))
    found = dict(zip(NUMBERS, (contrast, *(difference(a, b) for a, b in programs))))
    return {"case": case.name, "seed": case.seed, "view": view, "held_out": bool(case.is_test[view]),
            "samples": raster(taken).samples, **{n: f"{v:.3g}" for n, v in found.items()},
            "seconds": f"{time.perf_counter() - began:.0f}"}  # fmt: skip


def alike(names: list[str], snapshots: Path | None) -> Iterator[tuple[Case, list[str]]]:
    """Cases of different frames before noise and light, and the names of those that have the same."""
    groups: dict[bytes, tuple[Case, list[str]]] = {}
    for name in names:
        case = load_case(name, SEED, snapshots)
        exposures = case.true_exposures()
        numbers = np.array([exposures.energy_kev, exposures.distance, exposures.psf_sigma_px])
        low, high = case.scene.bounds
        key = exposures.views.fingerprint() + numbers.tobytes() + low.tobytes() + high.tobytes()
        groups.setdefault(key, (case, []))[1].append(name)
    for case, same in groups.values():
        yield case, same[1:]


def summary(rows: list[dict[str, str]]) -> list[str]:
    """A line a case, the larger number of its two frames."""
    lines = ["| case | multislice | beside our finer frame | all in one plane | optics | hotopy |", "| --- " * 6 + "|"]
    for name in dict.fromkeys(r["case"] for r in rows):
        mine = [r for r in rows if r["case"] == name]
        worst = [max(float(r[n]) for r in mine) for n in NUMBERS[1:]]
        also = "".join(f", `{a}`" for a in mine[0]["also"].split())
        lines.append(f"| `{name}`{also} | " + " | ".join("–" if math.isnan(w) else f"{w:.1e}" for w in worst) + " |")
    return lines


def main() -> None:
    """Compare what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=case_names())
    parser.add_argument("--snapshots", type=Path, help="folder of simulated red cells, as `holosplat bench run` takes")
    parser.add_argument("--csv", type=Path, help="add rows to this file, as they come")
    parser.add_argument("--machine", default="x86_64, one core, shared")
    parser.add_argument("--summary", type=Path, help="print the table of a file, and do nothing else")
    given = parser.parse_args()
    if given.summary:
        print(*summary(read(given.summary)), sep="\n")
        return
    rows: list[dict[str, Any]] = read(given.csv) if given.csv else []
    done = {r["case"] for r in rows}
    for case, also in alike(given.cases, given.snapshots):
        if case.name in done:
            continue
        for view in (int(np.flatnonzero(~case.is_test)[0]), int(np.flatnonzero(case.is_test)[0])):
            rows.append(row(case, view) | {"also": " ".join(also), "machine": given.machine, "commit": commit()})
            print(rows[-1], flush=True)
        if given.csv:
            write(rows, given.csv, COLUMNS)
    print(*summary(rows), sep="\n")


if __name__ == "__main__":
    main()
