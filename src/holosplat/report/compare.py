"""Two runs side by side: what was asked, decided and found, and where their volumes differ."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import as_written
from ..geometry import Grid
from ..inference import Decision
from ..io.atomic import atomic_path
from ..methods import METHODS
from ..metrics import VolumeScores, volume_scores
from ..scan import Scan
from ..tables import to_table
from ..units import beam_named, in_percent, wavenumber
from ..volume import Volume
from ..workflows.evaluate import Evaluation, evaluate, of_absorption
from ..workflows.provenance import CONFIG_SUM, RUN
from ..workflows.reconstruct import load_reconstruction
from ..workflows.reconstruction import Reconstruction, instants_of, reconstruction_at
from ..workflows.rehearsal import read_rehearsal
from ..workflows.run_folder import RunFolder
from .content import DELTA, Quantity, flatten
from .curves import correlation_figure
from .figures import richest_planes, slices_figure
from .page import Table, duration, resolved, template
from .run import LARGEST_VOLUME
from .style import Block, drawn_block, format_length, in_print, scientific

HEAD = ("", "A", "B")
ON_THE_WAY = ("decided", "resolved")
"""Entries of config.json that a run found, and was not asked."""
COLUMN = 44
"""Characters of a column on the terminal."""


@dataclass(frozen=True)
class Side:
    """A run. result: matter that stands still; evaluation: on its own frames; None: these are no longer there."""

    folder: RunFolder
    result: Reconstruction
    evaluation: Evaluation | None

    def score(self, part: str, name: str) -> str:
        """A score of its `part`, "test" or "train", averaged over frames."""
        found = getattr(self.evaluation, part, None)
        return "–" if found is None else scientific(found.mean[name], 4)

    def field(self) -> tuple[np.ndarray, np.ndarray, float]:
        """The lowest and the highest corner (x, y, z) of the field of view, and the pixels [m]."""
        with as_written(self.folder.summary, "what reconstruct wrote"):
            detector = self.folder.read_summary()["detector"]
            pixel, rows, columns = (float(detector[name]) for name in ("pixel_size_m", "rows", "columns"))
            centre = np.array(detector.get("centre_m", (0.0, 0.0, 0.0)), dtype=np.float64)
        half = 0.5 * pixel * np.array([columns, rows, columns])
        return centre - half, centre + half, pixel


@dataclass(frozen=True)
class Comparison:
    """Two runs, A and B, and their volumes on one grid, which holds the fields of view of both."""

    first: Side
    second: Side

    @property
    def sides(self) -> tuple[Side, Side]:
        """A and B."""
        return self.first, self.second

    @cached_property
    def grid(self) -> Grid:
        """Voxels of the larger pixels, or so large that at most `LARGEST_VOLUME` lie along an edge."""
        fields = [side.field() for side in self.sides]
        low, high = np.min([f[0] for f in fields], axis=0), np.max([f[1] for f in fields], axis=0)
        edge = max(*(f[2] for f in fields), float((high - low).max()) / LARGEST_VOLUME)
        x, y, z = (int(n) for n in np.ceil((high - low) / edge - 1e-6))
        cx, cy, cz = (float(c) for c in 0.5 * (low + high))
        return Grid.centred((z, y, x), edge, (cx, cy, cz))

    @cached_property
    def quantity(self) -> Quantity:
        """δ where both runs tell it; else µ, each at the energy of its run."""
        told = all(side.result.delta_told for side in self.sides)
        return DELTA if told else Quantity("µ", 1.0, "m⁻¹")

    @cached_property
    def volumes(self) -> tuple[Volume, Volume]:
        """Those of A and B on the grid, in units of the quantity."""
        return self._volume(self.first), self._volume(self.second)

    def _volume(self, side: Side) -> Volume:
        found = side.result.object.voxelise(self.grid)
        if self.quantity == DELTA:
            return found
        beta = of_absorption(found).beta * np.float32(2 * wavenumber(side.result.energy_kev))
        return Volume(beta, beta, self.grid)

    @cached_property
    def scores(self) -> VolumeScores | None:
        """Those of B against A; None where either is empty."""
        first, second = self.volumes
        return volume_scores(second, first) if np.any(first.delta) and np.any(second.delta) else None

    def found(self) -> list[Table]:
        """Tables of the results of both runs, and of the differences of their volumes."""
        return [table for table in (self._found(), self._apart()) if table.rows]

    def asked(self) -> list[Table]:
        """Which decisions, settings and input differ."""
        return [table for table in (self._decisions(), self._settings()) if table.rows]

    def verdict(self) -> str:
        """The comparison in a sentence or two."""
        words = [_word(side) for side in self.sides]
        doubted, limited = ([name for name, each in zip("AB", words) if each == one] for one in ("wrong", "limited"))
        said = {0: "", 1: f"Do not trust {' and '.join(doubted)}: its frames are not explained. "}
        text = said.get(len(doubted), "Trust neither A nor B: the frames of both are not explained. ")
        if words == ["consistent"] * 2:
            text = "Both explain their frames. "
        text += "".join(f"{name} is as good as its method gets with these views. " for name in limited)
        if self.scores is None:
            return f"{text}One of the volumes is empty, so there is nothing to compare."
        error = in_percent(self.scores.relative_error_delta)
        return f"{text}Their {self.quantity.symbol} differs by {error} (root mean square, as a share of A's)."

    def _rows(self, *named: tuple[str, Callable[[Side], str]]) -> list[tuple[str, ...]]:
        return [(name, *(of(side) for side in self.sides)) for name, of in named]

    def _found(self) -> Table:
        rows = self._rows(
            ("folder", lambda side: str(side.folder.path)),
            ("object", lambda side: f"{side.result.method}: {side.result.object.described}"),
            ("photon energy or wavelength", lambda side: beam_named(side.result.energy_kev)[1]),
            ("verdict", lambda side: in_print(side.result.verdict.words) if side.result.verdict else "not judged"),
            ("likely cause", _cause),
            ("by rehearsals", lambda side: in_print(found.said) if (found := read_rehearsal(side.folder)) else "–"),
            ("total", lambda side: in_print(side.result.total.words) if side.result.total else "–"),
            *(
                (f"{label} of {frames} frames", lambda side, part=part, name=name: side.score(part, name))
                for part, frames in (("test", "held-out"), ("train", "training"))
                for label, name in (("SSIM", "ssim"), ("FRCM", "frcm"), ("PSNR, dB,", "psnr"))
            ),
            ("time", lambda side: duration(sum(side.result.timing.values()))),
            ("finished", lambda side: "yes" if side.result.finished else "no: interrupted"),
        )
        return Table("What was found", [row for row in rows if set(row[1:]) != {"–"}], HEAD)

    def _apart(self) -> Table:
        scores, symbol = self.scores, self.quantity.symbol
        if scores is None:
            return Table("The volumes", [])
        rows = [
            (f"difference of {symbol}, root mean square over A's", in_percent(scores.relative_error_delta)),
            ("overlap of the matter (Dice, at half of A's level)", f"{scores.dice:.4f}"),
            (f"mean {symbol} in A's matter, of A", self.quantity.text(scores.true_mean_delta)),
            (f"mean {symbol} in A's matter, of B", self.quantity.text(scores.mean_delta)),
            ("they correlate down to, FSC ½-bit", resolved(scores.resolution_half_bit, scores.pitch)),
            ("they correlate down to, FSC 0.143", resolved(scores.resolution_fixed, scores.pitch)),
        ]
        return Table("The volumes", rows)

    def _decisions(self) -> Table:
        made = []
        for choice in (side.result.choice for side in self.sides):
            made.append(chosen(choice.decisions) | {"kept state": choice.kept or "–", "kind of matter": choice.matter})
        return Table("Decisions that differ", differing(*made), HEAD)

    def _settings(self) -> Table:
        """Settings that differ; of those of one method alone, only values other than the defaults."""
        (first, usual), (second, other) = (_request(side) for side in self.sides)
        known = {name: value for name, value in (usual | other).items() if (name in first) != (name in second)}
        rows = [row for row in differing(first, second) if known.get(row[0]) not in row[1:]]
        return Table("Settings and input that differ", rows, HEAD)


def compare(first: RunFolder, second: RunFolder, scan: Scan | None = None) -> Comparison:
    """Compare two runs: what was asked, decided and found, and where their volumes differ.

    scan: the frames on which both are scored (default: no scores of frames)

    `found()` and `asked()` of the result are tables, `volumes` holds δ of both [Z, Y, X] on one grid, `scores` the
    differences of the second from the first, and `verdict()` is the comparison in words; `write_comparison` makes a
    page of it. Of runs of matter in motion the first times are compared. Errors: `InputError` for folders without a
    finished run, and for a scan of another photon energy.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> runs = [hs.RunFolder("voxels"), hs.RunFolder("gaussians")]
        >>> for run, method in zip(runs, (hs.Voxels(), hs.preset("fast"))):
        ...     result = hs.reconstruct(scan, hs.MaterialPrior.known(water), method, folder=run)
        >>> comparison = hs.compare(*runs, scan)
        >>> comparison.scores.dice > 0.8
        True
    """
    return Comparison(*(side_of(folder, scan) for folder in (first, second)))


def side_of(folder: RunFolder, scan: Scan | None) -> Side:
    """A run, at its first time, with its scores on `scan`."""
    folder.require_run()
    result, times = load_reconstruction(folder), instants_of(folder)
    if times:
        result = reconstruction_at(result, times, 0)
        scan = scan.at_instant(0) if scan is not None and scan.is_series else scan
    return Side(folder, result, None if scan is None else evaluate(result, scan, None))


def _request(side: Side) -> tuple[dict[str, str], dict[str, str]]:
    """What a run was asked, by dotted names, and the usual settings of its method."""
    told = side.folder.read_config()
    kind = told.get("method", {}).get("kind")
    usual = {"method": to_table(METHODS[kind])} if kind in METHODS else {}
    own = {name: value for name, value in told.items() if name not in (RUN, CONFIG_SUM, *ON_THE_WAY)}
    return flatten(own), flatten(usual)


def differing(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Names and both values of what is not the same in two tables; a dash where there is none."""
    names = [*first, *(name for name in second if name not in first)]
    pairs = ((name, str(first.get(name, "–")), str(second.get(name, "–"))) for name in names)
    return [pair for pair in pairs if pair[1] != pair[2]]


def chosen(decisions: Sequence[Decision]) -> dict[str, str]:
    """Name → what was chosen; where one name is decided several times, all choices in their order."""
    found = dict[str, str]()
    for each in decisions:
        found[each.name] = f"{found[each.name]}, {each.choice}" if each.name in found else each.choice
    return found


def _word(side: Side) -> str:
    """The verdict by rehearsals, or without them that on the frames alone; empty where nothing was judged."""
    found, frames = read_rehearsal(side.folder), side.result.verdict
    if found is not None:
        return found.word
    return "" if frames is None else "consistent" if frames.good else "wrong"


def _cause(side: Side) -> str:
    found = side.result.verdict
    return (
        in_print(found.reasons[0].removeprefix("Likely cause: ")) if found and not found.good and found.reasons else "–"
    )


def in_columns(table: Table) -> list[str]:
    """A table as lines of a terminal, its cells broken at `COLUMN` characters."""
    rows = [table.head, *table.rows] if table.head else table.rows
    cells = [[textwrap.wrap(cell.replace("\u00a0", " "), COLUMN) or [""] for cell in row] for row in rows]
    lines = [table.caption]
    for row in cells:
        lines += [
            "  " + "".join(f"{part:{COLUMN + 2}}" for part in parts).rstrip()
            for parts in zip_longest(*row, fillvalue="")
        ]
    return lines


def write_comparison(comparison: Comparison, path: Path) -> None:
    """Write the comparison as one self-contained HTML file, whole or not at all."""
    first, second = (side.folder.path for side in comparison.sides)
    size = " × ".join(str(n) for n in comparison.grid.shape[::-1])
    edge = comparison.grid.voxel_size[0]
    blocks = [replace(block, number=k + 1) for k, block in enumerate(_blocks(comparison))]
    page = template("template.html").render(
        title="Two runs side by side",
        verdict=comparison.verdict(),
        summary=f"A: {first}; B: {second}. Both volumes on {size} voxels of {format_length(edge, 4)}.",
        key_figures=(),
        blocks=blocks,
        scores=comparison.found(),
        records=comparison.asked(),
        record_heading="What differs in decisions and settings",
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _blocks(comparison: Comparison) -> list[Block]:
    """Slices of both volumes on one colour scale with their difference, and how they correlate."""
    first, second = comparison.volumes
    scores, symbol = comparison.scores, comparison.quantity.symbol
    if scores is None:
        return []
    planes = richest_planes(first)
    figure = slices_figure(second, first, planes, comparison.quantity, ("A", "B"))
    text = f"{symbol} of A and of B on one colour scale, and B − A, in the planes that hold most matter of A."
    curve = correlation_figure(None, scores, scores.pitch, "A with B")
    words = (
        f"Fourier shell correlation of the {symbol} of A and of B on one grid. The upper scale is the full period. Two "
        "runs of the same frames share their noise, which correlates, too: this is no resolution of either."
    )
    slices = drawn_block("Slices of both", text, f"Slices of {symbol}.", figure)
    return [slices, drawn_block("Correlation", words, "A with B in Fourier space.", curve)]
