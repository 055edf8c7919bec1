"""`holosplat bench`: the suite of cases × methods × seeds and its report, and the thesis' study."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from holosplat.checks import require
from holosplat.cli.places import Kept, with_checked_arguments
from holosplat.cli.progress import ProgressBar
from holosplat.cli.sentence import INTERRUPTED, interruptible, say, tell
from holosplat.ranges import Seed

if TYPE_CHECKING:
    from ..suite.folder import Row
    from ..suite.run import Suite


def thesis(
    out: Kept = Path("thesis_study"),
    schedule: Literal["full", "third", "short"] = "short",
    configurations: tuple[str, ...] = (),
    case: Literal["thesis16", "thesis8"] = "thesis16",
    physics: Literal["declared", "contact", "far", "blurred", "noisy"] = "declared",
    snapshots: Path | None = None,
    seed: Seed = 0,
) -> None:
    """Rerun the thesis' study: its configurations, its schedule and loss, and all curves.

    The same command goes on where an earlier one ended, or was interrupted.

    Args:
        out: Folder of the study, new or to go on with.
        schedule: The thesis' 30 000 steps, or one three or ten times shorter.
        configurations: Names of configurations (default: the eight of its Table 2).
        case: Twelve training views of sixteen, or eight.
        physics: The case as declared, in contact (absorption alone), at 50 cm, with a blurred or with a noisy detector.
        snapshots: Folder of simulated cells (VTK files), of which the seed takes one; without, cells are generated.
        seed: Seed of the scene and of the random start.
    """
    from holosplat.io.lock import sole_writer

    from ..suite.case import load_case
    from ..thesis.configurations import PACES, Measured
    from ..thesis.configurations import configurations as named
    from ..thesis.folder import StudyFolder
    from ..thesis.study import run_study

    chosen, folder, interrupted = named(configurations), StudyFolder(out), False
    try:
        with sole_writer(out), ProgressBar() as bar:
            bar.show("scene and scan", 0.0, {})
            measured = Measured.of(load_case(case, seed, snapshots), physics)
            run_study(measured, chosen, PACES[schedule], seed, folder, bar.show)
    except KeyboardInterrupt:
        interrupted = True
    if not interrupted or any(folder.finished(configuration.name) for configuration in chosen):
        from ..thesis.folder import load_study
        from ..thesis.pages.page import write_study

        for path in write_study(load_study(folder), folder.path):
            say(f"wrote {path}")
    if interrupted:
        say(f"interrupted; what is done stays in {out}, and the same command goes on from there")
        raise SystemExit(INTERRUPTED)


FIRST_SEED = 101
"""Options were tuned on scenes of seeds below 100."""


@dataclass(frozen=True)
class Folders:
    """What cases need that is not generated."""

    snapshots: Path | None = None
    """Folder of simulated cells (VTK files) for the cases that have them; without, cells are generated."""
    data: Path | None = None
    """Folder of measured data, for the cases that need them (default: they are fetched)."""


def run(
    cases: tuple[str, ...] = (),
    methods: tuple[str, ...] = (),
    seeds: tuple[Seed, ...] = (FIRST_SEED,),
    out: Kept = Path("bench"),
    folders: Folders = Folders(),
    retry: bool = False,
    list_only: Annotated[bool, arg(name="list")] = False,
) -> None:
    """Run methods on cases; rows that are there already are kept, so an interrupted benchmark goes on.

    Args:
        cases: Names of cases, or TOML files of your own (FILE.toml, or FILE.toml:VARIANT) (default: all; measured ones
            only with --data).
        methods: Names of methods (default: all but those that align views first, such as tikhonov-tv+mass).
        seeds: Seeds of scenes and noise; options were tuned on seeds below 100.
        out: Folder of the benchmark, new or to go on with.
        retry: Run again what failed.
        list_only: Only list cases and methods.
    """
    from holosplat.io.lock import sole_writer

    from ..declaration import Case
    from ..suite.case import case_names, load_case
    from ..suite.folder import BenchFolder
    from ..suite.methods import ALIGNED, METHODS, REFERENCES
    from ..suite.prepare import MEASURED, MeasuredCase
    from ..suite.run import Suite, chosen, run_suite

    if list_only:
        print("cases:", *[*case_names(), *MEASURED], sep="\n  ")
        print("methods:")
        for name, method in (METHODS | ALIGNED).items():
            print(f"  {name:24} {method.family}: {method.summary}")
        return
    table = METHODS | ALIGNED
    wanted = {name: table[name] for name in chosen("--methods", methods or list(METHODS), list(table))}
    files = [name for name in cases if ".toml" in name]
    listed = [name for name in cases if name not in files]
    known = [*case_names(), *(MEASURED if listed or folders.data else ())]
    sources = {name: name for name in chosen("--cases", listed, known)} if listed or not files else {}
    sources = _at_hand(sources, folders.data)
    sources |= {load_case(file, min(seeds, default=0), folders.snapshots).name: file for file in files}
    require(bool(sources), "none of the cases has its data at hand; give their folder by --data FOLDER.")

    def load(name: str, seed: int) -> Case | MeasuredCase:
        if name in MEASURED:
            return replace(MEASURED[name], folder=folders.data, seed=seed)
        return load_case(sources[name], seed, folders.snapshots)

    suite = Suite(list(sources), sorted(set(seeds)), wanted, REFERENCES, load)
    folder = BenchFolder(out)
    folder.require_usable()
    _tell({name: source for name, source in sources.items() if name not in MEASURED}, suite, folders, out)
    with interruptible(lambda: _kept(out)), sole_writer(out), _Screen() as screen:
        run_suite(suite, folder, retry=retry, on_progress=screen.show, on_row=screen.tell)
    say(f"{out} holds all {len(suite)} rows; now: holosplat bench report {out}")


def report(folder: Positional[Path] = Path("bench")) -> None:
    """Write report.html, report.md and their pictures into the folder of a benchmark.

    Args:
        folder: Folder of the benchmark, which may be unfinished.
    """
    from ..suite.folder import BenchFolder
    from ..suite.pages.report import write_bench_report

    for path in write_bench_report(BenchFolder(folder)):
        say(f"wrote {path}")


@dataclass(frozen=True)
class Draw:
    """How sealed cases are drawn, and how long contestants may take."""

    seed: Seed = FIRST_SEED
    """Seed from which matter, geometry and noise are drawn; options were tuned on seeds below 100."""
    size: int = 48
    """Pixels along an edge of frames and volumes: bodies are resolved, and all takes an hour."""
    limit: float = 300.0
    """Wall time after which a contestant is stopped [s]: many times what any takes on such cases."""


def arena(
    cases: tuple[str, ...] = (),
    tracks: tuple[str, ...] = (),
    out: Kept = Path("arena"),
    history: Path | None = None,
    draw: Draw = Draw(),
    retry: bool = False,
    list_only: Annotated[bool, arg(name="list")] = False,
) -> None:
    """Run other people's programs beside holosplat on sealed cases under one clock, and write one page.

    Rows that are there already are kept, so an interrupted arena goes on. Peers that are not installed are listed.

    Args:
        cases: Names of sealed cases (default: all twelve).
        tracks: Kinds of contests: kernels, steps, retrieval, tomography, jobs (default: all).
        out: Folder of the arena, new or to go on with; arena.html and entry.json are written there.
        history: Folder of the time line, such as docs/data/arena: earlier entries are compared, and this one is added.
        retry: Run again what failed.
        list_only: Only list cases, tracks and contestants.
    """
    from holosplat.io.lock import sole_writer

    from ..suite.arena.cases import FAMILIES
    from ..suite.arena.contest import CONTESTANTS, TRACKS
    from ..suite.arena.run import Arena, ArenaFolder, entry_of, run_arena
    from ..suite.run import chosen

    made = Arena(
        chosen("--cases", cases, list(FAMILIES)),
        chosen("--tracks", tracks, list(TRACKS)),
        draw.seed,
        draw.size,
        draw.limit,
    )
    if list_only:
        print("cases:", *made.cases, sep="\n  ")
        for one in CONTESTANTS:
            print(f"  {one.track:11} {one.name:22} {one.summary}{'' if one.installed else ' (not installed)'}")
        return
    require(history is None or history.is_dir(), f"--history must be a folder that exists, but {history} is none.")
    folder = ArenaFolder(out)
    folder.require_usable()
    if made.absent:
        say(f"not installed, and so left out: {', '.join(made.absent)}; pip install 'holosplat[bench]' has them")
    with interruptible(lambda: _kept(out)), sole_writer(out), _Screen() as screen:
        run_arena(made, folder, retry=retry, on_progress=screen.show, on_row=screen.tell_arena)
    from ..suite.arena.history import read_history
    from ..suite.pages.arena import write_arena

    entry = entry_of(made, folder)
    entry.write(folder.entry)
    if history is not None:
        entry.write(history / entry.file)
    for path in write_arena(entry, [] if history is None else read_history(history), folder.path):
        say(f"wrote {path}")


def bench(
    act: Annotated[
        Annotated[None, subcommand("run", constructor=with_checked_arguments(run))]
        | Annotated[None, subcommand("report", constructor=with_checked_arguments(report))]
        | Annotated[None, subcommand("arena", constructor=with_checked_arguments(arena))]
        | Annotated[None, subcommand("thesis", constructor=with_checked_arguments(thesis))],
        arg(name=""),
    ],
) -> None:
    """Compare methods on cases, under one physics and one set of scores (run, report), and other people's programs with
    holosplat (arena); rerun the thesis' study."""


class _Screen:
    """What a benchmark says on standard error: a bar on a terminal, and a line for each row."""

    def __init__(self) -> None:
        self._bar: ProgressBar | None = None

    def __enter__(self) -> _Screen:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._clear()

    def show(self, stage: str, fraction: float) -> None:
        """A stage is done to `fraction`; only a terminal shows it."""
        if sys.stderr.isatty():
            self._bar = self._bar or ProgressBar()
            self._bar.show(stage, fraction, {})

    def tell(self, row: Row, left: int) -> None:
        """A row is written."""
        self._clear()
        say(f"{row.case} {row.seed} {row.method}: {_outcome(row)} ({left} to go)")

    def tell_arena(self, row: Row, left: int) -> None:
        """A row of the arena is written."""
        self._clear()
        numbers = ", ".join(f"{name} {value:.3g}" for name, value in row.test.items() if value is not None)
        said = f"{numbers}, {row.seconds:.3g} s" if row.done else f"no result: {row.reason}"
        say(f"{row.case} {row.method}: {said} ({left} to go)")

    def _clear(self) -> None:
        if self._bar is not None:
            self._bar.__exit__(None, None, None)
        self._bar = None


def _outcome(row: Row) -> str:
    if not row.done:
        return f"failed: {row.reason}"
    return (
        f"SSIM {row.test['ssim']:.4f}, FRCM {row.test['frcm']:.4f}, Dice {row.volume['dice']:.4f}, "
        f"relative error of δ {row.volume['relative_error_delta']:.4f}, {row.seconds:.1f} s"
    )


def _at_hand(sources: dict[str, str], data: Path | None) -> dict[str, str]:
    """The cases whose data are at hand; of the others it is said that they are skipped, and why."""
    from ..suite.prepare import MEASURED, missing_data

    missing = missing_data(tuple(name for name in sources if name in MEASURED), data)
    for name, why in missing.items():
        say(f"{name} is skipped, for its data are not at hand (--data FOLDER): {why}")
    return {name: source for name, source in sources.items() if name not in missing}


def _tell(sources: Mapping[str, str], suite: Suite, folders: Folders, out: Path) -> None:
    """Say what the cases that are simulated take; `InputError` where there is less, with those that fit."""
    from holosplat.beamline.simulate import Simulation

    from ..suite.case import planned_frames
    from ..suite.methods import of_benchmark, of_methods

    methods, each = [method.options for method in suite.methods.values()], {}
    for name, source in sources.items():
        exposures, is_test = planned_frames(source, folders.snapshots)
        samples = Simulation().samples(exposures)
        each[name] = of_methods(exposures, is_test, samples, methods).times(len(suite.seeds))
    if each:
        smallest = sorted(each, key=lambda name: each[name].memory)
        fewer = (smallest[:count] for count in range(len(smallest) - 1, 0, -1))
        others = ((f"--cases {' '.join(kept)}", of_benchmark([each[name] for name in kept])) for kept in fewer)
        tell("the benchmark", of_benchmark(list(each.values())), out, others)


def _kept(out: Path) -> str:
    return f"interrupted; what {out} holds is whole, and the same command goes on from there"
