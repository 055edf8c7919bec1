"""`holosplat dataset | train`: simulated scenes in a folder, and from these to the weights of a network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from holosplat.cli.places import Kept, Output
from holosplat.cli.progress import ProgressBar
from holosplat.cli.sentence import interruptible, tell
from holosplat.ranges import Jobs, Seed, Within
from holosplat.units import number_of

from ..training.options import Ranges, TrainOptions

if TYPE_CHECKING:
    from holosplat.planning.needs import Needs

    from ..training.train import Training

Layout = Literal["nerf-synthetic", "r2-gaussian", "onix"]
"""Those of `training.export`, which loads torch."""


def dataset(
    out: Kept,
    count: Annotated[int, Within(1, 10**6)] = 1000,
    drawn: Annotated[Ranges, OmitArgPrefixes] = Ranges(),
    seed: Seed = 0,
    jobs: Jobs = 1,
    layouts: Annotated[tuple[Layout, ...], arg(name="export")] = (),
) -> None:
    """Simulate scenes for learning, drawn at random from stated ranges, into a folder of shards with a datasheet.

    The scene of a number and a seed is always the same; a folder that is there goes on with what it lacks.

    Args:
        out: Folder to make, or to go on with.
        count: Number of scenes.
        seed: Seed of the scenes.
        jobs: Processes that simulate.
        layouts: Layouts of other programs into which the scenes are written too, each into a folder of its name in out.
    """
    from ..training.export import export
    from ..training.folder import Dataset, make_dataset

    wanted = Dataset(out, drawn, seed, count)
    left = sum(map(len, wanted.missing()))
    fewer = ((f"--jobs {n}", _needs(drawn, left, n)) for n in range(jobs - 1, 0, -1))
    tell("the dataset", _needs(drawn, left, jobs), out, fewer)
    with ProgressBar() as bar:
        with interruptible(lambda: f"interrupted; {out} keeps its whole files, and the same command goes on"):
            made = make_dataset(wanted, jobs, bar.of("scenes"))
        done = [
            export(wanted, layout, lambda part, layout=layout: bar.show(f"{layout} files", part, {}))
            for layout in layouts
        ]
    print(f"wrote {number_of(made, 'file')} of scenes; {out / 'datasheet.md'} says what they are")
    for each in done:
        left_out = f"; left out, for their views have no common axis: {len(each.left_out)}" if each.left_out else ""
        print(f"wrote {number_of(each.count, 'scene')} into {each.folder}{left_out}")


def _needs(drawn: Ranges, scenes: int, jobs: int) -> Needs:
    """What so many scenes take."""
    from holosplat.beamline.simulate import Simulation
    from holosplat.planning.acts import of_simulation

    from ..training.needs import of_dataset

    views = drawn.views + drawn.held_out
    ends = (of_simulation(each, Simulation().samples(each), views) for each in drawn.extremes())
    return of_dataset(max(ends, key=lambda needs: needs.memory), (drawn.rows, drawn.columns), views, scenes, jobs)


def train(
    data: Positional[Path],
    out: Output,
    how: Annotated[TrainOptions, OmitArgPrefixes] = TrainOptions(),
    resume: bool = False,
) -> None:
    """Train a network on scenes of `holosplat dataset`: weights with a card, and curves.

    That of `--start learned`, or, by --network, those of the methods onix and pixelnerf, which see frames alone, or
    dynamics, that of `forecast --by graph`, which learns from series of `grow --compact`.

    Args:
        data: Folder of scenes, or of folders of `grow --compact`.
        out: Folder to make.
        resume: Go on with an interrupted training; --resume FOLDER alone, with its scenes and options.
    """
    from ..training.dynamics import train_dynamics
    from ..training.train import made_by, trainer_of
    from .curves import training_curves

    who = made_by(how.device)  # before files change under hours of work
    if how.network == "dynamics":
        with ProgressBar() as bar, interruptible(lambda: _kept(out)):
            weights, judged = train_dynamics(data, out, how, resume, _show(bar, how), who)
        print(f"errors across surfaces of series that were not trained on, in radii: {judged.last()}")
        print(f"wrote {weights} and {training_curves(out)}")
        return
    from ..training.folder import Dataset
    from ..training.shown import Validation

    trainer = trainer_of(how.network)
    scenes = Dataset.read(data)
    scenes.require_whole()
    frames, views = (scenes.ranges.rows, scenes.ranges.columns), max(how.shown.views)
    views = min(views, scenes.ranges.views)
    tell("the training", trainer.needs(frames, views, how), out)
    training = (trainer.training.resumed if resume else trainer.training.begun)(scenes, out, how)
    with ProgressBar() as bar:
        drawn = Validation.of(scenes.ranges, scenes.seed, how.validation, bar.of("scenes to validate"))
        told = trainer.validation(drawn.samples)
        with interruptible(lambda: _kept(out)):
            training.run(told, _show(bar, how))
    weights = training.finish(told, who)
    print(f"Dice of scenes of another seed: {told.last()}")
    print(f"wrote {weights} and {training_curves(out)}")


def _kept(out: Path) -> str:
    return f"interrupted; {out} keeps the last checkpoint, go on with --resume"


def _show(bar: ProgressBar, how: TrainOptions) -> Callable[[Training], None]:
    return lambda now: bar.show("training", now.step / how.steps, now.record)
