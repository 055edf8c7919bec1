"""`holosplat convert | retrieve`: scans in other formats; phase and thickness of single frames."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from ..checks import InputError, require
from ..frames import evenly
from ..io.atomic import atomic_path
from ..io.formats import HDF5_SUFFIXES, WRITERS, loader_of, read_as, read_frames
from ..io.images import TiffLayout
from ..io.phase_maps import PhaseMaps, is_file, write_phase_maps
from ..io.reading import Reading
from ..matter import DeltaBeta, KnownRatio, MaterialPrior
from ..ranges import Metres, Natural, Positive, Signed, Within, checked_dataclass, flag
from ..scan import Scan
from ..units import number_of
from .light import LightFlags
from .options import OneMaterial, PriorOptions
from .places import Output
from .progress import ProgressBar
from .sentence import say

if TYPE_CHECKING:
    from ..baselines.retrieve import Retrieved


@checked_dataclass
class WritingOptions:
    """How it is written."""

    png: Literal["grey16", "rgba8"] | None = None
    """nerf-synthetic: 16-bit grey images (default), or the 8-bit RGBA that some programs insist on."""
    camera_distance: Positive | None = None
    """nerf-synthetic: cameras' distance, in half fields of view (default 100); the farther, the more parallel."""
    tiff: TiffLayout | None = None
    """tiff: one stack (default), or one file a frame."""
    truth: Path | None = None
    """r2-gaussian: volume file of the truth, for its scores."""
    seed_points: Natural | None = None
    """nerf-synthetic, r2-gaussian: points to start from."""


@checked_dataclass
class EveningOptions:
    """Light that is the same in all frames."""

    still_light: Annotated[int, Within(0, 32)] | None = None
    """Divide out the light that all training frames share: up to so many half waves across a frame, such as 4, or any
    pattern (0) (default: nothing)."""
    inside: Metres | None = None
    """With it: distance from the axis within which matter lies [m] (default: anywhere)."""

    def applied(self, scan: Scan, prior: MaterialPrior) -> Scan:
        """The scan without such light."""
        from ..methods.method import STAND_IN_RATIO, shows_no_refraction
        from ..workflows.run_illumination import FixedPatternOptions, flatfield_corrected

        require(self.still_light is not None or self.inside is None, "--inside needs --still-light.")
        if self.still_light is None:
            return scan
        require(
            prior.fixes_ratio or shows_no_refraction(scan),
            "--still-light needs --material or --delta-beta, by which matter is told from light.",
        )
        prior = prior if prior.fixes_ratio else MaterialPrior.of_ratio(STAND_IN_RATIO)
        with ProgressBar() as bar:
            options = FixedPatternOptions(self.still_light, self.inside or 0.0)
            found = flatfield_corrected(scan, prior, options, bar.show)
        say(f"still light: {found.provenance['still_light']}")
        return found


NXTOMO = ".nxs"


def convert(
    source: Annotated[Positional[Path], arg(metavar="SOURCE")],
    out: Annotated[Positional[Output], arg(metavar="OUT")],
    writing: WritingOptions,
    to: str | None = None,
    reading: Reading = Reading(),
    matter: PriorOptions = PriorOptions(),
    evening: EveningOptions = EveningOptions(),
) -> None:
    """Bring a scan into another format; what SOURCE is, its content says.

    Args:
        source: Scan, a file (NXtomo) or folder (nerf-synthetic, tiff, r2-gaussian, a run's).
        out: File (nxtomo) or folder to make.
        to: Format to write: nxtomo (where OUT ends with .nxs, .h5 or .hdf5), tiff, nerf-synthetic or r2-gaussian, which
            needs a material or δ/β, for which its line integrals are retrieved.
    """
    if to is None:
        named = out.suffix.lower() in (NXTOMO, *HDF5_SUFFIXES)
        require(named, f"--to is required, for {out.name} says no format by its suffix ({NXTOMO} is nxtomo); add it.")
        to = "nxtomo"
    require(to in WRITERS, f"--to must be one of {', '.join(WRITERS)}, but it is {to!r}.")
    writer, said = WRITERS[to], {name: value for name, value in vars(writing).items() if value is not None}
    for name in said:
        having = " or ".join(other for other, each in WRITERS.items() if name in each.takes)
        require(name in writer.takes, f"{flag(name)} goes with --to {having}.")
    require(
        reading.told.wall is None, "--wall is part of models and changes no frames; give it to reconstruct instead."
    )
    scan = read_as(source, reading, joined=False)
    loader = loader_of(source)
    if loader.opens is not None:  # which may hold counts
        from ..preprocess import require_relative

        require_relative(np.asarray(scan.source[evenly(len(scan), 3)]))
    if remark := loader.remark(source, scan):
        say(remark)
    prior = matter.prior(scan.exposures.reference_energy)
    takes_material = "material" in writer.takes
    wanted = evening.still_light is not None or takes_material
    require(not prior.fixes_ratio or wanted, f"a material is not needed with --to {to}; leave it.")
    require(len(prior.materials) < 2, f"--to {to} takes one material; give --material once.")
    scan = evening.applied(scan, prior)
    retrieved = partial(_retrieved, scan, prior) if takes_material and prior.fixes_ratio else None
    if warning := writer.write(out, scan, said, retrieved):
        say(warning)
    say(f"wrote {out}: {to}, {number_of(len(scan), 'frame')} of {scan.views.shape[0]} × {scan.views.shape[1]} pixels, "
         f"{int(scan.is_test.sum())} of them held out")  # fmt: skip


def _retrieved(scan: Scan, prior: MaterialPrior) -> tuple[np.ndarray, float]:
    """Thickness [N, H, W] [m] of a material, by Paganin (2002), and its δ; of δ/β alone such that the greatest
    thickness is half the field's longer side."""
    import torch

    from ..optics import retrieve_thickness

    exposures, views = scan.exposures.optical, scan.views
    delta, beta = (1.0, 1.0 / prior.ratio) if isinstance(prior, KnownRatio) else prior.materials[0]
    refraction = exposures.refraction(delta, beta)
    found = retrieve_thickness(
        torch.from_numpy(scan.frames), views.pitch, exposures.distance, exposures.energy_kev, *refraction
    ).numpy()
    if prior.fixes_level:
        return found, delta
    scale = float(found.max()) / (0.5 * max(views.width, views.height))
    if not scale > 0:
        raise InputError("the frames hold no shadow of matter with this --delta-beta; check its sign.")
    return found / scale, scale


STAND_IN_DELTA = 1e-6
"""δ where only δ/β is known: the phase does not depend on it."""


@checked_dataclass
class RatioOptions(OneMaterial):
    """The one material; give it, or δ/β."""

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
    matter: RatioOptions = RatioOptions(),
    method: str = "tikhonov",
    illumination: LightFlags = LightFlags(),
    reading: Reading = Reading(),
) -> None:
    """Retrieve phase and thickness of single frames, into TIFF files or HDF5.

    Args:
        scan: Scan: a file (NXtomo), or a folder (tiff, nerf-synthetic, r2-gaussian, or a run's).
        out: HDF5 file to write (.h5), or folder to make: a TIFF stack a map, maps.json and a preview.
        method: tikhonov (through the full wave optics, the most reliable), admm, ctf, paganin, gerchberg-saxton or
            hybrid-input-output; docs/phase_retrieval.md compares them.
    """
    from ..baselines.retrieve import retrieve as act
    from ..workflows.preconditions import check_frames

    measured = read_frames(scan, reading).in_memory()
    check_frames(measured)
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
    what = "phase (rad) and thickness (m)" if level else "phase (rad); without --material there is no thickness"
    low, high = (float(np.quantile(found.phase.numpy(), share)) for share in (1e-4, 1 - 1e-4))
    print(f"phase from {low:.4g} to {high + 0.0:.4g} rad (quantiles 1e-4 and 1 - 1e-4); light {words}")
    if not measured.exposures.distance.any():
        say("the frames are in contact: they show absorption, and the phase is what δ/β makes of it")
    say(f"wrote {out}: {what}, {number_of(len(measured), 'frame')}")


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
