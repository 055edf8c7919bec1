"""How the program chooses between hypotheses: one score of unseen frames, and one policy."""

from .selection import ERRORS, MARGIN, Compared, Decision, Score, select

__all__ = ["ERRORS", "MARGIN", "Compared", "Decision", "Score", "select"]
