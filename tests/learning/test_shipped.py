"""The weights of the package: what they are, and that they know red cells of a seed that nothing was learnt from."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path

import pytest
import torch

from holosplat.learning.start import SHIPPED, read_weights
from holosplat_bench.training.options import Ranges, TrainOptions
from holosplat_bench.training.sample import sample_of
from holosplat_bench.training.shown import dice, example_of_views

CELLS = Ranges(
    rows=48, columns=48, views=4, held_out=1, tilted=0.0, noiseless=1.0, across=(12.0, 14.0), fresnel=(0.02, 0.1)
)


def test_they_are_small_and_say_what_they_were_trained_on():
    card = read_weights().card

    assert SHIPPED.stat().st_size < 5e6
    assert not card.made_by["commit"].endswith("dirty")
    assert card.trained_on["kinds"] == ["red-cells"]
    assert f"made with {card.training['steps']}." in inspect.getsource(TrainOptions)
    assert set(card.typical_misfit) == {"2", "3", "4", "6"}


def test_they_say_where_they_fail(monkeypatch):
    """As `python benchmarks/card_of_weights.py` writes it: run it where docs/data/learned.csv has changed."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    card = read_weights().card

    assert "It knows red cells alone, 10 to 22 pixels across" in card.limits
    assert "It is worst in 2 views: on 16 scenes of another seed the mean Dice coefficient is 0.71." in card.limits
    assert card.limits == importlib.import_module("card_of_weights").said_of(card)


@pytest.mark.parametrize(("views", "least"), [(2, 0.5), (4, 0.7)])
def test_they_know_red_cells(views, least):
    lesson = example_of_views(sample_of(CELLS, 77, 1), views)

    with torch.inference_mode():
        found = read_weights().network(lesson.images, lesson.taps)[1]

    assert dice(found, lesson.occupancy) > least
