"""Cases of continuous matter and uneven light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holosplat.beamline.light import EVEN_LIGHT
from holosplat.materials import parse_material
from holosplat.specimens.continuous import ContinuousScene
from holosplat_bench.suite.case import load_case
from holosplat_bench.suite.prepare import fingerprint


def test_light_is_uneven_on_frames_for_training_alone(monkeypatch):
    case = load_case("light12-5000")
    small = replace(case, exposures=case.exposures[[0, 5, -1]], is_test=case.is_test[[0, 5, -1]])
    monkeypatch.setattr("holosplat.beamline.simulate.SIMULATED_FRINGE_SAMPLES", 2)
    lit, even = small.scan(), replace(small, light=EVEN_LIGHT).scan()
    assert np.array_equal(lit.frames[2], even.frames[2])
    quiet = replace(small, photons=None)
    ratio = quiet.scan().frames[:2] / replace(quiet, light=EVEN_LIGHT).scan().frames[:2]
    assert 0.005 < ratio[0].std() < 0.05
    assert np.abs(ratio[0] - ratio[1]).max() > 0.01
    assert lit.provenance["light_smooth"] == "0.02"
    assert lit.provenance["held_out_frames"] == "noise-free"
    assert fingerprint(small) != fingerprint(replace(small, light=EVEN_LIGHT))


def test_soft_matter_has_its_ratio_and_coats_their_two_materials():
    soft, coated = load_case("soft12"), load_case("coated")
    assert soft.prior.kind == "ratio"
    truth = soft.truth()
    assert truth.delta.sum(dtype=float) / truth.beta.sum(dtype=float) == pytest.approx(1500, rel=1e-3)
    assert isinstance(coated.scene, ContinuousScene)
    shell, core = coated.scene.elements[:2]
    oil, polymer = (parse_material(*m).delta_beta(20.0) for m in (("C16H34", 0.77), ("C5H8O2", 1.19)))
    assert shell.matter == polymer
    assert core.matter == oil.against(polymer)
