"""Weights of trained networks in safetensors files, with a card that says what they are."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ..checks import InputError, as_written, require, require_regular
from ..io.atomic import atomic_path
from ..representations import AlignedNetwork, PixelAligned
from ..tables import from_table, table_in, to_table
from .network import Guess, Size

SHIPPED = Path(__file__).with_name("red_cells.safetensors")
"""Weights that may come with the package."""
Kind = TypeVar("Kind")
VERSION = 1
"""Of the network's layout."""


@dataclass(frozen=True)
class Card:
    """The model card of trained weights.

    trained_on: the scenes' ranges and seed; training: options, steps and seed; made_by: version, commit and machine;
    scores: of scenes of another seed, by the number of views; typical_misfit: what guesses leave unexplained there of
    the retrieved thickness (95 % of the scenes leave less), by the number of views; limits: where it fails, in words
    """

    trained_on: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    made_by: dict[str, str] = field(default_factory=dict)
    scores: dict[str, dict[str, float]] = field(default_factory=dict)
    typical_misfit: dict[str, float] = field(default_factory=dict)
    limits: str = ""

    @property
    def of_red_cells(self) -> bool:
        """Whether all scenes that were trained on are of red cells."""
        return set(self.trained_on.get("kinds", ())) in ({"red-cells"}, {"red-cells", "crowd"}, {"crowd"})

    def dice(self, views: int) -> float:
        """Mean Dice coefficient of guesses from so many views, by the same rule; 0 where it is not known."""
        return _nearest({count: said.get("dice", 0.0) for count, said in self.scores.items()}, views, 0.0)


def _nearest(said: Mapping[str, float], views: int, unsaid: float) -> float:
    """Look up `views`, or the next smaller number in the table, or the smallest."""
    known = sorted(int(count) for count in said)
    return said[str(max([count for count in known if count <= views] or known[:1]))] if known else unsaid


@dataclass(frozen=True)
class Trained:
    """A network and its card."""

    network: Guess
    card: Card


def write_weights(path: Path, network: Guess, card: Card) -> None:
    """Write the weights in half precision, whole or not at all; a megabyte holds half a million."""
    said = {"holosplat": str(VERSION), "size": json.dumps(asdict(network.size)), "card": json.dumps(asdict(card))}
    tensors = {name: value.detach().half().contiguous() for name, value in network.state_dict().items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(tensors, said))


@lru_cache(maxsize=2)
def read_weights(path: Path = SHIPPED) -> Trained:
    """The network in a file; `InputError` for one that `holosplat train` did not write, or of another version."""
    if path == SHIPPED and not path.exists():
        raise InputError(
            "no weights come with this version of holosplat; train a network (holosplat dataset, holosplat train) and "
            "name its file with --set weights=FILE."
        )
    tensors, said = tensors_of(path)
    if said.get("holosplat") != str(VERSION):
        raise InputError(
            f"{path} must hold weights of version {VERSION} of holosplat's network, but it holds "
            f"{said.get('holosplat', 'others')}; train anew (holosplat train)."
        )
    with as_written(path, "what holosplat train wrote"):
        network = Guess(size_of(Size, said, tensors))
        card = card_of(said)
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{path} must hold the weights of the network that it says, but: {error}.") from None
    network.eval().requires_grad_(False)
    return Trained(network, card)


def size_of(kind: type[Kind], said: Mapping[str, str], tensors: Mapping[str, Tensor]) -> Kind:
    """The size of a network that a file says, which is not larger than the weights in it; raises what `as_written`
    takes for anything else."""
    size = from_table(kind, table_in(said["size"]))
    held = max((length for tensor in tensors.values() for length in tensor.shape), default=0)
    named = [width for value in vars(size).values() for width in (value if isinstance(value, tuple) else (value,))]
    require(max(named) <= held, f"a network of {max(named)} channels has larger weights than it holds.")
    return size


def card_of(said: Mapping[str, str]) -> Card:
    """The card in a file, whose entries can be looked up; raises what `as_written` takes for anything else."""
    card = from_table(Card, table_in(said["card"]))
    asked = (card.of_red_cells, card.dice(2))
    require(all(number >= 0 for number in asked), "a number of the card is below zero.")
    return card


def tensors_of(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a safetensors file by name, in single precision, and what is written beside them; `InputError` for
    a file that is none."""
    require_regular(path, "a file of weights")
    try:
        with safe_open(path, framework="pt") as file:
            said = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 (it is no mapping)
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} must be a safetensors file, but it is damaged or another: {error}.") from None
    return tensors, said


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
