"""What `reconstruct` gives back: the matter, and what was decided and found on the way."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..align.geometry import Geometry
from ..display import card, of_object
from ..io.volumes import Contents
from ..methods.uncertain import Determined, placed
from ..motion.elastic import Rest
from ..optics.background import LightOptions
from ..representations import Stored
from ..scan import Scan
from .choice import Choice
from .run_light import EVEN
from .totals import TotalMatter
from .verdict import Verdict


@dataclass(frozen=True)
class Reconstruction:
    """What a method made of a scan.

    object: the matter, of any kind
    method: name of the method
    energy_kev: photon energy [keV] at which δ and β hold
    oversample: wave samples a pixel in the fit
    timing: seconds that each stage took
    finished: whether all stages came to their end
    choice: what was decided on the way, and which state `object` is
    delta_told: whether prior or frames say what δ is; else β alone is known, and δ = β stands for it
    verdict: whether the training frames are explained; None for runs of versions that did not say
    total: the total δ by these frames, with its standard error; None likewise
    constants: what was known to a range only, or of continuous matter not at all, by the frames
    light: what is assumed of the light of other frames of the scan: smooth if that of the training frames is uneven
    geometry: where the frames were found to be; None: they are taken to be where the scan says
    still: [H, W] the light that all frames of the scan have in common, by those for training; None: there is none
    rest: what is known of the shape of moving bodies at rest; None: nothing
    """

    object: Stored
    method: str
    energy_kev: float
    oversample: int
    timing: dict[str, float]
    finished: bool
    choice: Choice = field(default_factory=Choice)
    delta_told: bool = True
    verdict: Verdict | None = None
    total: TotalMatter | None = None
    constants: tuple[Determined, ...] = ()
    light: LightOptions = EVEN
    geometry: Geometry | None = None
    still: np.ndarray | None = None
    rest: Rest | None = None

    @property
    def contents(self) -> Contents:
        """What files of its volume hold: δ only where it is told."""
        return Contents.of(self.delta_told, self.energy_kev)

    def _repr_html_(self) -> str:
        """What Jupyter shows: what was decided and found, and the object."""
        rows = {"method": self.method, "photon energy": f"{self.energy_kev:.4g} keV", "finished": str(self.finished)}
        rows["time"] = f"{sum(self.timing.values()):.1f} s"
        rows |= {"frames": " ".join(self.verdict.lines("training frames"))} if self.verdict else {}
        rows |= {"total": self.total.words} if self.total else {}
        return card("Reconstruction", rows) + "<br/>" + of_object(self.object)

    def placed(self, scan: Scan) -> Scan:
        """`scan`, as it was given to the reconstruction, at the distance and energy, or in the poses, that were
        found."""
        return placed(self.geometry.applied(scan) if self.geometry else scan, self.constants)
