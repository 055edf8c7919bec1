"""Scans from and to the NeRF-synthetic layout (Mildenhall et al. 2020, "Blender"): PNG images and camera poses.

The layout has grey values and pinhole cameras. Entries called `holosplat` hold the rest (exact parallel geometry,
intensities, optics, times); other programs ignore them. docs/converting.md has the table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from PIL import Image

from holosplat.checks import InputError, in_range, require, shaped
from holosplat.geometry import Grid, Views
from holosplat.io.atomic import atomic_folder, write_json
from holosplat.io.guard import undamaged
from holosplat.io.raw_file import Loader, Retrieved, Writer, folder_with, require_said
from holosplat.io.table import Table, beam_table, exposure_table, read_own_exposures
from holosplat.ranges import Metres, Natural, Positive, Signed, Small, Within, checked_dataclass
from holosplat.scan import ENERGY_RANGE_KEV, PIXEL_RANGE_M, Exposures, Scan, checked_distance

FINEST = 64
"""Voxels along the longer side of the field of view in which a hull is looked for."""
SHADOW = 0.1
"""Share of the greatest thickness from which on a pixel counts as shadow."""
AGREEMENT = 0.9
"""Share of the views that must have a voxel in their shadow (one bad frame in many does no harm)."""


def uniform_points(views: Views, count: int, seed: int = 0) -> np.ndarray:
    """[count, 3] points (x, y, z) [m], even in the box that the detectors look at."""
    grid = Grid.of_views(views)
    extent = np.array(grid.voxel_size) * np.array(grid.shape[::-1])
    return grid.centre + extent * (np.random.default_rng(seed).random((count, 3)) - 0.5)


def hull_points(thickness: np.ndarray, views: Views, count: int, seed: int = 0) -> np.ndarray:
    """[count, 3] points (x, y, z) [m], evenly distributed in the visual hull of the shadows (Laurentini 1994).

    thickness: [V, H, W] retrieved line integrals of any scale; a shadow consists of the pixels above a tenth of their
    99.9th percentile. A voxel belongs to the hull if it lies in the shadow of nine tenths of the views.
    """
    shaped("thickness", thickness, (len(views), *views.shape))
    level = SHADOW * float(np.percentile(thickness, 99.9))
    require(level > 0, "the frames hold no shadow of the material; check it, or leave it away for points anywhere.")
    grid = Grid.of_views(views, refine=min(1.0, FINEST / max(views.shape)))
    z, y, x = np.meshgrid(*grid.axes()[::-1], indexing="ij")
    centres = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    dark = np.zeros(len(centres))
    for n, shadow in enumerate(thickness > level):
        inside, row, column = _pixels(centres, views, n)
        dark[inside] += shadow[row[inside], column[inside]]
    filled = np.flatnonzero(dark >= AGREEMENT * len(views))
    require(len(filled) > 0, "the views' shadows have no volume in common; check their poses, or leave the material.")
    random = np.random.default_rng(seed)
    return centres[random.choice(filled, count)] + np.array(grid.voxel_size) * (random.random((count, 3)) - 0.5)


def _pixels(points: np.ndarray, views: Views, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether view `n` sees points [P, 3] [m], and the (row, column) of the pixels [P] that they fall on."""
    lab = points @ views.rotations[n, :2].T - views.shifts[n]
    column, row = np.floor(lab / views.pixel_sizes[n] + 0.5 * np.array(views.shape[::-1])).astype(int).T
    h, w = views.shape
    return (row >= 0) & (row < h) & (column >= 0) & (column < w), row, column


PngKind = Literal["grey16", "rgba8"]
LEVELS: dict[PngKind, int] = {"grey16": 65535, "rgba8": 255}
"""The white of each kind."""


def write_png(path: Path, image: np.ndarray, kind: PngKind) -> None:
    """Write `image` [H, W], black at 0 and white at 1, rounded to the levels of `kind` and cut off beyond them."""
    levels = np.rint(np.clip(image, 0.0, 1.0) * LEVELS[kind])
    if kind == "grey16":
        Image.fromarray(levels.astype(np.uint16)).save(path, format="PNG")
    else:
        grey = Image.fromarray(levels.astype(np.uint8))
        Image.merge("RGBA", (grey, grey, grey, Image.new("L", grey.size, 255))).save(path, format="PNG")


def read_png(path: Path) -> tuple[np.ndarray, int]:
    """An image's levels [H, W] as stored, and its white: 255 or 65535. Colours must be equal and alpha opaque;
    `InputError` otherwise, or if the file is damaged."""
    with undamaged(path, "a complete PNG image"), Image.open(path, formats=("PNG",)) as image:
        mode, values = image.mode, np.asarray(image)
    if mode.startswith("I"):  # 16 bits: "I;16", and "I" in older versions of Pillow
        return values, LEVELS["grey16"]
    require(mode in ("L", "LA", "RGB", "RGBA"), f"{path} must be a grey image of 8 or 16 bits, but its kind is {mode}.")
    bands = values if values.ndim == 3 else values[..., None]
    if mode.endswith("A"):
        require(bool((bands[..., -1] == 255).all()), f"{path} must be opaque, but its alpha is not; fill it in first.")
        bands = bands[..., :-1]
    require(bool((bands == bands[..., :1]).all()), f"{path} must be grey, but it has colours; make it grey first.")
    return bands[..., 0], LEVELS["rgba8"]


FORMAT = "holosplat NeRF-synthetic 1"
TRAIN, TEST, VAL = (f"transforms_{split}.json" for split in ("train", "test", "val"))
POINTS = "points3d.ply"
MOST_TANGENT = 0.02
"""The widest cameras of others that pass for parallel, as the tangent of half their angle: so much of its distance
from the axis may a point stray, per half field of view of depth."""


@checked_dataclass
class NerfOptions:
    """Options of the folder."""

    png: PngKind = "grey16"
    """Kind of the images: 16-bit grey, or 8-bit RGBA for programs that read only this."""
    camera_distance: Annotated[float, Within(10, 1e5, unit="half fields of view")] = 100.0
    """Distance of the cameras from the origin, in half fields of view; larger ones are more parallel."""
    seed_points: Natural = 20_000
    """Number of points in points3d.ply."""


@checked_dataclass
class GivenOptics:
    """Values that folders of other programs lack."""

    energy_kev: Positive
    """Photon energy [keV]."""
    distance: Metres
    """Propagation distance [m]."""
    pixel_size: Small
    """Pixel size in the sample plane [m]."""
    black: Signed = 0.0
    """Intensity of black, relative to the flat field."""
    white: Signed = 1.0
    """Intensity of white, relative to the flat field."""

    def __post_init__(self) -> None:
        in_range("energy", self.energy_kev, *ENERGY_RANGE_KEV, unit="keV")
        checked_distance(self.distance)
        in_range("pixel size", self.pixel_size, *PIXEL_RANGE_M, unit="metres")
        good = math.isfinite(self.black) and math.isfinite(self.white) and self.black < self.white
        require(good, f"black must be below white, but they are {self.black:g} and {self.white:g}; exchange them.")


def scene_scale(views: Views) -> float:
    """Scene units per metre [1/m]: the longer side of the field of view goes from -1 to 1."""
    return 2.0 / max(views.width, views.height)


def camera_poses(views: Views, camera_distance: float) -> np.ndarray:
    """Camera-to-world matrices [V, 4, 4] in scene units, as Blender and OpenGL have cameras: x right, y up, -z ahead.

    The world is the object frame, scaled. Rows of R are the lab's axes seen from the object: right, down, along the
    beam. Each camera looks along the beam at the centre of its (shifted) detector, from `camera_distance` upstream.
    """
    right, down, beam = views.rotations.transpose(1, 0, 2)
    aside = scene_scale(views) * (views.shifts[:, :1] * right + views.shifts[:, 1:] * down)
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = right, -down, -beam
    poses[:, :3, 3] = aside - camera_distance * beam
    return poses


def grey_range(scan: Scan) -> tuple[float, float]:
    """The intensities that become black and white: least and greatest of all training frames."""
    frames = scan.train().frames
    return float(frames.min()), float(frames.max())


def write_nerf_synthetic(
    path: str | Path, scan: Scan, options: NerfOptions = NerfOptions(), thickness: np.ndarray | None = None
) -> None:
    """Write `scan` as a folder with train/ and test/ images, their transforms, and points3d.ply.

    Held-out frames have the same grey scale as training frames; intensities beyond it are cut off. thickness: [N, H, W]
    retrieved for a known material; then the points fill its visual hull, else the field of view. transforms_val.json is
    a copy of the test's: most readers ask for one. Errors: `InputError` for views of several pixel sizes, since one
    angle of view serves all cameras.
    """
    from holosplat.io.solids import write_ply  # needs torch, which takes longer than all else

    _ = scan.views.pixel_size
    views, train = scan.views, np.flatnonzero(~scan.is_test)
    low, high = grey_range(scan)
    head = {
        "format": FORMAT,
        "count": len(scan),
        "shape": list(views.shape),
        "scale_per_m": scene_scale(views),
        "camera_distance": options.camera_distance,
        "low": low,
        "high": high,
        "white": LEVELS[options.png],
        "points": "uniform" if thickness is None else "visual hull",
        **beam_table(scan),
    }
    half = 0.5 * views.width * scene_scale(views) / options.camera_distance
    poses = camera_poses(views, options.camera_distance)
    with atomic_folder(path) as folder:
        for name, numbers in ((TRAIN, train), (TEST, np.flatnonzero(scan.is_test))):
            split = name.removeprefix("transforms_").removesuffix(".json")
            (folder / split).mkdir()
            frames = []
            for k, n in enumerate(numbers.tolist()):
                path_of_image = f"{split}/r_{k:04d}"
                grey = (scan.frames[n].astype(np.float64) - low) / (high - low or 1.0)
                write_png(folder / f"{path_of_image}.png", grey, options.png)
                exposure = {"index": n, **exposure_table(scan.exposures, n)}
                pose = {"transform_matrix": poses[n].tolist()}
                frames.append({"file_path": f"./{path_of_image}", "holosplat": exposure, **pose})
            table = {"camera_angle_x": 2 * math.atan(half), "frames": frames, "holosplat": head}
            for copy in (name, VAL) if name == TEST else (name,):
                write_json(folder / copy, table)
        if thickness is None:
            points = uniform_points(views[train], options.seed_points)
        else:
            points = hull_points(thickness[train], views[train], options.seed_points)
        write_ply(folder / POINTS, points * scene_scale(views))


def read_nerf_synthetic(path: str | Path, given: GivenOptics | None = None) -> Scan:
    """The scan of a NeRF-synthetic folder; `given` holds what the folders of other programs lack, whose cameras must be
    nearly parallel. Intensities are as exact as the images' bits."""
    folder = Path(path)
    splits = [Table.read(folder / TRAIN)]
    own = "holosplat" in splits[0]
    if own or (folder / TEST).exists():
        splits.append(Table.read(folder / TEST))
    heads = [split.values.get("holosplat") for split in splits]
    require(
        all(head == heads[0] for head in heads),
        f"{folder}: the entry holosplat of {TRAIN} and {TEST} must be the same, but it differs; take the two of one "
        "folder.",
    )
    tables = [split.tables("frames") for split in splits]
    require(len(tables[0]) > 0, f"{splits[0].label('frames')} must hold at least one frame, but it holds none.")
    frames = [frame for split in tables for frame in split]
    named = [frame.text("file_path").lower().endswith(".png") for frame in frames]  # .png is left away, or not
    files = [frame.file("file_path", "" if whole else ".png") for frame, whole in zip(frames, named)]
    images = [read_png(file) for file in files]
    (first, white), is_test = images[0], np.arange(len(frames)) >= len(tables[0])
    for file, (image, its_white) in zip(files, images):
        same = image.shape == first.shape and its_white == white
        this, that = (f"{a.shape} pixels and white at {w}" for a, w in ((image, its_white), images[0]))
        require(same, f"{file} must be as {files[0].name}, with {that}, but it has {this}; convert it.")
    levels = np.stack([image for image, _ in images]).astype(np.float64)
    if not own:
        require_said(str(folder), TAKES[:3] if given is None else ())
        assert given is not None
        exposures = _exposures_of_cameras(folder, splits, frames, (first.shape[0], first.shape[1]), given)
        values = given.black + (given.white - given.black) / white * levels
        return Scan(
            values.astype(np.float32), exposures, is_test, {"converted_from": f"NeRF-synthetic folder {folder.name}"}
        )
    require(given is None, f"{folder} says itself how it was taken; leave away what is given for others' folders.")
    head = splits[0].table("holosplat")
    head.require_format(FORMAT)
    for name, found in (("shape", list(first.shape)), ("white", white)):
        require(
            head.need(name) == found,
            f"{head.label(name)} is {head.need(name)}, but that of the images is {found}; they must be those that "
            "were written with it.",
        )
    low, high = head.number("low"), head.number("high")
    order, exposures = read_own_exposures(head, frames, (first.shape[0], first.shape[1]))
    values = (low + (high - low) / white * levels).astype(np.float32)
    return Scan(values[order], exposures, is_test[order], head.texts("provenance"))


def _exposures_of_cameras(
    folder: Path, splits: list[Table], frames: list[Table], shape: tuple[int, int], given: GivenOptics
) -> Exposures:
    """Exposures of frames of `shape` (H, W) by cameras that are taken for parallel; the centre of view is the shift."""
    angles = [split.number("camera_angle_x") for split in splits]
    require(len(set(angles)) == 1, f"{folder}: camera_angle_x must be the same for all frames, but it is {angles}.")
    tangent = math.tan(0.5 * angles[0])
    if not 0 < tangent <= MOST_TANGENT:
        raise InputError(
            f"{splits[0].label('camera_angle_x')} must be below {2 * math.atan(MOST_TANGENT):.3g} rad (beams are "
            f"parallel here), but it is {angles[0]:g}; these are perspective views, which holosplat cannot use."
        )
    poses = np.array([frame.numbers("transform_matrix", (4, 4)) for frame in frames])
    rotations = poses[:, :3, :3].transpose(0, 2, 1) * np.array([1.0, -1.0, -1.0])[:, None]
    away = -np.einsum("vi,vi->v", poses[:, :3, 3], rotations[:, 2])
    require(
        bool((away > 0).all() and np.ptp(away) <= 1e-3 * away.max()),
        f"{folder}: cameras must look at the origin's side from one distance, but theirs go from {away.min():g} to "
        f"{away.max():g}; bring the images to one scale first.",
    )
    metres_per_unit = given.pixel_size * shape[1] / (2 * float(away.mean()) * tangent)
    shifts = metres_per_unit * np.einsum("vi,vki->vk", poses[:, :3, 3], rotations[:, :2])
    return Exposures.of(Views(rotations, shifts, shape, given.pixel_size), given.energy_kev, given.distance)


TAKES = ("energy_kev", "distance", "pixel_size", "black", "white")


def _read(path: Path, given: Mapping[str, float]) -> Scan:
    require_said(str(path), [name for name in TAKES[:3] if given and name not in given])
    return read_nerf_synthetic(path, GivenOptics(**given) if given else None)


LOADER = Loader("nerf-synthetic", f"a folder with {TRAIN}", folder_with(TRAIN), _read, TAKES)


def _convert(out: Path, scan: Scan, options: Mapping[str, Any], retrieved: Retrieved | None) -> str:
    write_nerf_synthetic(out, scan, NerfOptions(**options), None if retrieved is None else retrieved()[0])
    (low, high), held_out = grey_range(scan), scan.frames[scan.is_test]
    cut = int(((held_out < low) | (held_out > high)).sum())
    if not cut:
        return ""
    return f"{cut} of {held_out.size} held-out pixels lie beyond the training frames' range and were cut off"


WRITER = Writer(_convert, ("png", "camera_distance", "seed_points", "material"))
