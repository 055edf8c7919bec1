"""Whether waves that go through a thick cell slab by slab predict unseen views better than straight rays do.

    python benchmarks/thick_cell.py FOLDER/hl60_qlsi_A140.tar.lzma --out docs/data/thick_cell.csv   # 15 minutes

A measured living cell (HL60, RI-imaging/ODTbrain, CC0): complex fields of 140 views, up to 3 rad, of red light in a
medium of index 1.335, which diffracts within the cell: λ times its thickness is some 90 pixels squared. Voxels with a
phase that is not negative are fitted to the fields of twelve views, once by the projection approximation and once by
multislice (Cowley & Moodie 1957), and predict the fields between them. Both have the same steps and total variation.
Multislice knows front from back: turned in the wrong sense it is a model that cannot be right, and must do worse where
the views tell. Plain torch, nothing of holosplat's optics. The fields are those in the plane of focus, whose place
about the axis is not recorded: `focus` is tried.
"""

from __future__ import annotations

import argparse
import io
import math
import tarfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import torch
from machine import commit
from rows import machine, replaced, shown, spent
from torch import Tensor
from torch.nn.functional import grid_sample, pad

PIXEL, WAVELENGTH, BINNED = 0.139e-6, 0.647e-6 / 1.335, 2
"""Of the frames and in the medium [m]; pixels along an edge that are joined: light of that aperture shows no less."""
TRAIN, SLABS, MARGIN, STEPS = 12, 14, 13, 120
WEIGHT = 0.02
"""Of total variation, for both models."""


@dataclass(frozen=True)
class Row:
    """model: projection or multislice; sense: of rotation; focus: plane of focus behind the axis [m]; field, phase:
    relative errors of unseen views; fitted: of the fields of seen ones; seconds: of the processor"""

    model: str
    sense: int
    focus: float
    field: float
    phase: float
    fitted: float
    seconds: float
    machine: str
    commit: str


def measured(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Complex fields and phases [V, H, W], and angles [V] in rad."""
    with tarfile.open(path, "r:xz") as archive:
        series, angles = (archive.extractfile(name) for name in ("series.h5", "angles.txt"))
        assert series is not None
        assert angles is not None
        theta = np.loadtxt(angles)
        with h5py.File(io.BytesIO(series.read())) as file:
            views = [file[f"qpi_{n}"] for n in range(len(theta))]
            amplitudes, phases = (np.array([v[f"{name}/raw"][:] for v in views]) for name in ("amplitude", "phase"))
    size = phases.shape[1] // BINNED
    shape = (len(theta), size, BINNED, size, BINNED)
    fields, phases = (a.reshape(shape).mean((2, 4)) for a in (amplitudes * np.exp(1j * phases), phases))
    return fields, phases, theta


class Waves:
    """The field in the focus of a volume of phases a voxel [Z, Y, X]."""

    def __init__(self, size: int, model: str, sense: int, focus: float) -> None:
        self.model, self.sense, self.each = model, sense, size // SLABS
        pixel = BINNED * PIXEL
        f = torch.fft.fftfreq(size + 2 * MARGIN, pixel, dtype=torch.float64)
        waves = 2 * math.pi * (1 / WAVELENGTH**2 - f[:, None] ** 2 - f**2).clamp_min(0).sqrt()
        beyond = waves - 2 * math.pi / WAVELENGTH
        half, to_focus = 0.5 * self.each * pixel, focus - 0.5 * size * pixel
        self.half, self.step, self.back = (
            torch.exp(1j * beyond * z).to(torch.complex64) for z in (half, 2 * half, to_focus)
        )
        c = (torch.arange(size) - 0.5 * (size - 1)) / (0.5 * size)
        self.depth, self.row, self.column = torch.meshgrid(c, c, c, indexing="ij")

    def __call__(self, volume: Tensor, angle: float) -> Tensor:
        """[H, W]."""
        cos, sin = math.cos(self.sense * angle), math.sin(self.sense * angle)
        x, z = self.column * cos - self.depth * sin, self.column * sin + self.depth * cos
        at = torch.stack([x, self.row, z], -1).float()[None]
        turned = grid_sample(volume[None, None], at, align_corners=False)[0, 0]
        if self.model == "projection":
            return torch.exp(1j * turned.sum(0))
        size = len(volume) + 2 * MARGIN
        wave = torch.ones(size, size, dtype=torch.complex64)
        for n, slab in enumerate(turned.split(self.each)):
            wave = self._gone(wave, self.step if n else self.half)
            wave = wave * torch.exp(1j * pad(slab.sum(0), (MARGIN,) * 4))
        wave = self._gone(wave, self.half * self.back)
        return wave[MARGIN:-MARGIN, MARGIN:-MARGIN]

    def _gone(self, wave: Tensor, factor: Tensor) -> Tensor:
        return torch.fft.ifft2(torch.fft.fft2(wave) * factor)


def relative(found: list[Tensor], wanted: list[Tensor], nothing: float) -> float:
    """Root of the squared errors over what `nothing` leaves."""
    error = sum(float((a - b).abs().square().sum()) for a, b in zip(found, wanted))
    return math.sqrt(error / sum(float((b - nothing).abs().square().sum()) for b in wanted))


def fitted(path: Path, model: str, sense: int, focus: float) -> Row:
    """One model fitted and judged."""
    fields, exact, theta = measured(path)
    seen, between = (
        sorted({int(np.argmin(np.abs(theta - theta[0] - math.pi * (n + part) / TRAIN))) for n in range(TRAIN)})
        for part in (0, 0.5)
    )
    size, truth = fields.shape[1], torch.from_numpy(fields).to(torch.complex64)
    waves, volume = Waves(size, model, sense, focus), torch.zeros(size, size, size, requires_grad=True)
    adam = torch.optim.Adam([volume], lr=0.006)
    with spent() as time:
        for step in range(STEPS):
            adam.param_groups[0]["lr"] = 0.006 if step < 0.6 * STEPS else 0.002
            adam.zero_grad()
            for v in seen:
                ((waves(volume.clamp_min(0), theta[v]) - truth[v]).abs().square().mean() / len(seen)).backward()
            total = [(volume.diff(dim=axis).square() + 1e-6).sqrt().mean() for axis in range(3)]
            (WEIGHT * torch.stack(total).sum()).backward()
            adam.step()
    with torch.no_grad():
        shows = partial(waves, volume.clamp_min(0))
        found = {v: shows(theta[v]) for v in (*seen, *between)}
    known, unseen = ([truth[v] for v in views] for views in (seen, between))
    new = [found[v] for v in between]
    turns = [torch.from_numpy(np.exp(-1j * exact[v])) for v in between]
    missed = sum(float(torch.angle(a * turn).square().sum()) for a, turn in zip(new, turns))
    phase = math.sqrt(missed / float((exact[between] ** 2).sum()))
    numbers = (relative(new, unseen, 1.0), phase, relative([found[v] for v in seen], known, 1.0))
    return Row(model, sense, focus, *numbers, time.cpu_seconds, machine(), commit())


def main() -> None:
    """Parse the command line, and fit each model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="hl60_qlsi_A140.tar.lzma")
    parser.add_argument("--out", type=Path, help="CSV file of rows, replaced where they are there")
    options = parser.parse_args()
    torch.set_num_threads(1)
    tried = [("projection", 1, 0.0)]
    tried += [("multislice", sense, focus) for focus in (0.0, 0.7e-6, 2e-6) for sense in (1, -1)]
    for model, sense, focus in tried:
        row = fitted(options.data, model, sense, focus)
        shown(row)
        if options.out:
            replaced(options.out, row, key=3)


if __name__ == "__main__":
    main()
