"""What cards say of where networks fail: what they never saw, and where they scored least."""

from __future__ import annotations

from holosplat_bench.training.options import Ranges
from holosplat_bench.training.train import limits

SCORES = {"2": {"dice": 0.514, "scenes": 7.0}, "3": {"dice": 0.4, "scenes": 7.0}}


def test_what_was_never_seen_is_said():
    said = limits(Ranges(views=4, noise=(0.01, 0.15)), (2, 3, 3, 6), SCORES)

    assert "It saw scenes in 2, 3 and 4 views; in a share of 0.2 of them beams were tilted by up to 40°." in said
    assert "It never saw noise of more than 0.15 of the phase of a body." in said
    for missing in ("continuous matter", "a medium that absorbs more", "uneven light", "misaligned views"):
        assert missing in said
    assert said.endswith("It is worst in 3 views: on 7 scenes of another seed the mean Dice coefficient is 0.40.")


def test_what_was_seen_is_not_said_to_be_missing():
    kinds = ("filled-capsules", "soft-cells", "crowd")
    ranges = Ranges(
        kinds=kinds,
        noiseless=1.0,
        tilted=0.0,
        medium=0.3,
        uneven=(0.0, 0.1),
        misaligned_px=(0.0, 1.0),
        filled=(0.02, 0.1),
    )

    said = limits(ranges, (2,), SCORES)

    assert "It knows filled capsules and soft cells and crowd alone" in said
    assert "in 2 to 22 % of the room" in said
    assert "It saw scenes in 2 views; all beams had one axis. It never saw noise. Nor did it see materials" in said
