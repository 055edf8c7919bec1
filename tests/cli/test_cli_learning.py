"""`holosplat dataset`, `train` and `reconstruct --start learned`."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers.cli import MATTER, holosplat, known, refused, worked
from holosplat.cli.options import MethodOptions
from holosplat.io.volumes import read_guess
from holosplat.learning.network import Guess, Size
from holosplat.learning.start import Card, read_weights, write_weights
from holosplat.methods import Gaussians
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("unjudged_runs")

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


def test_a_guess_that_predicts_less_is_not_begun_with_and_the_run_says_so(shop, tmp_path):
    weights = tmp_path / "weights.safetensors"
    write_weights(weights, Guess(Size((4, 4, 4, 4), 3, (4, 4, 4))), Card())

    done = worked(
        holosplat(
            *("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop)),
            *("--start", "learned", "--set", f"weights={weights}"),
        )
    )

    assert "start: phase retrieval (data fission: network's guess -" in done.out
    (decision,) = (d for d in RunFolder(tmp_path / "run").read_summary()["decisions"] if d["name"] == "start")
    assert decision["choice"] == "phase retrieval"
    guess, spread, of_copies = read_guess(tmp_path / "run" / "guess.h5")
    assert spread is not None
    assert not of_copies
    assert guess.delta.shape == spread.shape


@pytest.mark.parametrize(
    ("content", "said"), [(None, "must be a file of weights, but there is no such file"), (b"?", "damaged or another")]
)
@pytest.mark.parametrize("method", ["auto", "gaussians", "surfaces", "onix"])
def test_weights_that_cannot_be_read_are_refused_before_any_work(shop, tmp_path, monkeypatch, method, content, said):
    monkeypatch.setattr("holosplat.workflows.reconstruct.prepared", lambda *_: pytest.fail("work has begun"))
    path = tmp_path / "weights.safetensors"
    if content is not None:
        path.write_bytes(content)
    start = () if method == "onix" else ("--start", "learned")
    asked = ("reconstruct", shop.scan, "--out", tmp_path / "run", *MATTER[2:], "--method", method, *start)

    refused(holosplat(*asked, "--set", f"weights={path}"), said)

    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", [None, "auto", "gaussians", "surfaces"])
def test_every_method_with_gaussians_takes_the_start(method):
    chosen = MethodOptions(method, start="learned").chosen()

    of_gaussians = chosen if isinstance(chosen, Gaussians) else getattr(chosen, "gaussians", None)
    assert isinstance(of_gaussians, Gaussians)
    assert of_gaussians.start == "learned"


def test_a_start_is_refused_by_methods_without_one(shop, tmp_path):
    asked = holosplat(
        *("reconstruct", shop.scan, "--out", tmp_path / "run", "--method", "voxels", "--start", "learned", *MATTER[2:])
    )

    refused(asked, "--start says what Gaussians begin with")
    assert not (tmp_path / "run").exists()


def test_scenes_are_exported_to_layouts_of_others(tmp_path):
    done = worked(
        holosplat(
            *("dataset", "--out", tmp_path / "scenes", "--count", "1", *SCENES, "--tilted", "0"),
            *("--export", "nerf-synthetic", "r2-gaussian", "onix"),
        )
    )

    for layout in ("nerf-synthetic", "r2-gaussian", "onix"):
        assert f"wrote 1 scene into {tmp_path / 'scenes' / layout}" in done.out
