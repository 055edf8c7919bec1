"""Families of simulated scenes, each with matter, light and noise at random; specimens at random, a function a kind,
within the room that every view sees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from holosplat.beamline.light import UnevenLight
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.metrics import volume_scores
from holosplat.scan import Exposures, Scan
from holosplat.specimens.continuous import Bump, ContinuousScene, Element, Soft, ellipsoid
from holosplat.specimens.phantoms import packed_balls
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavelength, wavenumber
from holosplat.workflows.reconstruct import Reconstruction

from ..specimens.matter import (
    Capsules,
    ContinuousKind,
    CrowdedCells,
    FoamDrop,
    MeshedKind,
    RedCells,
    SoftCells,
)
from .case import BallStar, BodyWithAbsorber, CoatedDroplets, RoundCell, SheppLogan, Specimen, Tissue


@dataclass(frozen=True)
class Room:
    """d: diameter of a body; wide, deep: extents of the field that every view sees, and of its columns and rows [m]."""

    d: float
    wide: float
    high: float
    columns: float

    @property
    def box(self) -> tuple[float, float, float]:
        """[m]."""
        return (self.wide, self.high, self.wide)

    @property
    def least(self) -> float:
        """[m]."""
        return min(self.high, self.columns)


Draw = np.random.Generator
"""What specimens are drawn by."""


def _red_cells(rng: Draw, room: Room) -> Specimen:
    box = (room.columns, room.high, room.columns)
    return RedCells(int(rng.integers(1, 12)), room.d, box, "cylinder", rng.uniform(0, 0.08), 0, rng.uniform(0, 0.3))


def _crowd(rng: Draw, room: Room) -> Specimen:
    x, y = min(room.wide, 3 * room.d), min(room.high, 3 * room.d)
    return CrowdedCells(rng.uniform(0.1, 0.3), room.d, (x, y, x))


def _capsules(rng: Draw, room: Room) -> Specimen:
    diameters = (0.6 * room.d, room.d)
    return Capsules(int(rng.integers(1, 8)), diameters, room.d * rng.uniform(0.08, 0.2), room.box, rng.uniform(0, 0.3))


def _foam(rng: Draw, room: Room) -> Specimen:
    return FoamDrop(room.least, int(rng.integers(5, 25)), rng.uniform(0.3, 0.6) * room.d)


def _star(rng: Draw, room: Room) -> Specimen:
    return BallStar((0.1 * room.d, 0.25 * room.d, 0.6 * room.d), int(rng.integers(4, 9)))


def _soft_cells(rng: Draw, room: Room) -> Specimen:
    return SoftCells(int(rng.integers(2, 9)), (0.7 * room.d, 1.3 * room.d), room.box, room.d * rng.uniform(0.05, 0.2))


def _coated(rng: Draw, room: Room) -> Specimen:
    return CoatedDroplets(int(rng.integers(2, 8)), (0.6 * room.d, room.d), room.d * rng.uniform(0.08, 0.2), room.box)


KINDS: dict[str, tuple[Callable[[Draw, Room], Specimen], Callable[[Room], float]]] = {
    "red-cells": (_red_cells, lambda room: 0.33 * room.d),
    "crowd": (_crowd, lambda room: 0.6 * room.d),
    "capsules": (_capsules, lambda room: 0.3 * room.d),
    "foam": (_foam, lambda room: 0.5 * room.least),
    "star": (_star, lambda room: 0.4 * room.d),
    "soft-cells": (_soft_cells, lambda room: room.d),
    "round": (lambda rng, room: RoundCell(room.least * rng.uniform(0.45, 1)), lambda room: 0.5 * room.least),
    "tissue": (
        lambda rng, room: Tissue(room.box, int(rng.integers(10, 50)), int(rng.integers(50, 400))),
        lambda room: 0.5 * room.least,
    ),
    "head": (lambda rng, room: SheppLogan(room.least * rng.uniform(0.65, 1)), lambda room: 0.5 * room.least),
    "coated": (_coated, lambda room: room.d),
    "absorber": (
        lambda rng, room: BodyWithAbsorber(
            (0.9 * room.wide, 0.7 * room.high, 0.8 * room.wide), 0.09 * room.wide, int(rng.integers(1, 4))
        ),
        lambda room: 0.5 * room.least,
    ),
}
"""How each kind is drawn, and about how thick it is, for its phase."""


PIXEL, ENERGY = 1e-6, 20.0
REFERENCE = 1e-7
"""δ with which a scene is made first, to see how thick it is."""
TRIALS = 50
"""Draws of matter of which one must find its place."""
Matter = Callable[[DeltaBeta], MeshScene | ContinuousScene]
"""The matter of a draw, of any δ and β."""
Judge = Callable[[Reconstruction], float]
"""The error of what a run made."""


@dataclass(frozen=True)
class Scene:
    """scan: frames, with those that no run sees; prior: what is told; error: of what a run made; facts: the draw;
    matter: of a simulated scene."""

    scan: Scan
    prior: MaterialPrior
    error: Judge
    facts: str
    matter: MeshScene | ContinuousScene | None = None


@dataclass(frozen=True)
class Family:
    """How scenes are drawn, of so many views; light: what of it a draw says; phase: least and largest [rad]; flux:
    whether some scenes have frames of slightly different flux; pattern: greatest rms of a fixed pattern of single
    pixels; told: one is drawn."""

    matter: Callable[[Draw, Room], Matter]
    views: tuple[int, ...] = (6, 7, 8)
    light: Callable[[Draw], dict[str, float]] = lambda rng: {}
    phase: tuple[float, float] = (0.15, 2.5)
    photons: tuple[float, float] | None = (2e3, 1e5)
    flux: bool = True
    pattern: float = 0.0
    told: tuple[str, ...] = ("ratio",)

    def scene(self, seed: int, name: str) -> Scene:
        """The scene that `seed` gives."""
        rng = np.random.default_rng([sum(map(ord, name)), len(name), seed])
        rows, columns, count = int(rng.integers(46, 56)), int(rng.integers(48, 61)), int(rng.choice(self.views))
        fresnel, phase, ratio = (log_uniform(rng, *ends) for ends in ((0.05, 0.8), self.phase, (300, 3000)))
        room = Room(rng.uniform(0.2, 0.4) * rows * PIXEL, *(0.9 * PIXEL * n for n in (columns, rows, columns)))
        angles, is_test = np.arange(count) * 180 / count + rng.uniform(0, 180), np.zeros(count, dtype=bool)
        distance = PIXEL**2 / wavelength(ENERGY) / fresnel
        exposures = Exposures.of(
            Views.from_angles(angles, (rows, columns), PIXEL), ENERGY, distance, float(rng.choice([0, 0, 0.5]))
        )
        matter = self.placed(rng, room)
        thin = DeltaBeta(REFERENCE, REFERENCE / ratio)
        lines = matter(thin).project(exposures.views[[0]])[1]
        material = DeltaBeta(*(x * phase / (wavenumber(ENERGY) * float(lines.max())) for x in thin))
        truth = matter(material)
        photons = None if self.photons is None or rng.random() < 0.2 else log_uniform(rng, *self.photons)
        light = self.light(rng)
        if self.flux and rng.random() < 0.4:
            light = {"light_offset": rng.uniform(0.001, 0.005)} | light
        pattern = 1 + self.pattern * rng.uniform(0.3, 1) * rng.normal(size=(rows, columns))
        clean = simulate(truth, exposures, is_test=is_test).frames * pattern
        lamp, draw = UnevenLight(**light, light_seed=seed).on(count, (rows, columns)), np.random.default_rng(seed)
        frames = np.stack([lamp.recorded(one, n, photons, draw) for n, one in enumerate(clean)])
        told, grid = str(rng.choice(self.told)), Grid.of_views(exposures.views)
        known = {"known": MaterialPrior.known(material), "ratio": MaterialPrior.of_ratio(ratio)}
        prior, true = known.get(told, MaterialPrior.unknown()), truth.voxelise(grid)
        facts = f"{matter.args[0].kind}, " if isinstance(matter, partial) else ""
        facts += f"Fresnel number {fresnel:.2f}, {phase:.2f} rad, {told_photons(photons)}, {told} told"
        facts += "".join(f", {key.removeprefix('light_')} {value:.2g}" for key, value in light.items())
        facts += f", pattern {pattern.std():.3f}" if self.pattern else ""
        return Scene(
            Scan(frames.astype(np.float32), exposures, is_test),
            prior,
            lambda done: volume_scores(done.object.voxelise(grid), true).relative_error_delta,
            facts,
            truth,
        )

    def placed(self, rng: Draw, room: Room) -> Matter:
        """The matter of the first draw that finds its place; `InputError` where none of `TRIALS` does."""
        for _ in range(TRIALS):
            matter = self.matter(rng, room)
            try:
                matter(DeltaBeta(REFERENCE, REFERENCE))
            except InputError:  # no place for so many bodies
                continue
            return matter
        raise InputError(f"a family must have room for its bodies, but none of {TRIALS} draws has; make it larger.")


def log_uniform(rng: Draw, least: float, most: float) -> float:
    """A number between two, evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def told_photons(photons: float | None) -> str:
    """Photons a pixel in words; None: no noise."""
    return "no photon noise" if photons is None else f"{photons:.0f} photons"


def drawn(kind: str) -> Callable[[Draw, Room], Matter]:
    """A kind of `random_specimens`, with empty cores or with a second material."""

    def draw(rng: Draw, room: Room) -> Matter:
        narrow = replace(room, wide=room.wide / np.sqrt(2)) if kind in ("tissue", "absorber") else room
        specimen, seed = KINDS[kind][0](rng, narrow), int(rng.integers(1 << 30))
        more = rng.uniform(*((2, 5) if kind == "absorber" else (0.3, 0.8)))
        darker = rng.uniform(*((20, 80) if kind == "absorber" else (0.2, 1.0)))
        second = kind in ("coated", "absorber")
        filling = (lambda m: DeltaBeta(m.delta * more, m.beta * darker)) if second else None
        return partial(_filled, specimen, seed, filling)

    return draw


def _filled(
    specimen: Specimen,
    seed: int,
    filling: Callable[[DeltaBeta], DeltaBeta] | None,
    material: DeltaBeta,
) -> MeshScene | ContinuousScene:
    if isinstance(specimen, ContinuousKind):
        return specimen.continuous(seed, [material, *([filling(material)] if filling else [])])[0]
    assert isinstance(specimen, MeshedKind)
    made = specimen.bodies(seed, None)
    empty = DeltaBeta(-material.delta, -material.beta)
    materials = [material] * len(made.outer) + [empty] * len(made.cores)
    return MeshScene((*made.outer, *made.cores), tuple(materials))


Part = tuple[np.ndarray, np.ndarray, Soft | Bump, float, np.ndarray | None]
"""Centre, semi-axes [m], profile, level, turn."""


def _of_parts(parts: list[Part]) -> Matter:
    def made(material: DeltaBeta) -> ContinuousScene:
        elements: list[Element] = []
        for centre, semi, profile, level, turn in parts:
            matter = DeltaBeta(level * material.delta, level * material.beta)
            elements.append(ellipsoid(centre, semi, profile, matter, turn))
        return ContinuousScene(tuple(elements))

    return made


def _rod(radius: float, room: Room, edge: float, level: float, place: np.ndarray, lean: float = 0.0) -> Part:
    """A rod along y, longer than any frame; lean [rad]."""
    c, s = np.cos(lean), np.sin(lean)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return place, np.array([radius, 8 * room.high, radius]), Soft(edge), level, turn


def _balls(rng: Draw, room: Room, count: int, across: float, wide: float) -> list[Part]:
    """Soft-edged balls in a cylinder of diameter `wide`, of edges of their own."""
    sizes = np.sort(across * rng.uniform(0.5, 1, count))[::-1]
    edge = rng.uniform(0.1, 0.5)
    balls = packed_balls(sizes, (wide, room.high, wide), rng, margin=0.02 * across)
    return [
        (one.centre, np.full(3, 0.5 * one.diameter / (1 + 0.5 * edge)), Soft(edge), rng.uniform(0.6, 1), None)
        for one in balls
    ]


def _texture(rng: Draw, room: Room, count: int, level: float, wide: float) -> list[Part]:
    """Bumps of either sign in a cylinder of diameter `wide` that is longer than the frames."""
    parts: list[Part] = []
    for _ in range(count):
        radius = rng.uniform(0.04, 0.12) * wide
        r, at = (0.5 * wide - radius) * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        centre = np.array([r * np.cos(at), rng.uniform(-0.6, 0.6) * room.high, r * np.sin(at)])
        parts.append((centre, np.full(3, radius), Bump(2), level * rng.choice([-1, 1]) * rng.uniform(0.3, 1), None))
    return parts


def _spheres(rng: Draw, room: Room) -> Matter:
    count = int(rng.integers(1, 4))
    sizes = room.high * rng.uniform(0.3, 0.6, count)
    balls = packed_balls(np.sort(sizes)[::-1], room.box, rng)
    edge = rng.uniform(0.5, 2.0)
    return _of_parts(
        [(b.centre, np.full(3, 0.5 * b.diameter / (1 + 0.5 * edge)), Soft(edge), 1.0, None) for b in balls]
    )


def _fibres(rng: Draw, room: Room) -> Matter:
    parts = [_rod(room.wide * rng.uniform(0.05, 0.15), room, rng.uniform(0, 0.3), 1.0, np.zeros(3))]
    for _ in range(int(rng.integers(0, 3))):
        at, far = rng.uniform(0, 2 * np.pi), 0.3 * room.wide
        place = far * np.array([np.cos(at), 0, np.sin(at)])
        parts.append(
            _rod(room.wide * rng.uniform(0.03, 0.08), room, rng.uniform(0, 0.3), 1.0, place, rng.uniform(-0.1, 0.1))
        )
    return _of_parts(parts)


def _capillary(rng: Draw, room: Room) -> Matter:
    outer, liquid = 0.5 * room.wide * rng.uniform(0.75, 0.95), rng.uniform(0, 0.5)
    inner = outer * rng.uniform(0.7, 0.9)
    parts = [_rod(outer, room, 0.0, 1.0, np.zeros(3)), _rod(inner, room, 0.0, liquid - 1.0, np.zeros(3))]
    return _of_parts(parts + _balls(rng, room, int(rng.integers(1, 6)), 0.7 * inner, 1.9 * inner))


def _agarose(rng: Draw, room: Room) -> Matter:
    wide = room.wide * rng.uniform(0.8, 1.0)
    parts = [_rod(0.5 * wide / 1.05, room, 0.1, rng.uniform(0.1, 0.4), np.zeros(3))]
    parts += _texture(rng, room, 60, 0.1, wide)
    return _of_parts(parts + _balls(rng, room, int(rng.integers(2, 6)), 0.3 * wide, 0.9 * wide))


def _textured(rng: Draw, room: Room) -> Matter:
    parts = _balls(rng, room, int(rng.integers(1, 5)), 0.4 * room.high, 0.9 * room.wide)
    return _of_parts(parts + _texture(rng, room, 150, rng.uniform(0.05, 0.2), room.wide))


def _cut_cells(rng: Draw, room: Room) -> Matter:
    beyond = (1.2 * room.wide, 1.3 * room.high, 1.2 * room.wide)
    cells = RedCells(int(rng.integers(4, 10)), room.d, beyond, "cylinder", 0.03, 0, rng.uniform(0, 0.3))
    return partial(_filled, cells, int(rng.integers(1 << 30)), None)


def _lamp(**ends: tuple[float, float]) -> Callable[[Draw], dict[str, float]]:
    return lambda rng: {f"light_{name}": log_uniform(rng, *each) for name, each in ends.items()}


def _either(*kinds: str) -> Callable[[Draw, Room], Matter]:
    return lambda rng, room: drawn(str(rng.choice(kinds)))(rng, room)


CELLS = _either("red-cells", "soft-cells", "capsules")
SIMULATED: Mapping[str, Family] = {
    "red cells": Family(drawn("red-cells"), told=("ratio", "known")),
    "soft cells": Family(drawn("soft-cells")),
    "soft spheres, few photons": Family(_spheres, photons=(300, 1e4), phase=(0.1, 0.8)),
    "round cell": Family(drawn("round"), phase=(0.5, 3), views=(4, 6, 8)),
    "fibres": Family(_fibres),
    "capillary": Family(_capillary),
    "agarose": Family(_agarose),
    "textured medium": Family(_textured),
    "foam": Family(drawn("foam"), told=("ratio", "known")),
    "tissue": Family(drawn("tissue")),
    "coated droplets": Family(drawn("coated"), told=("ratio", "free")),
    "absorbers": Family(drawn("absorber"), told=("ratio", "free")),
    "crowd": Family(drawn("crowd"), told=("ratio", "known")),
    "capsules": Family(drawn("capsules"), told=("ratio", "known")),
    "star of balls": Family(drawn("star"), told=("ratio", "known")),
    "head": Family(drawn("head")),
    "drift": Family(CELLS, light=_lamp(pattern=(0.01, 0.05), drift_px=(1, 6), pattern_px=(4, 15))),
    "uneven light": Family(CELLS, light=_lamp(smooth=(0.005, 0.04), slope=(0.002, 0.02))),
    "fixed pattern": Family(CELLS, pattern=0.05),
    "grain": Family(CELLS, light=_lamp(grain=(0.005, 0.04), grain_px=(1, 3))),
    "cut cells, few views": Family(_cut_cells, views=(3, 4), told=("known",)),
    "soft cells, few views": Family(drawn("soft-cells"), views=(3, 4)),
}
"""Of these alone light, pattern and noise differ from even, none and white: the four from "drift" to "grain"."""
