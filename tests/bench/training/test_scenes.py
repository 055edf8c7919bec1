"""Scenes for learning: the same for ever, whole, and shown in ways that agree with themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torch.nn.functional import avg_pool2d

from holosplat.checks import InputError
from holosplat.learning.network import FINE, coarse, thickness_of
from holosplat.materials import DeltaBeta
from holosplat.specimens.drawn import Substances
from holosplat_bench.declaration import Matter, Substance, case_of
from holosplat_bench.specimens.fluids import Bubbles
from holosplat_bench.training.folder import Dataset, write_datasheet
from holosplat_bench.training.options import Ranges
from holosplat_bench.training.sample import Sample, draw_scene, sample_of
from holosplat_bench.training.shown import make_example

WATER = Substance("H2O", 1.0)
TINY = Ranges(rows=34, columns=30, views=3, held_out=1, across=(9.0, 11.0), fresnel=(0.02, 0.1), noiseless=1.0)


@pytest.fixture(scope="module")
def sample() -> Sample:
    return sample_of(TINY, 3, 0)


def test_a_scene_is_the_same_for_ever_and_others_differ(sample):
    again = sample_of(TINY, 3, 0)

    assert all(np.array_equal(getattr(sample, name), getattr(again, name)) for name in Sample.names())
    assert draw_scene(TINY, 3, 0) == draw_scene(TINY, 3, 0) != draw_scene(TINY, 3, 1) != draw_scene(TINY, 4, 0)


def test_what_is_drawn_lies_in_its_ranges():
    for index in range(40):
        scene = draw_scene(Ranges(), 1, index)
        pixel, energy = scene.detector.pixel_size, scene.beam.energy_kev
        number = pixel**2 / (12.398e-10 / energy * scene.beam.distance)
        assert number * 1.001 >= 0.02
        assert number <= 0.6 * 1.001
        assert 8 <= energy <= 30
        assert 0.9 * 7.82e-6 / 22 <= pixel <= 1.1 * 7.82e-6 / 10


@pytest.mark.parametrize("kind", ["capsules", "filled-capsules", "ellipsoids", "crowd", "foam", "soft-cells"])
def test_every_kind_can_be_imaged(kind):
    found = sample_of(replace(TINY, kinds=(kind,), views=2, rows=40, columns=40), 0, 0)

    assert 0 < found.occupancy.mean() / 255 < 0.6
    assert np.abs(found.contrast).max() > 0


def test_matter_that_fills_the_field_can_be_declared():
    """Bubbles in water, seen as the kind itself draws them."""
    declared = draw_scene(TINY, 3, 0)
    pixel = declared.detector.pixel_size
    declared = replace(declared, specimen=Bubbles(20 * pixel, 3), matter=Matter(Substance("vacuum"), None, WATER))
    water = WATER.delta_beta(declared.beam.energy_kev)
    drawn = declared.specimen.drawn(Substances(DeltaBeta(0.0, 0.0), None, water), 5)

    case = case_of(declared, "bubbles", 5)

    assert case.specimen == drawn.text
    (_, seen), (_, expected) = (scene.project(case.exposures.views) for scene in (case.scene, drawn.scene))
    assert np.array_equal(seen, expected)
    assert seen.min() < 0


def test_a_medium_turns_the_sign_of_the_absorption_and_changes_nothing_else_that_is_drawn():
    dry, wet = (draw_scene(replace(TINY, medium=share), 0, 0) for share in (0.0, 1.0))
    told = [scene.material_prior().materials[0] for scene in (dry, wet)]

    assert told[1].delta == pytest.approx(told[0].delta)
    assert told[1].beta == pytest.approx(-told[0].beta)
    assert wet.matter.medium.delta_beta(20.0).delta > told[0].delta
    assert (wet.specimen, wet.beam, wet.views) == (dry.specimen, dry.beam, dry.views)


def test_filled_capsules_are_of_two_levels_of_one_ratio():
    found = draw_scene(replace(TINY, kinds=("filled-capsules",), medium=1.0), 0, 0)
    assert found.matter.core is not None
    core, shell, medium = (
        part.delta_beta(20.0) for part in (found.matter.core, found.matter.material, found.matter.medium)
    )
    inside, outside = core.against(medium), shell.against(medium)
    assert 0.2 <= inside.delta / outside.delta <= 0.8
    assert inside.ratio == pytest.approx(outside.ratio)


@pytest.mark.parametrize(("flipped", "turns"), [(False, 0), (True, 0), (False, 1), (True, 3)])
def test_images_are_those_of_the_occupancy_that_is_shown(sample, flipped, turns):
    truth = replace(sample, thickness=_true_thickness(sample))

    shown = make_example(truth, [2, 0], slice(4, 30), flipped, turns)

    seen = avg_pool2d(shown.images[:, 1:2], FINE)[:, 0]
    meant = thickness_of(coarse(shown.occupancy).flatten(), shown.taps)
    assert float((seen - meant).norm() / meant.norm()) < 0.12
    assert shown.occupancy.shape == (30, 26, 30)


def _true_thickness(sample: Sample) -> np.ndarray:
    """What the frames' retrieved thickness should be, by the lattice of whole frames."""
    whole = make_example(sample, list(range(4)), slice(None), False, 0)
    shadows = thickness_of(coarse(whole.occupancy).flatten(), whole.taps) * 4
    return shadows.repeat_interleave(2, 1).repeat_interleave(2, 2).numpy().astype(np.float16)


def test_a_dataset_goes_on_with_what_it_lacks_and_is_no_other(tmp_path, monkeypatch, sample):
    made = list[int]()

    def simulated(ranges: Ranges, seed: int, index: int) -> Sample:
        made.append(index)
        return sample

    monkeypatch.setattr("holosplat_bench.training.folder.sample_of", simulated)
    monkeypatch.setattr("holosplat_bench.training.folder.SHARD", 2)
    dataset = Dataset(tmp_path / "data", TINY, 3, 3)
    dataset.begin()
    dataset.make(dataset.missing()[0])
    with pytest.raises(InputError, match="lacks 1 of 2 files; run holosplat dataset again"):
        Dataset.read(tmp_path / "data").require_whole()

    for shard in Dataset.read(tmp_path / "data").missing():
        dataset.make(shard)
    larger = replace(dataset, count=4)
    larger.begin()

    assert made == [0, 1, 2]
    assert larger.missing() == [range(2, 4)]
    kept = larger.sample(2)
    assert all(np.array_equal(getattr(kept, name), getattr(sample, name)) for name in Sample.names())
    with pytest.raises(InputError, match="other ranges or another seed"):
        replace(dataset, seed=4).begin()
    with pytest.raises(InputError, match="holosplat dataset made"):
        Dataset.read(tmp_path)


def test_the_datasheet_tells_every_range_and_every_array(tmp_path):
    dataset = Dataset(tmp_path, TINY, 3, 3)
    write_datasheet(dataset)

    text = (tmp_path / "datasheet.md").read_text(encoding="utf-8")

    assert all(f"| {name} | " in text for name in vars(TINY))
    assert all(name in text for name in Sample.names())
    assert "| across | 9 to 11 | " in text
    assert "3 scenes of red-cells" in text


def test_ranges_that_are_none_are_refused():
    with pytest.raises(InputError, match="phase must be \\(least, most\\)"):
        Ranges(phase=(0.5, 0.1))
    with pytest.raises(InputError, match="views must be at least 2"):
        Ranges(views=1)
