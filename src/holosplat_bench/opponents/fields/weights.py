"""Files of the weights of pixel-aligned networks: safetensors, with a card that says what they are."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from holosplat.checks import InputError, as_written, require
from holosplat.io.atomic import atomic_path
from holosplat.learning.start import Card, card_of, size_of, tensors_of
from holosplat.tables import to_table

from .aligned_network import AlignedNetwork, PixelAligned

ALIGNED_VERSION = "aligned 1"
"""Of the network's layout."""
ONIX, PIXELNERF = "onix", "pixelnerf"
"""Networks of δ and β through waves, and of attenuation."""


@dataclass(frozen=True)
class AlignedWeights:
    """The weights of `PixelAligned` by name, its size, and what they are; network: `onix` or `pixelnerf`."""

    network: str
    size: AlignedNetwork
    weights: dict[str, Tensor]
    card: Card


def write_aligned(path: Path, network: str, size: AlignedNetwork, weights: Mapping[str, Tensor], card: Card) -> None:
    """Write the weights in half precision, whole or not at all."""
    said = {"holosplat": ALIGNED_VERSION, "network": network, "size": json.dumps(to_table(size))}
    said["card"] = json.dumps(asdict(card))
    tensors = {name: value.detach().half().contiguous().cpu() for name, value in weights.items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(tensors, said))


def read_aligned(path: Path, network: str) -> AlignedWeights:
    """The weights of `network` in a file that `holosplat train` wrote; `InputError` for any other file."""
    tensors, said = tensors_of(path)
    require(
        said.get("holosplat") == ALIGNED_VERSION and said.get("network") == network,
        f"{path} must hold weights of the network {network}, but it holds {said.get('network', 'others')}; train it "
        f"(holosplat train --network {network}).",
    )
    with as_written(path, "what holosplat train wrote"):
        size, card = size_of(AlignedNetwork, said, tensors), card_of(said)
    wanted = {name: tuple(weight.shape) for name, weight in PixelAligned(size).named_parameters()}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if wanted != found or not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise InputError(f"{path} must hold the weights of the network that it says, but it does not; train anew.")
    return AlignedWeights(network, size, tensors, card)
