"""The arena's run: every contestant on every sealed case, one row each; what is there already is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import numpy as np
import torch
from scipy.sparse import csr_array

from holosplat.checks import require
from holosplat.matter import Matter
from holosplat.metrics.volumes import robust_material_delta
from holosplat.optics.retrieval import RETRIEVALS
from holosplat.optics.sampling import fringe_sampling
from holosplat.progress import Progress
from holosplat.representations import VoxelGrid
from holosplat.units import wavelength, wavenumber
from holosplat.version import source_commit
from holosplat.workflows.evaluate import score_object
from holosplat.workflows.provenance import environment, scan_hash

from ..folder import BenchFolder, Row
from .cases import SealedCase, prepare_case
from .contest import BEST_PAIR, CONTESTANTS, TRACKS, WARM, Answer, Contestant, Outcome, Question, Track, compete
from .history import Entry


class ArenaFolder(BenchFolder):
    """A folder as that of a benchmark, of rows of the arena; `entry`: what goes into the time line."""

    FORMAT = "holosplat arena 1"

    @property
    def entry(self) -> Path:
        """The JSON file of the whole run."""
        return self.path / "entry.json"


@dataclass(frozen=True)
class Arena:
    """What is run: cases by name, tracks, their seed and size [pixels along an edge]; limit: wall time of a contestant
    [s]; contestants: who competes."""

    cases: Sequence[str]
    tracks: Sequence[Track]
    seed: int
    size: int
    limit: float
    contestants: Sequence[Contestant] = tuple(CONTESTANTS)

    def __post_init__(self) -> None:
        require(self.limit > 0, f"limit must be above 0 s, but it is {self.limit:g}; give seconds.")

    @property
    def entered(self) -> list[Contestant]:
        """Those of the tracks who are installed."""
        return [c for c in self.contestants if c.track in self.tracks and c.installed]

    @property
    def absent(self) -> list[str]:
        """What pip would install so that the others could compete."""
        return sorted({c.distribution for c in self.contestants if c.track in self.tracks and not c.installed})

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.cases) * len(self.entered)


def run_arena(
    arena: Arena,
    folder: ArenaFolder,
    *,
    retry: bool = False,
    on_progress: Progress = lambda stage, fraction: None,
    on_row: Callable[[Row, int], None] = lambda row, left: None,
) -> None:
    """Fill `folder` with the rows of `arena` that it lacks; with `retry`, failed ones are made again.

    A contestant that fails, hangs or crashes gets a row that says so, and the others go on. `on_row(row, left)` is
    called after each row, with the number of those to come.
    """
    folder.create()
    order = {track: n for n, track in enumerate(TRACKS)}
    entered = sorted(arena.entered, key=lambda one: order[one.track])
    missing = {
        name: [c for c in entered if not folder.has_row(name, arena.seed, row_name(c), retry)] for name in arena.cases
    }
    left = sum(map(len, missing.values()))
    for name, wanted in missing.items():
        if not wanted:
            continue
        on_progress(f"{name}: scene and frames", 0.0)
        judge = _Judge.of(prepare_case(name, arena.seed, arena.size, folder.case(name, arena.seed)))
        for contestant in wanted:
            on_progress(f"{name}: {contestant.track}, {contestant.name}", 1 - left / len(arena))
            row = judge.row(contestant, arena, folder)
            folder.write_row(row)
            left -= 1
            on_row(row, left)


def entry_of(arena: Arena, folder: ArenaFolder) -> Entry:
    """The time line's entry of all rows of `folder` of this seed; versions: of the peers that are installed."""
    peers = {c.distribution for c in arena.entered if not c.ours}
    versions = {name: metadata.version(name) for name in sorted(peers)}
    return Entry.of([row for row in folder.read_rows() if row.seed == arena.seed], arena.size, arena.absent, versions)


def row_name(contestant: Contestant) -> str:
    """Track and name, which together are a row's method."""
    return f"{contestant.track}+{contestant.name}"


@dataclass(frozen=True)
class _Judge:
    """A case made ready: what contestants are asked, and what their answers are held against."""

    case: SealedCase
    retrieved: np.ndarray
    """k∫δ dz [V, H, W] [rad] by holosplat's Tikhonov, which all tomographies are given."""
    blank: Row

    @classmethod
    def of(cls, case: SealedCase) -> _Judge:
        train = case.scan.train()
        delta = 1 / (wavenumber(train.exposures.reference_energy) * train.views.pixel_size)
        frames, retrieve = torch.from_numpy(train.frames), RETRIEVALS["tikhonov"]
        found = retrieve(frames, train.exposures, delta, delta / case.ratio).numpy() / train.views.pixel_size
        blank = Row(case.name, case.seed, "", "", "", 0, "failed", "", scan_hash(case.scan), source_commit(), "")
        return cls(case, found, replace(blank, **environment("cpu")))

    def row(self, contestant: Contestant, arena: Arena, folder: ArenaFolder) -> Row:
        """The row of a contestant."""
        place = list(arena.contestants).index(contestant)
        about = {"family": contestant.track, "summary": contestant.summary, "place": place}
        row = replace(self.blank, method=row_name(contestant), **about)
        question = self.question(contestant.track)
        if contestant.name == BEST_PAIR:
            pair = self._best_pair(arena, folder)
            question = replace(question, pair=tuple(one.act for one in pair))
            row = replace(row, summary=f"{contestant.summary}: {' + '.join(one.name for one in pair) or 'none'}")
        if contestant.name == BEST_PAIR and not question.pair:
            outcome = Outcome(None, "no peer has both a phase and a volume on this case; run these tracks, too")
        else:
            outcome = compete(contestant.act, question, WARM.get(contestant.track, 1), arena.limit)
        row = replace(row, when=datetime.now(UTC).isoformat(timespec="seconds"))
        if outcome.answer is None:
            return replace(row, reason=outcome.reason)
        try:
            numbers = self.numbers(contestant.track, question, outcome.answer)
        except (KeyError, ValueError) as error:  # of other names, shapes, or values that are not finite
            return replace(row, reason=f"gave an answer that cannot be judged: {error}")
        taken = {"seconds": outcome.seconds, "memory_bytes": outcome.memory_bytes}
        return replace(row, status="done", test=numbers, **taken)

    def question(self, track: Track) -> Question:
        """What the contestants of a track are asked."""
        scan, rng = self.case.scan.train(), np.random.default_rng(self.case.seed)
        rotations, (pixel, energy) = scan.views.rotations, (scan.views.pixel_size, scan.exposures.reference_energy)
        angles = np.arctan2(rotations[:, 0, 2], rotations[:, 0, 0])
        shape = self.case.truth.grid.shape
        volume, lines = np.zeros(shape, np.float32), np.zeros(scan.frames.shape, np.float32)
        if track == "kernels":
            lines = rng.random(scan.frames.shape, dtype=np.float32)
        if track in ("kernels", "steps"):  # of another scene than the frames' own, so that there is a step to make
            volume = np.ascontiguousarray(self._radians()[::-1])
        if track == "tomography":
            lines = self.retrieved
        return Question(
            scan.frames, angles, pixel, energy, float(scan.exposures.distance[0]), self.case.ratio, lines, volume
        )

    def _radians(self) -> np.ndarray:
        """The true kδ times a pixel [Z, Y, X]."""
        views = self.case.scan.views
        return self.case.truth.delta * np.float32(self._k() * views.pixel_size)

    def _k(self) -> float:
        return wavenumber(self.case.scan.exposures.reference_energy)

    def _best_pair(self, arena: Arena, folder: ArenaFolder) -> list[Contestant]:
        """The peers' best retrieval and tomography on this case by their rows, none where one is lacking."""
        rows = {row.method: row for row in folder.read_rows() if row.case == self.case.name and row.done}
        pair = []
        for track in ("retrieval", "tomography"):
            there = [c for c in arena.contestants if c.track == track and not c.ours and row_name(c) in rows]
            pair += sorted(there, key=lambda one: float(rows[row_name(one)].test["error"] or 0))[:1]
        return pair if len(pair) == 2 else []

    def numbers(self, track: Track, question: Question, answer: Answer) -> dict[str, float | None]:
        """What a track asks for, `error` first; `KeyError` and `ValueError` for answers that cannot be judged."""
        if track == "kernels":
            exact = forward(question, question.volume)
            lines, volume = _shaped(answer["lines"], exact.shape), _shaped(answer["volume"], question.volume.shape)
            there, back = float((lines * question.lines).sum()), float((volume * question.volume).sum())
            return {"error": _relative(lines, exact), "adjoint": abs(there - back) / abs(there)}
        if track == "steps":
            wanted = gradient(question)
            return {"error": _relative(_shaped(answer["gradient"], wanted.shape), wanted)}
        if track == "retrieval":
            return {"error": _relative(_shaped(answer["lines"], self.case.lines.shape), self.case.lines)}
        truth, scan, material = self.case.truth, self.case.scan, robust_material_delta(self.case.truth)
        delta = _shaped(answer["volume"], truth.grid.shape) / (self._k() * scan.views.pixel_size)
        beta = _shaped(answer["beta"], delta.shape) if "beta" in answer else delta / self.case.ratio
        channels = np.stack([delta / material, beta * self.case.ratio / material]).astype(np.float32)
        matter = Matter.free(material, material / self.case.ratio)
        found = VoxelGrid(torch.from_numpy(channels), truth.grid, matter)
        scores = score_object(found, scan, truth, fringe_sampling(scan.exposures))
        assert scores.test is not None
        assert scores.volume is not None
        volume = scores.volume
        return {"error": volume.relative_error_delta, "dice": volume.dice, "ssim": scores.test.mean["ssim"]}


def _shaped(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """`array` in float64; `ValueError` unless it is of `shape` and finite."""
    if array.shape != shape:
        raise ValueError(f"its shape is {array.shape}, but {shape} was asked for")
    if not np.isfinite(array).all():
        raise ValueError("not all of its values are finite")
    return array.astype(np.float64)


def _relative(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


# --- what kernels and steps are held against: numpy in float64, of no contestant ---------------------------------


def footprints(angles: np.ndarray, side: int) -> csr_array:
    """Strip integrals [V·W, Z·X] in pixels of square voxels: the shadow of a square that is turned by θ is a trapezoid,
    the convolution of boxes |cos θ| and |sin θ| wide, whose integral over each pixel is in closed form."""
    middle = np.arange(side) - 0.5 * (side - 1)
    z, x = (array.ravel() for array in np.meshgrid(middle, middle, indexing="ij"))
    rows, columns, values = [], [], []
    for v, angle in enumerate(angles):
        wide, narrow = sorted((abs(np.cos(angle)), abs(np.sin(angle))), reverse=True)
        at = x * np.cos(angle) + z * np.sin(angle) + 0.5 * side
        for shift in (-2, -1, 0, 1, 2):
            pixel = np.floor(at).astype(int) + shift
            share = _up_to(pixel + 1 - at, wide, narrow) - _up_to(pixel - at, wide, narrow)
            hit = (share > 0) & (pixel >= 0) & (pixel < side)
            rows.append(v * side + pixel[hit])
            columns.append(np.flatnonzero(hit))
            values.append(share[hit])
    shape = (len(angles) * side, side * side)
    return csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)


def _up_to(t: np.ndarray, wide: float, narrow: float) -> np.ndarray:
    """The part of a trapezoid of area 1, centred on 0, that lies below t."""
    if narrow < 1e-9:  # a box; the quotient below would lose all digits
        return np.clip(t / wide + 0.5, 0, 1)

    def ramp(u: np.ndarray) -> np.ndarray:
        return 0.5 * np.maximum(u, 0) ** 2

    half, less = 0.5 * (wide + narrow), 0.5 * (wide - narrow)
    return (ramp(t + half) - ramp(t + less) - ramp(t - less) + ramp(t - half)) / (wide * narrow)


def forward(question: Question, volume: np.ndarray) -> np.ndarray:
    """Lines [V, H, W] of a volume [Z, Y, X], exactly."""
    side, rows = volume.shape[0], volume.shape[1]
    slices = volume.astype(np.float64).transpose(0, 2, 1).reshape(side * side, rows)
    lines = footprints(question.angles, side) @ slices
    return lines.reshape(len(question.angles), side, rows).transpose(0, 2, 1)


def gradient(question: Question) -> np.ndarray:
    """∂/∂volume [Z, Y, X] of half the squared misfit of the frames, by the chain rule: exact strips, and Fresnel's
    kernel on the pixels, amid twice as much empty space."""
    frames, volume = question.frames.astype(np.float64), question.volume
    views, rows, columns = frames.shape
    fy, fx = (np.fft.fftfreq(2 * n, question.pixel) for n in (rows, columns))
    chirp = np.pi * wavelength(question.energy_kev) * question.distance * (fy[:, None] ** 2 + fx**2)
    factor = -(1 / question.ratio + 1j)
    behind = np.exp(factor * forward(question, volume))
    spectrum = np.fft.fft2(behind - 1, s=(2 * rows, 2 * columns)) * np.exp(-1j * chirp)
    seen = np.fft.ifft2(spectrum)[:, :rows, :columns] + 1
    back = np.zeros(spectrum.shape, complex)
    back[:, :rows, :columns] = 2 * (np.abs(seen) ** 2 - frames) * seen
    upstream = np.fft.ifft2(np.fft.fft2(back) * np.exp(1j * chirp))[:, :rows, :columns]
    lines = (np.conj(behind * factor) * upstream).real
    side = volume.shape[0]
    spread = footprints(question.angles, side).T @ lines.transpose(0, 2, 1).reshape(views * columns, rows)
    return spread.reshape(side, columns, rows).transpose(0, 2, 1)
