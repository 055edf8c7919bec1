"""How the program chooses between hypotheses: one score of unseen frames, and one policy."""

from .selection import ERRORS, LEAST, MARGIN, Compared, Decision, Score, select

__all__ = ["ERRORS", "LEAST", "MARGIN", "Compared", "Decision", "Score", "select"]
