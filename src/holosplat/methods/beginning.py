"""What Gaussians began with where a network was asked for a start, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..learning.start import GuessedMatter

Start = Literal["learned", "cells", "phase"]


@dataclass(frozen=True)
class Beginning:
    """What was begun with.

    taken: the network's guess, red cells of its size by their shape at rest, or phase retrieval and tomography
    why: in a sentence
    guess: what the network said, also where it was not taken; None where it was not asked
    """

    taken: Start
    why: str
    guess: GuessedMatter | None = None
