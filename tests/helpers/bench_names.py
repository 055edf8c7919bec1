"""The cases of the suite in their order, and those that differ from the others in what they may be."""

from __future__ import annotations

NAMES = (
    ["main12", "main4", "thesis16", "thesis8", "cells4", "cells6", "cells8", "cells12", "xmpi4", "two_beam"]
    + ["plasma8-1e3", "plasma8-1e4", "plasma8-1e5", "noise12-500", "noise12-2000", "noise12-10000", "crowded12"]
    + ["sharp-even", "sharp-light", "sharp-drift", "misaligned12", "misaligned4"]
    + ["two_materials8", "shells8", "foam12", "soft12", "soft12-unknown", "soft12-5000"]
    + ["light12-5000", "drift", "tissue16", "coated"]
    + ["absorber12", "contact91"]
    + ["bubbles8", "cuvette8", "jet8", "breakup8", "crack8", "shock8", "keyhole8", "lattice8", "fibres8", "channel8"]
    + ["star8", "resolution"]
)
THIN = ("fibres8",)
"""Cases of bodies that fill no voxel."""
BOTH_SIDES = {"shock8": 0.11}
"""Largest contrast on the other side of the medium, in units of the largest."""
APART = {"contact91": 0.9}
"""Degrees between held-out views and those for training, where these are closer than 4° to each other."""
MOST_VOXELS = dict.fromkeys(("main12", "main4", "misaligned12", "misaligned4"), 2.1e6)
