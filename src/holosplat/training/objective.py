"""The training loss of networks, and the scores of their guesses."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from ..learning.network import Guess
from .options import Goal
from .shown import Lesson


def loss(network: Guess, lesson: Lesson, goal: Goal) -> tuple[Tensor, Tensor]:
    """The training loss, and the soft Dice coefficient [2] of the guess and of the corrected one."""
    parts, scores = [], []
    for logits in network(lesson.images, lesson.taps):
        dice = soft_dice(torch.sigmoid(logits.float()), lesson.occupancy)
        entropy = binary_cross_entropy_with_logits(logits.float(), lesson.occupancy)
        parts.append(goal.entropy * entropy + goal.dice * (1 - dice))
        scores.append(dice.detach())
    return goal.first * parts[0] + parts[1], torch.stack(scores)


def soft_dice(guess: Tensor, truth: Tensor) -> Tensor:
    """`(2 Σ ab + 1) / (Σ a² + Σ b² + 1)` of shares a and b; one where both are empty."""
    return (2 * (guess * truth).sum() + 1) / (guess.square().sum() + truth.square().sum() + 1)


def dice(logits: Tensor, truth: Tensor) -> float:
    """The Dice coefficient of voxels of which more than half is matter; one where there are none in either."""
    return share_of_overlap(logits > 0, truth > 0.5)


def share_of_overlap(found: Tensor, there: Tensor) -> float:
    """The Dice coefficient of two masks; one where both are empty."""
    total = int(found.sum() + there.sum())
    return 1.0 if total == 0 else 2 * int((found & there).sum()) / total
