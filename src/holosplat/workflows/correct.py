"""From raw counts to a scan of relative intensities, frame by frame: the file may be larger than memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..checks import require
from ..frames import Derived, Taken, evenly
from ..io.atomic import require_apart, require_writable
from ..io.formats import loader_of, open_raw
from ..io.nxtomo import scan_writer
from ..io.odd_light import Beside
from ..io.raw_file import DARK, FLAT, PROJECTION, ScanFile
from ..io.reading import Reading
from ..optics.air import Box
from ..preprocess import (
    EigenFlats,
    PixelRepair,
    TotalVariationWeights,
    defective_pixels,
    eigen_flats,
    fixed_pattern,
    relative_intensity,
)
from ..preprocess.pixels import MOST_DEFECTS, filled
from ..progress import Advance
from ..ranges import Natural, checked_dataclass
from ..scan import Scan
from .run_illumination import AirLight, Look

RIM = 0.05
"""Width of a frame's rim, as a part of its shorter side, that `normalise = "rim"` takes to be free of the object."""

Method = Literal["dynamic", "plain"]
Normalise = Literal["air", "mean", "rim", "none"]

LOOKED_AT = 16
"""Frames that are looked at for the level of their air, at most."""
FAR = 0.1
"""How far light may be off the flat field in all frames, where flats do not differ by more: else matter did it."""
ENOUGH_FLATS = 3
"""Flats that the dynamic method needs."""


@checked_dataclass
class CorrectionOptions:
    """How raw frames are corrected."""

    method: Method | None = None
    """dynamic: a flat field for each frame, from the flats' principal components; plain: the mean flat field (default:
    dynamic with three flats or more)."""
    normalise: Normalise | None = None
    """What is brought to 1 in each frame: its air, by a smooth factor, its mean, its rim, or nothing (default: the air
    where it is uneven beyond its noise; the mean where flats change, and neither air nor a border brighter than the
    rest is seen; else, and where that is farther off 1 than flats differ, nothing)."""
    air: tuple[Box, ...] = ()
    """Boxes without matter in any frame: first row, end row, first column, end column (default: found)."""
    rings: int | None = None
    """Take out what all projections have in common in details finer than this odd number of columns, such as 5: noise
    and dust of few flats, which make rings. Lines of the object along its axis go, too (default: nothing)."""
    components: Natural | None = None
    """Most principal components (default: as many as stand out of the noise)."""
    binning: Natural | None = None
    """Pixels are averaged this many by this many to find their weights (default: 8, less for small frames)."""

    def __post_init__(self) -> None:
        goes = not self.air or self.normalise in (None, "air")
        require(goes, f"--air goes with --normalise air, but this is {self.normalise}; leave one of them.")
        for name in ("components", "binning"):
            value = getattr(self, name)
            require(value is None or self.method != "plain", f"{name} goes with the method dynamic; leave it.")


@dataclass(frozen=True)
class Corrected:
    """What was corrected: frames; defective pixels that the file marks, and that were found beside; components used;
    the method; flats in the file; what was normalised; projections without air, which took the others' mean light; the
    pattern (rms) of what all frames had in common, if that was taken out; least and greatest number that a frame was
    divided by; level of the air in what was written, None where none was found."""

    frames: int
    marked: int
    found: int
    components: int
    method: Method = "dynamic"
    flats: int = 0
    normalised: Normalise = "none"
    airless: int = 0
    rings: float = 0.0
    divided: tuple[float, float] = (1.0, 1.0)
    air: float | None = None


class FlatFielding:
    """The dark and flat fields of a raw file, made ready: a number of a projection in, relative intensity out."""

    def __init__(self, file: ScanFile, options: CorrectionOptions, on_progress: Advance) -> None:
        self.file, self.options = file, options
        darks, self._flats = file.numbers(DARK), file.numbers(FLAT)
        self.flats, self.brightness = len(self._flats), np.ones(1)
        self.method: Method = options.method or ("dynamic" if self.flats >= ENOUGH_FLATS else "plain")
        dynamic = self.method == "dynamic"
        enough = self.flats >= (ENOUGH_FLATS if dynamic else 1)
        wanted = "at least three flats for the dynamic method" if dynamic else "flats (image_key 1)"
        remedy = "take --method plain" if dynamic and self.flats else "add --flats"
        require(enough, f"{file.path} must hold {wanted}, but it holds {self.flats or 'none'}; {remedy}.")
        dark, noise = _mean_and_noise(file, darks)
        self.marked = file.mask()
        mean_flat = file.mean(FLAT)
        found = self.marked | defective_pixels(dark, noise, mean_flat)
        self.found = int((found & ~self.marked).sum())
        share = found.mean()
        require(
            share <= MOST_DEFECTS,
            f"{file.path}: {share:.0%} of the pixels are defective by its darks and flats; check its image_key.",
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
        return self.with_missing(number)[0]

    def with_missing(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """The same, and its pixels [H, W] bool without a value of their own."""
        raw, mask = self.file.frame(number), self.repair.mask
        lost = ~np.isfinite(raw) & ~mask
        if lost.any():
            raw = filled(self.file.label, raw[None], lost[None], mask, np.array([number]))[0][0]
        else:
            raw = self.repair(raw)
        bright = raw.mean() > self.dark.mean()
        require(bool(bright), f"{self.file.path}: frame {number} is as dark as the dark ones; mark it invalid (3).")
        return relative_intensity(raw, self.dark, self.flat_field(raw)), lost | mask

    def flat_field(self, raw: np.ndarray) -> np.ndarray:
        """The flat field less the dark one, [H, W] counts, for a frame of counts `raw` [H, W] already repaired."""
        if self.eigen is None or self._weights is None:
            return self.light
        return self.eigen.light(self._weights(raw - self.dark))

    def _eigen_flats(self) -> EigenFlats:
        """Principal components of the flats, read twice by rows and once whole for their means and repairs."""
        flats, places = self._flats, self.repair.places
        repaired, brightness = np.empty((len(flats), len(places))), np.empty(len(flats))
        for i, n in enumerate(flats):
            raw = self.file.frame(n)
            repaired[i] = self.repair.values(raw)
            brightness[i] = (self.repair(raw) - self.dark).mean()
        require(bool((brightness > 0).all()), f"{self.file.path} has flats without light; mark them invalid (3).")
        self.brightness = brightness / brightness.mean()
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
    reading: Reading = Reading(),
) -> Corrected:
    """Correct the raw counts in the file `source` by its flats and darks, and write the scan file `out`.

    options: flat-field method, normalisation, and ring removal
    reading: values that the file lacks, and the part of it to take

    One frame is in memory at a time. Defective pixels, marked in the file or found in its darks and flats, are filled
    from their neighbours and marked in the result; frames are turned upright, corrected as a whole, and then
    cut. The result counts frames, defective pixels and components. Errors: `InputError` for a file without flats, for
    too many defective pixels, and where `out` cannot be written.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> from holosplat.beamline.record import record
        >>> hs.write_scan("scan.nxs", scan)
        >>> options = hs.beamline.RecordingOptions(flats=10, darks=4)
        >>> raw = record("scan.nxs", "raw.nxs", options, hs.optics.Camera(), hs.optics.Illumination())
        >>> done = hs.correct("raw.nxs", "corrected.nxs")
        >>> done.frames, done.flats, done.method
        (8, 10, 'dynamic')
        >>> hs.read("corrected.nxs")
        Scan(8 frames of 16 × 16 pixels, 2 of them held out)
    """
    require_writable(out)
    require_apart(out, source)
    reading.told.vouch(Path(source))
    with open_raw(source, reading.told.given(loader_of(source).takes)) as file:
        fielding = FlatFielding(file, options, on_progress)
        count = 0 if fielding.eigen is None else len(fielding.eigen)
        marked = int(fielding.marked.sum())
        normal = Normalisation(fielding, options)
        on_progress(0.5)
        described = {
            "corrected": fielding.method if fielding.eigen is None else f"dynamic, {count} components",
            "normalised": normal.what,
            "defective_pixels": f"{marked} marked, {fielding.found} found",
        }
        if options.rings is not None:
            described["rings"] = f"{options.rings} columns, {normal.pattern.std():.3%} (rms)"
        frames, doubt = _Corrected.of(fielding, normal), normal.light and normal.light.doubt
        whole = Scan.of(frames, file.exposures, file.is_test, file.provenance() | described, doubt)
        scan = reading.applied(whole, joined=False)
        everywhere = replace(frames, are_alike=True)
        lacks = reading.applied(Scan.of(everywhere, file.exposures, file.is_test, {}), joined=False)[[0]].missing
        kept = {"light": scan.light, "mask": None if lacks is None else lacks[0]}
        with scan_writer(out, scan.exposures, scan.is_test, scan.provenance, **kept) as add:
            shown = evenly(len(scan), LOOKED_AT)
            written = []
            for i in range(len(scan)):
                one = scan[[i]]
                add(one.frames[0], None if one.missing is None else one.missing[0])
                written += [one.frames[0]] if i in shown else []
                on_progress(0.5 + 0.5 * (i + 1) / len(scan))
            normal.beside.tell()
    airless = normal.light.airless if normal.light else 0
    found = (marked, fielding.found, count, fielding.method, fielding.flats, normal.what, airless)
    air = Look.at(lambda i: written[i].astype(np.float64), len(written)).air()
    return Corrected(len(scan), *found, float(normal.pattern.std()), normal.divided, air)


class Normalisation:
    """What is brought to 1 in each frame, by `options`; what: its name; light: by air, where that is it; pattern: the
    faults [H, W] of all frames that are divided out, too; divided: least and greatest number of what frames were;
    beside: the frames before, beside each other."""

    def __init__(self, fielding: FlatFielding, options: CorrectionOptions) -> None:
        """Looks at all projections once where air may be found; `InputError` where it is asked for in vain."""
        self._path, wanted, numbers = fielding.file.path, options.normalise, fielding.file.numbers(PROJECTION)
        self._numbers, still = numbers, len(np.unique(fielding.file.exposures.time)) == 1
        self.beside = Beside(fielding.file.label, still, fielding.light)
        self._flats = fielding.brightness
        self.light: AirLight | None = None
        self.divided = (np.inf, 0.0)
        asked, look = wanted == "air" or bool(options.air), None
        if asked or wanted is None:
            look = Look.at(lambda i: fielding(int(numbers[i])), len(numbers))
            self.light = AirLight.of(look, options.air, asked)
        require(
            not asked or self.light is not None,
            f"{self._path}: no projection shows air; give boxes of it by --air, or take --normalise mean.",
        )
        changes = fielding.eigen is not None and len(fielding.eigen) > 0
        matter = look is not None and (look.air() is not None or look.has_bright_border())
        if self.light and look and not asked and not look.has_matter_beside_air():
            small = (look.frames.shape[1], look.frames.shape[2])
            levels = [self.light.factor(i, small).mean() for i in range(len(look.frames))]
            self.light = None if self._is_dimmed(levels) else self.light
        matter = matter or (look is not None and self._is_dimmed(look.frames.mean(axis=(1, 2))))
        otherwise: Normalise = "mean" if changes and not matter else "none"
        self.what: Normalise = "air" if self.light else wanted or otherwise
        self.pattern = np.ones((1, 1))
        if options.rings is not None:
            self.pattern = fixed_pattern(
                lambda i: self._evened(i, fielding(int(numbers[i]))), len(numbers), options.rings
            )

    def _is_dimmed(self, levels: Sequence[float] | np.ndarray) -> bool:
        """Whether the levels [V] of all frames are farther off 1 than `FAR`, and than flats differ: by matter, then."""
        low, high = min(1 - FAR, *self._flats), max(1 + FAR, *self._flats)
        return bool(np.max(levels) < low or np.min(levels) > high)

    def __call__(self, number: int, frame: np.ndarray) -> np.ndarray:
        """The frame [H, W] of projection `number`, normalised."""
        self.beside.add(int(self._numbers[number]), frame)
        return self._evened(number, frame) / self.pattern

    def _evened(self, number: int, frame: np.ndarray) -> np.ndarray:
        if self.light is not None:
            factor = self.light.factor(number, (frame.shape[0], frame.shape[1]))
            return self._divided(frame, factor, float(factor.mean()))
        if self.what == "none":
            return self._divided(frame, np.ones(()), 1.0)
        counted = np.ones(frame.shape, dtype=bool)
        if self.what == "rim":
            width = max(1, round(RIM * min(frame.shape)))
            counted[width:-width, width:-width] = False
        level = float(frame[counted].mean())
        require(level > 0, f"{self._path} has a projection whose rim is dark; normalise by its mean.")
        return self._divided(frame, np.array(level), level)

    def _divided(self, frame: np.ndarray, by: np.ndarray, level: float) -> np.ndarray:
        self.divided = (min(self.divided[0], level), max(self.divided[1], level))
        return frame / by


@dataclass(frozen=True)
class _Corrected(Derived):
    """The projections of an open raw file, corrected when they are read; are_alike: without the pixels that are missing
    in some of them alone."""

    fielding: FlatFielding
    normal: Normalisation
    numbers: np.ndarray
    shape: tuple[int, int, int]
    are_alike: bool = False

    @classmethod
    def of(cls, fielding: FlatFielding, normal: Normalisation) -> _Corrected:
        numbers = fielding.file.numbers(PROJECTION)
        return cls(fielding, normal, numbers, (len(numbers), fielding.dark.shape[0], fielding.dark.shape[1]))

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        read = [self.fielding.with_missing(int(self.numbers[i])) for i in numbers]
        frames = np.stack([self.normal(int(i), frame) for i, (frame, _) in zip(numbers, read)])
        missing = np.stack([self.fielding.repair.mask if self.are_alike else lost for _, lost in read])
        return frames.astype(np.float32), missing if missing.any() else None


def _mean_and_noise(file: ScanFile, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation [H, W] of the frames `numbers`; zeros where there are none, or one for the latter."""
    mean, squares = np.zeros(file.exposures.views.shape), np.zeros(file.exposures.views.shape)
    for count, n in enumerate(numbers, start=1):  # Welford 1962
        frame = file.frame(n)
        step = frame - mean
        mean += step / count
        squares += step * (frame - mean)
    return mean, np.sqrt(squares / max(len(numbers) - 1, 1))
