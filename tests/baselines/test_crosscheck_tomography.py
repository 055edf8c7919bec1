"""Our tomographies against other people's: ASTRA (2D, on the processor), scikit-image and svmbir, where installed.

`pip install 'holosplat[bench]'` has ASTRA and svmbir. One slice of a phantom without symmetry tells every sign.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.baselines import TOMOGRAPHIES
from holosplat.baselines.algebraic import Algebraic, Ramp, filtered_backprojection, sirt
from holosplat.checks import InputError, MissingError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import PerView
from holosplat.methods.method import Task
from holosplat.projectors.voxels import SliceProjector
from holosplat.scan import Exposures, Scan
from holosplat_bench.opponents import mbir as other

SIDE, ROWS = 49, 3
ANGLES = np.arange(40) * 4.5
PITCH = 2e-6
BLOBS = ((-6.0, 8.0, 9.0, 1.0), (10.0, 4.0, 5.0, 0.5), (3.0, -12.0, 4.0, 0.8))
"""x, z, radius [pixels] and value of each disc."""


def quiet(fraction: float) -> None:
    """No progress to show."""


def views_at(angles=ANGLES, pitch=PITCH) -> Views:
    return Views.from_angles(angles, (ROWS, SIDE), pitch)


def phantom() -> np.ndarray:
    """Values [Z, X] of the discs, averaged over voxels."""
    fine = (np.arange(SIDE * 8) + 0.5) / 8 - SIDE / 2
    image = sum(v * ((fine - x) ** 2 + (fine[:, None] - z) ** 2 < r**2) for x, z, r, v in BLOBS)
    return np.asarray(image, dtype=np.float64).reshape(SIDE, 8, SIDE, 8).mean((1, 3))


def disc_lines(angles=ANGLES) -> np.ndarray:
    """Exact line integrals [V, W] in pixels: chords, averaged over pixels."""
    fine = (np.arange(SIDE * 16) + 0.5) / 16 - SIDE / 2
    lines = np.zeros((len(angles), fine.size))
    for v, angle in enumerate(np.deg2rad(angles)):
        for x, z, r, value in BLOBS:
            away = fine - np.cos(angle) * x - np.sin(angle) * z
            lines[v] += 2 * value * np.sqrt(np.clip(r**2 - away**2, 0, None))
    return lines.reshape(len(angles), SIDE, 16).mean(2)


def as_thickness(lines: np.ndarray, pitch=PITCH) -> torch.Tensor:
    """[V, W] in pixels → [V, H, W] in metres, the same in all rows."""
    return torch.from_numpy(pitch * lines).float()[:, None].repeat(1, ROWS, 1)


def ours(method, lines: np.ndarray, angles=ANGLES, **options) -> np.ndarray:
    """The middle slice [Z, X] of our reconstruction."""
    views = views_at(angles)
    return method(as_thickness(lines), views, Grid.of_views(views), None, quiet, **options)[:, 1].double().numpy()


def inner() -> np.ndarray:
    """The circle that every view sees, without its rim."""
    at = np.arange(SIDE) + 0.5 - SIDE / 2
    return np.hypot(at, at[:, None]) < 0.45 * SIDE


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """Relative distance inside the common circle."""
    return float(np.linalg.norm((first - second)[inner()]) / np.linalg.norm(second[inner()]))


# --- ASTRA --------------------------------------------------------------------------------------------------


def by_astra(kind: str, lines: np.ndarray, iterations: int, model: str) -> np.ndarray:
    """A slice [Z, X] by ASTRA on the processor; its rows run downwards along -z."""
    astra = pytest.importorskip("astra", reason="needs the package astra-toolbox", exc_type=ImportError)
    volume = astra.create_vol_geom(SIDE, SIDE)
    rays = astra.create_proj_geom("parallel", 1.0, SIDE, np.deg2rad(ANGLES))
    projector = astra.create_projector(model, rays, volume)
    data = astra.data2d.create("-sino", rays, lines.astype(np.float32))
    found = astra.data2d.create("-vol", volume)
    settings = astra.astra_dict(kind)
    settings |= {"ProjectorId": projector, "ProjectionDataId": data, "ReconstructionDataId": found}
    if kind == "FBP":
        settings["option"] = {"FilterType": "ram-lak"}
    algorithm = astra.algorithm.create(settings)
    astra.algorithm.run(algorithm, iterations)
    return astra.data2d.get(found)[::-1].astype(np.float64)


@pytest.mark.parametrize("model", ["strip", "linear"])
def test_filtered_backprojection_is_astras(model):
    lines = disc_lines()
    found = ours(filtered_backprojection, lines, options=Ramp("ramlak", 1.0))
    bound = 0.01 if model == "strip" else 0.05  # ASTRA's projector is also what it smears back by
    assert apart(found, by_astra("FBP", lines, 1, model)) < bound


@pytest.mark.parametrize("sweeps", [5, 50])
def test_sirt_is_astras(sweeps):
    lines = disc_lines()
    found = ours(sirt, lines, options=Algebraic(sweeps=sweeps))
    assert apart(found, by_astra("SIRT", lines, sweeps, "strip")) < 1e-5  # the same strips


# --- scikit-image -------------------------------------------------------------------------------------------


def test_filtered_backprojection_is_that_of_scikit_image():
    transform = pytest.importorskip("skimage.transform")
    lines = disc_lines()
    theirs = transform.iradon(lines.T, ANGLES, filter_name="ramp", circle=True)[::-1]  # its rows run along -z
    assert apart(ours(filtered_backprojection, lines, options=Ramp("ramlak", 1.0)), theirs) < 1e-6


# --- svmbir -------------------------------------------------------------------------------------------------


def test_svmbir_sees_what_we_see():
    """Orientation, sign and length: from lines of our own projector, back to the phantom."""
    pytest.importorskip("svmbir", reason="needs the package svmbir")
    views, truth = views_at(), phantom()
    volume = torch.from_numpy(truth).float()[:, None].repeat(1, ROWS, 1)
    volume[:, 0] = 0.3  # rows differ
    grid = Grid.of_views(views)
    projector = SliceProjector(grid, views)
    lines = projector.lines_out(projector.project(projector.volume_in(volume)))
    found = other.svmbir_volume(
        lines, views, grid, None, quiet, options=other.Mbir(snr_db=50, sharpness=0, iterations=100)
    )
    assert found.shape == grid.shape
    assert apart(found[:, 2].double().numpy(), truth) < 0.1  # its prior couples rows; a wrong sign would be above 1
    assert float(found[12:36, 0, 12:36].mean()) == pytest.approx(0.3, rel=0.1)


def test_svmbir_takes_a_shifted_detector():
    pytest.importorskip("svmbir", reason="needs the package svmbir")
    straight, truth = views_at(), phantom()
    views = Views(straight.rotations, np.tile([2 * PITCH, 0.0], (len(straight), 1)), straight.shape, PITCH)
    grid = Grid.of_views(straight)
    projector = SliceProjector(grid, views)
    volume = torch.from_numpy(truth).float()[:, None].repeat(1, ROWS, 1)
    lines = projector.lines_out(projector.project(projector.volume_in(volume)))
    found = other.svmbir_volume(
        lines, views, grid, None, quiet, options=other.Mbir(snr_db=50, sharpness=0, iterations=100)
    )
    assert apart(found[:, 1].double().numpy(), truth) < 0.02


def test_what_svmbir_cannot_do_is_refused(monkeypatch):
    monkeypatch.setattr(other, "_svmbir", lambda: None)
    views = views_at()
    lines, grid = as_thickness(disc_lines()), Grid.of_views(views)
    tilted = Views(views.rotations[:, [0, 2, 1]] * [[1], [1], [-1]], views.shifts, views.shape, PITCH)
    wobbling = Views(views.rotations, PITCH * np.eye(40, 2), views.shape, PITCH)
    with pytest.raises(InputError, match="svmbir needs views that turn about the y axis only"):
        other.svmbir_volume(lines, tilted, grid, None, quiet)
    with pytest.raises(InputError, match="svmbir needs"):
        other.svmbir_volume(lines, wobbling, grid, None, quiet)
    with pytest.raises(InputError, match="rows along y are the detector's rows"):
        other.svmbir_volume(lines, views, Grid.of_views(views, 2), None, quiet)
    away = Grid(grid.shape, grid.voxel_size, (grid.origin[0] + PITCH, *grid.origin[1:]))
    with pytest.raises(InputError, match="its middle on the rotation axis, but it is 1 pixels off"):
        other.svmbir_volume(lines, views, away, None, quiet)


def test_without_svmbir_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "svmbir", None)
    views = views_at()
    with pytest.raises(MissingError, match=r"pip install 'holosplat\[bench\]'"):
        other.svmbir_volume(as_thickness(disc_lines()), views, Grid.of_views(views), None, quiet)


def test_svmbir_is_the_benchmarks_alone():
    """No table of the core has it, whatever is imported; the benchmark's method has it, and no other tomography."""
    assert "svmbir" not in TOMOGRAPHIES
    with pytest.raises(InputError, match="tomography must be one of fbp, art, sirt, sirt-nonneg, tv, but"):
        PerView(tomography="svmbir")
    with pytest.raises(InputError, match="tomography must be one of svmbir, but it is 'tv'"):
        other.MbirPerView(tomography="tv")


def test_the_benchmarks_method_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "svmbir", None)
    exposures = Exposures.of(views_at(), 20.0, 0.01)
    scan = Scan(np.ones((len(ANGLES), ROWS, SIDE), dtype=np.float32), exposures, np.zeros(len(ANGLES), dtype=bool))
    (stage,) = other.MbirPerView("paganin", bounded=False).stages()
    with pytest.raises(MissingError, match="this method needs the package svmbir"):
        stage.start(Task(scan, MaterialPrior.known(DeltaBeta(1e-6, 1e-9))), None)
