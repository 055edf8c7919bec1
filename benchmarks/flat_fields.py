"""What plain and dynamic flat-fielding leave of raw frames: the tables of docs/notebook/imaging_chain.md.

    python benchmarks/flat_fields.py [--seeds 101 102 103] [--side 128] [--views 8]

Red cells, simulated from meshes, recorded by `record` (12 bits, 100 flats, 20 darks, default pulses), corrected by
`correct`. Residuals are root mean squares over all frames and seeds: against the noise-free frames, with the photons'
noise in them, and without it (what the true light of each pulse, divided by the flat field that was used, leaves of an
even frame; both normalised). Run it with one thread (OMP_NUM_THREADS=1).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from machine import commit

import holosplat as hs
from holosplat.beamline.record import RecordingOptions, record
from holosplat.io.raw_file import PROJECTION
from holosplat.io.scan_file import open_scan
from holosplat.optics.camera import Camera, Illumination, spread
from holosplat.workflows.correct import CorrectionOptions, FlatFielding, correct

PIXEL = {"3.2 µm": 3.2e-6, "0.5 µm": 0.5e-6}
CASES: dict[str, tuple[str, float, Camera]] = {
    "3.2 µm, 1e4 photons": ("3.2 µm", 1e4, Camera()),
    "3.2 µm, 1e3 photons": ("3.2 µm", 1e3, Camera()),
    "0.5 µm, 1e4 photons": ("0.5 µm", 1e4, Camera()),
    "0.5 µm, 1e4 photons, scintillator 0.7 px": ("0.5 µm", 1e4, Camera(scintillator_px=0.7)),
    "0.5 µm, 1e5 photons": ("0.5 µm", 1e5, Camera()),
}
METHODS = {
    "plain": CorrectionOptions("plain"),
    "plain, normalised": CorrectionOptions("plain", "mean"),
    "dynamic": CorrectionOptions("dynamic"),
}


def clean_scan(regime: str, seed: int, side: int, views: int, psf_px: float) -> hs.Scan:
    """Noise-free frames of 24 cells, 20 pixels (3.2 µm) or 16 pixels (0.5 µm) wide."""
    pixel = PIXEL[regime]
    width = side * pixel
    diameter = 20 * pixel if regime == "3.2 µm" else 16 * pixel
    cells = hs.specimens.random_cells(24, (0.75 * width, 0.85 * width, 0.75 * width), seed=seed, diameter=diameter)
    scene = hs.MeshScene.of_one_material(cells, hs.materials.HAEMOGLOBIN.delta_beta(20.0))
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(views, (side, side), pixel), 20.0, 0.1, psf_px)
    return hs.simulate(scene, exposures)


def residuals(
    folder: Path, case: str, seed: int, side: int, views: int
) -> Iterator[tuple[str, float, float, float, int]]:
    """(method, mean square with noise, mean square of the flat fields alone, seconds a frame, components)."""
    regime, photons, camera = CASES[case]
    clean, raw, truth, out = (folder / name for name in ("clean.nxs", "raw.nxs", "truth.h5", "scan.nxs"))
    hs.io.write_scan(clean, clean_scan(regime, seed, side, views, 0.3))
    sharp = hs.io.read_scan(clean).frames
    options = RecordingOptions(photons_per_pixel=photons, seed=seed)
    record(clean, raw, options, camera, Illumination(), truth)
    for name, method in METHODS.items():
        started = time.process_time()
        done = correct(raw, out, method)
        seconds = (time.process_time() - started) / views
        found = hs.io.read_scan(out).frames
        wanted = np.stack([spread(frame.astype(np.float64), camera.scintillator_px) for frame in sharp])
        yield (
            name,
            float(np.mean((found - wanted) ** 2)),
            left_by_flats(raw, truth, method, camera),
            seconds,
            done.components,
        )


def left_by_flats(raw: Path, truth: Path, method: CorrectionOptions, camera: Camera) -> float:
    """Mean square that true light over used flat field leaves of an even frame, over frames."""
    with open_scan(raw) as file, h5py.File(truth) as told:
        fielding = FlatFielding(file, method, lambda fraction: None)
        gain = told["sensor/gain"][()]
        left = []
        for i, number in enumerate(file.numbers(PROJECTION)):
            weights, components = told["projections/weights"][i], told["light/components"][()]
            light = told["light/mean"][()] + np.tensordot(weights, components, 1)
            light = gain * spread(light, camera.scintillator_px)
            relative = fielding.repair(light) / fielding.flat_field(fielding.repair(file.frame(int(number))))
            left.append(np.mean((relative / relative.mean() - 1) ** 2))
    return float(np.mean(left))


def main() -> None:
    """Print one row for each case and method."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--views", type=int, default=8)
    given = parser.parse_args()
    print(f"commit {commit()}, seeds {given.seeds}, {given.side}² pixels, {given.views} views")
    print("| case | method | residual | of the flat fields alone | components | s/frame |")
    print("| --- |" + " --- |" * 5)
    for case in CASES:
        rows: dict[str, list[tuple[float, float, float, int]]] = {}
        for seed in given.seeds:
            with tempfile.TemporaryDirectory() as folder:
                for name, *numbers in residuals(Path(folder), case, seed, given.side, given.views):
                    rows.setdefault(name, []).append(tuple(numbers))  # type: ignore[arg-type]
        for name, found in rows.items():
            total, flat, seconds, components = np.array(found).T
            print(
                f"| {case} | {name} | {np.sqrt(total.mean()):.4f} | {np.sqrt(flat.mean()):.4f} | "
                f"{min(components):.0f}–{max(components):.0f} | {seconds.mean():.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
