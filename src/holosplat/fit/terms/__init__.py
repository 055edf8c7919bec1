"""The terms of a loss. docs/adding.md says how to add one: a file here, and a line in `TERMS`."""

from __future__ import annotations

from collections.abc import Callable

from ...model import Model
from ...scan import Scan
from ..problem import Term
from .frames import FrameTerm, Objective, alignment_prior, light_prior
from .object import Anisotropy, VolumeTerm

Build = Callable[[float, Model, Scan], Term]
"""(weight, the model at the start, the training frames) → the term."""

TERMS: dict[str, Build] = {
    "alignment_prior": alignment_prior,
    "light_prior": light_prior,
}
"""Terms that any fit takes by name and weight (`terms` of its options), beside those of its objective."""

__all__ = ["TERMS", "Anisotropy", "Build", "FrameTerm", "Objective", "VolumeTerm"]
