"""Phase retrieval of one frame in uneven, grainy light, on a fibre of known phase: docs/data/fibre.csv.

    OMP_NUM_THREADS=1 python benchmarks/fibre.py [--seeds 6]

A round fibre that ends in the frame, 1.15 rad thick, δ/β 1000, at 11 keV, 78.88 mm and 104.7 nm a pixel, as a hologram
of a spider's hair was taken. The truth has its thickness in closed form, and its waves are sampled twice as finely as
those of retrieval. "noise" is photon noise of 1900 photons a pixel; "uneven" has besides air of 1.02, 1.2 % of smooth
background (correlated over 120 pixels) and 2 % of grain (3 pixels). Seeds alternate between frames of 301 × 257 and
256 × 400 pixels, and between radii of 20 and 14 pixels.
"""

from __future__ import annotations

import argparse
import platform
import time
from pathlib import Path

import numpy as np
import torch
from rows import written

import holosplat as hs
from holosplat.beamline.light import UnevenLight
from holosplat.units import wavenumber
from holosplat.version import source_commit

COMMIT = source_commit()
"""Before the table is written, which is part of the tree."""
TABLE = Path(__file__).resolve().parents[1] / "docs/data/fibre.csv"
ENERGY, PIXEL, DISTANCE, RATIO, PEAK, PHOTONS = 11.0, 104.7e-9, 78.88e-3, 1000.0, 1.15, 1900
SHAPES, RADII = ((301, 257), (256, 400)), (20.0, 14.0)
LIGHT = {
    "light_flux": 1.02,
    "light_smooth": 0.012,
    "light_smooth_px": 120.0,
    "light_grain": 0.02,
    "light_grain_px": 3.0,
}
METHODS = ("tikhonov", "admm", "ctf")
FIELDS = ("light", "seed", "method", "error", "total", "least_phase", "air", "seconds", "machine", "commit")


def thickness(views: hs.Views, radius_px: float) -> torch.Tensor:
    """Chords [H, W] in metres of a fibre that leans by 0.2 and tapers to its tip over 30 pixels."""
    (h, w), pitch = views.shape, views.pixel_size / PIXEL
    x = ((torch.arange(w).double() + 0.5 - w / 2) * pitch)[None]
    y = ((torch.arange(h).double() + 0.5 - h / 2) * pitch)[:, None]
    off = (y - 6 - 0.2 * x) / np.hypot(1, 0.2)
    tip = ((x + 0.22 * SHAPES[0][1]) / 30).clamp(0, 1)
    return 2 * PIXEL * (radius_px**2 * tip - off**2).clamp_min(0).sqrt()


def fibre(shape: tuple[int, int], radius_px: float) -> tuple[hs.Exposures, hs.DeltaBeta, np.ndarray, np.ndarray]:
    """Exposures, material, the frame [H, W] in even light, and the true phase [H, W] in radians."""
    exposures = hs.Exposures.of(hs.Views.from_angles([0.0], shape, PIXEL), ENERGY, DISTANCE)
    delta = PEAK / (wavenumber(ENERGY) * 2 * radius_px * PIXEL)
    instrument = hs.model.Instrument(exposures, 2, torch.float64)
    lines = thickness(instrument.views, radius_px)[None]
    frame = instrument.image(lines * delta / RATIO, lines * delta)[0].numpy()
    means = torch.nn.functional.avg_pool2d(thickness(exposures.views.refined(4), radius_px)[None], 4)[0]
    return exposures, hs.DeltaBeta(delta, delta / RATIO), frame, -wavenumber(ENERGY) * delta * means.numpy()


def run(light: str, seed: int, method: str) -> dict[str, object]:
    """One row of the table."""
    exposures, material, frame, truth = fibre(SHAPES[seed % 2], RADII[seed // 2 % 2])
    if light != "even":
        lamp = UnevenLight(light_seed=seed, **(LIGHT if light == "uneven" else {})).on(1, frame.shape)
        frame = lamp.recorded(frame, 0, PHOTONS, np.random.default_rng(seed))
    began = time.perf_counter()
    found = hs.retrieve(frame[None].astype(np.float32), exposures, material, method)
    seconds, air = time.perf_counter() - began, truth == 0
    phase = found.phase[0].numpy().astype(float)
    phase -= np.median(phase[air])
    numbers = {
        "error": np.linalg.norm((phase - truth)[~air]) / np.linalg.norm(truth[~air]),
        "total": phase.sum() / truth.sum(),
        "least_phase": np.quantile(phase, 1e-4),
        "air": phase[air].std(),
    }
    said = {"light": light, "seed": seed, "method": method, **{k: f"{v:.3f}" for k, v in numbers.items()}}
    return said | {"seconds": f"{seconds:.0f}", "machine": f"{platform.machine()}, one core", "commit": COMMIT}


def main() -> None:
    """All rows; the table is written anew."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=6)
    count = parser.parse_args().seeds
    torch.set_num_threads(1)
    tasks = [("even", 0), ("noise", 0), *(("uneven", seed) for seed in range(count))]
    written(TABLE, FIELDS, (run(light, seed, method) for method in METHODS for light, seed in tasks))


if __name__ == "__main__":
    main()
