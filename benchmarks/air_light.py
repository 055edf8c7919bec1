"""How well smooth light is found where there is no air, by how much of its unevenness counts as noise at least.

    python benchmarks/air_light.py --out docs/data/air_light.csv       # some five minutes on one core

Frames of random size show air about an ellipse of noise, in light that slopes or is a random field. A row: the part of
unevenness that counts as noise (`optics.background.FINER`), noise of the frames, number of scenes, and median, mean and
largest error inside the ellipse, as a share of the light's unevenness there (5 and more count as 5).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import written

from holosplat.beamline.light import correlated_field
from holosplat.optics import background
from holosplat.optics.noise import NoiseModel

PARTS, NOISES = (0.0, 0.02, 0.04, 0.08, 0.15, 0.25), (0.0, 0.0003, 0.001, 0.002, 0.01, 0.03)
WORST = 5.0
"""Relative error that any larger one counts as."""


def scene(seed: int, noise: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Frames, air and true light [V, H, W]."""
    rng = np.random.default_rng(seed)
    h, w, count = *(int(n) for n in rng.integers(48, 130, 2)), int(rng.choice([4, 8]))
    length, rms = rng.uniform(15, 80), float(rng.choice([0.005, 0.02, 0.05]))
    y, x = (2 * (np.arange(n) + 0.5) / n - 1 for n in (h, w))
    inside = (y[:, None] / rng.uniform(0.5, 1.1)) ** 2 + (x / rng.uniform(0.5, 0.95)) ** 2 < 1
    light = []
    for _ in range(count):
        a, b, c = rng.normal(size=3)
        slopes = (a + b * y[:, None] + c * x) / np.sqrt(3)
        light.append(1 + rms * (slopes if seed % 3 == 0 else correlated_field((h, w), length, rng)))
    true = np.stack(light)
    frames = true * np.where(inside, 1 + 0.05 * rng.normal(size=true.shape), 1) + noise * rng.normal(size=true.shape)
    air = torch.from_numpy(~inside).expand(true.shape).clone()
    return torch.from_numpy(frames.astype(np.float32)), air, torch.from_numpy(true)


def error(seed: int, noise: float) -> float:
    """Of the light inside, relative to its deviation from the mean in air."""
    frames, air, true = scene(seed, noise)
    found = background.Background.of_air(frames, air, NoiseModel.of_frames(frames, air)).factor()
    plain = (true * air).sum(dim=(1, 2), keepdim=True) / air.sum(dim=(1, 2), keepdim=True)
    left, whole = (found - true)[~air].square().mean(), (true - plain)[~air].square().mean()
    return min(WORST, float((left / whole).sqrt()))


def rows(seeds: int) -> Iterator[dict[str, str]]:
    """One for each part and noise."""
    now = commit()
    for part in PARTS:
        background.FINER = part
        for noise in NOISES:
            errors = [error(seed, noise) for seed in range(seeds)]
            values = {"median": np.median(errors), "mean": np.mean(errors), "largest": max(errors)}
            said = {name: f"{value:.3f}" for name, value in values.items()}
            yield {"part": f"{part:g}", "noise": f"{noise:g}", "scenes": str(seeds), **said, "commit": now}


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=24)
    options = parser.parse_args()
    torch.set_num_threads(1)
    written(options.out, ("part", "noise", "scenes", "median", "mean", "largest", "commit"), rows(options.seeds))


if __name__ == "__main__":
    main()
