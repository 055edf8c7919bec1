"""`holosplat dataset`, `train` and `reconstruct --start learned`."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers.cli import MATTER, holosplat, refused, worked
from holosplat.learning.network import Guess
from holosplat.learning.size import Size
from holosplat.learning.weights import Card, read_weights, write_weights

SMALL = ("--image", "4", "4", "4", "4", "--features", "3", "--volume", "4", "4", "4")
SCENES = ("--rows", "24", "--columns", "24", "--views", "2", "--held-out", "1", "--across", "8", "10")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("learning") / "scenes"
    worked(holosplat("dataset", "--out", folder, "--count", "2", *SCENES))
    return folder


def test_scenes_become_weights_with_a_card_and_curves(scenes, tmp_path):
    out = tmp_path / "training"

    done = worked(holosplat("train", scenes, "--out", out, "--steps", "2", "--validation", "1", *SMALL))

    assert "Dice of scenes of another seed: 2 views" in done.out
    card = read_weights(out / "weights.safetensors").card
    assert card.trained_on["rows"] == 24
    assert card.training["steps"] == 2
    assert set(card.typical_misfit) == {"2"}
    assert (out / "curves.png").stat().st_size > 1000
    refused(holosplat("train", scenes, "--out", out, "--steps", "2"), "must be new or empty")


def test_a_dataset_of_other_ranges_is_refused_and_a_part_of_it_is_no_dataset(scenes, tmp_path):
    refused(holosplat("dataset", "--out", scenes, "--count", "2"), "other ranges or another seed")
    refused(holosplat("train", tmp_path, "--out", tmp_path / "out"), "holosplat dataset made")


def test_a_guess_that_the_frames_contradict_is_refused(shop, tmp_path):
    weights = tmp_path / "weights.safetensors"
    write_weights(weights, Guess(Size((4, 4, 4, 4), 3, (4, 4, 4))), Card(typical_misfit={"2": 0.01}))

    asked = holosplat(
        *("reconstruct", shop.scan, "--out", tmp_path / "run", "--method", "gaussians", "--material", MATTER[3]),
        *("--density", "1.335", "--matter", "levels", "--start", "learned", "--set", f"weights={weights}"),
    )

    refused(asked, "the frames contradict the learned start")
    assert not (tmp_path / "run").exists()
