"""Storage of a run of `follow` in progress, so that it can be resumed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch

from ..mesh import TriangleMesh
from .detections import Detection


class Journal(Protocol):
    """Keeps the last state of a run: tensors, and plain values."""

    def load(self) -> Mapping[str, Any] | None:
        """Load the last saved state; None at the beginning."""
        ...

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep `state` in place of what was saved before."""
        ...


class Nowhere:
    """Keeps nothing."""

    def load(self) -> None:
        """Load nothing."""

    def save(self, state: Mapping[str, Any]) -> None:
        """Forget it."""


def from_sightings(found: Sequence[Sequence[Detection]]) -> list[list[dict[str, Any]]]:
    """Sightings at each time as tensors and plain values, which `to_sightings` reads."""
    return [
        [
            {
                "vertices": torch.from_numpy(one.mesh.vertices),
                "faces": torch.from_numpy(one.mesh.faces),
                "name": one.mesh.name,
                "cut": one.cut,
            }
            for one in bodies
        ]
        for bodies in found
    ]


def to_sightings(saved: Sequence[Sequence[Mapping[str, Any]]]) -> list[list[Detection]]:
    """The inverse of `from_sightings`."""
    return [
        [
            Detection(TriangleMesh(one["vertices"].numpy(), one["faces"].numpy(), one["name"]), bool(one["cut"]))
            for one in bodies
        ]
        for bodies in saved
    ]
