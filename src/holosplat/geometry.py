"""Where things are: views (poses and the detector's raster) and grids (a volume's raster).

Frames, signs and pixel centres follow docs/conventions.md: `x_lab = R x_obj`, the beam runs along +z_lab,
pixel `(i, j)` has its centre at `x = (j + ½ - W/2) p + sx`, `y = (i + ½ - H/2) p + sy`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from .checks import InputError, finite, positive, require, shaped
from .rotations import rotation_tilted as rotation_tilted
from .rotations import rotation_y as rotation_y

if TYPE_CHECKING:
    import torch

FARTHEST_PX = 1e6
"""Pixels beyond which no detector lies beside its place."""


@dataclass(frozen=True)
class Views:
    """The poses of V views, and the raster of their detectors.

    rotations: [V, 3, 3], `x_lab = R x_obj`.
    shifts: [V, 2] detector shifts `(sx, sy)` [m].
    shape: `(H, W)` pixels.
    pitch: `p` [m], the unit of lengths in pixels; the pixel size where all views have the same.
    scales: [V] pixel sizes of the views over `pitch` (None: all one). Pixels are square.
    sources: [V] distances R [m] of point sources, at `(0, 0, -R)` of the lab (None: parallel); pixels are at `z = 0`.

    In units of its own pixel, a view of pixels `s p` is one of pixels `p` with the matrix `R / s` and the shift `(sx,
    sy) / s`. Errors: `InputError` for matrices that are no rotations, and for shapes, shifts or sizes out of range.

    Examples:

        >>> import holosplat as hs
        >>> views = hs.Views.from_angles([0.0, 45.0, 90.0], shape=(48, 64), pixel_size=0.5e-6)
        >>> len(views), views.shape, views.pixel_size
        (3, (48, 64), 5e-07)
        >>> views.rotations[2].round(3) + 0.0
        array([[ 0.,  0.,  1.],
               [ 0.,  1.,  0.],
               [-1.,  0.,  0.]])
        >>> f"{1e6 * views.width:.0f} µm × {1e6 * views.height:.0f} µm"
        '32 µm × 24 µm'
    """

    rotations: np.ndarray
    shifts: np.ndarray
    shape: tuple[int, int]
    pitch: float
    scales: np.ndarray | None = None
    sources: np.ndarray | None = None

    def __post_init__(self) -> None:
        rotations = finite("view rotation", np.asarray(self.rotations, dtype=np.float64))
        shaped("view rotation", rotations, (None, 3, 3))
        off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3))
        proper = np.all(off <= 1e-6 + 1e-5 * np.eye(3)) and np.all(np.linalg.det(rotations) > 0)
        require(bool(proper), "view rotation must hold proper rotation matrices (R Rᵀ = 1, det R = 1).")
        shifts = finite("detector shift", np.asarray(self.shifts, dtype=np.float64))
        shaped("detector shift", shifts, (len(rotations), 2))
        far = float(np.abs(shifts).max(initial=0.0)) / self.pitch
        require(
            far <= FARTHEST_PX, f"detector shift must be at most {FARTHEST_PX:g} pixels, but it is {far:g}; correct it."
        )
        if np.shape(self.shape) != (2,) or min(self.shape) < 1 or any(int(n) != n for n in self.shape):
            raise InputError(f"detector shape must be two positive counts (rows, columns), but it is {self.shape}.")
        object.__setattr__(self, "rotations", rotations)
        object.__setattr__(self, "shifts", shifts)
        object.__setattr__(self, "shape", (int(self.shape[0]), int(self.shape[1])))
        object.__setattr__(self, "pitch", positive("pixel size", self.pitch, "metres"))
        scales = np.ones(len(rotations)) if self.scales is None else np.asarray(self.scales, dtype=np.float64)
        sources = None if self.sources is None else np.asarray(self.sources, dtype=np.float64)
        for name, given, array in (("scales", "pixel scale", scales), ("sources", "source distance", sources)):
            if array is not None:
                shaped(given, finite(given, array), (len(rotations),))
                require(bool((array > 0).all()), f"{given}s must be above zero, but one is not; correct it.")
            object.__setattr__(self, name, array)

    @classmethod
    def of_pixels(
        cls, rotations: np.ndarray, shifts: np.ndarray, shape: tuple[int, int], pixel_size: float | np.ndarray
    ) -> Views:
        """Views with one pixel size [m] or one for each, [V]; the pitch is the smallest."""
        sizes = np.asarray(pixel_size, dtype=np.float64)
        for size in sizes.reshape(-1):
            positive("pixel size", float(size), "metres")
        if sizes.ndim == 0 or (len(sizes) > 0 and bool((sizes == sizes[0]).all()) and len(sizes) == len(rotations)):
            return cls(rotations, shifts, shape, float(sizes.reshape(-1)[0]))
        shaped("pixel size", sizes, (len(rotations),))
        return cls(rotations, shifts, shape, float(sizes.min(initial=np.inf)), sizes / sizes.min(initial=np.inf))

    @classmethod
    def from_rotations(cls, rotations: np.ndarray, shape: tuple[int, int], pixel_size: float | np.ndarray) -> Views:
        """Views of any orientation without detector shifts: rotations [V, 3, 3], pixel_size [m], one or [V]."""
        return cls.of_pixels(rotations, np.zeros((len(rotations), 2)), shape, pixel_size)

    @classmethod
    def from_angles(
        cls, angles_deg: np.ndarray | list[float], shape: tuple[int, int], pixel_size: float | np.ndarray
    ) -> Views:
        """Tomographic views: angles [V] in degrees about the y axis, pixel_size [m], one or [V]."""
        return cls.from_rotations(rotation_y(angles_deg), shape, pixel_size)

    @classmethod
    def evenly_spaced(cls, count: int, shape: tuple[int, int], pixel_size: float) -> Views:
        """`count` tomographic views over [0°, 180°), pixel_size [m]."""
        require(count >= 1, f"the number of views must be at least 1, but it is {count}.")
        return cls.from_angles(np.arange(count) * (180.0 / count), shape, pixel_size)

    def __len__(self) -> int:
        return len(self.rotations)

    def fingerprint(self) -> bytes:
        """Equal for equal views, different for different ones."""
        arrays = (self.rotations, self.shifts, self.relative, *([] if self.sources is None else [self.sources]))
        where = b"".join(array.tobytes() for array in arrays)
        return where + repr((self.shape, self.pitch)).encode()

    def __getitem__(self, index: np.ndarray | list[int] | slice) -> Views:
        sources = None if self.sources is None else self.sources[index]
        rotations, shifts, scales = self.rotations[index], self.shifts[index], self.relative[index]
        return replace(self, rotations=rotations, shifts=shifts, scales=scales, sources=sources)

    def parallel(self, what: str) -> Views:
        """The views themselves; `InputError` where beams diverge, which `what` does not model."""
        if self.sources is not None:
            raise InputError(
                f"{what} needs parallel beams, but these diverge from a source {self.sources.min(initial=np.inf):g} m "
                "before the object; docs/howto/which_instrument.md says what takes cones."
            )
        return self

    @property
    def relative(self) -> np.ndarray:
        """`scales` [V], which are always there."""
        assert self.scales is not None
        return self.scales

    @property
    def pixel_sizes(self) -> np.ndarray:
        """Pixel sizes [V] [m]."""
        return self.pitch * self.relative

    @property
    def has_one_pixel(self) -> bool:
        """Whether all views have the same pixel size."""
        return bool((self.relative == self.relative[:1]).all())

    @property
    def pixel_size(self) -> float:
        """The pixel size [m] of all views; `InputError` where they have several."""
        sizes = self.pixel_sizes
        if not self.has_one_pixel:
            raise InputError(
                f"this needs views of one pixel size, but theirs go from {1e6 * sizes.min():.6g} to "
                f"{1e6 * sizes.max():.6g} µm; choose those of one (--views), or bring all to one raster "
                "(holosplat join --pixel-size)."
            )
        return float(sizes[0]) if len(sizes) else self.pitch

    @property
    def finest(self) -> float:
        """The smallest pixel size [m] of the views."""
        return float(self.pixel_sizes.min()) if len(self) else self.pitch

    @property
    def width(self) -> float:
        """Width of the field of view [m]; of the smallest one, if pixel sizes differ."""
        return self.shape[1] * self.finest

    @property
    def height(self) -> float:
        """Height of the field of view [m]; of the smallest one, if pixel sizes differ."""
        return self.shape[0] * self.finest

    @property
    def fields(self) -> np.ndarray:
        """Widths and heights [V, 2] [m] of the fields of view."""
        return self.pixel_sizes[:, None] * np.array(self.shape[::-1])

    @property
    def shares_axis(self) -> bool:
        """Whether every view turns about the object's y axis only, parallel, on pixels of one size: slices decouple."""
        y = np.array([0.0, 1.0, 0.0])
        upright = np.allclose(self.rotations[:, 1], y) and np.allclose(self.shifts[:, 1], self.shifts[:1, 1])
        return bool(upright) and self.has_one_pixel and self.sources is None

    def in_units_of(self, length: float) -> Views:
        """The same views with `length` [m] as the unit of length."""
        sources = None if self.sources is None else self.sources / length
        return replace(self, shifts=self.shifts / length, pitch=self.pitch / length, sources=sources)

    def refined(self, factor: int) -> Views:
        """The same field of view on a raster `factor` times finer."""
        h, w = self.shape
        return replace(self, shape=(h * factor, w * factor), pitch=self.pitch / factor)

    def cropped(self, rows: slice, columns: slice) -> Views:
        """The part of the raster from `start` to `stop` of `rows` and `columns`; the pixels stay where they are."""
        (h, w), p = self.shape, self.pixel_sizes
        moved = [0.5 * (part.start + part.stop - n) * p for part, n in ((columns, w), (rows, h))]
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        return replace(self, shape=shape, shifts=self.shifts + np.stack(moved, axis=1))

    def about_column(self, column: float) -> Views:
        """The views with the rotation axis, the object's y axis, at `column` of every frame (0: middle of the first).

        Errors: `InputError` for a column beyond the detector, and if the detector moves sideways from view to view.
        """
        width, sideways = self.shape[1], self.shifts[:, 0]
        require(
            -0.5 <= column <= width - 0.5,
            f"the axis' column must be one of 0 to {width - 1}, but it is {column:g}; count columns from 0.",
        )
        require(
            bool(np.allclose(sideways, sideways[:1], rtol=0, atol=1e-3 * self.finest)),
            "the scan says itself where the axis is (its detector moves sideways); leave the axis' column.",
        )
        shifts = self.shifts.copy()
        shifts[:, 0] = (0.5 * (width - 1) - column) * self.pixel_sizes
        return replace(self, shifts=shifts)

    def turned_back(self) -> Views:
        """The views with every rotation reversed about the object's y axis: the angles θ of a tomogram become -θ.

        Errors: `InputError` for views that turn about another axis, whose rotations say their sense themselves.
        """
        upright = bool(np.allclose(self.rotations[:, 1], [0.0, 1.0, 0.0], rtol=0, atol=1e-6))
        require(upright, "the sense of rotation is that about one axis, but the views have none in common; leave it.")
        mirror = np.diag([1.0, 1.0, -1.0])
        return replace(self, rotations=mirror @ self.rotations @ mirror)

    def padded(self, margin: tuple[int, int]) -> Views:
        """The raster grown by `margin = (rows, columns)` pixels on every side; centres of old pixels stay."""
        (h, w), (my, mx) = self.shape, margin
        return replace(self, shape=(h + 2 * my, w + 2 * mx))

    def taller(self, rows: int) -> Views:
        """The raster with `rows` more above and below; centres of old pixels stay."""
        return self.padded((rows, 0))


@dataclass(frozen=True)
class Poses:
    """V views made ready for kernels: tensors that stay on a device, picked by index without waiting for it.

    rotations: [V, 3, 3] float64.
    shifts: [V, 2] float64, detector shifts `(sx, sy)` [m].
    shape: `(H, W)` pixels.
    pitch: of square pixels [m].
    scales: [V] float64, pixel sizes over `pitch`, as in `Views`; None where all are one.
    sources: [V] float64, distances of sources [m], as in `Views`; None for parallel beams.

    Rotations, shifts, scales and sources may require gradients, which projections then give them.
    """

    rotations: torch.Tensor
    shifts: torch.Tensor
    shape: tuple[int, int]
    pitch: float
    scales: torch.Tensor | None = None
    sources: torch.Tensor | None = None

    @classmethod
    def of(cls, views: Views, device: torch.device | str = "cpu") -> Poses:
        """The poses of `views` on `device`."""
        import torch

        arrays = (np.ascontiguousarray(a) for a in (views.rotations, views.shifts, views.relative))
        rotations, shifts, scales = (torch.from_numpy(a).to(device) for a in arrays)
        alike = bool((views.relative == 1).all())
        sources = None if views.sources is None else torch.from_numpy(views.sources).to(device)
        return cls(rotations, shifts, views.shape, views.pitch, None if alike else scales, sources)

    def __len__(self) -> int:
        return len(self.rotations)

    @property
    def requires_grad(self) -> bool:
        """Whether gradients of any of the arrays are asked for."""
        arrays = (self.rotations, self.shifts, self.scales, self.sources)
        return any(each is not None and each.requires_grad for each in arrays)

    @property
    def matrices(self) -> torch.Tensor:
        """`R / s` [V, 3, 3]: points of the object frame to the lab's, in units where each view's pixel is `pitch`."""
        return self.rotations if self.scales is None else self.rotations / self.scales[:, None, None]

    @property
    def offsets(self) -> torch.Tensor:
        """The shifts [V, 2] in the same units [m]."""
        return self.shifts if self.scales is None else self.shifts / self.scales[:, None]

    @property
    def finest(self) -> float:
        """The smallest pixel size [m]; waits for a GPU where sizes differ."""
        return self.pitch if self.scales is None or not len(self) else self.pitch * float(self.scales.detach().min())

    def views(self) -> Views:
        """The same poses as `Views`, without gradients."""
        rotations, shifts = (array.detach().cpu().numpy() for array in (self.rotations, self.shifts))
        more = (None if a is None else a.detach().cpu().numpy() for a in (self.scales, self.sources))
        return Views(rotations, shifts, self.shape, self.pitch, *more)

    def __getitem__(self, index: torch.Tensor) -> Poses:
        """The poses `index` [K], an integer tensor on the same device."""
        scales, sources = (None if a is None else a.index_select(0, index) for a in (self.scales, self.sources))
        rotations, shifts = self.rotations.index_select(0, index), self.shifts.index_select(0, index)
        return replace(self, rotations=rotations, shifts=shifts, scales=scales, sources=sources)

    def parallel(self, what: str) -> Poses:
        """The poses themselves; `InputError` where beams diverge, which `what` does not model."""
        if self.sources is not None:
            self.views().parallel(what)
        return self


@dataclass(frozen=True)
class Grid:
    """The raster of a volume, indexed `[z, y, x]`.

    shape: `(Z, Y, X)` voxels.
    voxel_size: `(dx, dy, dz)` [m].
    origin: centre `(x, y, z)` [m] of voxel [0, 0, 0].

    Errors: `InputError` for other counts and lengths.

    Examples:

        >>> import holosplat as hs
        >>> views = hs.Views.evenly_spaced(8, shape=(12, 16), pixel_size=1e-6)
        >>> grid = hs.Grid.of_views(views)
        >>> grid.shape
        (16, 12, 16)
        >>> x, y, z = grid.axes()
        >>> f"{1e6 * x[0]:.1f} to {1e6 * x[-1]:.1f} µm"
        '-7.5 to 7.5 µm'
    """

    shape: tuple[int, int, int]
    voxel_size: tuple[float, float, float]
    origin: tuple[float, float, float]

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise InputError(f"volume shape must be three positive counts (Z, Y, X), but it is {self.shape}.")
        size = tuple(positive("voxel size", v, "metres") for v in self.voxel_size)
        require(len(size) == 3, f"voxel size must be three lengths (dx, dy, dz), but it is {self.voxel_size}.")
        require(len(self.origin) == 3, f"volume origin must be (x, y, z) in metres, but it is {self.origin}.")
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "voxel_size", size)
        finite("volume origin", np.asarray(self.origin, dtype=np.float64))
        object.__setattr__(self, "origin", tuple(float(v) for v in self.origin))

    @classmethod
    def centred(
        cls, shape: tuple[int, int, int], voxel_size: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> Grid:
        """A grid of cubic voxels of `voxel_size` [m] about `centre` (x, y, z) [m], by default the object's origin."""
        z, y, x = shape
        low_x, low_y, low_z = (c - 0.5 * (n - 1) * voxel_size for n, c in zip((x, y, z), centre))
        return cls(shape, (voxel_size, voxel_size, voxel_size), (low_x, low_y, low_z))

    @classmethod
    def of_views(cls, views: Views, refine: float = 1) -> Grid:
        """The views' field of view at pixel pitch (divided by `refine`): Z = X = W, Y = H; of the smallest pixels.

        It is centred where the (shifted) detectors look: at the point nearest to all their axes.
        """
        h, w = (round(n * refine) for n in views.shape)
        grid = cls.centred((w, h, w), views.finest / refine)
        centre = np.linalg.lstsq(views.rotations[:, :2].reshape(-1, 3), views.shifts.reshape(-1), rcond=1e-6)[0]
        if np.abs(centre).max() < 1e-6 * views.finest:
            return grid
        x, y, z = (float(o + c) for o, c in zip(grid.origin, centre))
        return replace(grid, origin=(x, y, z))

    @classmethod
    def around(cls, points: np.ndarray, unit: float, most_voxels: int) -> Grid:
        """A grid around `points` [N, 3] `(x, y, z)` [units of `unit` metres] and two units more on every side.

        Voxels are cubes of one unit, or larger where those would be more than `most_voxels`.
        """
        low, high = points.min(0) - 2, points.max(0) + 2
        pitch = max(1.0, float((np.prod(high - low) / most_voxels) ** (1 / 3)))
        x, y, z = (int(n) for n in np.ceil((high - low) / pitch))
        origin = (0.5 * (low + high) - 0.5 * (np.array([x, y, z]) - 1) * pitch) * unit
        edge = pitch * unit
        return cls((z, y, x), (edge, edge, edge), (origin[0], origin[1], origin[2]))

    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Voxel-centre coordinates `(x [X], y [Y], z [Z])` [m]."""
        counts = self.shape[::-1]
        return tuple(o + d * np.arange(n) for o, d, n in zip(self.origin, self.voxel_size, counts))  # type: ignore[return-value]

    @property
    def centre(self) -> np.ndarray:
        """The middle `(x, y, z)` [m] of the grid."""
        return np.array(self.origin) + 0.5 * np.array(self.voxel_size) * (np.array(self.shape[::-1]) - 1)

    def block(self, start: tuple[int, int, int], shape: tuple[int, int, int]) -> Grid:
        """The part of `shape` voxels whose first one is voxel `start` (z, y, x) of this grid."""
        origin = [o + d * i for o, d, i in zip(self.origin, self.voxel_size, start[::-1])]
        return Grid(shape, self.voxel_size, (origin[0], origin[1], origin[2]))

    def divided(self, factors: tuple[int, int, int]) -> Grid:
        """The same extent with each voxel divided by `factors` `(fx, fy, fz)`; the grid itself where all are 1.

        Errors: `InputError` for a factor below 1.
        """
        require(min(factors) >= 1, f"factors of a division must be at least 1, but they are {factors}.")
        if max(factors) == 1:
            return self
        (z, y, x), (fx, fy, fz) = self.shape, factors
        size = [d / f for d, f in zip(self.voxel_size, factors)]
        low = [o - 0.5 * (f - 1) * s for o, f, s in zip(self.origin, factors, size)]
        return Grid((z * fz, y * fy, x * fx), (size[0], size[1], size[2]), (low[0], low[1], low[2]))
