"""`holosplat train`: from a dataset to the weights of a network."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional

from ..training.options import TrainOptions
from .places import Output
from .progress import INTERRUPTED, ProgressBar
from .room import tell

DEFAULT = TrainOptions()
"""More steps than the weights of the package were made with: their card says how many."""


def train(
    data: Positional[Path], out: Output, how: Annotated[TrainOptions, OmitArgPrefixes] = DEFAULT, resume: bool = False
) -> None:
    """Train a network on scenes of `holosplat dataset`: weights with a card, and curves.

    That of `--start learned`, or, by --network, those of the methods onix and pixelnerf, which see frames alone.

    Args:
        data: Folder of scenes.
        out: Folder to make.
        resume: Go on with an interrupted training; --resume FOLDER alone, with its scenes and options.
    """
    from ..planning.acts import of_training
    from ..report.curves import training_curves
    from ..training.aligned import AlignedTraining, AlignedValidation
    from ..training.folder import Dataset
    from ..training.shown import Validation
    from ..training.train import Training, made_by

    scenes = Dataset.read(data)
    scenes.require_whole()
    frames, views = (scenes.ranges.rows, scenes.ranges.columns), max(how.shown.views)
    views = min(views, scenes.ranges.views)
    tell("the training", of_training(frames, views, how.network, how.size, how.steps), out)
    kind = Training if how.network == "start" else AlignedTraining
    training = (kind.resumed if resume else kind.begun)(scenes, out, how)
    who = made_by(how.device)  # before files change under hours of work
    with ProgressBar() as bar:
        told = Validation.of(
            scenes.ranges, scenes.seed, how.validation, lambda fraction: bar.show("scenes to validate", fraction, {})
        )
        if how.network != "start":
            told = AlignedValidation(told.samples, network=how.network)
        try:
            training.run(told, lambda now: bar.show("training", now.step / how.steps, now.record))
        except KeyboardInterrupt:
            print(f"interrupted; {out} keeps the last checkpoint, go on with --resume", file=sys.stderr)
            raise SystemExit(INTERRUPTED) from None
    weights = training.finish(told, who)
    print(f"Dice of scenes of another seed: {told.last()}")
    print(f"wrote {weights} and {training_curves(out)}")
