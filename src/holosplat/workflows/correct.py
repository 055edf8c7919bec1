"""From raw counts to a scan of relative intensities, frame by frame: the file may be larger than memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..checks import require
from ..io.atomic import require_apart, require_writable
from ..io.nxtomo import scan_writer
from ..io.scan_file import DARK, FLAT, PROJECTION, ScanFile, open_scan
from ..preprocess import (
    EigenFlats,
    PixelRepair,
    TotalVariationWeights,
    defective_pixels,
    eigen_flats,
    relative_intensity,
)
from ..progress import Advance

MOST_DEFECTS = 0.2
"""A larger share of defective pixels is no camera to reconstruct from."""
RIM = 0.05
"""Width of a frame's rim, as a part of its shorter side, that `normalise = "rim"` takes to be free of the object."""

Method = Literal["dynamic", "plain"]
Normalise = Literal["mean", "rim", "none"]


@dataclass(frozen=True)
class CorrectionOptions:
    """How raw frames are corrected."""

    method: Method = "dynamic"
    """dynamic: a flat field for each frame, from the flats' principal components; plain: the mean flat field."""
    normalise: Normalise | None = None
    """What is brought to 1 in each frame: its mean, its rim, or nothing (default: dynamic the mean, plain nothing)."""
    components: int | None = None
    """Most principal components (default: as many as stand out of the noise)."""
    binning: int | None = None
    """Pixels are averaged this many by this many to find their weights (default: 8, less for small frames)."""

    def __post_init__(self) -> None:
        require(self.method in ("dynamic", "plain"), f"method must be dynamic or plain, but it is {self.method!r}.")
        known = self.normalise in (None, "mean", "rim", "none")
        require(known, f"normalise must be mean, rim or none, but it is {self.normalise!r}.")
        for name in ("components", "binning"):
            value = getattr(self, name)
            require(value is None or self.method == "dynamic", f"{name} goes with the method dynamic; leave it.")
            require(value is None or value >= 1, f"{name} must be at least 1, but it is {value}.")

    @property
    def reference(self) -> Normalise:
        """What is brought to 1, by default too."""
        return self.normalise or ("mean" if self.method == "dynamic" else "none")


@dataclass(frozen=True)
class Corrected:
    """What was corrected: frames; defective pixels that the file marks, and that were found beside; components used."""

    frames: int
    marked: int
    found: int
    components: int


class FlatFielding:
    """The dark and flat fields of a raw file, made ready: a number of a projection in, relative intensity out."""

    def __init__(self, file: ScanFile, options: CorrectionOptions, on_progress: Advance) -> None:
        self.file, self.options = file, options
        darks, self._flats = file.numbers(DARK), file.numbers(FLAT)
        dynamic = options.method == "dynamic"
        enough = len(self._flats) >= (3 if dynamic else 1)
        wanted = "at least three flats (1) for the dynamic method" if dynamic else "flats (1)"
        require(enough, f"{file.fields.path} must mark {wanted} in image_key, but it marks {len(self._flats)}.")
        dark, noise = _mean_and_noise(file, darks)
        self.marked = file.mask()
        mean_flat = file.mean(FLAT)
        found = self.marked | defective_pixels(dark, noise, mean_flat)
        self.found = int((found & ~self.marked).sum())
        share = found.mean()
        require(
            share <= MOST_DEFECTS,
            f"{file.fields.path}: {share:.0%} of the pixels are defective by its darks and flats; check its image_key.",
        )
        on_progress(0.1)
        self.repair = PixelRepair(found)
        self.dark = self.repair(dark)
        self.light = self.repair(mean_flat) - self.dark
        self.eigen = self._eigen_flats() if dynamic else None
        self._weights = None if self.eigen is None else TotalVariationWeights(self.eigen, options.binning)
        on_progress(0.3)

    def __call__(self, number: int) -> np.ndarray:
        """The relative intensity [H, W] of frame `number` of the file."""
        raw = self.repair(self.file.frame(number))
        bright = raw.mean() > self.dark.mean()
        require(
            bool(bright), f"{self.file.fields.path}: frame {number} is as dark as the dark ones; mark it invalid (3)."
        )
        frame = relative_intensity(raw, self.dark, self.flat_field(raw))
        return frame / self._level(frame)

    def flat_field(self, raw: np.ndarray) -> np.ndarray:
        """The flat field less the dark one, [H, W] counts, for a frame of counts `raw` [H, W] already repaired."""
        if self.eigen is None or self._weights is None:
            return self.light
        return self.eigen.light(self._weights(raw - self.dark))

    def _level(self, frame: np.ndarray) -> float:
        """What is brought to 1."""
        if self.options.reference == "none":
            return 1.0
        counted = np.ones(frame.shape, dtype=bool)
        if self.options.reference == "rim":
            width = max(1, round(RIM * min(frame.shape)))
            counted[width:-width, width:-width] = False
        level = float(frame[counted].mean())
        require(level > 0, f"{self.file.fields.path} has a projection whose rim is dark; normalise by its mean.")
        return level

    def _eigen_flats(self) -> EigenFlats:
        """Principal components of the flats, read twice by rows and once whole for their means and repairs."""
        flats, places = self._flats, self.repair.places
        repaired, brightness = np.empty((len(flats), len(places))), np.empty(len(flats))
        for i, n in enumerate(flats):
            raw = self.file.frame(n)
            repaired[i] = self.repair.values(raw)
            brightness[i] = (self.repair(raw) - self.dark).mean()
        require(
            bool((brightness > 0).all()), f"{self.file.fields.path} has flats without light; mark them invalid (3)."
        )
        h, w = self.dark.shape

        def rows_of(rows: slice) -> np.ndarray:
            block = np.stack([self.file.rows(n, rows) for n in flats])
            inside = (places >= rows.start * w) & (places < rows.stop * w)
            block.reshape(len(flats), -1)[:, places[inside] - rows.start * w] = repaired[:, inside]
            return block - self.dark[rows]

        return eigen_flats(rows_of, brightness, (h, w), self.options.components)


def correct(
    source: Path,
    out: Path,
    options: CorrectionOptions = CorrectionOptions(),
    on_progress: Advance = lambda fraction: None,
) -> Corrected:
    """Correct the raw file `source` (NXtomo with flats and darks) into the scan file `out`, one frame at a time.

    Defective pixels, marked in the file or found in its darks and flats, are filled from their neighbours; frames are
    turned upright. `InputError` when the file has no flats, or too many defective pixels.
    """
    require_writable(out)
    require_apart(out, source)
    with open_scan(source) as file:
        fielding = FlatFielding(file, options, on_progress)
        projections = file.numbers(PROJECTION)
        count = 0 if fielding.eigen is None else len(fielding.eigen)
        marked = int(fielding.marked.sum())
        described = {
            "corrected": options.method if fielding.eigen is None else f"dynamic, {count} components",
            "normalised": options.reference,
            "defective_pixels": f"{marked} marked, {fielding.found} found",
        }
        with scan_writer(out, file.exposures, file.is_test, file.provenance() | described) as add:
            for i, number in enumerate(projections):
                add(fielding(int(number)))
                on_progress(0.3 + 0.7 * (i + 1) / len(projections))
    return Corrected(len(projections), marked, fielding.found, count)


def _mean_and_noise(file: ScanFile, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation [H, W] of the frames `numbers`; zeros where there are none, or one for the latter."""
    mean, squares = np.zeros(file.exposures.views.shape), np.zeros(file.exposures.views.shape)
    for count, n in enumerate(numbers, start=1):  # Welford 1962
        frame = file.frame(n)
        step = frame - mean
        mean += step / count
        squares += step * (frame - mean)
    return mean, np.sqrt(squares / max(len(numbers) - 1, 1))
