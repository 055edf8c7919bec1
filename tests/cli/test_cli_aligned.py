"""`holosplat train --network`, and the methods that take its weights."""

from __future__ import annotations

from helpers.ball_sample import ball_sample
from helpers.cli import holosplat, refused, worked
from holosplat_bench.opponents.fields import AlignedNetwork
from holosplat_bench.opponents.fields.weights import read_aligned
from holosplat_bench.training.folder import Dataset
from holosplat_bench.training.options import Ranges


def test_a_network_is_trained_and_the_method_of_its_name_takes_it(tmp_path, monkeypatch, shop, unjudged_runs):
    sample = ball_sample()
    monkeypatch.setattr(Dataset, "read", lambda folder: Dataset(folder, Ranges(), 0, 4))
    monkeypatch.setattr(Dataset, "require_whole", lambda self: None)
    monkeypatch.setattr(Dataset, "sample", lambda self, index: sample)
    monkeypatch.setattr("holosplat_bench.training.shown.sample_of", lambda ranges, seed, index: sample)
    options = ("--network", "pixelnerf", "--steps", "2", "--validation", "1", "--views", "2")

    worked(holosplat("train", tmp_path, "--out", tmp_path / "out", *options))

    path = tmp_path / "out" / "weights.safetensors"
    assert read_aligned(path, "pixelnerf").size == AlignedNetwork()
    assert path.stat().st_size < 200_000
    assert (tmp_path / "out" / "curves.png").is_file()
    matter = ("--material", "haemoglobin", "--set", f"weights={path}", "--set", "fit.schedule.steps=1")
    worked(holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", "--method", "pixelnerf", *matter))
    refused(
        holosplat("reconstruct", shop.scan, "--out", tmp_path / "other", "--method", "onix", *matter),
        "must hold weights of the network onix, but it holds pixelnerf",
    )
