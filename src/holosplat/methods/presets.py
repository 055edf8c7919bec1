"""Methods by name: presets, and the files that options are read from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from ..checks import InputError, require
from ..fit.density import DensityControl
from ..fit.schedule import Schedule
from ..fit.terms import THESIS, Objective
from ..tables import changed, read_table
from . import METHODS
from .gaussian_options import FitOptions, GaussianRates
from .gaussians import Gaussians
from .method import Method

OLD_RATES = {
    "rate_position": "centres",
    "rate_scale": "log_scales",
    "rate_rotation": "quaternions",
    "rate_amplitude": "raw_amplitudes",
}
"""What version 0.1 called the rates of a schedule."""


def presets() -> dict[str, Gaussians]:
    """Named options of Gaussians, for `--preset`."""
    default = Gaussians()
    schedule = replace(default.fit.schedule, steps=60)
    volume = replace(default.volume, retrieval=30, iterations=80, corrections=3, inner=10)
    random = Objective(
        l1=1.0, tv_volume=0.1, overfull=10.0, two_levels=0.1, noise_gain=15.0, noise_width=1.0, coarse=1.0
    )
    return {
        "default": default,
        "fast": replace(default, approximate_steps=30, volume=volume, fit=replace(default.fit, schedule=schedule)),
        "thesis": Gaussians(
            start="random",
            separate=True,
            fit=FitOptions(
                THESIS,
                Schedule(
                    steps=30_000,
                    views_per_step=4,
                    warmup_steps=1000,
                    detach_worst=True,
                    validation_views=1,
                    validate_every=250,
                ),
                # centres: the thesis' 1.6e-4 of half the field, if the field is 128 pixels wide
                GaussianRates(centres=0.01, log_scales=1e-3, quaternions=1e-3, raw_amplitudes=0.01),
                DensityControl(every=500, start=0.1, stop=0.5, max_count=250_000, faint=1e-3),
            ),
        ),
        "random": Gaussians(
            start="random",
            random_count=8_000,
            fit=FitOptions(
                random,
                Schedule(steps=1500, views_per_step=2, decay=0.05, volume_every=5),
                GaussianRates(centres=0.1, log_scales=0.04, quaternions=0.02, raw_amplitudes=0.06),
                DensityControl(every=100, start=0.05, stop=0.6, grow_fraction=0.05, max_count=40_000, faint=0.003),
            ),
        ),
    }


def preset(name: str) -> Gaussians:
    """The options called `name`; `InputError` listing the names otherwise."""
    table = presets()
    if name not in table:
        raise InputError(f"preset must be one of {', '.join(table)}, but it is {name!r}.")
    return table[name]


def method_called(name: str) -> Method:
    """The method called `name` with its options by default; `InputError` listing the names otherwise."""
    if name not in METHODS:
        raise InputError(f"method must be one of {', '.join(METHODS)}, but it is {name!r}.")
    return METHODS[name]


def chosen_method(method: str | None, preset_name: str | None, config: Path | None) -> Method:
    """The method that one of the three names: a method, a preset of Gaussians, or a file; Gaussians without any."""
    if config is not None:
        return read_method(config)
    return method_called(method) if method is not None else preset(preset_name or "default")


def read_method(path: Path) -> Method:
    """The method that a JSON or TOML file describes: the config.json of a run, of any version, or such a table alone.

    A table may be partial: `base` names the preset or the method that it changes (default: that of its `kind`).
    """
    table = read_table(path)
    values = table.get("method", _modern(table.get("settings", table)))
    require(isinstance(values, dict), f"{path} must hold a table of options, but it holds {values!r}.")
    values = {**values}
    kind = values.get("kind", Gaussians.kind)
    base = values.pop("base", None)
    start = _of_kind(str(kind)) if base is None else _based_on(str(base))
    return changed(start, values, "", type(start))


def _of_kind(kind: str) -> Method:
    for method in METHODS.values():
        if method.kind == kind:
            return method
    kinds = dict.fromkeys(method.kind for method in METHODS.values())
    raise InputError(f"kind must be one of {', '.join(kinds)}, but it is {kind!r}.")


def _based_on(name: str) -> Method:
    return preset(name) if name in presets() else method_called(name)


def _modern(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of version 0.1 as the options of Gaussians have them; others as they are."""
    fit = settings.get("fit")
    if not isinstance(fit, dict):
        return settings
    schedule = fit.get("schedule")
    if not isinstance(schedule, dict) or not set(schedule) & set(OLD_RATES):
        return settings
    rates = {OLD_RATES[name]: value for name, value in schedule.items() if name in OLD_RATES}
    rest = {name: value for name, value in schedule.items() if name not in OLD_RATES}
    return {**settings, "fit": {**fit, "schedule": rest, "rates": rates}}
