"""Training where a GPU's tensors would be: none is left behind, and what is learnt is what the CPU learns.

The GPU is pretended (`helpers.pretended_gpu`), and the kernels' plain twins run. Checkpoints are not written there:
wrapped tensors cannot be.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.ball_sample import ball_sample
from helpers.pretended_gpu import OnGpu, pretended_gpu
from holosplat.checks import InputError
from holosplat.learning.network import Size
from holosplat.learning.start import read_weights
from holosplat_bench.opponents.fields import AlignedNetwork
from holosplat_bench.opponents.fields.weights import read_aligned
from holosplat_bench.opponents.training import AlignedTraining, AlignedValidation
from holosplat_bench.training.folder import Dataset
from holosplat_bench.training.options import FrameLossWeights, Ranges, TrainOptions, ViewSampling
from holosplat_bench.training.sample import Sample
from holosplat_bench.training.shown import Validation
from holosplat_bench.training.train import Training

pytest.importorskip("triton")

STEPS = 3
SMALL = AlignedNetwork((4, 6), 8, 2)
OPTIONS = TrainOptions(
    steps=STEPS,
    warm_up=2,
    rate=0.02,
    precision="float32",
    shown=ViewSampling(views=(2, 3), rows=(16,)),
    size=Size((4, 4, 6, 6), 3, (4, 6, 8)),
    frames=FrameLossWeights(adversary=0.1, pretrain=0.3),
)


@pytest.fixture(scope="module")
def sample() -> Sample:
    """On frames of an even number of pixels, as all datasets have them."""
    ball = ball_sample()
    contrast, thickness = (array[:, :24] for array in (ball.contrast, ball.thickness))
    return replace(ball, contrast=contrast, thickness=thickness, occupancy=ball.occupancy[:, :24])


@pytest.fixture
def data(tmp_path, monkeypatch, sample) -> Dataset:
    monkeypatch.setattr(Dataset, "sample", lambda self, index: sample)
    return Dataset(tmp_path / "data", Ranges(), 0, 4)


def learnt(data: Dataset, network: str, device: str, out: Path) -> tuple[list[float], Training]:
    """Losses of all steps and the scores of a validation, after training on a device; the weights are written."""
    options, samples = replace(OPTIONS, network=network, device=device), [data.sample(0)]
    if network == "start":
        training, told = Training(data, out, options), Validation(samples)
    else:
        training = AlignedTraining(data, out, options, SMALL)
        told = AlignedValidation(samples, network=network, size=SMALL)  # type: ignore[arg-type]
    for _ in range(STEPS):
        training.advance()
    told.judge(training.network, STEPS)
    out.mkdir()
    training.finish(told, {})
    return [float(value) for row in (*training.rows, *told.rows) for value in row], training


@pytest.mark.parametrize("network", ["start", "onix", "pixelnerf"])
def test_a_network_learns_there_what_it_learns_on_the_cpu(data, network, monkeypatch, tmp_path):
    true, _ = learnt(data, network, "cpu", tmp_path / "cpu")
    with pretended_gpu(monkeypatch, kernels=False):
        same, training = learnt(data, network, "cuda", tmp_path / "gpu")

    assert isinstance(next(training.network.parameters()), OnGpu)
    assert np.allclose(same, true, rtol=1e-4, atol=1e-6)
    path = tmp_path / "gpu" / "weights.safetensors"
    card = (read_weights(path) if network == "start" else read_aligned(path, network)).card
    assert card.training["device"] == "cuda"
    if isinstance(training, AlignedTraining):
        assert training.critic is not None
        assert all(isinstance(weight, OnGpu) for weight in training.critic.parameters())


def test_a_training_asks_for_a_gpu_that_is_not_there(data, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for kind, network in ((Training, "start"), (AlignedTraining, "onix")):
        with pytest.raises(InputError, match=r"device|backend"):
            kind.begun(data, tmp_path / network, replace(OPTIONS, network=network, device="cuda"))
        assert not (tmp_path / network).exists()
