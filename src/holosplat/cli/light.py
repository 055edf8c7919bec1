"""The options of the light beside the flat fields, and numbers that may say their unit."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.constructors import PrimitiveConstructorSpec

from ..checks import InputError
from ..ranges import checked_dataclass

if TYPE_CHECKING:
    from ..optics.background import LightOptions


DECISIONS: dict[str, dict[str, str]] = {
    "light=even": {"kind": "even"},
    "light=smooth": {"kind": "smooth"},
    "pattern=none": {"still": "none"},
    "noise=white": {"noise": "white"},
    "noise=correlated": {"noise": "correlated"},
}
"""What can be told of the light and the noise, and the field of `LightOptions` that holds it."""


@checked_dataclass
class LightFlags:
    """The light beside the flat fields."""

    light: Literal["auto", "even", "smooth"] = "auto"
    """auto: smooth where evidence is for it, else even; even: none; smooth: in any case."""
    air: tuple[tuple[int, int, int, int], ...] = ()
    """Boxes without matter or fringes in any frame: first row, end row, first column, end column (default: found)."""

    def options(self) -> LightOptions:
        """What is assumed of the light."""
        from ..optics.background import LightOptions

        return LightOptions(self.light, self.air)


@checked_dataclass
class RunLightFlags(LightFlags):
    """The light beside the flat fields, of several frames."""

    still_light: Literal["auto", "none"] = "auto"
    """auto: divide out a pattern that all frames have in the same pixels, if unseen frames are then predicted better;
    none: keep it."""
    decide: tuple[str, ...] = ()
    """Decisions that are told, as NAME=CHOICE: light=even or smooth, pattern=none, noise=white or correlated."""

    def options(self) -> LightOptions:
        """What is assumed of the light. Errors: `InputError` for a decision that there is not."""
        told = replace(super().options(), still=self.still_light)
        for each in self.decide:
            if each not in DECISIONS:
                raise InputError(f"--decide must be one of {', '.join(DECISIONS)}, but it is {each!r}; correct it.")
            told = replace(told, **DECISIONS[each])
        return told


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
