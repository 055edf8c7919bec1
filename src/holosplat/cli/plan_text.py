"""A plan and a survey as lines of text."""

from __future__ import annotations

import numpy as np

from ..planning.contrast import Setup
from ..planning.plan import Motion, Plan, Recording, Sampling, Storage, Survey, Waves
from ..units import in_percent

WIDTH = 38
MOST_ROWS = 9
"""Energies that are printed, at most."""


def plan_lines(name: str, setup: Setup, recording: Recording, plan: Plan) -> list[str]:
    """The plan, one quantity a line; what the recording does not say is left out."""
    blur = f", blur {setup.blur_px:.3g} px (standard deviation)" if setup.blur_px else ""
    head = f"{setup.energy_kev:g} keV, {_length(setup.distance)}, pixels of {_length(setup.pixel_size)}{blur}"
    groups = [_waves(plan), _detection(recording, plan), _sampling(recording, plan.sampling)]
    groups += [_motion(plan.motion), _storage(recording, plan.storage)]
    lines = [name, head]
    for title, rows in groups:
        if rows:
            lines += ["", title, *(f"  {label:{WIDTH}}{value}" for label, value in rows)]
    return lines


Group = tuple[str, list[tuple[str, str]]]


def _waves(plan: Plan) -> Group:
    waves = plan.waves
    absorbed = f"{in_percent(abs(waves.absorption))} {'more' if waves.absorption >= 0 else 'less'} than the medium"
    rows = [
        ("Δδ, Δβ", f"{waves.delta:.3g}, {waves.beta:.3g}"),
        ("Fresnel number, object's radius", f"{waves.fresnel_object:.3g}"),
        ("Fresnel number, pixel", f"{waves.fresnel_pixel:.3g}"),
        ("first fringe √(λz)", _fringe(waves)),
        ("largest phase shift", f"{waves.phase:.3g} rad"),
        ("largest absorption", absorbed),
        ("contrast, least to greatest", f"{waves.contrast_low:+.3g} to {waves.contrast_high:+.3g}"),
        ("contrast, rms over the shadow", f"{waves.contrast_rms:.3g}"),
        ("90 % of the signal lies within", _length(waves.spread)),
    ]
    return "one object", rows


def _fringe(waves: Waves) -> str:
    if waves.fringe == 0:
        return "none: absorption alone"
    blurred = " (finer than two pixels: blurred)" if waves.fringe_px < 2 else ""
    return f"{_length(waves.fringe)}, {waves.fringe_px:.3g} px{blurred}"


def _detection(recording: Recording, plan: Plan) -> Group:
    found = plan.detection
    rows = [
        (f"signal to noise, {_number(recording.photons_per_pixel)} photons/px", f"{found.snr:.3g}"),
        ("  by its place on the pixels", f"{found.snr_worst:.3g} to {found.snr_best:.3g}, rms {found.snr_rms:.3g}"),
        ("photons/px for signal to noise 5", _number(found.photons)),
        (
            "  by its place on the pixels",
            f"{_number(found.photons_best)} to {_number(found.photons_worst)}, for the mean SNR² "
            f"{_number(found.photons_mean)}",
        ),
    ]
    return "detection in one view (object in the middle of an even detector)", rows


def _sampling(recording: Recording, sampling: Sampling) -> Group:
    views = "1 view" if recording.views == 1 else f"{recording.views} views"
    rows = [
        (f"Crowther limit of {views}, object", _length(sampling.limit_object)),
        ("views that resolve a pixel, object", f"{sampling.views_object}"),
    ]
    if sampling.field is not None and sampling.limit_field is not None:
        width, height = sampling.field
        rows += [
            (f"Crowther limit of {views}, field", _length(sampling.limit_field)),
            ("views that resolve a pixel, field", f"{sampling.views_field}"),
            ("field of view, width × height", f"{_length(width)} × {_length(height)}"),
        ]
    return "tomography over 180°, without prior knowledge", rows


def _motion(motion: Motion) -> Group:
    rows = []
    if motion.blur_px is not None:
        rows.append(("blur in an exposure", f"{motion.blur_px:.3g} px"))
    if motion.step_px is not None:
        rows.append(("path from frame to frame", f"{motion.step_px:.3g} px"))
    if motion.longest_exposure is not None and motion.slowest_rate is not None:
        rows.append(("exposure with a blur of one pixel", _with_unit(motion.longest_exposure, "s")))
        rows.append(("frame rate with a path of one pixel", _with_unit(motion.slowest_rate, "Hz")))
    return "motion", rows


def _storage(recording: Recording, storage: Storage) -> Group:
    rows = []
    if storage.data_rate is not None:
        rows.append(("data rate of all views", _with_unit(storage.data_rate, "B/s")))
    if storage.raw is not None and storage.volume is not None:
        instants = "1 frame" if recording.frames == 1 else f"{recording.frames} frames"
        voxels = " × ".join(str(n) for n in storage.volume)
        rows += [
            (f"raw data of {instants}, all views", _with_unit(storage.raw, "B")),
            ("volume (z × y × x), δ and β", f"{voxels} voxels, {_with_unit(storage.volume_bytes or 0, 'B')}"),
            (f"volumes of {instants}", _with_unit(storage.volumes_bytes or 0, "B")),
        ]
    return "data", rows


def survey_lines(survey: Survey) -> list[str]:
    """The best distance of several energies, and where the best of all lies."""
    energy, distance = survey.best
    rows, count = survey.table(), len(survey.energies_kev)
    shown = sorted({*np.linspace(0, count - 1, min(count, MOST_ROWS)).round().astype(int).tolist(), energy})
    photons = _number(survey.photons_per_pixel)
    lines = [
        f"best distance; signal to noise (SNR) with {photons} photons/px, rms over the places on the pixels;",
        "near: the shortest distance with 90 % of that SNR; within: the circle with 90 % of the signal",
        "     energy   distance       near       SNR  photons/px for 5    fringe     within",
    ]
    for e in shown:
        row = rows[e]
        lengths = [_length(row[key]) for key in ("best_distance_m", "distance_for_90_percent_m", "spread_m")]
        lines.append(
            f"  {row['energy_kev']:>5.4g} keV  {lengths[0]:>9}  {lengths[1]:>9}  {row['snr']:>8.3g}  "
            f"{_number(row['photons_for_5']):>16}  {row['fringe_px']:>5.3g} px  {lengths[2]:>9}"
            + ("  best" if e == energy else "")
        )
    ends = _at_an_end("distance", distance, survey.distances) + _at_an_end("energy", energy, survey.energies_kev)
    return lines + ends


def _at_an_end(name: str, index: int, values: np.ndarray) -> list[str]:
    if len(values) == 1 or 0 < index < len(values) - 1:
        return []
    end = "lower" if index == 0 else "upper"
    return [f"  the best {name} is the {end} end of its range: a wider range may hold a better one"]


def _number(value: float) -> str:
    """A count for people: 1.09e+06 → 1.1e6."""
    if value < 1e4:
        return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"


def _length(metres: float) -> str:
    return _with_unit(metres, "m")


def _with_unit(value: float, unit: str) -> str:
    """`value` with an SI prefix: 3.2e-6 m → 3.2 µm."""
    prefixes = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T", 15: "P", 18: "E"}
    rounded = float(f"{value:.3g}")
    exponent = 0 if rounded == 0 else int(np.clip(3 * np.floor(np.log10(abs(rounded)) / 3), -12, 18))
    return f"{rounded / 10.0**exponent:.4g} {prefixes[exponent]}{unit}"
