"""What a reconstruction is asked to do: settings, presets, and the file `config.json`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ..baselines import HolographicTV
from ..baselines.two_materials import LEAST_CONTRAST
from ..checks import InputError, at_least, require
from ..fit.density import DensityControl
from ..fit.loop import FitOptions
from ..fit.objective import THESIS, Objective
from ..fit.schedule import Schedule
from ..io.json import read_json
from ..materials import DeltaBeta


@dataclass(frozen=True)
class MaterialPrior:
    """What is known of the matter: its δ and β (`known`), only their `ratio`, or nothing (`free`).

    delta, beta: of the material against its medium (β of either sign); ratio: δ/β; second_delta, second_beta: of
    another material, lighter, where two are known (0: there is one).
    """

    kind: Literal["known", "ratio", "free"] = "free"
    delta: float = 0.0
    beta: float = 0.0
    ratio: float = 0.0
    second_delta: float = 0.0
    second_beta: float = 0.0

    @classmethod
    def known(cls, material: DeltaBeta, second: DeltaBeta | None = None) -> MaterialPrior:
        """One material, or two, whose δ (above zero, and not the same) and β are known."""
        for one in (material, second or material):
            require(
                one.delta > 0,
                f"the material must have δ above its medium's, but the difference is {one.delta:.3g}; "
                "exchange the two.",
            )
        if second is None:
            return cls("known", material.delta, material.beta)
        denser, lighter = sorted((material, second), reverse=True)
        require(
            denser.delta >= LEAST_CONTRAST * lighter.delta,
            f"two materials are told apart by δ, of which one must have at least {LEAST_CONTRAST:g} times the other's, "
            f"but they have {denser.delta:.3g} and {lighter.delta:.3g}; take them for one.",
        )
        return cls("known", *denser, second_delta=lighter.delta, second_beta=lighter.beta)

    @property
    def materials(self) -> tuple[DeltaBeta, ...]:
        """The known materials, the denser first; none where not both δ and β are known."""
        known = (DeltaBeta(self.delta, self.beta), DeltaBeta(self.second_delta, self.second_beta))
        return tuple(one for one in known if one.delta > 0)

    def as_dict(self) -> dict[str, Any]:
        """What is known, ready for JSON; nothing of a second material where there is none."""
        values = dataclasses.asdict(self)
        return {name: value for name, value in values.items() if value or not name.startswith("second_")}

    @classmethod
    def of_ratio(cls, ratio: float) -> MaterialPrior:
        """One material of unknown density, with δ/β known (negative where β lies below the medium's)."""
        require(
            abs(ratio) >= 1 and abs(ratio) < 1e6,
            f"delta_beta must have a size between 1 and 1e6, but it is {ratio:g}.",
        )
        return cls("ratio", ratio=ratio)


@dataclass(frozen=True)
class Settings:
    """Everything about a reconstruction but the scan, the material and the seed.

    start: `phase` (phase retrieval, total-variation tomography, Gaussians where there is matter) or `random`;
    spacing_px: distance between Gaussians at a phase start [pixels]; spacing_noise: what it grows by, as a share, for
    the share of the frames' contrast that is noise, at most to twice; max_start: coarser rather than more than
    this many; approximate_steps: steps in which they learn the starting volume; random_count: Gaussians of a
    random start; separate: after a phase start with nothing known of the matter, δ and β are fitted apart, not at the
    one ratio that the frames suggest; most_materials: how many (1 or 2) may be found there; volume, fit: options of
    the starting volume and of the fit.
    """

    start: Literal["phase", "random"] = "phase"
    spacing_px: float = 1.0
    spacing_noise: float = 2.3
    max_start: int = 150_000
    approximate_steps: int = 50
    random_count: int = 8_000
    separate: bool = False
    most_materials: int = 2
    volume: HolographicTV = field(default_factory=HolographicTV)
    fit: FitOptions = field(default_factory=FitOptions)

    def __post_init__(self) -> None:
        require(self.spacing_px > 0, f"spacing_px must be positive, but it is {self.spacing_px}.")
        at_least(self, 0, "approximate_steps", "spacing_noise")
        at_least(self, 1, "max_start", "random_count")
        require(
            self.most_materials in (1, 2),
            f"most_materials must be 1 or 2, but it is {self.most_materials}; no more than two can be told apart.",
        )


def presets() -> dict[str, Settings]:
    """Named settings for `--preset`."""
    default = Settings(
        fit=FitOptions(
            Objective(
                l1=1.0,
                tv_volume=0.25,
                overfull=10.0,
                two_levels=1.25,
                noise_gain=0.5,
                noise_width=1.0,
                coarse=1.0,
            ),
            Schedule(steps=300, rate_position=0.01, rate_scale=0.01, rate_rotation=0.01, rate_amplitude=0.01),
        ),
    )
    return {
        "default": default,
        "fast": replace(
            default,
            approximate_steps=30,
            volume=replace(default.volume, retrieval=30, iterations=80, corrections=3, inner=10),
            fit=replace(default.fit, schedule=replace(default.fit.schedule, steps=60)),
        ),
        "thesis": Settings(
            start="random",
            separate=True,
            fit=FitOptions(
                THESIS,
                Schedule(
                    steps=30_000,
                    views_per_step=4,
                    rate_position=0.01,  # the thesis' 1.6e-4 of half the field, if the field is 128 pixels wide
                    rate_scale=1e-3,
                    rate_rotation=1e-3,
                    rate_amplitude=0.01,
                    warmup_steps=1000,
                    detach_worst=True,
                    validation_views=1,
                    validate_every=250,
                ),
                DensityControl(every=500, start=0.1, stop=0.5, max_count=250_000, faint=1e-3),
            ),
        ),
        "random": Settings(
            start="random",
            random_count=8_000,
            fit=FitOptions(
                Objective(
                    l1=1.0,
                    tv_volume=0.1,
                    overfull=10.0,
                    two_levels=0.1,
                    noise_gain=15.0,
                    noise_width=1.0,
                    coarse=1.0,
                ),
                Schedule(
                    steps=1500,
                    views_per_step=2,
                    rate_position=0.1,
                    rate_scale=0.04,
                    rate_rotation=0.02,
                    rate_amplitude=0.06,
                    decay=0.05,
                    volume_every=5,
                ),
                DensityControl(every=100, start=0.05, stop=0.6, grow_fraction=0.05, max_count=40_000, faint=0.003),
            ),
        ),
    }


def preset(name: str) -> Settings:
    """The settings called `name`; `InputError` listing the names otherwise."""
    table = presets()
    if name not in table:
        raise InputError(f"preset must be one of {', '.join(table)}, but it is {name!r}.")
    return table[name]


def read_settings(path: Path) -> Settings:
    """Settings from a JSON file: those of a run (its config.json), or such a table alone; checked field by field."""
    values = read_json(path)
    return from_plain(Settings, values.get("settings", values), "settings")


def from_plain(kind: Any, values: Any, where: str) -> Any:
    """The dataclass `kind` from a nested dictionary; unknown, missing and ill-typed entries are an `InputError`."""
    require(isinstance(values, dict), f"{where} must be a table of settings, but it is {values!r}.")
    hints = get_type_hints(kind)
    unknown, missing = set(values) - set(hints), set(hints) - set(values)
    require(not unknown, f"{where} has the unknown entries {', '.join(sorted(unknown))}; remove them.")
    require(not missing, f"{where} lacks the entries {', '.join(sorted(missing))}; add them.")
    return kind(**{name: _checked(hint, values[name], f"{where}.{name}") for name, hint in hints.items()})


def _checked(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_plain(hint, value, where)
    if get_origin(hint) is Literal:
        choices = get_args(hint)
        require(value in choices, f"{where} must be one of {', '.join(choices)}, but it is {value!r}.")
        return value
    kinds = {float: (int, float), int: (int,), bool: (bool,), str: (str,)}[hint]
    good = isinstance(value, kinds) and (hint is bool or not isinstance(value, bool))
    require(good, f"{where} must be of the type {hint.__name__}, but it is {value!r}.")
    return hint(value)
