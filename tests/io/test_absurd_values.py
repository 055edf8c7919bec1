"""Values that no experiment has: one sentence that names them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holosplat.beamline.grow import Growth
from holosplat.beamline.light import UnevenLight
from holosplat.beamline.simulate import field_centre
from holosplat.checks import InputError, whole_seed
from holosplat.cli.options import MaterialOptions
from holosplat.geometry import Views
from holosplat.scan import Exposures, Scan
from holosplat.workflows.preconditions import check_frames

VIEWS = Views.evenly_spaced(2, (5, 13), 1e-6)


@pytest.mark.parametrize("seed", [-1, 1 << 63, 1 << 70])
def test_seeds_are_those_that_generators_take(seed):
    assert whole_seed("--seed", (1 << 63) - 1) == (1 << 63) - 1
    with pytest.raises(InputError, match=r"--seed must be (0 or more|below 2⁶³), but"):
        whole_seed("--seed", seed)
    with pytest.raises(InputError, match="light_seed must"):
        UnevenLight(light_seed=seed)
    with pytest.raises(InputError, match="seed must"):
        Growth(seed=seed)


def test_an_empty_name_is_no_material():
    with pytest.raises(InputError, match="material"):
        MaterialOptions(material="").filling()


def test_blur_and_shifts_are_those_of_detectors():
    with pytest.raises(InputError, match=r"psf_sigma_px must be at most 1000, but it is 1e\+09"):
        Exposures.of(VIEWS, 20.0, 0.1, 1e9)
    with pytest.raises(InputError, match=r"detector shift must be at most 1e\+06 pixels"):
        replace(VIEWS, shifts=np.full((2, 2), 1e9))


def test_a_field_of_view_lies_on_earth():
    bounds = (np.zeros(3), np.ones(3))
    assert field_centre(bounds, (1e5, 0, 0), "um")[0] == pytest.approx(0.1)
    with pytest.raises(InputError, match=r"origin must lie within 1 m, but it is \(1e\+300, 0, 0\) um"):
        field_centre(bounds, (1e300, 0, 0), "um")


def test_intensities_are_not_below_zero():
    """Noise may take some there, behind metal."""
    frames = np.full((2, 5, 13), 0.9, dtype=np.float32)
    frames[:, :, :3] = -0.01
    scan = Scan(frames, Exposures.of(VIEWS, 20.0, 0.1), np.zeros(2, dtype=bool))
    check_frames(scan)
    frames[:, :, :4] = -0.01
    with pytest.raises(InputError, match="31% of their pixels are below zero"):
        check_frames(replace(scan, frames=frames))
