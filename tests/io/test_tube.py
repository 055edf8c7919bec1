"""A tube around the object: how much light passes its wall, and frames as if without it."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_tilted
from holosplat.io.formats import read_as
from holosplat.io.larger_frames import Tube
from holosplat.io.nxtomo import write_scan
from holosplat.io.reading import Part, Reading, Told
from holosplat.scan import Exposures, Scan

SHAPE, PIXEL, COLUMN = (3, 21), 1e-4, 8.0
TUBE = Tube(1e-3, 1.6e-3, 500.0)


def a_scan(frames: np.ndarray | None = None) -> Scan:
    exposures = Exposures.of(Views.from_angles([0.0, 40.0, 90.0, 130.0], SHAPE, PIXEL), 20.0, 0.0)
    return Scan(np.ones((4, *SHAPE)) if frames is None else frames, exposures, np.zeros(4, dtype=bool))


def test_the_wall_takes_light_by_its_length_along_the_ray():
    passed = TUBE.transmission(a_scan().views.about_column(COLUMN))
    assert passed.shape == (4, 21)
    at = {x: passed[0, int(COLUMN) + x] for x in (0, 5, -5, 6, 8, 12)}
    assert at[0] == pytest.approx(np.exp(-500 * 0.6e-3))
    assert at[5] == pytest.approx(np.exp(-500 * 2 * np.sqrt(0.8e-3**2 - 0.5e-3**2)))  # just beside the bore
    assert at[6] == pytest.approx(np.exp(-500 * 2 * np.sqrt(0.8e-3**2 - 0.6e-3**2)))
    assert at[-5] == pytest.approx(at[5])
    assert (at[8], at[12]) == (1.0, 1.0)
    np.testing.assert_array_equal(passed[1:], passed[:1].repeat(3, axis=0))


def test_what_is_said_of_a_tube_goes_before_the_part_that_is_taken(tmp_path):
    object_alone = np.linspace(0.2, 1, 4 * 3 * 21).reshape(4, *SHAPE)
    passed = TUBE.transmission(a_scan().views.about_column(COLUMN))
    write_scan(tmp_path / "tube.nxs", a_scan(object_alone * passed[:, None]))
    told = Told(axis_column=COLUMN, tube="1e-3:1.6e-3:500")
    found = read_as(tmp_path / "tube.nxs", Reading(told, Part(views="1:3", crop=":,2:20")))
    np.testing.assert_allclose(found.frames, object_alone[1:3, :, 2:20], rtol=1e-5)
    assert "divided out" in found.provenance["tube"]
    assert "tube" not in told.given()


@pytest.mark.parametrize(
    ("text", "words"),
    [("4e-3", "INNER:OUTER:ATTENUATION"), ("a:b:c", "INNER:OUTER"), ("2:1:5", "greater outer"), ("1:2:-5", "positive")],
)
def test_other_tubes_are_refused(text, words):
    with pytest.raises(InputError, match=words):
        Tube.parsed(text)


def test_a_tube_needs_an_axis():
    views = Views.from_rotations(
        rotation_tilted(np.array([0.0, 30.0, 70.0]), np.array([0.0, 20.0, -40.0])), SHAPE, 1e-4
    )
    with pytest.raises(InputError, match="one axis"):
        TUBE.transmission(views)
