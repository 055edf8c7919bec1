"""Distance, size, volume and dry mass of single red cells from one optical hologram each, by the known shape at rest.

    python benchmarks/red_cells.py ../shared/data/real/rbc_holograms --out docs/data/red_cells.csv   # 10 minutes

Measured holograms (MorpHoloNet, MIT licence): 532 nm, pixels of 0.5 µm, one view a cell, in a hypertonic, an isotonic
and a hypotonic medium. A cell is that of Evans & Fung (1972) with free diameter, thickness (dimple, slope, rim),
stretch along an axis in its plane, bending and tilt. Its index, absorption and place, light (level and slopes), blur
and distance are free, too. Expected values and their standard deviations are `PRIOR`.

Gauss-Newton steps find the largest posterior at distances within a fifth of the published one (`coarse`, of a cell
lying flat or on edge), and then at each micrometre about the best (`profile`). The noise is what the best fit leaves of
the frame, with one degree of freedom a patch of pixels that vary together, so that model errors widen the intervals.
`cell` rows hold the likeliest values and 95 % intervals over all distances.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import tifffile
import torch
from machine import commit
from rows import written
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from holosplat.geometry import Views
from holosplat.matter import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.model import Instrument
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import RADIUS, RedCell, icosphere
from holosplat.specimens.scene import MeshScene
from holosplat.units import photon_energy

WAVELENGTH, PIXEL = 532e-9, 0.5e-6
INCREMENT = 0.19
"""Refractive index times volume that matter adds [µm³/pg = ml/g] (Barer 1952, Nature 169, 366: 0.18 to 0.21)."""
MEDIA = {"Hypertonic": (1.347, 67e-6), "Isotonic": (1.344, 136e-6), "Hypotonic": (1.333, 44e-6)}
"""Index of the medium, and the distance [m] that the data's own authors found."""
PRIOR = {
    "x": (0.0, 3.0),  # µm
    "y": (0.0, 3.0),
    "size": (0.0, 0.1),  # logarithm of the diameter over that at rest
    "dimple": (0.0, 0.3),  # logarithms of half the thickness over that at rest, at t = 0, ½ and 1
    "middle": (0.0, 0.3),
    "rim": (0.0, 0.3),
    "stretch": (0.0, 0.1),
    "azimuth": (0.0, 1.0),
    "tilt_x": (0.0, 0.5),
    "tilt_y": (0.0, 0.5),
    "bowl": (0.0, 0.1),
    "saddle": (0.0, 0.1),
    "saddle_2": (0.0, 0.1),
    "trefoil": (0.0, 0.1),
    "trefoil_2": (0.0, 0.1),
    "index": (0.06, 0.015),  # over that of the medium
    "absorption": (0.0, 0.003),  # imaginary part of the index
    "level": (1.0, 0.02),
    "slope_x": (0.0, 0.02),
    "slope_y": (0.0, 0.02),
    "blur": (0.6, 0.3),  # pixels
}
NAMES = list(PRIOR)
MEAN, DEVIATION = (np.array([each[i] for each in PRIOR.values()]) for i in (0, 1))
SPHERE, FACES = icosphere(3)


COLUMNS = ("row", "cell", "distance_um", "quantity", "value", "low", "high", "commit")
COARSE = (0.8, 0.9, 1.0, 1.1, 1.2)
"""Distances of the first fits over the published one, by cells of the `FIRST` numbers alone."""
FIRST = ("x", "y", "size", "tilt_x", "tilt_y", "index", "absorption", "level", "blur")
FINE = 1e-6 * np.arange(-5, 6)
STEP = 0.02
TILTS = (0.1, 1.2)
DRAWS = 4000


@dataclass(frozen=True)
class Fit:
    """A cell at a distance [m]: -log of the posterior but for a constant, the numbers in deviations, the Jacobian."""

    distance: float
    cost: float
    u: np.ndarray
    jacobian: np.ndarray


@dataclass(frozen=True)
class Hologram:
    """A frame [H, W], relative, and the optics of all distances tried."""

    frame: np.ndarray
    energy_kev: float
    index: float
    error: float = 0.03
    patch: float = 9.0

    def residual(self, u: np.ndarray, distance: float) -> np.ndarray:
        """Of the frame and of what is expected, in standard deviations; u: numbers in deviations from the mean."""
        left = (self.predicted(MEAN + DEVIATION * u, distance) - self.frame) / (self.error * math.sqrt(self.patch))
        return np.concatenate([left.ravel(), u])

    def fitted(self, start: np.ndarray, distance: float, steps: int, free: Sequence[str] = NAMES) -> Fit:
        """The likeliest cell at a distance, from `start` on; free: numbers that change."""
        ways = np.eye(len(start))[[name in free for name in NAMES]]

        def residual(v: np.ndarray) -> np.ndarray:
            return self.residual(start + v @ ways, distance)

        def jacobian(v: np.ndarray) -> np.ndarray:
            here = residual(v)
            return np.stack([(residual(v + STEP * way) - here) / STEP for way in np.eye(len(v))], axis=1)

        done = least_squares(residual, np.zeros(len(ways)), jacobian, max_nfev=steps)
        return Fit(distance, float(done.cost), start + done.x @ ways, done.jac)

    def with_errors_of(self, fit: Fit) -> Hologram:
        """The same with the errors that `fit` leaves: their size, and the pixels that vary together, Σρ² of lags."""
        left = self.predicted(MEAN + DEVIATION * fit.u, fit.distance) - self.frame
        power = np.abs(np.fft.fft2(left - left.mean())) ** 2
        correlation = np.fft.ifft2(power).real
        return replace(self, error=float(left.std()), patch=float(np.square(correlation / correlation[0, 0]).sum()))

    def predicted(self, p: np.ndarray, distance: float) -> np.ndarray:
        """The frame of the cell with the numbers `p` at a distance [m]."""
        said = dict(zip(NAMES, p))
        instrument = waves(self.frame.shape, self.energy_kev, distance)
        matter = DeltaBeta(-said["index"] / self.index, said["absorption"] / self.index)
        lines = MeshScene((cell(said),), (matter,)).project(instrument.views)
        blur = torch.tensor([abs(said["blur"])], dtype=torch.float64)
        image = instrument.frames(lines, psf_sigma_px=blur)[0].numpy().astype(np.float64)
        y, x = (np.linspace(-1, 1, n) for n in image.shape)
        return image * (said["level"] + said["slope_x"] * x + said["slope_y"] * y[:, None])


@lru_cache(maxsize=4)
def waves(shape: tuple[int, int], energy_kev: float, distance: float) -> Instrument:
    """The optics of one distance [m]."""
    return Instrument(Exposures.of(Views.from_angles([0.0], shape, PIXEL), energy_kev, distance, 1.0))


def cell(said: dict[str, float]) -> TriangleMesh:
    """The closed surface [m] of the cell."""
    x, y, z = SPHERE.T
    t, logs = x**2 + y**2, [said[name] for name in ("dimple", "middle", "rim")]
    curve = logs[0] * (1 - t) * (1 - 2 * t) + logs[1] * 4 * t * (1 - t) + logs[2] * t * (2 * t - 1)
    bend = np.array([said[name] for name in ("bowl", "saddle", "saddle_2", "trefoil", "trefoil_2")])
    turn = Rotation.from_rotvec([said["tilt_x"], said["tilt_y"], 0.0]) * Rotation.from_rotvec([0, 0, said["azimuth"]])
    shape = RedCell(2 * RADIUS * math.exp(said["size"]), turn.as_matrix(), stretch=said["stretch"], bend=bend)
    points = shape.surface(np.stack([x, y, z * np.exp(curve)], axis=-1))
    return TriangleMesh(points + 1e-6 * np.array([said["x"], said["y"], 0.0]), FACES, "cell")


def rows(name: str, folder: Path) -> Iterator[dict[str, object]]:
    """The profile of one cell's distance, and the cell."""
    index, published = MEDIA[name]
    frame = tifffile.imread(folder / f"{name}_RBC.tif").astype(np.float64) / 127.5
    hologram = Hologram(frame, photon_energy(WAVELENGTH, index), index)
    starts = [np.where(np.array(NAMES) == "tilt_x", tilt / PRIOR["tilt_x"][1], 0.0) for tilt in TILTS]
    coarse = [hologram.fitted(u, part * published, 12, FIRST) for part in COARSE for u in starts]
    best = min(coarse, key=lambda fit: fit.cost)
    for step in (3e-6, 1e-6):
        best = min(
            (hologram.fitted(best.u, best.distance + s * step, 12) for s in (-1, 0, 1)), key=lambda fit: fit.cost
        )
    final = hologram.with_errors_of(best)
    for fit in coarse:
        left = hologram.predicted(MEAN + DEVIATION * fit.u, fit.distance) - frame
        yield row("coarse", name, fit.distance, "misfit_rms", float(left.std()))
    fits = [final.fitted(best.u, best.distance + away, 10) for away in FINE]
    for fit in fits:
        yield row("profile", name, fit.distance, "cost", fit.cost)
    best = min(fits, key=lambda fit: fit.cost)
    yield row("cell", name, best.distance, "misfit_rms", final.error)
    yield row("cell", name, best.distance, "noise_rms", float(frame[:16, :16].std()))
    yield row("cell", name, best.distance, "pixels_together", final.patch)
    drawn = draws(fits)
    for quantity, values in drawn.items():
        low, middle, high = np.quantile(values, (0.025, 0.5, 0.975))
        yield row("cell", name, best.distance, quantity, middle, low, high)


def draws(fits: list[Fit]) -> dict[str, np.ndarray]:
    """Of the posterior: normal about the likeliest cell of each distance, whose weights are the posterior's."""
    random, found = np.random.default_rng(0), dict[str, list[float]]()
    costs = np.array([fit.cost for fit in fits])
    z = np.array([fit.distance for fit in fits])
    # the profile between the distances tried: a parabola through the likeliest and its neighbours
    at = int(np.clip(costs.argmin(), 1, len(fits) - 2))
    curve = np.polyfit(z[at - 1 : at + 2] - z[at], costs[at - 1 : at + 2], 2)
    centre, width = z[at] - curve[1] / (2 * curve[0]), 1 / math.sqrt(2 * max(curve[0], 1e-3 / FINE[-1] ** 2))
    covariances = [np.linalg.inv(fit.jacobian.T @ fit.jacobian) for fit in fits]
    for distance in random.normal(centre, width, DRAWS):
        nearest = int(np.abs(z - distance).argmin())
        u = random.multivariate_normal(fits[nearest].u, covariances[nearest])
        said = dict(zip(NAMES, MEAN + DEVIATION * u))
        volume = abs(cell(said).volume) * 1e18
        numbers = {
            "distance_um": distance * 1e6,
            "diameter_um": 2e6 * RADIUS * math.exp(said["size"]),
            "volume_um3": volume,
            "optical_volume_um3": volume * said["index"],
            "dry_mass_pg": volume * said["index"] / INCREMENT,
            "index": said["index"],
            "tilt_deg": math.degrees(math.hypot(said["tilt_x"], said["tilt_y"])),
        }
        for quantity, value in numbers.items():
            found.setdefault(quantity, []).append(value)
    return {quantity: np.array(values) for quantity, values in found.items()}


def row(kind: str, name: str, distance: float, quantity: str, *numbers: float) -> dict[str, object]:
    """A row of the table."""
    said = [f"{number:.6g}" for number in numbers] + [""] * (3 - len(numbers))
    return dict(zip(COLUMNS, (kind, name, f"{distance * 1e6:.2f}", quantity, *said, commit())))


def main() -> None:
    """Write the table, line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with Isotonic_RBC.tif and its like")
    parser.add_argument("--cells", nargs="+", default=list(MEDIA), choices=list(MEDIA))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    written(options.out, COLUMNS, (each for name in options.cells for each in rows(name, options.folder)))


if __name__ == "__main__":
    main()
