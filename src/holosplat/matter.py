"""What matter is made of: the channels of a model's values, and what is known of the matter beforehand."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np

from .checks import InputError, require
from .geometry import Grid
from .ranges import Signed, Within, checked_dataclass
from .volume import Volume

Sign = Literal[-1, 0, 1]
"""1 for δ above the medium's, -1 below, 0 where that is not known."""
MatterKind = Literal["levels", "continuous"]
"""What matter is like: of one level of δ, or several, with sharp edges, or varying smoothly."""
LEAST_CONTRAST = 1.6
"""Two levels that are found, and not known, pass for one where they differ by less than this factor."""
MOST_DELTA = 10.0
"""What no δ or β of X-rays comes near: those of gold at 1 keV are 0.002."""
RATIO_RANGE = (1.0, 1e6)
"""Sizes of δ/β that may be given."""


class _Index(NamedTuple):
    delta: float
    beta: float


class DeltaBeta(_Index):
    """The refractive index n = 1 - delta + i·beta, dimensionless; either may be negative in a difference.

    Errors: `InputError` for numbers that are not finite.

    Examples:

        >>> import holosplat as hs
        >>> protein, water = hs.DeltaBeta(7.4e-7, 2.2e-10), hs.DeltaBeta(5.8e-7, 2.6e-10)
        >>> added = protein.against(water)
        >>> print(f"δ {added.delta:.1e}, β {added.beta:.1e}, δ/β {added.ratio:.0f}")
        δ 1.6e-07, β -4.0e-11, δ/β -4000
    """

    __slots__ = ()

    def __new__(cls, delta: float, beta: float) -> Self:
        """δ and β, both finite."""
        for name, value in (("δ", delta), ("β", beta)):
            finite = math.isfinite(value)
            require(finite, f"{name} must be a finite number, but it is {value}; correct it.")
        return super().__new__(cls, delta, beta)

    def against(self, medium: DeltaBeta) -> DeltaBeta:
        """What an object in `medium` adds to it: `(δ - δ_medium, β - β_medium)`."""
        return DeltaBeta(self.delta - medium.delta, self.beta - medium.beta)

    @property
    def sign(self) -> float:
        """1 for δ above the medium's, -1 below: the sign of what an occupancy, which is never negative, adds."""
        return math.copysign(1.0, self.delta)

    @property
    def ratio(self) -> float:
        """δ/β; infinite (with δ's sign) for β = 0, negative where the two differ in sign, NaN for vacuum."""
        if self.beta == 0:
            return math.copysign(math.inf, self.delta) if self.delta else math.nan
        return self.delta / self.beta


@dataclass(frozen=True)
class Matter:
    """What the channels of a model's values mean.

    channels: (δ, β) of a value of one, for each channel
    occupancies: True if values are shares of materials, which cannot add up to more than one; False if δ and β are
        free, each in its own of two channels
    """

    channels: tuple[DeltaBeta, ...]
    occupancies: bool = True

    def __post_init__(self) -> None:
        channels = tuple(DeltaBeta(float(delta), float(beta)) for delta, beta in self.channels)
        require(len(channels) > 0, "matter must have a channel at least, but it has none.")
        require(
            self.occupancies or len(channels) == 2,
            f"free δ and β have a channel each, but matter has {len(channels)} channels.",
        )
        for name, value in ((name, value) for channel in channels for name, value in zip(("δ", "β"), channel)):
            require(
                abs(value) <= MOST_DELTA,
                f"{name} of matter must lie within {MOST_DELTA:g} of 0, but it is {value:g} (n = 1 - δ + iβ).",
            )
        object.__setattr__(self, "channels", channels)

    @classmethod
    def one(cls, delta: float, beta: float) -> Matter:
        """One material; the values are its occupancy."""
        return cls((DeltaBeta(delta, beta),))

    @classmethod
    def several(cls, *materials: tuple[float, float]) -> Matter:
        """Materials, (δ, β) each; the values are their occupancies."""
        return cls(tuple(DeltaBeta(*each) for each in materials))

    @classmethod
    def free(cls, delta: float, beta: float) -> Matter:
        """δ and β apart, in units of `delta` and `beta`."""
        return cls((DeltaBeta(delta, 0.0), DeltaBeta(0.0, beta)), occupancies=False)

    def __len__(self) -> int:
        """The number of channels."""
        return len(self.channels)

    @property
    def single(self) -> bool:
        """Whether one occupancy carries both δ and β."""
        return len(self.channels) == 1

    @property
    def others(self) -> tuple[DeltaBeta, ...]:
        """The materials after the first, of weaker contrast; none where there is one, or none is told apart."""
        return self.channels[1:] if self.occupancies else ()

    @property
    def delta(self) -> float:
        """δ of a value of one in the first channel."""
        return self.channels[0].delta

    @property
    def beta(self) -> float:
        """β of the first material, or of a value of one in the channel of β."""
        return self.channels[0].beta if self.occupancies else self.channels[-1].beta

    def freed(self) -> Matter:
        """The first material's δ and β as units of two free channels."""
        return Matter.free(self.delta, self.beta)

    def in_lengths(self, unit: float) -> tuple[tuple[float, float], ...]:
        """(δ, β) [m] that a line integral of one `unit` [m] of each channel gives."""
        return tuple((delta * unit, beta * unit) for delta, beta in self.channels)

    def volume(self, values: np.ndarray, grid: Grid) -> Volume:
        """δ and β on `grid` of values [C, Z, Y, X]."""
        delta, beta = np.tensordot(np.array(self.channels, dtype=np.float32).T, values, axes=1)
        return Volume(delta, beta, grid)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as files hold them; `from_dict` reads them."""
        return {"channels": [list(channel) for channel in self.channels], "occupancies": self.occupancies}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Matter:
        """The matter that `as_dict` described; `InputError` for anything else."""
        try:
            channels = tuple(DeltaBeta(float(delta), float(beta)) for delta, beta in values["channels"])
            occupancies = bool(values["occupancies"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"matter must hold channels and occupancies, but it is {values!r}.") from error
        return cls(channels, occupancies)


class MaterialPrior:
    """The knowledge of the material before a reconstruction: δ and β, their ratio, or nothing.

    Made by `known`, `of_ratio` or `unknown`: `Known` or `KnownSeveral`, `KnownRatio`, or `Unknown`. δ and β are
    differences from the medium around the object. Errors: `InputError` for `MaterialPrior()` itself, for a δ of zero,
    and for a ratio whose size is not from 1 to 10⁶.

    Examples:

        >>> import holosplat as hs
        >>> hs.MaterialPrior.known(hs.DeltaBeta(5.8e-7, 2.6e-10))
        Known(material=DeltaBeta(delta=5.8e-07, beta=2.6e-10), medium='', two_sided=False)
        >>> hs.MaterialPrior.of_ratio(2200)
        KnownRatio(ratio=2200.0, sign=0, two_sided=False)
        >>> hs.MaterialPrior.unknown().fixes_ratio
        False
    """

    kind = ""
    """The name of this knowledge in files and tables."""
    materials: tuple[DeltaBeta, ...] = ()
    """The known materials, that of the stronger contrast (the larger |δ|) first."""
    sign: Sign = 0
    """1 where δ of the matter lies above its medium's, -1 where it lies below, 0 where that is not known."""
    two_sided: bool = False
    """Whether δ of matter may lie on both sides of its medium's."""
    spherical: bool = False
    """Whether continuous matter is spherical about a point that is not known, as a shock from there."""
    medium: str = ""
    """Name of the medium, as it was given."""

    def __new__(cls, *args: object, **named: object) -> Self:
        """One of the four; of the base class alone nobody could say what is known."""
        require(
            cls is not MaterialPrior,
            "what is known of the matter must be said by MaterialPrior.known(...), .of_ratio(...) or .unknown(), but "
            "it is MaterialPrior(); take one of them.",
        )
        return super().__new__(cls)

    @staticmethod
    def known(material: DeltaBeta, *others: DeltaBeta, medium: str = "") -> MaterialPrior:
        """δ (not zero) and β of one material, or of several whose δ differ; below zero for holes in a medium.

        medium: its name, for what is said; empty: vacuum, or not said.
        """
        if not others:
            return Known(DeltaBeta(*material), medium)
        by_size = sorted((material, *others), key=lambda one: (abs(one[0]), one), reverse=True)
        return KnownSeveral(tuple(DeltaBeta(*one) for one in by_size), medium)

    @staticmethod
    def of_ratio(ratio: float, sign: Sign = 0) -> MaterialPrior:
        """One material of unknown density, with δ/β known (negative where δ and β differ from the medium's otherwise);
        sign: as for `unknown`."""
        return KnownRatio(float(ratio), sign)

    @staticmethod
    def unknown(sign: Sign = 0) -> MaterialPrior:
        """Nothing is known: the frames decide. sign: 1 where δ lies above the medium's, -1 below; 0: not known."""
        return Unknown(sign)

    def signed(self, sign: Sign) -> MaterialPrior:
        """The same knowledge with a sign of δ, where that was not known."""
        return self

    def on_both_sides(self) -> MaterialPrior:
        """The same knowledge of continuous matter on both sides of its medium. Errors: `InputError` for several
        materials on one."""
        if self.two_sided:
            return self
        one = len(self.materials) < 2
        require(one, "matter on both sides of its medium must be of one --material, but there are several; give one.")
        return replace(self, two_sided=True)  # type: ignore[type-var]  # every kind is a dataclass

    def about_a_point(self) -> MaterialPrior:
        """The same knowledge of continuous matter that is spherical. Errors: `InputError` for several materials."""
        require(len(self.materials) < 2, "spherical matter must be of one material, but there are several; give one.")
        return replace(self, spherical=True)  # type: ignore[type-var]  # every kind is a dataclass

    def with_ratio(self, ratio: float) -> MaterialPrior:
        """What is known of one material whose δ/β was found."""
        return KnownRatio(float(ratio), self.sign, self.two_sided, self.spherical)

    @property
    def against(self) -> str:
        """What δ and β are differences to, in words; empty for vacuum, and where nothing is said."""
        return self.medium or ("the medium" if self.sign < 0 or self.two_sided else "")

    @property
    def delta_sign(self) -> float:
        """The sign of δ that is taken, 1.0 or -1.0: 1.0 where it is not known."""
        return -1.0 if self.sign < 0 else 1.0

    @property
    def fixes_level(self) -> bool:
        """Whether it is known which δ an occupancy of one has."""
        return bool(self.materials)

    @property
    def fixes_ratio(self) -> bool:
        """Whether the ratio δ/β is known."""
        return True

    def bound(self, upper: float) -> float:
        """The bound `upper` of the occupancy where the level of the material is known, else 0 (none)."""
        return upper if self.fixes_level else 0.0

    @property
    def lower(self) -> float:
        """The bound of an occupancy from below: 0, or none (-inf) where matter may lie on both sides of its medium."""
        return -math.inf if self.two_sided else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON, as config.json holds them."""
        first = self.materials[0] if self.materials else DeltaBeta(0.0, 0.0)
        told = {"sign": 0 if self.materials else self.sign, "medium": self.medium, "two_sided": self.two_sided}
        told |= {"spherical": self.spherical}
        plain = {"kind": self.kind, "delta": first.delta, "beta": first.beta, "ratio": 0.0}
        return plain | {name: value for name, value in told.items() if value}


@dataclass(frozen=True)
class Known(MaterialPrior):
    """One material of known δ and β, both against its medium."""

    material: DeltaBeta
    medium: str = field(default="", compare=False)
    two_sided: bool = False
    spherical: bool = field(default=False, repr=False)
    kind = "known"

    def __post_init__(self) -> None:
        _require_contrast(self.material)

    @property
    def materials(self) -> tuple[DeltaBeta, ...]:  # type: ignore[override]
        """The material."""
        return (self.material,)

    @property
    def sign(self) -> Sign:  # type: ignore[override]
        """That of the material's δ."""
        return -1 if self.material.delta < 0 else 1


@dataclass(frozen=True)
class KnownSeveral(MaterialPrior):
    """Materials of known δ and β, all against their medium, that of the larger |δ| first."""

    materials: tuple[DeltaBeta, ...]  # type: ignore[override]
    medium: str = field(default="", compare=False)
    kind = "known"

    def __post_init__(self) -> None:
        for material in self.materials:
            _require_contrast(material)
        deltas = [material.delta for material in self.materials]
        listed = ", ".join(f"{delta:.3g}" for delta in deltas)
        require(
            len(set(deltas)) == len(deltas),
            f"materials are told apart by δ, but theirs are {listed}; take those that are alike for one.",
        )

    @property
    def sign(self) -> Sign:  # type: ignore[override]
        """That of δ of the first."""
        return -1 if self.materials[0].delta < 0 else 1

    @property
    def two_sided(self) -> bool:  # type: ignore[override]
        """Whether they lie on both sides of their medium."""
        return any(material.delta * self.sign < 0 for material in self.materials)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return super().as_dict() | {"others": [list(other) for other in self.materials[1:]]}


@checked_dataclass
class KnownRatio(MaterialPrior):
    """One material of which only δ/β is known, and perhaps the sign of δ."""

    ratio: Signed
    sign: Annotated[Sign, Within(-1, 1)] = 0
    two_sided: bool = False
    spherical: bool = field(default=False, repr=False)
    kind = "ratio"

    def __post_init__(self) -> None:
        low, high = RATIO_RANGE
        require(
            low <= abs(self.ratio) <= high,
            f"delta_beta must have a size between {low:g} and {high:g}, but it is {self.ratio:g}.",
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return super().as_dict() | {"ratio": self.ratio}

    def signed(self, sign: Sign) -> MaterialPrior:
        """The same with that sign."""
        return replace(self, sign=sign)


@dataclass(frozen=True)
class Unknown(MaterialPrior):
    """Nothing is known of the matter, but perhaps the sign of δ."""

    sign: Sign = 0
    two_sided: bool = False
    spherical: bool = field(default=False, repr=False)
    kind = "free"

    @property
    def fixes_ratio(self) -> bool:
        """Whether the ratio δ/β is known: it is not."""
        return False

    def signed(self, sign: Sign) -> MaterialPrior:
        """The same with that sign."""
        return replace(self, sign=sign)


def _require_contrast(material: DeltaBeta) -> None:
    require(
        material.delta != 0,
        "the material must differ from its medium in δ, but the difference is 0; give another material or medium.",
    )
