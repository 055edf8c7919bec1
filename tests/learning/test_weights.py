"""Files of weights: what is written is read, and others are refused in one sentence."""

from __future__ import annotations

import pytest
import torch

from holosplat.checks import InputError
from holosplat.learning.network import Guess, Size
from holosplat.learning.start import Card, read_weights, write_weights

SMALL = Size((4, 4, 6, 6), 3, (4, 6, 8))


def test_weights_come_back_with_their_card(tmp_path):
    torch.manual_seed(0)
    network, card = (
        Guess(SMALL),
        Card({"seed": 3}, {"steps": 2}, {"commit": "abc"}, {"2": {"dice": 0.5}}, {"2": 0.1}, "all"),
    )
    write_weights(tmp_path / "w.safetensors", network, card)

    found = read_weights(tmp_path / "w.safetensors")

    assert found.card == card
    assert found.network.size == SMALL
    for name, value in network.state_dict().items():
        assert torch.allclose(found.network.state_dict()[name], value, rtol=1e-3, atol=1e-6)


def test_files_of_others_are_refused(tmp_path):
    from safetensors.torch import save

    damaged, other = tmp_path / "damaged.safetensors", tmp_path / "other.safetensors"
    write_weights(damaged, Guess(SMALL), Card())
    damaged.write_bytes(damaged.read_bytes()[:-100])
    other.write_bytes(save({"a": torch.zeros(2)}))
    bare = tmp_path / "bare.safetensors"
    bare.write_bytes(save({"a": torch.zeros(2)}, {"holosplat": "1"}))

    with pytest.raises(InputError, match="damaged or another"):
        read_weights(damaged)
    with pytest.raises(InputError, match="version 1 of holosplat's network, but it holds others"):
        read_weights(other)
    with pytest.raises(InputError, match="what holosplat train wrote"):
        read_weights(bare)
    with pytest.raises(InputError, match="a file of weights"):
        read_weights(tmp_path / "missing.safetensors")
