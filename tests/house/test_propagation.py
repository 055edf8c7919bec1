"""The frames of `simulate` are those of a second program of other code (`holosplat_bench/suite/multislice.py`)."""

from __future__ import annotations

import ast
import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import holosplat as hs
from holosplat.beamline.simulate import Simulation, simulated_frames
from holosplat.geometry import rotation_tilted
from holosplat.specimens.continuous import Bump, ContinuousScene, Soft, ellipsoid

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
MATTER = hs.DeltaBeta(7e-7, 3e-9)


@pytest.fixture
def propagation(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/propagation.py."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("propagation")


def exposures() -> hs.Exposures:
    """Rows and columns that differ and one of which is odd; a tilted view, a shifted detector, a blur."""
    views = hs.Views(rotation_tilted([25.0], [8.0]), np.array([[2.3e-6, -1.4e-6]]), (33, 28), 1e-6)
    return hs.Exposures.of(views, 20.0, 0.05, 0.6)


def meshes() -> hs.MeshScene:
    """Two cells of different matter."""
    cells = hs.specimens.random_cells(2, (14e-6, 18e-6, 14e-6), 3, 9e-6)
    return hs.MeshScene(tuple(cells), (MATTER, hs.DeltaBeta(2e-7, -1e-9)))


def ellipsoids() -> ContinuousScene:
    """A soft body with a gradient, a sharp one of other matter in it, and a bump."""
    turn = rotation_tilted([30.0], [20.0])[0]
    soft = ellipsoid((1e-6, 2e-6, 0), (8e-6, 9e-6, 6e-6), Soft(0.4), MATTER, turn, (2e4, -1e4, 3e4))
    sharp = ellipsoid((-2e-6, 0, 1e-6), (2e-6, 3e-6, 2.5e-6), Soft(0.0), hs.DeltaBeta(4e-7, 5e-8), turn)
    return ContinuousScene((soft, sharp, ellipsoid((0, -8e-6, 0), (4e-6,) * 3, Bump(3), MATTER)))


@pytest.mark.parametrize("scene", [meshes(), ellipsoids()], ids=["meshes", "ellipsoids"])
def test_two_programs_make_the_same_frame(propagation, scene):
    """To 0.5 % of the contrast on these pixels; and not by having no contrast."""
    taken = exposures()
    frame = next(simulated_frames(scene, taken)).astype(np.float64)
    slabs, one = propagation.other_frames(scene, taken)
    assert propagation.difference(slabs, frame) < 5e-3
    assert 1e-6 < propagation.difference(one, slabs) < 5e-3
    same, _ = propagation.optics_alone(scene, taken, Simulation().samples(taken))
    assert propagation.difference(same, frame) < 1e-5
    assert abs(frame - 1).max() > 0.05


@pytest.mark.parametrize(
    "wrong",
    [
        {"distance": 0.052},
        {"psf_sigma_px": 0.7},
        {"energy_kev": 23.0},
        {"views": replace(exposures().views, shifts=np.array([[2.3e-6, -1.3e-6]]))},
        {"views": replace(exposures().views, rotations=exposures().views.rotations.transpose(0, 2, 1))},
    ],
    ids=["distance", "blur", "energy", "shift", "rotation"],
)
def test_a_wrong_number_is_seen(propagation, wrong):
    taken, samples = exposures(), Simulation().samples(exposures())
    frame = next(simulated_frames(ellipsoids(), taken)).astype(np.float64)
    given = {name: value if name == "views" else np.full(1, value) for name, value in wrong.items()}
    found = propagation.optics_alone(ellipsoids(), replace(taken, **given), samples)[0]
    assert propagation.difference(found, frame) > 1e-2


def test_rays_keep_what_they_pierce(propagation):
    """A box of 4 × 6 × 8 µm: up to its middle half of it, behind it all of it."""
    slices = propagation.other
    corners = np.array([[x, y, z] for x in (-2, 2) for y in (-3, 3) for z in (-4, 4)]) * 1e-6
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([[a, b, c] for a, b, c, d in sides] + [[a, c, d] for a, b, c, d in sides])
    on = slices.Raster((9, 7), 1e-6, 2, (0, 1))
    met = slices.Surfaces.of([(corners, faces, 2.0, -1.0)], np.eye(3), on)
    for depth, length in ((-5e-6, 0), (0, 4e-6), (1e-3, 8e-6)):
        delta, beta = met.up_to(depth)
        assert np.unique(np.round(delta, 12)).tolist() == sorted({0, 2 * length})
        assert (delta > 1e-9).sum() == (8 * 12 if length else 0)
        np.testing.assert_allclose(beta, -0.5 * delta, atol=1e-18)
    with pytest.raises(ValueError, match="closed"):
        slices.Surfaces.of([(corners, faces[:-1], 1.0, 1.0)], np.eye(3), on)


def test_the_second_program_imports_nothing_of_the_first():
    tree = ast.parse((BENCHMARKS.parent / "src/holosplat_bench/suite/multislice.py").read_text(encoding="utf-8"))
    named = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    named |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    assert named == {"__future__", "collections.abc", "dataclasses", "itertools", "typing", "numpy", "scipy"}
