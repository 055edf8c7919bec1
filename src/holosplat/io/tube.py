"""A tube around the object, such as a capillary: what is known of it is divided out of the frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..checks import require
from ..ranges import ranged
from ..tables import number_in, shown

if TYPE_CHECKING:
    from ..geometry import Views
    from ..scan import Scan


@dataclass(frozen=True)
@ranged
class Tube:
    """A round tube about the rotation axis. inner, outer: diameters [m]; attenuation: µ of its wall [1/m]."""

    inner: float
    outer: float
    attenuation: float

    def __post_init__(self) -> None:
        good = 0 <= self.inner < self.outer < math.inf and 0 < self.attenuation < math.inf
        require(
            good,
            "a tube must have an inner diameter from 0, a greater outer one and a positive attenuation, but they are "
            f"{self.inner:g} m, {self.outer:g} m and {self.attenuation:g} per metre; correct --tube.",
        )

    @classmethod
    def parsed(cls, text: str) -> Tube:
        """The tube that INNER:OUTER:ATTENUATION says. Errors: `InputError` for anything else."""
        numbers = [number_in(word) for word in text.split(":")]
        require(
            len(numbers) == 3 and not any(map(math.isnan, numbers)),
            f"--tube must be INNER:OUTER:ATTENUATION, diameters [m] and µ of the wall [1/m], but it is {shown(text)}; "
            "write, for instance, 4e-3:4.5e-3:200.",
        )
        return cls(*numbers)

    def transmission(self, views: Views) -> np.ndarray:
        """Share of the light [V, W] that passes the wall, by column: `exp(-µ t)`, t the wall's length along the ray.

        Of pixels as points; waves that its edges throw, `W` columns wide, are not in it. Errors: `InputError` for views
        without a common axis.
        """
        require(views.shares_axis, "--tube goes with views about one axis, but these turn about others; leave it.")
        columns = (np.arange(views.shape[1]) - 0.5 * (views.shape[1] - 1)) * views.pixel_size
        x = columns + views.shifts[:, :1]
        outer, inner = (2 * np.sqrt(np.maximum((d / 2) ** 2 - x**2, 0)) for d in (self.outer, self.inner))
        return np.exp(-self.attenuation * (outer - inner))

    def taken_out_of(self, scan: Scan) -> Scan:
        """The scan as if without the tube, whose light is divided out of every frame."""
        said = {"tube": f"{self.inner:g} m to {self.outer:g} m, {self.attenuation:g} per metre, divided out"}
        return scan.divided(self.transmission(scan.views)[:, None, :].astype(np.float32), said)
