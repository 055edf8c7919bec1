"""Scans from and to the folders of R²-Gaussian (Zha et al. 2024): line integrals on angles about one axis.

That program does absorption tomography, so its images are line integrals and no holograms: the written line integrals
are retrieved from the frames, and line integrals that are read become the transmission of an absorber in contact with
the detector. Only the layout and the conventions of its files are used here, in parallel beam; docs/converting.md has
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from holosplat.checks import InputError, finite, in_range, positive, require, shaped
from holosplat.geometry import Grid, Views
from holosplat.io.atomic import atomic_folder, write_json
from holosplat.io.formats import read_volume_file
from holosplat.io.guard import read_array
from holosplat.io.raw_file import Loader, Retrieved, Writer, folder_with, require_said
from holosplat.io.table import Table, beam_table, exposure_table, read_own_exposures
from holosplat.ranges import Natural, checked_dataclass
from holosplat.scan import ENERGY_RANGE_KEV, PIXEL_RANGE_M, Exposures, Scan
from holosplat.units import wavenumber
from holosplat.volume import Volume

from .nerf_synthetic import hull_points

FORMAT = "holosplat R2-Gaussian 1"
META = "meta_data.json"
SPLITS = ("proj_train", "proj_test")
WORLD = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""`x_world = WORLD x_obj`: at angle 0 its beam runs along -x, columns along y, rows along -z; its axis is z."""
SEED_DENSITY = 0.15
"""Density of the points to start from, of a material of 1: they overlap (the default of its own script)."""


@checked_dataclass
class R2Options:
    """Options of the folder."""

    truth: Volume | None = None
    """The true volume, with which that program scores its reconstruction (default: zeros)."""
    seed_points: Natural = 50_000
    """Number of points to start from."""


@dataclass(frozen=True)
class _Square:
    """The square image that a frame of `shape` (H, W) is padded to: it covers [-1, 1]² of the scene.

    side [pixels]; top, left: where the frame begins. Columns are padded evenly, so that the axis stays in the
    middle; rows by one more below, where need be, which moves the scene along the axis.
    """

    shape: tuple[int, int]

    @property
    def side(self) -> int:
        h, w = self.shape
        return max(h, w) + (max(h, w) - w) % 2

    @property
    def corner(self) -> tuple[int, int]:
        return (self.side - self.shape[0]) // 2, (self.side - self.shape[1]) // 2

    def middle(self, views: Views) -> float:
        """The object's y [m] in the middle of the square."""
        rows = 0.5 * self.side - self.corner[0] - 0.5 * self.shape[0]
        return rows * views.pixel_size + float(views.shifts[0, 1])


def write_r2_gaussian(
    path: str | Path, scan: Scan, thickness: np.ndarray, delta: float, options: R2Options = R2Options()
) -> None:
    """Write line integrals of the scan's views as R²-Gaussian reads them, in scene units ([-1, 1]³ holds the field).

    thickness: [N, H, W] projected thickness [m] of a material with `delta`, so that its density in the scene is 1.
    The views must turn about y, with no shift of the axis. vol_gt.npy holds the truth, or zeros where there is none.
    """
    shaped("thickness", finite("thickness", thickness), scan.frames.shape)
    positive("delta", delta)
    views, square = scan.views, _Square(scan.views.shape)
    require(
        views.shares_axis,
        "R²-Gaussian has one angle a view about one axis, but these views turn about others or shift along it; "
        "choose another format.",
    )
    aside = np.abs(views.shifts[:, 0]).max() / views.pixel_size
    require(
        bool(aside < 1e-3),
        f"R²-Gaussian has its rotation axis in the middle of the detector, but it lies up to {aside:.3g} pixels "
        "beside it (shifts); resample the frames first.",
    )
    unit = 0.5 * square.side * views.pixel_size
    meta = _meta(scan, square, unit, delta)
    train = np.flatnonzero(~scan.is_test)
    truth = _true_density(options.truth, views, square, delta)
    points = hull_points(thickness[train], views[train], options.seed_points)
    points = (points - [0.0, square.middle(views), 0.0]) @ WORLD.T / unit
    (top, left), (h, w) = square.corner, views.shape
    with atomic_folder(path) as folder:
        for split, numbers in zip(SPLITS, (train, np.flatnonzero(scan.is_test))):
            (folder / split).mkdir()
            for k, n in enumerate(numbers.tolist()):
                name = f"{split}/{split}_{k:04d}.npy"
                image = np.zeros((square.side, square.side), np.float32)
                image[top : top + h, left : left + w] = thickness[n] / unit
                np.save(folder / name, image)
                exposure = {"index": n, **exposure_table(scan.exposures, n)}
                meta[split].append({"file_path": name, "angle": _angle(views, n), "holosplat": exposure})
        np.save(folder / "vol_gt.npy", truth)
        start = np.column_stack([points, np.full(len(points), SEED_DENSITY)])
        np.save(folder / f"init_{Path(path).name}.npy", start.astype(np.float32))
        write_json(folder / META, meta)


def read_r2_gaussian(path: str | Path, energy_kev: float | None = None, pixel_size: float | None = None) -> Scan:
    """A folder of R²-Gaussian as frames `exp(-p)` of line integrals p, in contact: a density of 1 is an absorber with μ
    = 1 per unit of length, β = μ / 2k. energy_kev, pixel_size [m]: for folders of other programs."""
    meta = Table.read(Path(path) / META)
    own = "holosplat" in meta
    given = energy_kev is not None or pixel_size is not None
    require(not (own and given), f"{path} says itself how it was taken; leave away the energy and the pixel size.")
    scanner = meta.table("scanner")
    if scanner.text("mode") != "parallel":
        raise InputError(
            f"{scanner.label('mode')} must be 'parallel', but it is {scanner.text('mode')!r}: beams are parallel here, "
            "and a cone's magnification changes with depth; resample the projections to parallel ones first."
        )
    splits = [meta.tables(split) if split in meta else [] for split in SPLITS]
    require(len(splits[0]) > 0, f"{meta.label(SPLITS[0])} must hold at least one projection, but it holds none.")
    entries = [entry for split in splits for entry in split]
    lines = _projections(entries, scanner.counts("nDetector", (2,)))
    is_test = np.arange(len(entries)) >= len(splits[0])
    if own:
        return _own_scan(meta, entries, lines, is_test)
    require_said(str(path), TAKES if energy_kev is None or pixel_size is None else ())
    assert energy_kev is not None
    assert pixel_size is not None
    in_range("energy", energy_kev, *ENERGY_RANGE_KEV, unit="keV")
    in_range("pixel size", pixel_size, *PIXEL_RANGE_M, unit="metres")
    angles = [entry.number("angle") for entry in entries]
    h, w = lines.shape[1:]
    views = Views.from_angles(np.rad2deg(angles), (h, w), pixel_size)
    unit = pixel_size / _pitch(scanner, (h, w))
    return _absorber(lines, Exposures.of(views, energy_kev, 0.0), is_test, unit, {})


def _angle(views: Views, n: int) -> float:
    """The angle [rad] of view `n`, which is the same in both conventions."""
    return float(np.arctan2(views.rotations[n, 0, 2], views.rotations[n, 0, 0]))


def _meta(scan: Scan, square: _Square, unit: float, delta: float) -> dict[str, Any]:
    """meta_data.json without its projections: the scanner, and (under `holosplat`) the conversion to metres."""
    angles = np.rad2deg([_angle(scan.views, n) for n in range(len(scan))])
    scanner: dict[str, Any] = {"mode": "parallel", "filter": None, "DSD": 7.0, "DSO": 5.0}
    scanner |= {"nDetector": [square.side] * 2, "sDetector": [2.0] * 2, "dDetector": [2.0 / square.side] * 2}
    scanner |= {"nVoxel": [square.side] * 3, "sVoxel": [2.0] * 3, "dVoxel": [2.0 / square.side] * 3}
    scanner |= {"offOrigin": [0.0] * 3, "offDetector": [0.0] * 2, "accuracy": 0.5}
    scanner |= {"startAngle": float(angles.min()), "totalAngle": float(np.ptp(angles)), "noise": False}
    ours = {
        "format": FORMAT,
        "count": len(scan),
        "shape": list(square.shape),
        "corner": list(square.corner),
        "metres_per_unit": unit,
        "delta": delta,
        **beam_table(scan),
    }
    empty: dict[str, Any] = {split: [] for split in SPLITS}
    box = [[-1.0] * 3, [1.0] * 3]
    return {"scanner": scanner, "vol": "vol_gt.npy", "bbox": box, **empty, "holosplat": ours}


def _true_density(truth: Volume | None, views: Views, square: _Square, delta: float) -> np.ndarray:
    """The density [x, y, z] float32 of their world: δ of the truth over `delta`, padded as the frames are."""
    density = np.zeros((square.side,) * 3, np.float32)
    if truth is None:
        return density
    wanted, found = Grid.of_views(views), truth.grid
    same = found.shape == wanted.shape and all(
        np.allclose(a, b, rtol=0, atol=1e-3 * views.pixel_size)
        for a, b in ((found.origin, wanted.origin), (found.voxel_size, wanted.voxel_size))
    )
    require(same, f"the truth must be on the grid of the field of view, {wanted}, but it is on {found}.")
    (top, left), (h, w) = square.corner, square.shape
    density[left : left + w, top : top + h, left : left + w] = truth.delta / delta
    return np.ascontiguousarray(density[::-1, ::-1].transpose(0, 2, 1))


def _projections(entries: list[Table], shape: tuple[int, ...]) -> np.ndarray:
    """Line integrals [N, H, W] float32 of the files that the entries name."""
    images = []
    for entry in entries:
        file = entry.file("file_path")
        image = read_array(file, "an array of numbers")
        require(image.dtype.kind in "iuf", f"{file} must hold numbers, but its type is {image.dtype}.")
        images.append(finite(str(file), shaped(str(file), image, shape)).astype(np.float32))
    return np.stack(images)


def _pitch(scanner: Table, shape: tuple[int, int]) -> float:
    """The pixels' edge in the file's unit of length; `InputError` unless the detector covers the volume's cube without
    an offset: the layout's two readers take other geometries differently."""
    edges = scanner.numbers("sDetector", (2,)) / shape
    cube = scanner.numbers("sVoxel", (3,)).max()
    even = bool(np.allclose(edges, edges[0], rtol=1e-3) and np.allclose(edges * shape, cube, rtol=1e-3))
    require(
        even and edges[0] > 0,
        f"{scanner.label('sDetector')} must be square and as large as the volume's longest side (parallel beam), but "
        f"it is {scanner.need('sDetector')}, and sVoxel {scanner.need('sVoxel')}.",
    )
    offset = scanner.numbers("offDetector", (2,)) if "offDetector" in scanner else np.zeros(2)
    require(
        not offset.any(), f"{scanner.label('offDetector')} must be 0, but it is {offset.tolist()}; shift the images."
    )
    return float(edges[0])


def _own_scan(meta: Table, entries: list[Table], lines: np.ndarray, is_test: np.ndarray) -> Scan:
    ours = meta.table("holosplat")
    ours.require_format(FORMAT)
    (top, left), (h, w) = ours.counts("corner", (2,)), ours.counts("shape", (2,))
    fits = h > 0 and w > 0 and top + h <= lines.shape[1] and left + w <= lines.shape[2]
    require(fits, f"{ours.label('shape')} must lie within the projections, but it is ({h}, {w}) at ({top}, {left}).")
    order, exposures = read_own_exposures(ours, entries, (h, w))
    contact = replace(exposures, distance=np.array(0.0), psf_sigma_px=np.array(0.0))
    cut = lines[order, top : top + h, left : left + w]
    return _absorber(
        cut,
        contact,
        is_test[order],
        positive("metres_per_unit", ours.number("metres_per_unit"), "metres"),
        ours.texts("provenance"),
    )


def _absorber(
    lines: np.ndarray, exposures: Exposures, is_test: np.ndarray, unit: float, provenance: dict[str, str]
) -> Scan:
    """The transmission `exp(-p)` of line integrals p, and β of a density of one: μ = 1 / unit, β = μ / 2k."""
    beta = 1 / (2 * wavenumber(exposures.one_energy("an absorber's scan")) * unit)
    told = {
        "converted_from": "R2-Gaussian",
        "frames": "exp(-p) of line integrals p",
        "beta_of_density_1": f"{beta:.6g}",
    }
    return Scan(np.exp(-lines), exposures, is_test, {**provenance, **told})


TAKES = ("energy_kev", "pixel_size")


def _remark(path: Path, scan: Scan) -> str:
    return (
        f"{path} has no phase: transmission exp(-p) in contact, where a density of 1 has beta "
        f"{scan.provenance['beta_of_density_1']}; reconstruct it with --delta-beta 1, and read beta"
    )


LOADER = Loader(
    *("r2-gaussian", f"a folder with {META}", folder_with(META)),
    *(lambda path, given: read_r2_gaussian(path, *(given.get(name) for name in TAKES)), TAKES),
    remark=_remark,
)


def _convert(out: Path, scan: Scan, options: Mapping[str, Any], retrieved: Retrieved | None) -> str:
    if retrieved is None:
        raise InputError("--to r2-gaussian needs --material or --delta-beta: it takes retrieved thickness.")
    truth = options.get("truth")
    how = R2Options(**{**options, "truth": None if truth is None else read_volume_file(truth)})
    write_r2_gaussian(out, scan, *retrieved(), how)
    return ""


WRITER = Writer(_convert, ("truth", "seed_points", "material"))
