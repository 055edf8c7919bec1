"""Constants of an experiment that are known to a range: the frames say where in it they lie, and how surely."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from ..baselines.material import LIKELY_RATIOS
from ..checks import InputError, require
from ..matter import DeltaBeta, Known, KnownRatio, KnownSeveral, MaterialPrior
from ..optics.coherence import quadrature
from ..ranges import checked_dataclass
from ..scan import Scan
from .method import Task, first_of_task, shows_no_refraction
from .profile import Profile, ProfileOptions, exposed

STAGE = "uncertain constants"
WIDE = 4.0
"""Ends of a range over each other from which on it is looked at in more places."""
FEW, MANY = 5, 9
"""Places, of a range and of a wide one."""
NEWTON = 3
"""Steps towards the likeliest constants, with half the differences each time."""
CONVERGED = 1e-3
"""Part of the misfit by which it may differ because a fit is not at its end; it counts as much as chance does."""
SEEN = 4.0
"""Differences of the misfit, in units of what is due to chance, from which on half a step still shows some."""
SYSTEMATIC, NOISY = 0.03, 0.4
"""Standard error of the logarithm of a constant beside that of the likelihood: of voxels, binning and support; and what
is added to it times the root of the noise over the contrast, for the more noise, the more do expectations count. Of
several constants together each has twice as much: what tells them apart is finer than what tells one."""
TOLD = 0.7
"""A constant is told by the frames if its standard error is less than this part of what the range left open."""
LIKELY = 2.0
"""Difference of -log of the probability up to which a constant lies within its interval, of about 95 %."""
ENOUGH_AIR = 0.1
"""Part of the pixels beside matter below which frames do not show where space is empty."""

Range = tuple[float, float]

UNITS = {"distance": " m", "energy_kev": " keV", "source_angle": " rad", "psf_sigma_px": " pixels"}
CALLED = {"energy_kev": "energy", "delta_beta": "δ/β", "source_angle": "source over its distance"}
CALLED |= {"psf_sigma_px": "blur of the detector", "distance": "distance", "bandwidth": "bandwidth"}
WIDTHS = ("bandwidth", "source_angle", "psf_sigma_px")
"""Constants that may be 0, which holds unless the frames predict each other better with the likeliest value."""


@checked_dataclass
class Uncertain:
    """Lowest and highest values of what is not known better; None for what is."""

    distance: Range | None = None
    """Effective propagation distance [m], the same for all frames."""
    energy_kev: Range | None = None
    """Photon energy [keV], the same for all frames."""
    delta_beta: Range | None = None
    """δ/β of the one material, at the nominal energy."""
    bandwidth: Range | None = None
    """Relative full width at half maximum of the spectrum, the same for all frames."""
    source_angle: Range | None = None
    """Standard deviation of the source over its distance from the sample [rad]."""
    psf_sigma_px: Range | None = None
    """Standard deviation of the detector's blur [pixels]."""

    def __post_init__(self) -> None:
        for name, (low, high) in self.given().items():
            require(
                abs(low) > 0 and low * high > 0 and abs(low) < abs(high) < math.inf,
                f"the range of {name} must go from a smaller to a larger size, both above 0, but it is {low:g} to "
                f"{high:g}; correct it.",
            )

    def given(self) -> dict[str, Range]:
        """What is uncertain, by name."""
        return {each.name: value for each in fields(self) if (value := getattr(self, each.name)) is not None}

    def middle(self) -> dict[str, float]:
        """The geometric mean of each range."""
        return {name: math.copysign(math.sqrt(low * high), low) for name, (low, high) in self.given().items()}


@dataclass(frozen=True)
class Determined:
    """A constant by the frames. value: the likeliest; low, high: between these with a probability of about 95 %, within
    the range `given`; told: whether the frames say more than the range did; remark: what else there is to say."""

    name: str
    value: float
    low: float
    high: float
    given: Range
    told: bool
    remark: str = ""

    def line(self) -> str:
        """The same in words."""
        unit, (least, most) = UNITS.get(self.name, ""), self.given
        known = f"{self.low:.4g} to {self.high:.4g}{unit}"
        said = f"by the frames, {known}" if self.told else "the frames say no more than the range"
        said += f"; given: {least:.4g} to {most:.4g}{unit}"
        return f"{CALLED[self.name]} {self.value:.4g}{unit} ({said}){'; ' + self.remark if self.remark else ''}"

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Determined:
        """That of a table of its fields."""
        return cls(**{**values, "given": (float(values["given"][0]), float(values["given"][1]))})


def determine(task: Task, uncertain: Uncertain, options: ProfileOptions | None = None) -> tuple[Determined, ...]:
    """The constants of `task` that are `uncertain`, by its training frames.

    The likelihood is that of `Profile`; what a range says counts as a normal distribution of the logarithm about its
    middle whose standard deviation is half its width, cut off at its ends. Errors: `InputError` for δ/β of a known
    material or of two, and for frames of several distances or energies where these are uncertain.
    """
    ranges = uncertain.given()
    if not ranges:
        return ()
    _require_one(task, uncertain)
    middle = uncertain.middle()
    longest = max(uncertain.distance) if uncertain.distance else None
    if shows_no_refraction(exposed(task.scan, middle | ({"distance": longest} if longest else {}))):
        return _untold(ranges, middle, "the frames show absorption alone")
    corners = [dict(zip(ranges, ends)) for ends in zip(*map(_sorted, ranges.values()))]
    corners += [corner | {"distance": longest} for corner in corners if longest]
    for corner in corners:
        quadrature(exposed(task.scan, corner).exposures)  # which says what no fit can sum
    ratio, start = _assumed_ratio(task, middle), {}
    if uncertain.delta_beta:
        low, high = _sorted(uncertain.delta_beta)
        start["delta_beta"] = ratio = min(max(ratio, low), high)
    profile = Profile(task, ratio, middle | {"delta_beta": ratio}, corners, options or ProfileOptions())
    if profile.air() < ENOUGH_AIR:
        return _untold(ranges, middle, "too few pixels show empty space, without which frames cannot tell")
    return without_idle(profile, Search(profile, ranges, task, start, profile.begin).run())


def without_idle(profile: Profile, found: tuple[Determined, ...]) -> tuple[Determined, ...]:
    """`found` with 0 for each width that the frames do not need, all others as they were found."""
    for i, each in enumerate(found):
        if each.name not in WIDTHS:
            continue
        values = {one.name: one.value for one in found}
        chosen = profile.needs(each.name, values) if each.told else None
        if chosen is None or chosen.choice != each.name:
            remark = "0 is used" if chosen is None else f"{chosen.line}; 0 is used"
            none = replace(each, value=0.0, low=0.0, told=False, remark=remark)
            found = (*found[:i], none, *found[i + 1 :])
    return found


def likeliest_ratio(task: Task, options: ProfileOptions | None = None) -> Determined:
    """δ/β of continuous matter of which nothing is known; that of its first volumes where the likelihood tells none."""
    found = determine(task, Uncertain(delta_beta=LIKELY_RATIOS), options)[0]
    if found.told:
        return found
    return replace(found, value=min(max(first_of_task(task).material.ratio, found.low), found.high))


def _untold(ranges: Mapping[str, Range], middle: Mapping[str, float], why: str) -> tuple[Determined, ...]:
    return tuple(
        Determined(name, 0.0 if name in WIDTHS else middle[name], *_sorted(r), r, False, why)
        for name, r in ranges.items()
    )


def told(task: Task, found: tuple[Determined, ...]) -> Task:
    """`task` with the constants that were `found`; δ and β of known materials at the new energy by
    `scan.far_from_edges`."""
    if not found:
        return task
    scan, values = placed(task.scan, found), {each.name: each.value for each in found}
    if "delta_beta" in values:
        return replace(task, scan=scan, prior=task.prior.with_ratio(values["delta_beta"]), delta_told=True)
    return replace(
        task,
        scan=scan,
        prior=at_energy(task.prior, scan.exposures.reference_energy / task.scan.exposures.reference_energy),
    )


def placed(scan: Scan, found: tuple[Determined, ...]) -> Scan:
    """`scan` at the distance and energy that were `found`."""
    return exposed(scan, {each.name: each.value for each in found})


def at_energy(prior: MaterialPrior, factor: float) -> MaterialPrior:
    """The same knowledge at `factor` times the energy."""
    if factor == 1:
        return prior
    if isinstance(prior, Known | KnownSeveral):
        there = (DeltaBeta(m.delta * factor**-2, m.beta * factor**-4) for m in prior.materials)
        return MaterialPrior.known(*there, medium=prior.medium)
    return replace(prior, ratio=prior.ratio * factor**2) if isinstance(prior, KnownRatio) else prior


def _require_one(task: Task, uncertain: Uncertain) -> None:
    prior, exposures = task.prior, task.scan.exposures
    if uncertain.delta_beta is not None and prior.fixes_ratio and task.delta_told:
        raise InputError("delta_beta must be a range where the material is not known, but it is; leave one of them.")
    require(len(prior.materials) < 2, "uncertain constants need one material, but several are known; give one.")
    for name in ("distance", "energy_kev"):
        values = getattr(exposures, name)
        require(
            getattr(uncertain, name) is None or bool((values == values[0]).all()),
            f"an uncertain {name} must be that of all frames, but theirs go from {values.min():g} to "
            f"{values.max():g}; take those of one.",
        )


def _assumed_ratio(task: Task, middle: Mapping[str, float]) -> float:
    """δ/β for the first volume, at the nominal energy of the task."""
    if task.prior.materials:
        known = task.prior.materials[0]
        return known.ratio if math.isfinite(known.ratio) else 10 * LIKELY_RATIOS[1]
    if isinstance(task.prior, KnownRatio):
        return task.prior.ratio
    there = exposed(task.scan, middle)
    first = first_of_task(task) if there is task.scan else first_of_task(replace(task, scan=there, first=None))
    return first.material.ratio


def _sorted(ends: Range) -> Range:
    return (min(ends), max(ends))


@dataclass
class Search:
    """The likeliest constants: by steps along each from `begun`, or from the middle of its range, and then by Newton's
    method; logarithms of sizes throughout."""

    profile: Profile
    ranges: Mapping[str, Range]
    task: Task
    begun: Mapping[str, float] = field(default_factory=dict)
    away: Callable[[Mapping[str, float]], None] = lambda constants: None
    """Told where the search goes on, where that is more than a step of δ/β from `begun`; misfits are then new."""
    _values: dict[tuple[float, ...], float] = field(default_factory=dict)
    _planned: int = 1

    def __post_init__(self) -> None:
        self.names = list(self.ranges)
        ends = np.log(np.abs(np.array(list(self.ranges.values()))))
        self.low, self.high = ends.min(axis=1), ends.max(axis=1)
        self.middle, self.half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        self.sign = np.sign([r[0] for r in self.ranges.values()])
        self.start = self.middle.copy()
        for name, value in self.begun.items():
            self.start[self.names.index(name)] = math.log(abs(value))
        k = len(self.names)
        self.places = [MANY if h > 0.5 * math.log(WIDE) else FEW for h in self.half]
        self._planned = sum(self.places) + (NEWTON + 1) * (2 * k + k * (k - 1) // 2)

    def run(self) -> tuple[Determined, ...]:
        """The constants in words and numbers."""
        at, step = self._likeliest()
        _, hessian = self._slopes(at, step)
        return self._said(at, hessian)

    def _likeliest(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the posterior is largest, and the last steps of differences."""
        at, step = self.start.copy(), np.array([2 * h / (places - 1) for h, places in zip(self.half, self.places)])
        for i in range(len(at)):
            at = self._descended(at, i, step[i])
        ratio = np.array([name == "delta_beta" for name in self.names])
        if bool((ratio & (np.abs(at - self.start) > 1.5 * step)).any()):
            self.away(self._constants(at))
            self._values.clear()
        for _ in range(NEWTON):
            _, hessian = self._slopes(at, step)
            shown = 0.5 * np.diag(hessian) * step**2 > SEEN * self._temperature()
            step = np.where(shown, step / 2, step)
            before, at = at, self._moved(at, step)
            if bool((np.abs(at - before) < self._systematic).all()):
                break
        return at, step

    def _descended(self, at: np.ndarray, i: int, step: float) -> np.ndarray:
        """From `at`, or where nothing tells a constant `i`, an end of its range, by steps [logarithm] to where neither
        side is likelier."""
        if self.names[i] not in self.begun:
            at = min([at, _with(at, i, self.low[i]), _with(at, i, self.high[i])], key=self._cost)
        while True:
            sides = (float(np.clip(at[i] + s * step, self.low[i], self.high[i])) for s in (-1, 1))
            best = min([at, *(_with(at, i, side) for side in sides)], key=self._cost)
            if best is at:
                return at
            at = best

    def _constants(self, at: np.ndarray) -> dict[str, float]:
        return {name: float(value) for name, value in zip(self.names, self.sign * np.exp(at))}

    def _likely(self, at: np.ndarray) -> float:
        key = tuple(np.round(at, 6))
        if key not in self._values:
            self.task.on_progress(STAGE, min(1.0, len(self._values) / self._planned))
            self._values[key] = self.profile(self._constants(at))
        return self._values[key]

    @property
    def _systematic(self) -> float:
        """Standard error of each logarithm besides that of the likelihood; no search needs to be finer."""
        several = 2 if len(self.names) > 1 else 1
        return several * (SYSTEMATIC + NOISY * math.sqrt(self.profile.noise_share))

    def _temperature(self) -> float:
        """What a difference of the misfit is worth: one, and what fits that have not come to their end differ by."""
        return 1 + CONVERGED * min(self._values.values())

    def _slopes(self, at: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient [K] and Hessian [K, K] of the misfit by differences, along half-steps within the ranges."""
        count, inside = len(at), np.clip(at, self.low + step, self.high - step)
        middle = self._likely(inside)
        up = [self._likely(_with(inside, i, inside[i] + step[i])) for i in range(count)]
        down = [self._likely(_with(inside, i, inside[i] - step[i])) for i in range(count)]
        gradient, hessian = np.zeros(count), np.zeros((count, count))
        for i in range(count):
            gradient[i] = (up[i] - down[i]) / (2 * step[i])
            hessian[i, i] = (up[i] - 2 * middle + down[i]) / step[i] ** 2
            for j in range(i):
                both = self._likely(_with(_with(inside, i, inside[i] + step[i]), j, inside[j] + step[j]))
                hessian[i, j] = hessian[j, i] = (both - up[i] - up[j] + middle) / (step[i] * step[j])
        return gradient + hessian @ (at - inside), hessian

    def _moved(self, at: np.ndarray, step: np.ndarray) -> np.ndarray:
        """A step of Newton's method, of two steps of the differences at most, to what is likelier; or none."""
        gradient, hessian = self._slopes(at, step)
        pull = self._pull(hessian)
        down = np.linalg.solve(pull, gradient / self._temperature() + (at - self.middle) / self.half**2)
        down *= min(1.0, 2 / float(np.abs(down / step).max() + 1e-12))
        moved = np.clip(at - down, self.low, self.high)
        tried = [at, moved, *(_with(at, i, at[i] + s * step[i]) for i in range(len(at)) for s in (-1, 1))]
        inside = [one for one in tried if bool(((one >= self.low) & (one <= self.high)).all())]
        return min(inside, key=self._cost)

    def _cost(self, at: np.ndarray) -> float:
        """-log of the posterior probability."""
        return self._likely(at) / self._temperature() + 0.5 * float(np.square((at - self.middle) / self.half).sum())

    def _pull(self, hessian: np.ndarray) -> np.ndarray:
        """Second derivative of -log of the posterior; directions in which the misfit is not convex count as flat."""
        values, vectors = np.linalg.eigh(hessian / self._temperature())
        return (vectors * np.maximum(values, 0)) @ vectors.T + np.diag(self.half**-2)

    def _said(self, at: np.ndarray, hessian: np.ndarray) -> tuple[Determined, ...]:
        values, vectors = np.linalg.eigh(hessian / self._temperature())
        known = (vectors / (1 / np.maximum(values, 1e-9) + self._systematic**2)) @ vectors.T
        covariance = np.linalg.inv(known + np.diag(self.half**-2))
        likeliest, at = at, self.middle + covariance @ known @ (at - self.middle)
        error, tried = np.sqrt(np.diag(covariance)), self._about_as_likely()
        found = []
        for i, (name, given) in enumerate(self.ranges.items()):
            ends = np.clip([at[i] - 2 * error[i], at[i] + 2 * error[i]], self.low[i], self.high[i])
            ends = np.array([min(ends[0], tried[:, i].min()), max(ends[1], tried[:, i].max())])
            told = bool(error[i] < TOLD * self.half[i] and ends[1] - ends[0] < 2 * self.half[i])
            first, last = (float(end) for end in self.sign[i] * np.exp(ends))
            value = float(self.sign[i] * math.exp(at[i]))
            remark = self._at_an_end(likeliest, i) if told else self._joined(covariance, i)
            found.append(Determined(name, value, *_sorted((first, last)), given, told, remark))
        return tuple(found)

    def _about_as_likely(self) -> np.ndarray:
        """The constants [T, K] that were tried and may be as well, the likeliest among them.

        A second derivative does not describe a misfit that levels off, as that of ever larger δ/β.
        """
        places = np.array(list(self._values))
        costs = np.array([self._cost(place) for place in places])
        return places[costs <= costs.min() + LIKELY]

    def _at_an_end(self, at: np.ndarray, i: int) -> str:
        near = 0.02 * self.half[i]
        end = "lower" if at[i] < self.low[i] + near else "upper" if at[i] > self.high[i] - near else ""
        return f"this is the {end} end of the range, and it may lie beyond" if end else ""

    def _joined(self, covariance: np.ndarray, i: int) -> str:
        """With what a constant that frames do not tell goes together."""
        error = np.sqrt(np.diag(covariance))
        linked = covariance[i] / (error[i] * error)
        others = [j for j in range(len(linked)) if j != i and abs(linked[j]) > TOLD]
        if not others:
            return ""
        how = ["grows with" if linked[j] > 0 else "falls as they grow:" for j in others]
        parts = [f"{word} {CALLED[self.names[j]]}" for word, j in zip(how, others)]
        return f"frames tell it only together with others: what explains them {' and '.join(parts)}"


def _with(at: np.ndarray, i: int, value: float) -> np.ndarray:
    changed = at.copy()
    changed[i] = value
    return changed
