"""How the program chooses between hypotheses: one score of unseen frames, and one policy."""

from .score import Score
from .selection import ERRORS, MARGIN, Compared, Decision, select

__all__ = ["ERRORS", "MARGIN", "Compared", "Decision", "Score", "select"]
