"""Phase retrieval of single views for one material: frames → projected thickness, by several methods.

All have the call of `Retrieval` and stand in `RETRIEVALS`. The first two are filters; the others start from
`bounded_estimate` and see the full wave optics, point-spread function and pixels included. How they compare:
docs/phase_retrieval.md.
"""

from __future__ import annotations

from inspect import signature
from typing import Any, Protocol

from torch import Tensor

from ...plugins import Extended
from ...progress import Advance
from ...scan import Exposures
from .bounded import FIXED, Estimate, bounded_estimate
from .contact import absorption_alone
from .halo import without_halo
from .linear import Linear, contrast_transfer, invert_contrast, paganin, retrieve_thickness
from .nonlinear import ADMM, Tikhonov, admm, tikhonov
from .spectra import Prior


class Retrieval(Protocol):
    """A method of phase retrieval; beside these arguments each has its `options`, with a default."""

    def __call__(
        self,
        frames: Tensor,
        exposures: Exposures,
        delta: float,
        beta: float,
        *,
        missing: Tensor | None = None,
        two_sided: bool = False,
        on_progress: Advance = lambda fraction: None,
    ) -> Tensor:
        """Thickness [V, H, W] in metres of one material (δ and β of any sign) from relative intensities [V, H, W].

        missing: pixels [V, H, W] bool without a value of their own (None: there are none); they have no weight.
        two_sided: whether the thickness may be negative, of matter on both sides of its medium; filters need no word.
        Of holes in a medium, whose δ against it is negative, it is theirs. The result has the frames' type, float32 or
        float64. `InputError` for frames that do not match `exposures` or are not finite, or δ = 0.
        """
        ...


RETRIEVALS: Extended[Retrieval] = Extended(
    {"paganin": paganin, "ctf": contrast_transfer, "tikhonov": tikhonov, "admm": admm}, "holosplat.retrievals"
)
"""Every method by its name; other packages add theirs (docs/adding.md)."""


def usual_options(retrieve: Retrieval) -> Any:
    """The options of a method by default; all have `noise`."""
    return signature(retrieve).parameters["options"].default


__all__ = [
    "ADMM",
    "FIXED",
    "RETRIEVALS",
    "Estimate",
    "Linear",
    "Prior",
    "Retrieval",
    "Tikhonov",
    "absorption_alone",
    "admm",
    "bounded_estimate",
    "contrast_transfer",
    "invert_contrast",
    "paganin",
    "retrieve_thickness",
    "tikhonov",
    "usual_options",
    "without_halo",
]
