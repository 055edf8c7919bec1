"""Numbers of a command line that may say their unit: `2px`, `0.6deg`, `2%`."""

from __future__ import annotations

import math
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec


def _in(metavar: str, **factors: float) -> PrimitiveConstructorSpec[float]:
    """Numbers in a unit of `factors`, which say what one of it is; without any, they are as they stand."""
    units = sorted(factors, key=len, reverse=True)

    def read(words: list[str]) -> float:
        said = words[0].strip()
        for unit in units:
            if said.endswith(unit):
                return float(said.removesuffix(unit)) * factors[unit]
        return float(said)

    def known(value: Any) -> bool:
        return isinstance(value, int | float)

    return PrimitiveConstructorSpec(1, metavar, read, known, lambda value: [f"{value:g}"])


Pixels = Annotated[float, _in("PIXELS", px=1.0, pixel=1.0, pixels=1.0)]
Degrees = Annotated[float, _in("DEGREES", **{"deg": 1.0, "°": 1.0, "mrad": math.degrees(1e-3)})]
Share = Annotated[float, _in("SHARE", **{"%": 0.01})]
