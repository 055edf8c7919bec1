"""The kinds of matter that may fill the field, or be missing in it, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

from .changing import Collapse, CrushedLattice, MergingDrops, PinchingJet
from .fluids import BreakUp, Bubbles, Cuvette, Jet, Shock
from .gas_waves import ExpandingShock
from .solids import Channel, Crack, Fibres, Keyhole, Lattice, Star

FieldMatter = Bubbles | Cuvette | Jet | BreakUp | Crack | Shock | Keyhole | Lattice | Fibres | Channel | Star
"""Every kind that stands still (see `drawn` for what each has)."""
Changing = MergingDrops | Collapse | PinchingJet | ExpandingShock | CrushedLattice
"""Every kind that changes with time."""
MATTER: Mapping[str, type[FieldMatter]] = {one.kind: one for one in get_args(FieldMatter)}
"""Name → kind, of those that stand still."""
CHANGING: Mapping[str, type[Changing]] = {one.kind: one for one in get_args(Changing)}
"""Name → kind, of those that change."""
