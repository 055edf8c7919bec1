"""The options of the light beside the flat fields."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from ..ranges import ranged

if TYPE_CHECKING:
    from ..optics.background import LightOptions


@dataclass(frozen=True)
@ranged
class LightFlags:
    """The light beside the flat fields."""

    light: Literal["auto", "even", "smooth"] = "auto"
    """auto: smooth where the air of frames is uneven beyond its noise, else even; even: none; smooth: in any case."""
    air: tuple[tuple[int, int, int, int], ...] = ()
    """Boxes without matter or fringes in any frame: first row, end row, first column, end column (default: found)."""

    def options(self) -> LightOptions:
        """What is assumed of the light."""
        from ..optics.background import LightOptions

        return LightOptions(self.light, self.air)


@dataclass(frozen=True)
@ranged
class RunLightFlags(LightFlags):
    """The light beside the flat fields, of several frames."""

    still_light: Literal["auto", "none"] = "auto"
    """auto: what all frames have in common in the same pixels is divided out, where their air shows that the light does
    it; none: it is not."""

    def options(self) -> LightOptions:
        """What is assumed of the light."""
        return replace(super().options(), still=self.still_light)
