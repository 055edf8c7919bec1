"""What a report shows of a network's guess."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.geometry import Grid
from holosplat.report.blocks import guess_block
from holosplat.report.content import GuessShown

GRID = Grid.centred((6, 5, 6), 1e-6)


def test_the_caption_says_how_much_of_the_matter_is_guessed():
    found, spread = np.zeros(GRID.shape, np.float32), np.zeros(GRID.shape, np.float32)
    found[2, 2, 1:5] = 1.0
    spread[2, 2, 4] = 0.4
    shown = GuessShown(found, found, spread, GRID, "The run began with the network's guess.")

    block = guess_block(shown)

    assert shown.unsure == pytest.approx(0.25)
    assert "25 % of its matter lies where guesses differ by more than 0.2" in block.caption
    assert block.caption.startswith("The run began with the network's guess.")
    assert block.drawn


def test_the_caption_says_of_which_guesses_the_spread_is():
    found = np.ones(GRID.shape, np.float32)

    of_views, of_copies = (guess_block(GuessShown(found, found, found, GRID, "Begun.", of)) for of in (False, True))

    assert "guesses without one of the views each" in of_views.caption
    assert "guesses of the same scene mirrored and turned" in of_copies.caption


def test_a_run_without_a_spread_says_so():
    found = np.ones(GRID.shape, np.float32)

    block = guess_block(GuessShown(found, found, None, GRID, "Begun."))

    assert "Where it is guessed, this run did not keep." in block.caption
