"""The kinds of matter that may fill the field, or be missing in it, by name."""

from __future__ import annotations

from collections.abc import Mapping

from .fluids import BreakUp, Bubbles, Cuvette, Jet, Shock
from .solids import Channel, Crack, Fibres, Keyhole, Lattice, Star

FieldMatter = Bubbles | Cuvette | Jet | BreakUp | Crack | Shock | Keyhole | Lattice | Fibres | Channel | Star
"""Every kind (see `drawn` for what each has)."""
MATTER: Mapping[str, type[FieldMatter]] = {
    one.kind: one for one in (Bubbles, Cuvette, Jet, BreakUp, Crack, Shock, Keyhole, Lattice, Fibres, Channel, Star)
}
"""Name → kind."""
