"""The facts of a scan for `holosplat info`: conditions, properties of its frames, and resources of its reconstruction.

A few frames, flats and darks are read, and no more, so that a scan of a terabyte is described as soon as a small one.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ..baselines import HolographicTV
from ..checks import InputError, UnsaidError
from ..frames import evenly
from ..geometry import Views
from ..io.angles import SAME_DEG, angles_of
from ..io.facts import Facts, keys_of
from ..io.raw_file import DARK, FLAT, INVALID, NAMES, PROJECTION, Loader, ScanFile
from ..io.reading import Reading
from ..io.stored_frames import StoredFrames, with_fields
from ..matter import MatterKind
from ..methods import Auto, Method, SmoothVolume, Surfaces
from ..methods.gaussians import Gaussians
from ..methods.window import windows_of
from ..optics.noise import NoiseModel, noise_levels, noise_share
from ..optics.sampling import fringes, on_larger_pixels
from ..preprocess import fault_of
from ..scan import Exposures, Scan
from ..tables import with_entries
from ..units import beam_named, number_of, span
from .acts import of_each_time
from .look import LOOKED, Look, looked
from .needs import (
    UNSEEN,
    Needs,
    Seen,
    Sizes,
    of_reconstruction,
    require_room,
)

FIELDS = 3
"""Flats, and darks, that are read."""
GAP, MOST_GAPS = 1.5, 4
"""Steps between neighbouring angles from which on there is a gap, and gaps that are named."""
OPTIONS = {"energy_kev": "energy-kev", "distance": "distance", "pixel_size": "pixel-size", "angles_deg": "angles"}
"""Names of what an option can say, and of the option."""
OPTICS = ("energy_kev", "distance", "pixel_size")
KINDS: dict[MatterKind, str] = {"levels": "closed bodies", "continuous": "continuous matter"}
UNKNOWN = "not known"

Opened = tuple[Scan, ScanFile | None]
"""A scan, and the file that it is of; None for formats whose frames are corrected."""
Unsaid = Mapping[str, str]
"""What neither files nor options say, and the sentence about it."""


@dataclass(frozen=True)
class ScanFacts:
    """The facts of a scan. scan: read with stand-ins for what is `unsaid`; look: at its frames `numbers`."""

    facts: Facts
    scan: Scan
    look: Look
    numbers: np.ndarray
    unsaid: tuple[str, ...]


def facts_of_scan(loader: Loader, path: Path, reading: Reading) -> ScanFacts:
    """Describe the scan at `path`. Errors: `InputError` for faults that stop its reading and that no option mends."""
    stand_ins, unsaid = dict[str, Any](), dict[str, str]()
    while True:
        try:
            given = stand_ins | reading.told.given(loader.takes)
            with _silent(bool(stand_ins)), _opened(loader, path, given) as opened:
                return _facts(path, reading, loader, opened, unsaid)
        except UnsaidError as error:
            new = {name: value for name, value in error.stand_ins.items() if name not in stand_ins}
            if not new:
                raise
            stand_ins |= new
            unsaid |= dict.fromkeys(new, str(error))


@contextmanager
def _silent(silent: bool) -> Iterator[None]:
    """Without the notes of readers, which would be on stand-ins."""
    logger = logging.getLogger("holosplat")
    before = logger.disabled
    logger.disabled = before or silent
    try:
        yield
    finally:
        logger.disabled = before


@contextmanager
def _opened(loader: Loader, path: Path, given: Mapping[str, Any]) -> Iterator[Opened]:
    """The scan with at most `FIELDS` flats and darks, the others being invalid."""
    if loader.opens is None:
        yield loader.read(path, given), None
        return
    with loader.opens(path, given) as file:
        kinds = file.kinds.copy()
        for kind in (FLAT, DARK):
            numbers = file.numbers(kind)
            kinds[np.setdiff1d(numbers, numbers[evenly(len(numbers), FIELDS)])] = INVALID
        few = with_fields(replace(file, kinds=kinds), given)
        yield Scan.of(StoredFrames.of(few), few.exposures, few.is_test, few.provenance(), few.divided), file


def _facts(path: Path, reading: Reading, loader: Loader, opened: Opened, unsaid: Unsaid) -> ScanFacts:
    scan, file = reading.applied(opened[0]), opened[1]
    numbers = evenly(len(scan), LOOKED)
    own = reading.applied(opened[0], joined=False) if "heightened" in scan.provenance else scan
    look = looked(np.asarray(own.source[numbers]))
    rows = {"what": f"a scan: {loader.mark} ({loader.name})"} | keys_of(path) | _frames(scan, file)
    rows |= _beam(scan.exposures, unsaid) | _angles(scan, file, unsaid)
    likeness = None if "angles_deg" in unsaid else opposite_likeness(own.views[numbers], look.frames)
    if likeness is not None:
        rows["half a turn on"] = (
            f"frames are mirrored about this axis: correlation {likeness:.2f} (1 where it is right)"
        )
    rows |= look.rows()
    if look.is_light and unsaid.keys().isdisjoint(OPTICS):
        rows["fringes"] = look.fringes(fringes(scan.exposures) / scan.views.pixel_sizes)
    if look.is_light and not unsaid:
        rows |= _needs(scan, numbers)
    missing = list(dict.fromkeys(unsaid.values()))
    if not look.is_light:
        missing.append(
            f"{path} must hold intensities, which are above 0, but its level is {look.level:.4g}; of the slices of a "
            "volume, `holosplat simulate` makes frames (--voxel-size)."
        )
    elif fault := fault_of(look.level):
        missing.append(f"{path}: {fault}")
    words = ["holosplat reconstruct", shlex.quote(str(path)), *_options(reading)]
    words += [f"--{OPTIONS.get(name, name)} …" for name in unsaid]
    more = " ".join([*words, *["--motion each"] * scan.is_series, "--out run"])
    matter = "not in the file; --material NAME or --delta-beta RATIO says it, else δ/β is estimated"
    facts = Facts(rows | {"material": matter}, tuple(missing), (more,) if look.is_light else ())
    return ScanFacts(facts, scan, look, numbers, tuple(unsaid))


def _options(reading: Reading) -> list[str]:
    """Metadata overrides and the selected part of a scan, as options of a command."""
    options = {f"--{name.replace('_', '-')}": value for name, value in reading.as_table().items()}
    return [name if value is True else f"{name} {shlex.quote(str(value))}" for name, value in options.items()]


def _frames(scan: Scan, file: ScanFile | None) -> dict[str, str]:
    h, w = scan.views.shape
    counts = [f"{number_of(len(scan), 'projection')} of {h} × {w} pixels (rows × columns)"]
    if file is not None:
        for kind, name in ((FLAT, "flat"), (DARK, "dark")):
            counts += [number_of(len(file.numbers(kind)), name)] if len(file.numbers(kind)) else []
        left = len(file.numbers(INVALID))
        counts += [f"{left} left out"] if left else []
    held_out = int(scan.is_test.sum())
    counts += [f"{held_out} held out of the fit"] if held_out else []
    rows = {"frames": ", ".join(counts)}
    if file is not None and file.mask().any():
        rows["defective pixels"] = f"{int(file.mask().sum())}, as the file marks them"
    if scan.is_series:
        times, each = scan.instants, number_of(len(scan) // len(scan.instants), "frame")
        rows["times"] = f"{len(times)} from {times[0]:.4g} to {times[-1]:.4g} s, {each} each"
    return rows


def _beam(exposures: Exposures, unsaid: Unsaid) -> dict[str, str]:
    values = {
        "distance": f"{span(exposures.distance)} m",
        "pixel_size": f"{span(1e6 * exposures.views.pixel_sizes)} µm",
    }
    rows = dict([beam_named(exposures.energy_kev)]) if "energy_kev" not in unsaid else {NAMES["energy_kev"]: UNKNOWN}
    rows |= {NAMES.get(name, name): UNKNOWN if name in unsaid else text for name, text in values.items()}
    if exposures.views.sources is not None:
        rows["source"] = f"{span(exposures.views.sources)} m before the object, whose rays are a cone"
    if exposures.psf_sigma_px.any():
        rows["blur"] = f"standard deviation {span(exposures.psf_sigma_px)} pixels"
    if exposures.bandwidth.any():
        rows["bandwidth"] = f"{span(exposures.bandwidth)} of the energy, full width at half maximum"
    return rows


def _angles(scan: Scan, file: ScanFile | None, unsaid: Unsaid) -> dict[str, str]:
    """Range, steps and gaps of the angles, the files or frames of the first and the last, and the axis."""
    angles = angles_of(scan.views)
    if "angles_deg" in unsaid:
        return {"angles": UNKNOWN}
    if len(scan) == 1:
        return {}
    if angles is None:
        return {"angles": f"{len(scan)} views that do not turn about one vertical axis"}
    whole = file is not None and len(file.exposures) == len(scan)
    names = [file.name(int(n)) for n in file.numbers(PROJECTION)[[0, -1]]] if whole and file else ["first", "last"]
    turned = np.rad2deg(np.unwrap(np.deg2rad(angles)))
    turned = turned if len(np.unique(np.sign(np.diff(turned)))) == 1 else angles  # of frames in another order
    ends = f"{names[0]} at {turned[0]:.5g}°, {names[1]} at {turned[-1]:.5g}°"
    rows = {"angles": f"{turned.min():.5g}° to {turned.max():.5g}°; {ends}"}
    steps = np.diff(np.unique(turned.round(4)))
    if len(steps):
        step = float(np.median(steps))
        places = np.flatnonzero(steps > GAP * step)
        low = np.unique(turned.round(4))
        gaps = ", ".join(f"{low[n]:.5g}° to {low[n + 1]:.5g}°" for n in places[:MOST_GAPS])
        named = f"{number_of(len(places), 'gap')}: {gaps}" if len(places) else "no gaps"
        rows["steps"] = f"{step:.4g}°, {named}"
    columns = 0.5 * (scan.views.shape[1] - 1) - scan.views.shifts[:, 0] / scan.views.pixel_sizes
    rows["axis"] = f"column {span(columns)} of {scan.views.shape[1]} (--axis-column; holosplat align --axis-only)"
    return rows


def opposite_likeness(views: Views, frames: np.ndarray) -> float | None:
    """Correlation of a frame of `frames` [K, H, W] with the mirrored one half a turn on; None without such two."""
    angles = angles_of(views)
    if angles is None or not views.has_one_pixel:
        return None
    pairs = combinations(range(len(angles)), 2)
    rows = views.shifts[:, 1] / views.pixel_size
    level = (p for p in pairs if round(rows[p[1]] - rows[p[0]]) == 0)
    pair = next((p for p in level if abs((angles[p[1]] - angles[p[0]]) % 360 - 180) < SAME_DEG), None)
    if pair is None:
        return None
    columns = np.arange(views.shape[1])
    axis = 0.5 * (len(columns) - 1) - views.shifts[list(pair), 0].mean() / views.pixel_size
    opposite = 2 * axis - columns
    both = (opposite >= 0) & (opposite <= len(columns) - 1)
    one = frames[pair[0]][:, both]
    other = np.stack([np.interp(opposite[both], columns, row) for row in frames[pair[1]]])
    if not both.any() or not np.ptp(one) or not np.ptp(other):
        return None
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def _needs(scan: Scan, numbers: np.ndarray) -> dict[str, str]:
    """Estimate resources of `reconstruct` for closed bodies and for continuous matter, from the frames `numbers`."""
    train = scan.train()
    if scan.is_series:
        needs = of_each_time(train.exposures, Auto(), None)
        return {"each time": needs.line()} if needs else {}
    few = scan.with_split(np.zeros(len(scan), dtype=bool))[numbers].in_memory()
    seen = seen_of(few, Auto())
    windows = seen.windows and replace(seen.windows, views=len(train))
    rows = {}
    for kind, name in KINDS.items():
        needs = of_reconstruction(Sizes.of(train.exposures), Auto(), kind, replace(seen, windows=windows), False)
        if needs is None:
            continue
        try:
            require_room(needs, Path.cwd(), smaller(train.exposures, Auto(), kind))
            rows[name] = needs.line()
        except InputError as error:  # says what would fit
            rows[name] = str(error)
    return rows


MOST_PIXELS = 100_000_000
"""Of all frames that are looked at: more take longer than an estimate is worth."""


def can_be_seen(scan: Scan) -> bool:
    """Whether the frames of `scan` are few enough to be looked at before all else."""
    rows, columns = scan.views.shape
    return 0 < len(scan) * rows * columns <= MOST_PIXELS


def seen_of(scan: Scan, method: Method, whole: bool = False) -> Seen:
    """Measure the training frames of `scan`, if they are few and of one time. Noise counts as white, and light as even:
    in other light windows hold whole frames. whole: whether a run works on whole frames in any case (free poses)."""
    if not can_be_seen(scan) or scan.is_series:
        return UNSEEN
    scan = scan.train().in_memory()
    noise = NoiseModel.white_only(noise_levels(scan.measured), scan.views.shape)
    windows = None if whole else windows_of(scan, noise)
    worked = scan if windows is None else windows.of(scan)
    gaussians, noisy = getattr(method, "gaussians", None), False
    if isinstance(gaussians, Gaussians):  # on the pixels that surfaces begin on (`methods.first_surfaces`)
        factor = gaussians.coarse.factor(worked.views.shape)
        noisy = noise_share((worked.binned(factor) if factor > 1 else worked).measured) > gaussians.volume.noisy
    return Seen(None if windows is None else Sizes.of(worked.exposures), noisy)


BINNINGS, FEWEST_COLUMNS = range(2, 9), 11
"""What is tried for --bin, and columns that must be left."""


def smaller(exposures: Exposures, method: Method, matter: MatterKind | None) -> Iterator[tuple[str, Needs]]:
    """The same reconstruction on larger voxels in the start, and on larger pixels; how, and what it takes then."""
    flag, coarse = "", method  # none where the method has no such start
    start = getattr(method, "volume", None)
    if isinstance(start, HolographicTV) and not isinstance(method, SmoothVolume):
        flag, coarse = "--set volume.refine=1", with_entries(method, {"volume": replace(start, refine=1)})
    elif isinstance(method, Auto | Surfaces):
        gaussians = replace(method.gaussians, volume=replace(method.gaussians.volume, refine=1))
        flag, coarse = "--set gaussians.volume.refine=1", replace(method, gaussians=gaussians)
    for factor in (1, *BINNINGS):
        if factor > 1 and exposures.views.shape[1] // factor < FEWEST_COLUMNS:
            return
        sizes, bins = Sizes.of(exposures, factor), f"--bin {factor}" if factor > 1 else ""
        for how, tried in ((bins, method), (f"{bins} {flag}".strip(), coarse)):
            needs = of_reconstruction(sizes, tried, matter)
            if needs is not None and how:
                yield how, needs


def coarser(exposures: Exposures, of: Callable[[Exposures], Needs | None]) -> Iterator[tuple[str, Needs]]:
    """What `of` says of the same frames on larger pixels; how, and what it takes then."""
    for factor in BINNINGS:
        if exposures.views.shape[1] // factor < FEWEST_COLUMNS:
            return
        if (needs := of(on_larger_pixels(exposures, factor))) is not None:
            yield f"--bin {factor}", needs
