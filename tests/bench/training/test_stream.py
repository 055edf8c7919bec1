"""Scenes as a torch dataset: the same for a number whatever else is drawn, in other processes too."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from holosplat.checks import InputError
from holosplat_bench.training.folder import Dataset, Scenes, tensors_of
from holosplat_bench.training.options import Ranges
from holosplat_bench.training.sample import Sample, sample_of

TINY = Ranges(rows=24, columns=24, views=2, held_out=1, across=(8.0, 10.0), fresnel=(0.05, 0.2), filled=(0.01, 0.02))


def test_a_scene_is_that_of_its_number_in_any_order_and_in_workers():
    scenes = Scenes(TINY, seed=3, count=3)

    loaded = list(DataLoader(scenes, batch_size=1, num_workers=2, sampler=[2, 0]))

    for batch, number in zip(loaded, (2, 0), strict=True):
        alone = sample_of(TINY, 3, number)
        assert set(batch) == set(Sample.names())
        for name in Sample.names():
            assert torch.equal(batch[name][0], torch.from_numpy(np.asarray(getattr(alone, name))))


def test_a_batch_is_a_stack_and_lessons_may_take_its_place():
    scenes = Scenes(TINY, seed=3, count=2)

    batch = next(iter(DataLoader(scenes, batch_size=2)))
    shown = Scenes(TINY, seed=3, count=2, shown=lambda sample: sample.facts[0])

    assert batch["contrast"].shape == (2, 3, 24, 24)
    assert batch["occupancy"].shape == (2, 24, 24, 24)
    assert [shown[0], shown[-1]] == [float(batch["facts"][k, 0]) for k in (0, 1)]


def test_numbers_beyond_the_last_scene_are_none():
    scenes = Scenes(TINY, count=2, shown=lambda sample: 1)

    assert len(scenes) == 2
    assert [scenes[k] for k in range(-2, 2)] == [1, 1, 1, 1]
    for number in (2, -3):
        with pytest.raises(IndexError, match="from 0 to 1"):
            scenes[number]
    with pytest.raises(InputError, match="count must lie between 1 and"):
        Scenes(TINY, count=0)


def test_a_folder_gives_the_same_scenes(tmp_path):
    dataset = Dataset(tmp_path / "data", TINY, 3, 1)
    dataset.begin()
    with pytest.raises(InputError, match="lacks 1 of 1 files"):
        Dataset.read(dataset.folder).require_whole()
    dataset.make(dataset.missing()[0])

    kept, drawn = tensors_of(Dataset.read(dataset.folder).sample(0)), Scenes(TINY, 3)[0]

    assert all(torch.equal(kept[name], drawn[name]) for name in Sample.names())
