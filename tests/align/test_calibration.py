"""Geometry by bodies of known shape: phantoms, beads, and what they cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import holosplat as hs
from helpers.polycube import polycube
from holosplat.align import CalibrationOptions, PosePrior, calibrate
from holosplat.align.calibration import Calibrated, _Search
from holosplat.align.derivatives import changes, moved_onto
from holosplat.align.phantom import Phantom, linearised, solved
from holosplat.beamline.misalignment import Misalignment
from holosplat.bodies.rest_shape import centroid
from holosplat.geometry import Views, rotation_tilted
from holosplat.model import Alignment, measure
from holosplat.specimens.red_cells import icosphere

PIXEL, SHAPE = 1e-6, (45, 48)
MATERIAL = hs.DeltaBeta(5e-7, 5e-10)
QUICK = CalibrationOptions(retrieval=0)
KNOWN = hs.MaterialPrior.known(MATERIAL)
BEADS = np.array([[9, -8, 3], [-10, 5, 7], [2, 10, -11], [-5, -11, -8]], dtype=float)


def planned(pixel: float = PIXEL) -> hs.Exposures:
    views = Views.from_rotations(rotation_tilted([0, 40, 85, 130], [0, 9, -6, 4]), SHAPE, pixel)
    return hs.Exposures.of(views, 20.0, 0.05, 0.3)


def frames_of(scene: hs.MeshScene, true: hs.Exposures, said: hs.Exposures) -> hs.Scan:
    """By rays through the scene, which the fit knows nothing of."""
    made = hs.simulate(scene, true, seed=0, is_test=np.zeros(len(true), dtype=bool))
    return hs.Scan(made.frames, said, made.is_test)


def beads(places: np.ndarray, radius: float = 4.0) -> hs.MeshScene:
    vertices, faces = icosphere(4)
    meshes = [hs.mesh.TriangleMesh(PIXEL * (radius * vertices + place), faces) for place in places]
    return hs.MeshScene.of_one_material(meshes, MATERIAL)


def worst(found: Calibrated, true: hs.Exposures) -> np.ndarray:
    """Largest errors [6] of the views, all moved together as near to the true ones as can be."""
    moved = replace(found.exposures, views=moved_onto(found.exposures.views, true.views))
    return np.abs(changes(moved, true)).max(0)


@pytest.fixture(scope="module")
def with_mesh() -> tuple[Calibrated, hs.Exposures]:
    """A body without symmetry in a pose far from that of its file; each view off by 1 px, 0.6°, 2 %."""
    true = Misalignment(1.0, 0.6, 0.02, 3).true_exposures(planned())
    body = polycube(7 * PIXEL)
    turn = Rotation.from_rotvec([0.7, -0.4, 1.9]).as_matrix()
    there = body.transformed(turn, PIXEL * np.array([2, -1, 1.5]) - turn @ centroid(body))
    scan = frames_of(hs.MeshScene.of_one_material([there], MATERIAL), true, planned())
    return calibrate(scan, KNOWN, body, QUICK), true


def test_a_phantom_tells_the_geometry_to_the_bars(with_mesh):
    """Shifts 0.05 px, turns 0.1°, roll 0.05°, distance 1 %."""
    found, true = with_mesh
    errors = worst(found, true)
    assert errors[:2].max() < 0.02
    assert errors[2:4].max() < 0.1
    assert errors[4] < 0.05
    assert errors[5] < 0.006
    before = np.abs(changes(replace(planned(), views=moved_onto(planned().views, true.views)), true)).max(0)
    assert (before[:6] > [0.5, 0.5, 0.3, 0.3, 0.2, 0.01]).all()
    assert found.words == ()
    assert len(found.lines()) == 6


def test_the_common_motion_goes_to_the_phantom(with_mesh):
    """Mean turns and shifts are those planned; the phantom is where the views see it."""
    found, _ = with_mesh
    again = moved_onto(found.exposures.views, planned().views)
    np.testing.assert_allclose(again.rotations, found.exposures.views.rotations, atol=1e-6)
    np.testing.assert_allclose(again.shifts, found.exposures.views.shifts, atol=1e-4 * PIXEL)
    seen = measure(found.phantom.surfaces(MATERIAL, PIXEL), found.exposures, 3)
    assert float(found.left.max()) < 0.05
    assert seen.shape == (4, *SHAPE)


def test_beads_in_unknown_places_tell_it_too():
    """Ten times better than the bars; and where the beads are, but for a motion of all."""
    true = Misalignment(1.0, 0.6, 0.02, 3).true_exposures(planned())
    found = calibrate(frames_of(beads(BEADS), true, planned()), KNOWN, 4.0 * PIXEL, QUICK)
    assert len(found.phantom) == len(BEADS)
    errors = worst(found, true)
    assert errors[:2].max() < 0.005
    assert errors[2:5].max() < 0.02
    assert errors[5] < 0.003
    apart = [np.sort(np.linalg.norm(p[:, None] - p, axis=2).ravel()) for p in (found.phantom.places / PIXEL, BEADS)]
    np.testing.assert_allclose(*apart, atol=0.01)


def test_one_bead_tells_no_turns_and_a_pixel_may_be_told():
    """What is not told stays as planned, and is said. The pixel is said to be 3 % larger than it is."""
    said = planned(1.03 * PIXEL)
    scan = frames_of(beads(BEADS[:1], 6.0), planned(), said)
    options = CalibrationOptions(PosePrior(5.0, 1.0, 1.0, 0.05), pixel=0.05, retrieval=0)
    found = calibrate(scan, KNOWN, 6.0 * PIXEL, options)
    assert "one bead looks the same" in found.words[0]
    np.testing.assert_allclose(found.exposures.views.rotations, said.views.rotations, atol=1e-9)
    assert not found.errors[:, 2:5].any()
    size, doubt = found.pixel_size
    assert size == pytest.approx(PIXEL, rel=2e-3)
    assert doubt < 5e-3
    assert found.exposures.views.pixel_size == size
    assert "pixel 1.00" in found.lines()[0] or "pixel 0.99" in found.lines()[0]


def test_shifts_are_of_the_pixels_that_are_found():
    """Planned ones and those beside them, in pixels of any size; and on pixels that are three times larger."""
    views = replace(planned().views, shifts=PIXEL * np.array([[4.0, -2.0], [1.0, 3.0], [0.0, 0.5], [-1.0, 2.0]]))
    scan = hs.Scan(np.ones((4, *SHAPE), np.float32), replace(planned(), views=views), np.zeros(4, dtype=bool))
    search = _Search(scan, KNOWN, Phantom.of_beads(PIXEL * BEADS, 4 * PIXEL), QUICK)
    search.numbers[:, :2] = torch.tensor([[0.3, -0.6], [0.9, 0.0], [-0.3, 0.6], [1.2, 0.3]])
    search.size = float(np.log(1.04))
    wanted = views.shifts / PIXEL + search.numbers[:, :2].numpy()
    for pixels in (1, 3):
        found = search.exposures(scan.binned(pixels).exposures).views
        assert found.pixel_size == pytest.approx(1.04 * pixels * PIXEL, rel=1e-9, abs=0)
        np.testing.assert_allclose(pixels * found.shifts / found.pixel_size, wanted, rtol=1e-9)


def test_frames_in_contact_have_no_distance_to_be_found():
    """Of some such frames among others, too: all distances stay, and are not said to be untold."""
    true = replace(planned(), distance=np.array([0.0, 0.05, 0.05, 0.05]))
    search = _Search(frames_of(beads(BEADS), true, true), KNOWN, Phantom.of_beads(PIXEL * BEADS, 4 * PIXEL), QUICK)
    search.step(1)
    found = search.found()
    assert not found.errors[:, 5].any()
    assert not found.changes[:, 5].any()
    assert (found.errors[:, :2] > 0).all()
    assert not [word for word in found.words if word.startswith("distance")]


def test_derivatives_are_those_of_the_frames():
    """Of each number, beside central differences over larger steps, in a rectangular field."""
    phantom, exposures = Phantom.of_beads(PIXEL * BEADS, 4.0 * PIXEL), planned()
    here = linearised(phantom, exposures, MATERIAL, 1, True)

    def seen(bodies: Phantom, of: hs.Exposures) -> torch.Tensor:
        return measure(bodies.surfaces(MATERIAL, of.views.pixel_size), of, 1).double()

    def turned(by: float) -> hs.Exposures:
        turns = torch.tensor([[0.0, by, 0.0]] * 4, dtype=torch.float64)
        return Alignment(turns=turns).exposures(exposures)

    nudge = np.zeros((4, 3))
    nudge[2, 1] = 0.1 * PIXEL
    wide = replace(exposures.views, pitch=PIXEL * 1.01), replace(exposures.views, pitch=PIXEL / 1.01)
    pairs = (
        (here.of_views[:, 3], seen(phantom, turned(0.005)) - seen(phantom, turned(-0.005)), 0.01),
        (here.of_all[7], seen(phantom.shifted(nudge), exposures) - seen(phantom.shifted(-nudge), exposures), 0.2),
        (
            here.of_all[12],
            seen(phantom, replace(exposures, views=wide[0])) - seen(phantom, replace(exposures, views=wide[1])),
            2 * np.log(1.01),
        ),
    )
    for found, difference, step in pairs:
        assert float((found - difference / step).norm()) < 0.15 * float(found.norm())


def test_numbers_that_do_not_matter_keep_what_was_expected():
    """And those of no uncertainty do not move: least squares of a straight line."""
    rng = torch.Generator().manual_seed(0)
    phantom, exposures = Phantom.of_beads(PIXEL * BEADS, 4.0 * PIXEL), planned()
    here = linearised(phantom, exposures, MATERIAL, 1, False)
    truth = 0.01 * torch.randn(4, 8, generator=rng, dtype=torch.float64)
    truth[:, [4, 6]] = 0
    frames = here.frames + torch.einsum("vk,vkhw->vhw", truth, here.of_views)
    numbers = (torch.zeros(4, 8, dtype=torch.float64), torch.zeros(12, dtype=torch.float64))
    wide = (torch.tensor([9.0, 9, 9, 9, 0, 9, 0, 9], dtype=torch.float64), torch.zeros(12, dtype=torch.float64))
    after = solved(frames, here, numbers, wide, 1.0)
    torch.testing.assert_close(after.of_views, truth, atol=1e-4, rtol=1e-2)
    assert not after.of_views[:, 4].any()
    assert not after.of_all.any()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"prior": hs.MaterialPrior.of_ratio(500.0)}, "material, of known density"),
        ({"body": 0.4 * PIXEL}, "radius of a pixel at least"),
        ({"body": replace(polycube(PIXEL), faces=polycube(PIXEL).faces[:, ::-1])}, "encloses no volume"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(change, said):
    scan = frames_of(beads(BEADS[:2]), planned(), planned())
    given = {"prior": KNOWN, "body": 4.0 * PIXEL} | change
    with pytest.raises(hs.InputError, match=said):
        calibrate(scan, given["prior"], given["body"], QUICK)
