"""What a command takes is told, and held against what there is, before it begins."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..matter import MaterialPrior, MatterKind
    from ..methods import Method
    from ..scan import Exposures


def tell_reconstruction(
    exposures: Exposures, out: Path, method: Method, prior: MaterialPrior, matter: MatterKind | None
) -> None:
    """Say what the reconstruction of training frames takes; `InputError` where there is less. Of a known material
    frames nearly always say that it has levels."""
    from ..matter import Known
    from ..planning.needs import Sizes, of_reconstruction, require_room, smaller

    if len(exposures) == 0:
        return  # there is nothing to fit, as the fit will say
    kind = matter or ("levels" if isinstance(prior, Known) else None)
    needs = of_reconstruction(Sizes.of(exposures), method, kind)
    if needs is not None:
        require_room(needs, out, smaller(exposures, method, kind))
        print(f"{method.kind} {needs.line()}", file=sys.stderr)


def tell_simulation(exposures: Exposures, out: Path, samples: int, frames: int) -> None:
    """The same for a simulation of `frames`, with so many wave samples along a pixel."""
    from ..planning.needs import of_simulation, require_room

    needs = of_simulation(exposures, samples, frames)
    require_room(needs, out)
    print(f"the simulation {needs.line()}", file=sys.stderr)
