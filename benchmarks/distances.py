"""Several distances of one view, beside hotopy at equal photons: rows of docs/data/distances.csv.

    OMP_NUM_THREADS=1 python benchmarks/distances.py [--seeds 201 202] [--side 128]

Red cells of haemoglobin at 20 keV, pixels of 0.5 µm, simulated in float64 from meshes at one, two and four distances;
β/δ is told. Frames of a set share the photons. The error is that of the thickness (root mean square over that of the
thickness), the seconds are the processor's, of one view. hotopy (GPL, extra `bench`) has the regularisation that
the *truth* chooses, for each row anew: better than any user of it can do. Ours choose by themselves.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import commit
from rows import written

from holosplat import Exposures, MeshScene, Views, simulate
from holosplat.materials import HAEMOGLOBIN
from holosplat.optics.propagation import bin_pixels, poisson
from holosplat.optics.retrieval import contrast_transfer, tikhonov
from holosplat.specimens import random_cells
from holosplat.units import wavelength, wavenumber

DATA = Path(__file__).parents[1] / "docs" / "data" / "distances.csv"
COLUMNS = ("seed", "photons", "distances", "program", "method", "error", "alpha", "seconds", "commit")
ENERGY, PIXEL = 20.0, 0.5e-6
SETS = {"0.05": (0.05,), "0.1": (0.1,), "0.2": (0.2,), "2": (0.1, 0.2), "4": (0.05, 0.08, 0.125, 0.2)}
"""Distances [m]."""
PHOTONS = (0.0, 20_000.0, 2_000.0)
"""A pixel, of all frames of a set together; 0: no noise."""
ALPHAS = [(low, high) for low in (0.0, 1e-4, 1e-3, 1e-2, 1e-1) for high in (1e-4, 1e-3, 1e-2, 1e-1, 3e-1)]
FEW_ALPHAS = [(low, high) for low in (0.0, 1e-3, 1e-1) for high in (1e-3, 1e-1, 3e-1)]
"""hotopy's regularisation below and above the first maximum of the transfer; few: of what iterates."""


def main() -> None:
    """Write the rows."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="+", default=[201, 202])
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--out", type=Path, default=DATA)
    given = parser.parse_args()
    torch.set_num_threads(1)
    written(given.out, COLUMNS, rows(given.seeds, given.side))


def rows(seeds: Sequence[int], side: int) -> Iterator[dict[str, Any]]:
    """A row for each program's method on each set of distances."""
    material = HAEMOGLOBIN.delta_beta(ENERGY)
    for seed in seeds:
        width = side * PIXEL
        cells = random_cells(24, (0.8 * width, 0.85 * width, 0.8 * width), seed=seed, diameter=8e-6)
        scene = MeshScene.of_one_material(cells, material)
        view = Views.from_angles([20.0], (side, side - 1), PIXEL)
        truth = bin_pixels(scene.project(view.refined(2))[1] / material.delta, 2)[0].numpy()
        for name, distances in SETS.items():
            taken = Exposures.of(view[[0] * len(distances)], ENERGY, np.array(distances))
            clean = simulate(scene, taken).frames.astype(np.float64)
            for photons in PHOTONS:
                frames = poisson(clean, photons / len(distances), seed) if photons else clean
                for program, method, find, alphas in contestants(taken, material.delta, material.beta):
                    found = [timed(find, frames, alpha) for alpha in alphas]
                    errors = [float(np.sqrt(np.mean((one - truth) ** 2) / np.mean(truth**2))) for one, _ in found]
                    best = int(np.argmin(errors))
                    numbers = {"error": f"{errors[best]:.4f}", "seconds": f"{found[best][1]:.2f}"}
                    said = {"seed": seed, "photons": int(photons), "distances": name, "commit": commit()}
                    yield said | {"program": program, "method": method, "alpha": alphas[best] or ""} | numbers


def timed(find: Callable[..., np.ndarray], frames: np.ndarray, alpha: Any) -> tuple[np.ndarray, float]:
    """Thickness [H, W] in metres, and what it took [s]."""
    began = time.process_time()
    return find(frames, alpha), time.process_time() - began


def contestants(
    taken: Exposures, delta: float, beta: float
) -> Iterator[tuple[str, str, Callable[..., np.ndarray], Sequence[Any]]]:
    """Program, method, frames [V, H, W] → thickness [H, W] in metres, and what it is regularised by."""
    for name, ours in (("ctf", contrast_transfer), ("tikhonov", tikhonov)):

        def find(frames: np.ndarray, _: None, ours: Any = ours) -> np.ndarray:
            return ours(torch.from_numpy(frames).float(), taken, delta, beta)[0].double().numpy()

        yield "holosplat", name, find, (None,)
    from hotopy import holo

    fresnel = [PIXEL**2 / (float(wavelength(ENERGY)) * z) for z in taken.distance]
    (h, w), unit = taken.views.shape, float(wavenumber(ENERGY)) * delta
    margin = [(min(h, w) // 4,) * 2] * 2
    shape = (h + sum(margin[0]), w + sum(margin[1]))
    inner = tuple(slice(low, low + n) for (low, _), n in zip(margin, (h, w)))
    signed = holo.Constraints(phase_max=0.0)
    for name, made, bound, alphas in (
        ("ctf", holo.CTF, None, ALPHAS),
        ("ict", holo.ICT, None, ALPHAS),
        ("ctf, phase <= 0", holo.CTF, signed, FEW_ALPHAS),
        ("tikhonov", holo.Tikhonov, None, FEW_ALPHAS),
        ("tikhonov, phase <= 0", holo.Tikhonov, signed, FEW_ALPHAS),
    ):

        def find(frames: np.ndarray, alpha: tuple[float, float], made: Any = made, bound: Any = bound) -> np.ndarray:
            padded = np.pad(frames, ((0, 0), *margin), mode="edge")
            retrieve = made(shape, fresnel, alpha=alpha, betadelta=beta / delta, dtype=torch.float64)
            phase = np.asarray(retrieve(torch.from_numpy(padded), constraints=bound)).reshape(shape)
            return -phase[inner] / unit

        yield "hotopy", name, find, alphas


if __name__ == "__main__":
    main()
