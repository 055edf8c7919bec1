"""Training: it learns, goes on where it stopped, and says what the weights are."""

from __future__ import annotations

import csv
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import rotation_y
from holosplat.learning.network import Size
from holosplat.learning.start import read_weights
from holosplat_bench.training.folder import Dataset
from holosplat_bench.training.options import LossWeights, Ranges, TrainOptions, ViewSampling
from holosplat_bench.training.sample import Sample
from holosplat_bench.training.shown import Validation, dice, example_of_views, loss, soft_dice
from holosplat_bench.training.train import Training

OPTIONS = TrainOptions(
    steps=6,
    warm_up=2,
    keep_every=3,
    rate=5e-3,
    precision="float32",
    size=Size((4, 4, 6, 6), 3, (4, 6, 8)),
    shown=ViewSampling(rows=(16,)),
)


def a_sample(seed: int) -> Sample:
    """A full box in three views, without the trouble of imaging it."""
    rng = np.random.default_rng(seed)
    occupancy = np.zeros((16, 20, 16), dtype=np.uint8)
    z, y, x = rng.integers(2, 8, 3)
    occupancy[z : z + 6, y : y + 6, x : x + 6] = 255
    full = occupancy / 255
    seen = np.stack([full.sum(0), full.sum(2).T[:, ::-1], full.sum(0)[:, ::-1]]).astype(np.float16)
    rotations = rotation_y([0.0, 90.0, 180.0])
    return Sample(
        seen * 0.01,
        seen,
        np.full(3, 1e-3, np.float32),
        rotations,
        np.zeros((3, 2)),
        np.zeros(3, bool),
        occupancy,
        np.zeros(8),
    )


@pytest.fixture
def data(tmp_path, monkeypatch) -> Dataset:
    monkeypatch.setattr(Dataset, "sample", lambda self, index: a_sample(index))
    return Dataset(tmp_path / "data", Ranges(), 0, 4)


def run(data: Dataset, folder: Path, options: TrainOptions = OPTIONS, stop: int = 0, resume: bool = False) -> Training:
    training = (Training.resumed if resume else Training.begun)(data, folder, options)

    def on_step(now: Training) -> None:
        if now.step == stop:
            raise KeyboardInterrupt

    training.run(Validation([a_sample(9)]), on_step)
    return training


def test_what_is_resumed_ends_as_what_was_never_interrupted(data, tmp_path):
    whole_run = run(data, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(data, tmp_path / "parts", stop=4)  # the checkpoint is of step 3

    parts = run(data, tmp_path / "parts", resume=True)

    ours, theirs = (each.network.state_dict() for each in (whole_run, parts))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert whole_run.rows == parts.rows
    with (tmp_path / "parts" / "curves.csv").open(encoding="utf-8") as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["1", "2", "3", "4", "5", "6"]


@pytest.mark.parametrize("size", [0, 3000, 30_000])
def test_a_checkpoint_that_does_not_fit_is_one_sentence(data, tmp_path, size):
    """torch says of a full disk what is no error of files."""
    training = Training.begun(data, tmp_path / "run", OPTIONS)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        with pytest.raises(InputError, match=r"checkpoint\.pt must be writable, but writing it failed"):
            training.keep(Validation([]))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["train.json"]


@pytest.fixture
def kept(data, tmp_path) -> Path:
    """The checkpoint of a training that was interrupted at step 4."""
    with pytest.raises(KeyboardInterrupt):
        run(data, tmp_path / "run", stop=4)
    return tmp_path / "run" / "checkpoint.pt"


def changed(path: Path, **entries: object) -> None:
    """The checkpoint with other entries; None: without."""
    found = torch.load(path, weights_only=True) | entries
    torch.save({name: value for name, value in found.items() if value is not None}, path)


@pytest.mark.parametrize(
    "damage", [lambda content: content[:1000], lambda content: b"", lambda content: b"x" + content]
)
def test_a_damaged_checkpoint_is_refused(data, kept, damage):
    kept.write_bytes(damage(kept.read_bytes()))
    with pytest.raises(
        InputError, match=r"checkpoint\.pt must be a checkpoint, but it is damaged; remove it, and --res"
    ):
        Training.resumed(data, kept.parent, OPTIONS)
    kept.unlink()
    assert Training.resumed(data, kept.parent, OPTIONS).step == 0


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"network": None}, "lacks or garbles 'network'"),
        ({"optimiser": {}}, "lacks or garbles"),
        ({"network": {}}, "lacks or garbles"),
        ({"step": -5}, "step must be from 0 to 6, but it is -5"),
        ({"step": 10**9}, "step must be from 0 to 6, but it is 1000000000"),
        ({"step": "x"}, "lacks or garbles"),
        ({"step": 2}, "rows must be 2 of 5 numbers"),
        ({"rows": [[1.0]] * 3}, "rows must be 3 of 5 numbers"),
        ({"rows": 5}, "lacks or garbles"),
    ],
)
def test_a_checkpoint_that_is_not_of_the_training_is_refused(data, kept, entries, said):
    changed(kept, **entries)
    with pytest.raises(InputError, match=rf"checkpoint\.pt must be a checkpoint of this training, but it .*{said}"):
        Training.resumed(data, kept.parent, OPTIONS)


def test_a_training_learns_boxes(data, tmp_path):
    options = replace(OPTIONS, steps=60, keep_every=60, rate=1e-2)

    training = run(data, tmp_path / "run", options)

    first, last = (np.mean([row[1] for row in part]) for part in (training.rows[:5], training.rows[-5:]))
    assert last < 0.35 * first


def test_weights_say_what_they_are(data, tmp_path):
    training, told = Training.begun(data, tmp_path / "run", OPTIONS), Validation([a_sample(9), a_sample(10)])
    training.run(told, lambda now: None)

    path = training.finish(told, {"commit": "abc"})

    card = read_weights(path).card
    assert card.made_by == {"commit": "abc"}
    assert card.trained_on["across"] == [10.0, 22.0]
    assert card.training["steps"] == 6
    assert set(card.scores) == set(card.typical_misfit) == {"2", "3"}
    assert card.limits.startswith("It knows red cells alone, 10 to 22 pixels across")


def test_other_options_and_folders_are_refused(data, tmp_path):
    run(data, tmp_path / "run", replace(OPTIONS, steps=1))

    with pytest.raises(InputError, match="must be new or empty"):
        Training.begun(data, tmp_path / "run", OPTIONS)
    with pytest.raises(InputError, match="other options or scenes"):
        Training.resumed(data, tmp_path / "run", OPTIONS)
    with pytest.raises(InputError, match="no training that could go on"):
        Training.resumed(data, tmp_path / "other", OPTIONS)


def test_rates_rise_fall_and_end():
    options = TrainOptions(steps=1000, rate=2e-3, warm_up=10, least_rate=0.1)

    assert options.rate_at(0) == pytest.approx(2e-4)
    assert options.rate_at(500) == pytest.approx(2e-3 * 0.55)
    assert options.rate_at(1000) == pytest.approx(2e-4)


def test_scores_are_one_where_the_guess_is_right_and_the_loss_is_small():
    truth = example_of_views(a_sample(1), 2).occupancy
    right = 200 * (truth - 0.5)

    assert dice(right, truth) == 1
    assert float(soft_dice(torch.sigmoid(right), truth)) == pytest.approx(1)
    assert dice(-right, truth) == 0
    assert dice(torch.full((2, 2, 2), -1.0), torch.zeros(2, 2, 2)) == 1


def test_the_loss_counts_both_guesses():
    lesson = example_of_views(a_sample(1), 2)

    class Known(torch.nn.Module):
        """A wrong guess, and a right correction."""

        def forward(self, images, taps):
            return torch.full_like(lesson.occupancy, -100.0), 200 * (lesson.occupancy - 0.5)

    value, scores = loss(Known(), lesson, LossWeights(entropy=0.0, dice=1.0, first=0.5))  # type: ignore[arg-type]

    assert float(value) == pytest.approx(0.5, abs=5e-3)
    assert scores.tolist() == pytest.approx([0, 1], abs=5e-3)
