"""Pixel-aligned networks learn from frames alone, go on where they stopped, and go to the methods of their name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.ball_sample import ball_sample
from helpers.two_balls import ONE, scan, truth
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.learning.start import Card, write_weights
from holosplat.matter import MaterialPrior
from holosplat.methods import Task, solve
from holosplat_bench.opponents.fields import AlignedNetwork, PixelAligned, PixelAlignedField
from holosplat_bench.opponents.fields.weights import read_aligned, write_aligned
from holosplat_bench.opponents.onix import AlignedFit, Onix, PixelNerf
from holosplat_bench.opponents.training import (
    AlignedTraining,
    AlignedValidation,
    Critic,
    draw_aligned_example,
    first_views,
)
from holosplat_bench.training.folder import Dataset
from holosplat_bench.training.options import FrameLossWeights, Ranges, TrainOptions, ViewSampling
from holosplat_bench.training.sample import Sample

pytestmark = pytest.mark.usefixtures("unjudged_runs")

SMALL = AlignedNetwork((4, 6), 8, 2)
OPTIONS = TrainOptions(
    steps=4,
    warm_up=2,
    keep_every=2,
    rate=0.02,
    network="onix",
    shown=ViewSampling(views=(2, 3)),
    frames=FrameLossWeights(),
)
ADVERSE = replace(OPTIONS, frames=FrameLossWeights(adversary=0.1, pretrain=0.3))
KNOWN = MaterialPrior.known(ONE.channels[0])


@pytest.fixture(scope="module")
def sample() -> Sample:
    return ball_sample()


@pytest.fixture
def data(tmp_path, monkeypatch, sample) -> Dataset:
    monkeypatch.setattr(Dataset, "sample", lambda self, index: sample)
    return Dataset(tmp_path / "data", Ranges(), 0, 4)


class SmallTraining(AlignedTraining):
    """The same of a small network."""

    def __init__(self, data: Dataset, folder: Path, options: TrainOptions) -> None:
        super().__init__(data, folder, options, SMALL)


def run(data: Dataset, folder: Path, options: TrainOptions, stop: int = 0, resume: bool = False) -> SmallTraining:
    training = (SmallTraining.resumed if resume else SmallTraining.begun)(data, folder, options)

    def on_step(now: object) -> None:
        if training.step == stop:
            raise KeyboardInterrupt

    training.run(AlignedValidation([data.sample(0)], size=SMALL), on_step)
    assert isinstance(training, SmallTraining)
    return training


def test_what_is_resumed_ends_as_what_was_never_interrupted_the_discriminator_too(data, tmp_path):
    whole = run(data, tmp_path / "whole", ADVERSE)
    with pytest.raises(KeyboardInterrupt):
        run(data, tmp_path / "parts", ADVERSE, stop=3)  # the checkpoint is of step 2

    parts = run(data, tmp_path / "parts", ADVERSE, resume=True)

    assert whole.rows == parts.rows
    assert whole.critic is not None
    assert parts.critic is not None
    for ours, theirs in ((whole.network, parts.network), (whole.critic, parts.critic)):
        state = theirs.state_dict()
        assert all(torch.equal(value, state[name]) for name, value in ours.state_dict().items())
    assert [row[3] > 0 for row in whole.rows] == [False, False, True, True]


def test_frames_alone_teach_where_matter_is(data, tmp_path, sample, monkeypatch):
    """Nothing of the sample's occupancy is shown to the network: it may be anything."""
    blind = replace(sample, occupancy=np.zeros_like(sample.occupancy))
    monkeypatch.setattr(Dataset, "sample", lambda self, index: blind)
    training = run(data, tmp_path / "run", replace(OPTIONS, steps=40, keep_every=40, rate=0.05))

    first, last = (np.mean([row[2] for row in part]) for part in (training.rows[:3], training.rows[-3:]))
    assert last < 0.7 * first
    field = first_views(sample, 3, "onix").field(dict(training.network.named_parameters()), SMALL)
    found = field.values().detach()[0].numpy()
    assert np.corrcoef(found.ravel(), truth(field.grid).numpy().ravel())[0, 1] > 0.6


def test_weights_go_to_the_method_of_their_name(data, tmp_path, sample):
    told = AlignedValidation([sample], size=SMALL)
    training = SmallTraining.begun(data, tmp_path / "run", replace(OPTIONS, steps=2))
    training.run(told, lambda now: None)
    path = training.finish(told, {"commit": "abc"})

    found = read_aligned(path, "onix")

    assert (found.size, found.card.made_by, found.card.training["network"]) == (SMALL, {"commit": "abc"}, "onix")
    assert set(found.card.scores) == {"2", "3"}
    assert "It saw scenes in 2 and 3 views" in found.card.limits
    guess = AlignedFit(weights=str(path), schedule=Schedule(steps=0))
    field = solve(Onix(guess), Task(scan(), KNOWN, 5))
    assert isinstance(field, PixelAlignedField)
    assert torch.equal(field.weights["all.weight"], training.network.state_dict()["all.weight"].half().float())
    with pytest.raises(InputError, match="must hold weights of the network pixelnerf, but it holds onix; train it"):
        solve(PixelNerf(guess), Task(scan(), KNOWN))


@pytest.mark.parametrize("network", ["onix", "pixelnerf"])
def test_a_misfit_is_nothing_where_the_prediction_is_right(sample, network):
    lesson = first_views(sample, 2, network)
    field = lesson.field(dict(PixelAligned(SMALL).named_parameters()), SMALL)
    right = field.at(0.0).with_parameters({"values": truth(field.grid)[None]})
    empty = right.with_parameters({"values": torch.zeros(1, *field.grid.shape)})

    assert list(lesson.seen) == [0, 1]
    assert list(lesson.targets) == [3, 4, 5, 2]
    assert float(lesson.misfit(right)) < 0.15  # voxels at pixels' pitch are full or empty
    assert 0.3 < float(lesson.misfit(empty)) < 3


def test_half_of_what_is_foretold_is_not_shown(sample):
    for step in range(8):
        lesson = draw_aligned_example(sample, ViewSampling(views=(2, 3)), 3, "onix", np.random.default_rng(step))
        assert sum(target not in lesson.seen for target in lesson.targets) == 2
        assert len(set(lesson.targets)) == 3
        assert not sample.is_test[lesson.seen].any()


def test_a_discriminator_learns_to_tell_and_says_how_to_mislead_it():
    torch.manual_seed(0)
    critic = Critic()
    optimiser = torch.optim.AdamW(critic.parameters(), 1e-2)
    real, made = (scale * torch.randn(1, 1, 25, 28) for scale in (2.0, 0.2))
    before = float(critic.loss(made, real).detach())
    for _ in range(15):
        optimiser.zero_grad()
        critic.loss(made, real).backward()
        optimiser.step()
    assert float(critic.loss(made, real).detach()) < before
    assert float(critic.misled(real).detach()) < float(critic.misled(made).detach())


def test_other_files_are_no_weights(tmp_path):
    from holosplat.learning.network import Guess, Size

    path = tmp_path / "weights.safetensors"
    write_weights(path, Guess(Size((4, 4, 4, 4), 3, (4, 4, 4))), Card())
    with pytest.raises(InputError, match="must hold weights of the network onix, but it holds others"):
        read_aligned(path, "onix")
    weights = dict(PixelAligned(SMALL).named_parameters())
    write_aligned(path, "onix", SMALL, weights | {"output.bias": torch.full((2,), torch.nan)}, Card())
    with pytest.raises(InputError, match="but it does not; train anew"):
        read_aligned(path, "onix")
    with pytest.raises(InputError, match="none validates: validation_views must be 0, but it is 2"):
        AlignedFit(schedule=Schedule(validation_views=2))
