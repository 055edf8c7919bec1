"""Training: from a dataset to weights with a model card, in a folder that can be continued."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from holosplat.backends import require_device
from holosplat.checks import InputError, as_written, require
from holosplat.io.atomic import read_json, write_json, write_state
from holosplat.learning.network import Guess
from holosplat.learning.start import Card, write_weights
from holosplat.planning.needs import Needs
from holosplat.plugins import Extended
from holosplat.tables import to_table
from holosplat.version import source_commit
from holosplat.workflows.provenance import environment
from holosplat.workflows.run_folder import checkpoint_state

from .folder import Dataset
from .needs import of_training
from .options import Ranges, TrainOptions
from .sample import Sample
from .shown import Judge, Validation, draw_example, loss, write_numbers

PURPOSE = 2102
"""Keeps the numbers that are drawn here apart from others of the same seed."""
BETAS = (0.9, 0.98)
"""AdamW's constants: gradients of single scenes are rough, and their squares are averaged over fifty."""
SETTINGS, CHECKPOINT, CURVES, WEIGHTS = "train.json", "checkpoint.pt", "curves.csv", "weights.safetensors"
"""Files of a training's folder."""
COLUMNS = ("step", "loss", "dice_guess", "dice", "rate")


def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 (AVX-512 BF16 or AMX), as far as torch says it."""
    found = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(found.get("avx512_bf16") or found.get("amx_bf16"))


class Training:
    """A training in its folder: what is learnt, the optimiser, and the step that comes next."""

    columns: ClassVar[tuple[str, ...]] = COLUMNS
    """Of the curves."""

    def __init__(self, data: Dataset, folder: Path, options: TrainOptions) -> None:
        self.data, self.folder, self.options = data, folder, options
        torch.manual_seed(options.seed)
        self.network = self._made().to(options.device)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=options.rate, weight_decay=options.decay, betas=BETAS
        )
        self.step = self._first = 0
        self._began = time.monotonic()
        self.rows: list[tuple[float, ...]] = []

    @classmethod
    def begun(cls, data: Dataset, folder: Path, options: TrainOptions) -> Self:
        """A training in a new folder; `InputError` where there is something in it, or its device cannot be used."""
        require_device(options.device)
        if folder.exists() and any(folder.iterdir()):
            raise InputError(f"{folder} must be new or empty, but it is not; choose another --out, or --resume.")
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / SETTINGS, _settings(data, options))
        return cls(data, folder, options)

    @classmethod
    def resumed(cls, data: Dataset, folder: Path, options: TrainOptions) -> Self:
        """The training in `folder` after its last checkpoint; `InputError` where it is one of other options or data, or
        its device cannot be used."""
        require_device(options.device)
        settings = folder / SETTINGS
        require(settings.is_file(), f"{folder} holds no training that could go on; leave --resume.")
        require(
            read_json(settings) == _settings(data, options),
            f"{folder} holds a training with other options or scenes; give the same, or choose another --out.",
        )
        training, checkpoint = cls(data, folder, options), folder / CHECKPOINT
        if checkpoint.is_file():
            training._take_up(checkpoint)
        return training

    def _take_up(self, checkpoint: Path) -> None:
        """Go on from a checkpoint; `InputError` where it is damaged, or not of this training."""
        kept = checkpoint_state(checkpoint)
        if kept is None:
            raise InputError(
                f"{checkpoint} must be a checkpoint, but it is damaged; remove it, and --resume begins anew."
            )
        with as_written(checkpoint, "a checkpoint of this training"):
            for name, part in self.parts().items():
                part.load_state_dict(kept[name])
            step, rows = int(kept["step"]), [tuple(map(float, row)) for row in kept["rows"]]
            require(0 <= step <= self.options.steps, f"step must be from 0 to {self.options.steps}, but it is {step}.")
            whole = len(rows) == step and all(len(row) == len(self.columns) for row in rows)
            require(whole, f"rows must be {step} of {len(self.columns)} numbers, but they are not.")
        self.step, self.rows = step, rows

    def _made(self) -> torch.nn.Module:
        """The network as it begins."""
        return Guess(self.options.size)

    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds, by name: everything with a `state_dict`."""
        return {"network": self.network, "optimiser": self.optimiser}

    def run(self, validation: Judge, on_step: Callable[[Training], None]) -> None:
        """All steps that are left; a checkpoint, curves and a validation every `keep_every` steps and at the end.

        on_step: called after each step. What is interrupted goes on from the last checkpoint.
        """
        self._first, self._began = self.step, time.monotonic()
        while self.step < self.options.steps:
            self.advance()
            if self.step % self.options.keep_every == 0 or self.step == self.options.steps:
                validation.judge(self.network, self.step)
                self.keep(validation)
            on_step(self)

    def advance(self) -> None:
        """One step: a scene as it is shown once. Its random numbers depend on the seed and the step alone."""
        options = self.options
        rng = np.random.default_rng([PURPOSE, options.seed, self.step])
        sample = self.data.sample(int(rng.integers(self.data.count)))
        rate = options.rate_at(self.step)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        value, scores = self._value(sample, rng)
        self.optimiser.zero_grad()
        value.backward()
        norm = float(clip_grad_norm_(self.network.parameters(), options.longest))
        if math.isfinite(norm):  # a step that is none, where sums overflowed
            self.optimiser.step()
        self.step += 1
        self.rows.append((self.step, float(value.detach()), *scores, rate))

    def _value(self, sample: Sample, rng: np.random.Generator) -> tuple[Tensor, list[float]]:
        """What this step minimises, and the scores that the curves show beside it."""
        assert isinstance(self.network, Guess)
        shown = draw_example(sample, self.options.shown, rng)
        with self._precision():
            value, scores = loss(self.network, shown.on(self.options.device), self.options.goal)
        return value, scores.tolist()

    def keep(self, validation: Judge) -> None:
        """Write the checkpoint, the curves and the validation, each whole or not at all."""
        state: dict[str, Any] = {name: part.state_dict() for name, part in self.parts().items()}
        write_state(self.folder / CHECKPOINT, state | {"step": self.step, "rows": [list(row) for row in self.rows]})
        write_numbers(self.folder / CURVES, self.columns, self.rows)
        validation.write(self.folder)

    def finish(self, validation: Validation, made_by: dict[str, str]) -> Path:
        """Write the weights with their card; their file."""
        card = validation.card(self.network, to_table(self.data.ranges) | {"seed": self.data.seed}, made_by)
        said = limits(self.data.ranges, self.options.shown.views, card.scores)
        path = self.folder / WEIGHTS
        self._write(path, replace(card, training=_settings(self.data, self.options)["options"], limits=said))
        return path

    def _write(self, path: Path, card: Card) -> None:
        assert isinstance(self.network, Guess)
        write_weights(path, self.network, card)

    @property
    def record(self) -> dict[str, float]:
        """Of the last step, for progress: steps and seconds since the training began, or was continued."""
        return {"step": self.step - self._first, "loss": self.rows[-1][1], "seconds": time.monotonic() - self._began}

    def _precision(self) -> AbstractContextManager[Any]:
        asked, device = self.options.precision, self.options.device
        short = device == "cuda" or has_bfloat16() if asked == "auto" else asked == "bfloat16"
        return torch.autocast(device, torch.bfloat16) if short else nullcontext()


class Trainer(NamedTuple):
    """How a network learns from scenes. training: its steps; validation: scores of scenes that it does not see; needs:
    memory, disk and time for frames of [rows, columns] in so many views."""

    training: type[Training]
    validation: Callable[[Sequence[Sample]], Validation]
    needs: Callable[[tuple[int, int], int, TrainOptions], Needs]


NETWORKS: Extended[Trainer] = Extended(
    {"start": Trainer(Training, Validation, lambda shape, views, how: of_training(shape, views, how.size, how.steps))},
    "holosplat.networks",
)
"""Networks that learn from scenes, by the name that --network knows; other packages add theirs (docs/adding.md)."""


def trainer_of(network: str) -> Trainer:
    """That of the network of this name. Errors: `InputError` for another name."""
    known = ", ".join((*NETWORKS, "dynamics"))
    require(network in NETWORKS, f"network must be one of {known}, but it is {network!r}.")
    return NETWORKS[network]


def _settings(data: Dataset, options: TrainOptions) -> dict[str, Any]:
    """What a training is resumed with again."""
    scenes = {"ranges": to_table(data.ranges), "seed": data.seed, "count": data.count}
    return {"options": to_table(options), "scenes": scenes}


def limits(ranges: Ranges, views: Sequence[int], scores: Mapping[str, Mapping[str, float]]) -> str:
    """Plain sentences about a network that learnt from scenes of `ranges`, shown in such numbers of `views`.

    scores: the Dice coefficient and the number of scenes of another seed, by the number of views
    """
    return " ".join([_matter(ranges), _views(ranges, views), _noise(ranges), _never(ranges), _worst(scores)])


def _matter(ranges: Ranges) -> str:
    kinds = " and ".join(kind.replace("-", " ") for kind in ranges.kinds)
    full = [ranges.crowded if kind == "crowd" else ranges.filled for kind in ranges.kinds]
    low, high = min(low for low, _ in full), max(high for _, high in full)
    return (
        f"It knows {kinds} alone, {_span(ranges.across)} pixels across, in {100 * low:g} to {100 * high:g} % of the "
        f"room, with δ/β of {_span(ranges.ratio)} and phases of {_span(ranges.phase)} rad, at Fresnel numbers of a "
        f"pixel of {_span(ranges.fresnel)}; of other matter its guesses may be wrong."
    )


def _views(ranges: Ranges, views: Sequence[int]) -> str:
    *counts, most = sorted({min(count, ranges.views) for count in views})
    said = f"{', '.join(map(str, counts))} and {most}" if counts else str(most)
    tilted = f"in a share of {ranges.tilted:g} of them beams were tilted by up to {ranges.tilt:g}°"
    return f"It saw scenes in {said} views; {tilted if ranges.tilted else 'all beams had one axis'}."


def _noise(ranges: Ranges) -> str:
    if ranges.noiseless == 1:
        return "It never saw noise."
    return f"It never saw noise of more than {ranges.noise[1]:g} of the phase of a body."


def _never(ranges: Ranges) -> str:
    """What no scene of the ranges has."""
    missing = {
        "two materials of one δ/β in a body": "filled-capsules" not in ranges.kinds,
        "continuous matter": "soft-cells" not in ranges.kinds,
        "a medium that absorbs more than the bodies": ranges.medium == 0,
        "uneven light": ranges.uneven[1] == 0,
        "misaligned views": ranges.misaligned_px[1] == 0,
        "materials of different δ/β": True,
        "beams that are not parallel": True,
    }
    *first, last = [name for name, is_missing in missing.items() if is_missing]
    return f"Nor did it see {', '.join(first)} or {last}."


def _worst(scores: Mapping[str, Mapping[str, float]]) -> str:
    views = min(scores, key=lambda count: scores[count]["dice"])
    worst = scores[views]
    return (
        f"It is worst in {views} views: on {worst['scenes']:.0f} scenes of another seed the mean Dice coefficient is "
        f"{worst['dice']:.2f}."
    )


def _span(pair: tuple[float, float]) -> str:
    return f"{pair[0]:g} to {pair[1]:g}"


def made_by(device: str) -> dict[str, str]:
    """Versions, machine and commit, in one table; device: what computed it."""
    found = environment("cuda" if device == "cuda" else "cpu")
    return {**found["versions"], **found["machine"], "commit": source_commit() or "none: not a git checkout"}
