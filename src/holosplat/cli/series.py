"""`holosplat series | watch`: many times as tasks of their own, here, by Slurm or on Dask, and scans as they appear."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg, subcommand

from ..checks import require
from ..io.formats import read_frames
from ..io.reading import Reading
from ..matter import MaterialPrior
from ..planning.acts import of_each_time, one_time, times_of
from ..planning.scan_facts import smaller
from ..ranges import Jobs, Seed, checked_dataclass
from ..series.collect import collect as join
from ..series.folder import Row, SeriesFolder, line_of, table_of, time_left, verdict_of
from ..series.plan import ACTS, AskedMotion, Cut, Settings, Slurm, Warm, listed, plan_series
from ..series.run import Counts, counted, run_left, run_on_dask, run_processes, states, submit, write_script
from ..series.stream import RECEIVED, SCHEME, Stream, Streaming
from ..series.task import run_task
from ..series.watch import Watch, WatchFolder, Watching
from ..tables import to_table
from ..units import number_of
from ..workflows.verdict import some
from .light import RunLightFlags
from .options import MethodOptions, PriorOptions
from .places import Kept, Output, with_checked_arguments
from .sentence import interruptible, put, say, tell
from .track import BodyFlags, MotionFlags

UNFINISHED = 4
"""Exit code of `series run` and `collect` where tasks failed or are left."""


@checked_dataclass
class EachTime:
    """What is done with each time."""

    warm: bool = True
    """Start each time from the one before, with fewer steps; where that fits worse than the last time started alone
    did, the better of both is kept. --no-warm: start each alone."""
    reports: bool = False
    """Write report.html of each run, too, which takes seconds a time."""


@dataclass(frozen=True)
class Act:
    """What is done with the times of a series: the options of `reconstruct`, and of `track`."""

    each: EachTime = field(default_factory=EachTime)
    how: MethodOptions = field(default_factory=MethodOptions)
    motion: MotionFlags = field(default_factory=MotionFlags)
    known: BodyFlags = field(default_factory=BodyFlags)
    illumination: RunLightFlags = field(default_factory=RunLightFlags)

    def settings(self, motion: AskedMotion, seed: int) -> Settings:
        """The settings of each task; `InputError` for options of another motion."""
        stray = [] if motion in ("bodies", "auto") else _changed(self.motion, self.known)
        stray += _changed(self.how) if motion in ("bodies", "flow") else []
        name = stray[0].replace("_", "-") if stray else ""
        require(not stray, f"--{name} does not go with --motion {motion}; leave one of them.")
        shared = {"light": self.illumination.options(), "seed": seed, "reports": self.each.reports}
        bodies = replace(self.motion.options(), body=self.known.known())
        how = {"method": self.how.chosen(), "matter": self.how.kind_of_matter(), "warm": Warm(self.each.warm)}
        return Settings(ACTS[motion], motion=bodies, **how, **shared)


def _changed(*groups: object) -> list[str]:
    """Names of fields that are not as they are without options."""
    pairs = [(group, type(group)()) for group in groups]
    return [name for group, usual in pairs for name, value in vars(group).items() if value != getattr(usual, name)]


@checked_dataclass
class SlurmFlags(Slurm):
    """A Slurm array script, FOLDER/slurm.sh, of the tasks that are left, --block of them in each job."""

    slurm: bool = False
    """Write it."""
    submit: bool = False
    """Write it, and submit it by sbatch."""

    def carry_out(self, folder: SeriesFolder, retry: bool) -> None:
        """Write the script, and submit it if that is asked for."""
        count, numbers = write_script(folder, self, retry)
        say(f"wrote {folder.script} for {number_of(count, 'task')}: {numbers}")
        if self.submit:
            print(submit(folder))
            return
        say(f"submit it by: sbatch {folder.script}")


def plan(
    scans: Positional[tuple[Path, ...]],
    out: Output,
    windows: Cut = Cut(),
    matter: PriorOptions = PriorOptions(),
    act: Annotated[Act, arg(name="")] = Act(),
    reading: Reading = Reading(),
    *,
    seed: Seed = 0,
    motion: AskedMotion = "each",
    track: bool = False,
) -> None:
    """Cut a series into tasks, in a new folder; nothing is reconstructed yet.

    Args:
        scans: A scan of many times, or the scans of a series in their order, one or more times each, or a folder of
            scan files, whose order is that of their names.
        out: Folder of the series to make.
        seed: Seed of everything random.
        motion: What is made of the times of a task, as by --motion of reconstruct. each: a run for each; still: one
            object for all; flow: one that a flow carries; bodies: closed bodies, as track; auto: by times set aside.
        track: Short for --motion bodies.
    """
    require(not matter.ranges(), "a series needs one number for --delta-beta; find it by reconstruct of one time.")
    require(
        not track or motion in ("each", "bodies"), f"--track is --motion bodies, but --motion is {motion}; leave one."
    )
    settings = act.settings("bodies" if track else motion, seed)
    folder = SeriesFolder(out)
    found = plan_series(listed(scans), settings, matter.prior, reading, windows)
    folder.create(found)
    tasks, times = len(found.windows()), len(found.moments())
    said = f"{number_of(times, 'time')} of {number_of(len(found.sources), 'scan')} in {number_of(tasks, 'task')}"
    say(f"{out}: {said}; now: holosplat series run {out}")


def run(
    folder: Positional[Path],
    task: Positional[int | None] = None,
    jobs: Jobs = 0,
    retry: bool = False,
    dask: str | None = None,
    cluster: SlurmFlags = SlurmFlags(),
    allow_external: bool = False,
) -> None:
    """Do one task of a series, or all that are left; what is done already is not done again.

    Without a task, all that are left are done in this process, one after another; any number of such processes may run
    at once, on any machines that see the folder. Exit code 4: some failed, or are left.

    Args:
        folder: Folder of the series.
        task: Number of the task, from 0 on. With --block N: of N tasks from it on those that are left.
        jobs: Or: all that are left, by so many processes of this machine, with cores / jobs threads each.
        retry: Do failed tasks again.
        dask: Or: all that are left, on the Dask cluster whose scheduler has this address, such as tcp://host:8786.
        allow_external: The plan says --allow-external, and you trust the folder and its scans.
    """
    ways = [task is not None, jobs != 0, dask is not None, cluster.slurm or cluster.submit]
    require(sum(ways) < 2, "give one of a task's number, --jobs, --dask and --slurm.")
    alone = cluster.block == 1 or task is not None or cluster.slurm or cluster.submit
    require(alone, "--block goes with a task's number or --slurm; give one of these, or leave it.")
    series = SeriesFolder(folder)
    require(
        allow_external or not series.plan().reading.told.allow_external,
        f"{folder} lets its scans bring values of other files; if you trust all of them, add --allow-external.",
    )
    if cluster.slurm or cluster.submit:
        cluster.carry_out(series, retry)
        return
    with interruptible(lambda: f"interrupted; what {folder} holds is whole, and the same command goes on from there"):
        if task is not None and cluster.block > 1:
            counts = run_left(series, retry, _tell_row, among=range(task, task + cluster.block))
        elif task is not None:
            counts = counted([run_task(series, task, _tell_row)])
        elif dask is not None:
            counts = run_on_dask(series, dask, retry, lambda state: say(f"task {state.number}: {state.state}"))
        elif jobs:
            counts = run_processes(series, jobs, retry)
        else:
            counts = run_left(series, retry, _tell_row)
    _end(series, counts)


def _tell_row(row: Row) -> None:
    say(line_of(row))


def _end(series: SeriesFolder, counts: Counts) -> None:
    """Say how far a series is; exit code 4 where something failed or is left."""
    said = f"{counts.done} done, {counts.running} running, {counts.failed} failed, {counts.left} left"
    say(f"{series.path}: {said}; holosplat series status|collect {series.path} say more")
    if counts.failed or counts.left:
        raise SystemExit(UNFINISHED)


def status(folder: Positional[Path]) -> None:
    """Say how far each task of a series is: done, running where, failed why, or left, and how long the rest takes.

    Args:
        folder: Folder of the series.
    """
    found = states(SeriesFolder(folder))
    put(table_of(found))
    print(time_left(found))


def collect(folder: Positional[Path], fronts: bool = False) -> None:
    """Join what the tasks of a series have done: tables of times, bodies, events, and a page; what is missing is said.

    Exit code 4: something is missing.

    Args:
        folder: Folder of the series.
        fronts: Also fit a spherical front to each time, such as of a shock: fronts.csv, with speed and step of δ.
    """
    found = join(series := SeriesFolder(folder), fronts)
    for path in (series.table, series.bodies, series.events, series.tracks, series.page, *[series.fronts] * fronts):
        say(f"wrote {path}")
    put(verdict_of([row for row in found.rows if row is not None]))
    if found.no_events:
        say(found.no_events)
    if found.missing:
        say(f"{len(found.missing)} of {len(found.moments)} times are missing: {some(found.missing)}")
        raise SystemExit(UNFINISHED)


def series(
    act: Annotated[
        Annotated[None, subcommand("plan", constructor=with_checked_arguments(plan))]
        | Annotated[None, subcommand("run", constructor=with_checked_arguments(run))]
        | Annotated[None, subcommand("status", constructor=with_checked_arguments(status))]
        | Annotated[None, subcommand("collect", constructor=with_checked_arguments(collect))],
        arg(name=""),
    ],
) -> None:
    """Reconstruct a series as tasks of their own: on this machine, by Slurm, on Dask (plan, run, status, collect)."""


def reconstruct_each(
    scan: Path,
    out: Path,
    settings: Settings,
    prior: Callable[[float], MaterialPrior],
    reading: Reading,
    resume: bool,
) -> None:
    """Make the series of all times of `scan` in the folder `out` as one task, with its table and page; resume: go on
    with a folder that was begun. Errors: `InputError` for another folder, and as of `plan_series`."""
    reading = replace(reading, part=replace(reading.part, time_frame=None))
    every = plan_series([scan], settings, prior, reading, Cut())
    planned = replace(every, cut=Cut(window=len(every.moments())))
    measured, method, matter = read_frames(scan, reading), settings.method, settings.matter
    seen = measured.exposures[~measured.is_test]
    needs = of_each_time(seen, method, matter) if len(seen) else None
    if needs is not None:
        count = times_of(seen)
        others = ((how, one.times(count)) for how, one in smaller(one_time(seen), method, matter))
        tell("the series", needs, out, others)
    folder = SeriesFolder(out)
    if resume and out.exists():
        require(
            folder.plan() == planned,
            f"{out} must be of the same scan and options to go on, but is not; leave --resume, choose another --out.",
        )
    else:
        folder.create(planned)
    with interruptible(lambda: f"interrupted; go on with --out {out} --resume"):
        counts = run_left(folder, retry=True, on_row=_tell_row)
    put(verdict_of([row for row in join(folder).rows if row is not None]))
    say(f"wrote {folder.table}, {folder.page}; each time is a run folder in {folder.task(0)}")
    if counts.failed or counts.left:
        raise SystemExit(UNFINISHED)


def watch(
    folder: Positional[Path],
    out: Kept,
    how: Watching = Watching(),
    each: EachTime = EachTime(),
    matter: PriorOptions = PriorOptions(),
    method: MethodOptions = MethodOptions(),
    reading: Reading = Reading(),
    *,
    illumination: RunLightFlags = RunLightFlags(),
    stream: Streaming = Streaming(),
    seed: Seed = 0,
) -> None:
    """Reconstruct scans as they appear in a folder, or times as they come from a socket, each begun with what the last
    one gave, and keep a live page.

    The page is OUT/live.html, which a browser opens without a server. Ctrl-C ends the watch, and the same command goes
    on where it was.

    Args:
        folder: Folder to watch, files in it, not those of folders in it; or tcp://HOST:PORT of a ZeroMQ socket.
        out: Folder of the results, new or to go on with.
        seed: Seed of everything random.
    """
    require(not matter.ranges(), "a watch needs one number for --delta-beta; find it by reconstruct of one scan.")
    require(reading.part.time_frame is None, "a watch takes all times of a scan; choose some with --time-frames.")
    settings = Act(each, method, illumination=illumination).settings("each", seed)
    address = re.sub("^tcp:/+", SCHEME, str(folder))  # pathlib makes one slash of two
    from_socket, result = address.startswith(SCHEME), WatchFolder(out)
    source = result.path / RECEIVED if from_socket else folder
    stray = not from_socket and stream != Streaming()
    require(not stray, "--socket, --high-water, --most-waiting and --most-mb go with tcp://HOST:PORT; leave them.")
    feed, asked = None, reading.as_table()
    if from_socket:
        feed, how = Stream(address, stream, reading, source, say), replace(how, settle=0.0)
        told = replace(reading.told, sources=None, pulses=None)  # of messages; files have the views that are taken
        reading = replace(reading, told=told)
    said = {
        "folder": address if from_socket else str(source.resolve()),
        "settings": to_table(settings.as_table()),
        "matter": asdict(matter),
        "reading": asked,
    }
    say(f"watching {address}; the page is {result.page}; Ctrl-C ends")
    with interruptible(lambda: f"ended; what {out} holds is whole, and the same command goes on from there"):
        watch = Watch(source, result, settings, matter.prior, reading, how, say, stream=feed)
        count = watch.run(said)
    say(f"ended after {number_of(count, 'scan')}")
