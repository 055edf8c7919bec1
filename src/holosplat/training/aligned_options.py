"""Options of the training of pixel-aligned networks, which see frames alone."""

from __future__ import annotations

from dataclasses import dataclass

from ..ranges import Natural, Share, Weight, ranged


@dataclass(frozen=True)
@ranged
class FrameGoal:
    """The training loss of networks that learn from frames alone, without volumes."""

    targets: Natural = 2
    """Frames that each step predicts; half of them, rounded up, are none of those that the network sees."""
    mse: Weight = 5.0
    """Of the mean square difference of frames, in that of their contrast (4D-ONIX: 5)."""
    adversary: Weight = 0.0
    """Of a discriminator that looks at frames in directions without one (4D-ONIX: 0.1; default: none)."""
    pretrain: Share = 0.5
    """Share of the steps before the discriminator begins."""
    adversary_rate: Weight = 1e-4
    """AdamW's rate of the discriminator (4D-ONIX: 1e-4)."""
