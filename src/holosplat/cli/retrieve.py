"""`holosplat retrieve`: phase and thickness of single frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from tyro.conf import Positional

from ..checks import require
from ..io.atomic import atomic_path
from ..io.phase_maps import PhaseMaps, is_file, write_phase_maps
from ..io.reading import Reading
from ..matter import DeltaBeta, KnownRatio
from ..ranges import Grams, Signed, checked_dataclass
from .light import LightFlags
from .options import PriorOptions
from .places import Output
from .progress import ProgressBar
from .sentence import say

if TYPE_CHECKING:
    from ..baselines.retrieve import Retrieved
    from ..scan import Scan

STAND_IN_DELTA = 1e-6
"""δ where only δ/β is known: the phase does not depend on it."""


RetrievalName = Literal["tikhonov", "admm", "ctf", "paganin", "gerchberg-saxton", "hybrid-input-output"]


@checked_dataclass
class OneMaterial:
    """The one material; give it, or δ/β."""

    material: str | None = None
    """Formula or name of the material (holosplat materials lists them)."""
    density: Grams | None = None
    """Its density [g/cm³]; a named one has its own."""
    medium: str | None = None
    """Formula or name of what surrounds it; none means vacuum."""
    medium_density: Grams | None = None
    """The medium's density [g/cm³]."""
    delta_beta: Signed | None = None
    """Or: only the ratio δ/β is known; it gives the phase, and no thickness."""
    contrast: Literal["above", "below"] = "above"
    """With it: side of the medium's δ on which matter lies; cells in light, whose index is larger, lie below."""

    def at(self, energy_kev: float) -> tuple[DeltaBeta, bool]:
        """δ and β at `energy_kev` [keV], and whether δ is known, not only δ/β."""
        material = () if self.material is None else (self.material,)
        density = () if self.density is None else (self.density,)
        prior = PriorOptions(material, density, self.medium, self.medium_density, self.delta_beta).prior(energy_kev)
        require(prior.fixes_ratio, "retrieve needs --material or --delta-beta, but neither is given; add one of them.")
        if isinstance(prior, KnownRatio):
            delta = STAND_IN_DELTA if self.contrast == "above" else -STAND_IN_DELTA
            return DeltaBeta(delta, delta / prior.ratio), False
        require(self.contrast == "above", "--contrast goes with --delta-beta; a material says it; leave --contrast.")
        return prior.materials[0], True


def retrieve(
    scan: Positional[Path],
    out: Output,
    matter: OneMaterial = OneMaterial(),
    method: RetrievalName = "tikhonov",
    illumination: LightFlags = LightFlags(),
    reading: Reading = Reading(),
) -> None:
    """Retrieve phase and thickness of single frames, into TIFF files or HDF5.

    Args:
        scan: Scan: a file (NXtomo), or a folder (tiff, nerf-synthetic, r2-gaussian, or a run's).
        out: HDF5 file to write (.h5), or folder to make: a TIFF stack a map, maps.json and a preview.
        method: Tikhonov through the full wave optics is the most reliable; docs/phase_retrieval.md compares them.
    """
    from ..baselines.retrieve import retrieve as act
    from ..io.formats import read_frames

    measured = read_frames(scan, reading).in_memory()
    material, level = matter.at(measured.exposures.reference_energy)
    with ProgressBar() as bar:
        how = {"light": illumination.options(), "missing": measured.missing, "on_progress": bar.of("phase retrieval")}
        found = act(measured.frames, measured.exposures, material, method, **how)
    words = found.light.in_words
    maps = {"phase": found.phase.numpy()}
    if level:
        maps["thickness"] = found.thickness.numpy()
    if found.light.background is not None:
        maps["light"] = found.light.background.factor().numpy()
    facts = {"method": method, "light": words, "delta_beta": f"{material.ratio:.6g}", "source": scan.name}
    facts |= {"delta": f"{material.delta:.6g}", "beta": f"{material.beta:.6g}"} if level else {}
    write_phase_maps(out, PhaseMaps(maps, measured.exposures, facts))
    if not is_file(out):
        _preview(out / "preview.png", measured, found)
    _report(out, measured, found, level)


def _preview(path: Path, measured: Scan, found: Retrieved) -> None:
    from ..report.content import view_labels
    from ..report.light import phase_figure

    background = found.light.background
    figure = phase_figure(
        measured.frames,
        None if background is None else background.factor().numpy(),
        found.phase.numpy(),
        view_labels(measured.views),
        measured.views.pixel_sizes,
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def _report(out: Path, measured: Scan, found: Retrieved, level: bool) -> None:
    what = "phase (rad) and thickness (m)" if level else "phase (rad); without --material there is no thickness"
    low, high = (float(np.quantile(found.phase.numpy(), share)) for share in (1e-4, 1 - 1e-4))
    print(f"phase from {low:.4g} to {high + 0.0:.4g} rad (quantiles 1e-4 and 1 - 1e-4); light {found.light.in_words}")
    if not measured.exposures.distance.any():
        say("the frames are in contact: they show absorption, and the phase is what δ/β makes of it")
    say(f"wrote {out}: {what}, {len(measured)} frames")
