"""A volume to start from, as a trained network guesses it from few views; weights of networks in safetensors files,
with a card that says what they are."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from ..baselines.rays import frames_of, refined
from ..checks import InputError, as_written, require, require_regular
from ..geometry import Grid, Views
from ..io.atomic import atomic_path
from ..matter import DeltaBeta
from ..model import Instrument
from ..optics.noise import noise_levels
from ..optics.retrieval import FIXED, Tikhonov, tikhonov
from ..optics.sampling import fringe_sampling
from ..progress import Progress
from ..ranges import Natural, checked_dataclass
from ..scan import Exposures, Scan
from ..tables import from_table, table_in
from ..volume import Volume
from .network import COPIES, FINE, THICKNESS, Guess, Size, Taps, coarse, thickness_of

SHIPPED = Path(__file__).with_name("red_cells.safetensors")
"""Weights that may come with the package."""
Kind = TypeVar("Kind")
Net = TypeVar("Net", bound=nn.Module)
VERSION = 1
"""Of the network's layout."""


@dataclass(frozen=True)
class Card:
    """The model card of trained weights.

    trained_on: the scenes' ranges and seed; training: options, steps and seed; made_by: version, commit and machine;
    scores: of scenes of another seed, by the number of views; typical_misfit: what guesses leave unexplained there of
    the retrieved thickness (95 % of the scenes leave less), by the number of views; limits: where it fails, in words
    """

    trained_on: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    made_by: dict[str, str] = field(default_factory=dict)
    scores: dict[str, dict[str, float]] = field(default_factory=dict)
    typical_misfit: dict[str, float] = field(default_factory=dict)
    limits: str = ""

    @property
    def of_red_cells(self) -> bool:
        """Whether all scenes that were trained on are of red cells."""
        return set(self.trained_on.get("kinds", ())) in ({"red-cells"}, {"red-cells", "crowd"}, {"crowd"})

    def dice(self, views: int) -> float:
        """Mean Dice coefficient of guesses from so many views, by the same rule; 0 where it is not known."""
        return _nearest({count: said.get("dice", 0.0) for count, said in self.scores.items()}, views, 0.0)


def _nearest(said: Mapping[str, float], views: int, unsaid: float) -> float:
    """Look up `views`, or the next smaller number in the table, or the smallest."""
    known = sorted(int(count) for count in said)
    return said[str(max([count for count in known if count <= views] or known[:1]))] if known else unsaid


@dataclass(frozen=True)
class Trained:
    """A network and its card."""

    network: Guess
    card: Card


def write_weights(path: Path, network: Guess, card: Card) -> None:
    """Write the weights in half precision, whole or not at all; a megabyte holds half a million."""
    write_network(path, network, card, str(VERSION), torch.half)


@lru_cache(maxsize=2)
def read_weights(path: Path = SHIPPED) -> Trained:
    """The network in a file; `InputError` for one that `holosplat train` did not write, or of another version."""
    if path == SHIPPED and not path.exists():
        raise InputError(
            "no weights come with this version of holosplat; train a network (holosplat dataset, holosplat train) and "
            "name its file with --set weights=FILE."
        )
    return Trained(*read_network(path, Guess, Size, str(VERSION), "holosplat train"))


def write_network(path: Path, network: Any, card: Card, version: str, kind: torch.dtype) -> None:
    """Write the weights of a `network` of that version as numbers of a `kind`, and its card, whole or not at all."""
    said = {"holosplat": version, "size": json.dumps(asdict(network.size)), "card": json.dumps(asdict(card))}
    tensors = {name: value.detach().to("cpu", kind).contiguous() for name, value in network.state_dict().items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(tensors, said))


def read_network(path: Path, net: Callable[[Any], Net], size: type, version: str, command: str) -> tuple[Net, Card]:
    """The network `net` of the size that a file says, and its card; `InputError` for a file that the `command` did not
    write, or of another version."""
    tensors, said = tensors_of(path)
    require(
        said.get("holosplat") == version,
        f"{path} must hold weights of version {version} of holosplat's network, but it holds "
        f"{said.get('holosplat', 'others')}; train anew ({command}).",
    )
    with as_written(path, "what holosplat train wrote"):
        network, card = net(size_of(size, said, tensors)), card_of(said)
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{path} must hold the weights of the network that it says, but: {error}.") from None
    return network.eval().requires_grad_(False), card


def size_of(kind: type[Kind], said: Mapping[str, str], tensors: Mapping[str, Tensor]) -> Kind:
    """The size of a network that a file says, which is not larger than the weights in it; raises what `as_written`
    takes for anything else."""
    size = from_table(kind, table_in(said["size"]))
    held = max((length for tensor in tensors.values() for length in tensor.shape), default=0)
    named = [width for value in vars(size).values() for width in (value if isinstance(value, tuple) else (value,))]
    require(max(named) <= held, f"a network of {max(named)} channels has larger weights than it holds.")
    return size


def card_of(said: Mapping[str, str]) -> Card:
    """The card in a file, whose entries can be looked up; raises what `as_written` takes for anything else."""
    card = from_table(Card, table_in(said["card"]))
    asked = (card.of_red_cells, card.dice(2))
    require(all(number >= 0 for number in asked), "a number of the card is below zero.")
    return card


def tensors_of(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a safetensors file by name, in single precision, and what is written beside them; `InputError` for
    a file that is none."""
    require_regular(path, "a file of weights")
    try:
        with safe_open(path, framework="pt") as file:
            said = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 (it is no mapping)
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} must be a safetensors file, but it is damaged or another: {error}.") from None
    return tensors, said


RETRIEVAL = Tikhonov(iterations=20, prior=FIXED)
"""Of each frame by itself: a third of the steps of the other starts, as a network mends what is left; with the prior of
the retrievals that it learned from."""
CONTRAST = 0.5
"""Of the contrast's root mean square, in the images."""


def retrieved_thickness(
    frames: Tensor, exposures: Exposures, material: DeltaBeta, missing: Tensor | None = None
) -> Tensor:
    """Projected thickness [V, H, W] [m] of `material` in relative frames [V, H, W], each by itself; missing: pixels
    [V, H, W] bool without a value; errors: those of `tikhonov`."""
    return tikhonov(frames, exposures, *material, options=RETRIEVAL, missing=missing)


def seen_in(scan: Scan, material: DeltaBeta) -> tuple[Tensor, Tensor, Tensor]:
    """The contrast [V, H, W] of a scan, the retrieved thickness of `material` [V, H, W] [smallest pixels], and the
    noise [V].

    Missing pixels have no weight: they show the contrast that the retrieved thickness has there.
    """
    frames, optics = torch.from_numpy(scan.frames), scan.exposures.optical
    thickness = retrieved_thickness(frames, scan.exposures, material, scan.gaps)
    if scan.gaps is not None:
        samples = fringe_sampling(optics, voxels=1)
        frames = torch.where(
            scan.gaps, frames_of(Instrument(optics, samples), refined(thickness.float(), samples), material), frames
        )
    return frames - 1, thickness / scan.views.finest, noise_levels(scan.measured)


def images(contrast: Tensor, thickness: Tensor, noise: Tensor) -> Tensor:
    """The network's images [V, 3, H, W] float32 of views.

    contrast: [V, H, W], relative intensity less one; thickness: [V, H, W], retrieved, in pixels; noise: [V], standard
    deviation of the noise of the contrast.
    """
    rms = contrast.float().square().mean().sqrt().clamp_min(torch.finfo(torch.float16).tiny)
    level = (noise.float() / rms)[:, None, None].expand(contrast.shape)
    return torch.stack([CONTRAST * contrast / rms, THICKNESS * thickness, CONTRAST * level], 1).float()


STAGE = "learned start"
MOST_COLUMNS = 128
"""Pixels across that the network sees, at most: larger frames are binned."""
CLEARLY = 0.75
"""Largest ratio of unexplained parts on larger and smaller pixels: these show shapes better."""
FEWEST = 32
"""Rows and columns of binned frames, at least."""
FEWEST_VIEWS = 3
"""Views of which one can be left out to see what the others say."""


@checked_dataclass
class LearnedStart:
    """Options of a start that a network guesses."""

    weights: str = ""
    """File of the network's weights (default: those of the package, if it has any)."""
    trial_steps: Natural = 300
    """Steps of the fit of Gaussians from every start, before they are compared: those of a whole fit."""
    trial_surfaces: Natural = 100
    """Steps of the fit of surfaces that follow, where matter has one known level."""
    cells: bool = True
    """Whether red cells, where the network knows these alone and beams are two, are also looked for by their shape at
    rest: two views hardly determine shapes. They are one more start to be compared."""

    @property
    def network(self) -> Trained:
        """The network and its card; errors: those of `read_weights`."""
        return read_weights(Path(self.weights)) if self.weights else read_weights()


@dataclass(frozen=True)
class Guessed:
    """The guess of a network.

    values: [Z, Y, X] float32, occupancy from 0 to 1
    grid: its voxels, of a pixel of the (binned) frames
    images, taps: what the network saw
    """

    values: Tensor
    grid: Grid
    images: Tensor
    taps: Taps

    def left(self, factor: int = 1) -> float:
        """The `unexplained` part of the volume on pixels `factor` times larger."""
        return unexplained(self.values, self.images, self.taps, factor)


def guess_matter(scan: Scan, material: DeltaBeta, network: Guess, on_progress: Progress) -> Guessed:
    """The occupancy of `material` that `network` guesses from the frames of `scan`.

    The network knows bodies of some pixels across. So frames are shown on pixels of two sizes, and the larger ones are
    taken where they explain the retrieved thickness clearly better, by what they show of it. Errors: those of phase
    retrieval.
    """
    on_progress(STAGE, 0.0)
    factors, found = _factors(scan), list[Guessed]()
    for done, factor in enumerate(factors):
        found.append(_on_pixels(scan.binned(factor) if factor > 1 else scan, material, network))
        on_progress(STAGE, (done + 1) / len(factors))
    finer, *coarser = found
    if coarser and coarser[0].left() < CLEARLY * finer.left(factors[1] // factors[0]):
        return coarser[0]
    return finer


@dataclass(frozen=True)
class GuessedMatter:
    """The guess of a network as matter, to be stored and shown.

    volume: δ and β; spread: [Z, Y, X] float32, standard deviation of occupancy in several guesses; of_copies: whether
    these are of copies of the scene, not without one of the views each
    """

    volume: Volume
    spread: np.ndarray
    of_copies: bool

    @classmethod
    def of(cls, found: Guessed, material: DeltaBeta, network: Guess) -> GuessedMatter:
        """What `network` guesses of `material`, and where its guesses differ (`spread`)."""
        values = found.values.numpy()
        volume = Volume(values * material.delta, values * material.beta, found.grid)
        return cls(volume, spread(found, network).numpy(), len(found.images) < FEWEST_VIEWS)


def _factors(scan: Scan) -> Sequence[int]:
    """By what frames are binned: as little as the network allows, and twice that where enough is left of them."""
    least = max(1, math.ceil(max(scan.views.shape) / MOST_COLUMNS))
    return [least * times for times in (1, 2) if times == 1 or min(scan.views.shape) >= 2 * least * FEWEST]


def _on_pixels(scan: Scan, material: DeltaBeta, network: Guess) -> Guessed:
    seen, views, grid = _shown(scan, material)
    taps = Taps.of(grid, views)
    with torch.inference_mode():
        values = torch.sigmoid(network(seen, taps)[1])
    return Guessed(values.clone(), grid.divided((FINE, FINE, FINE)), seen, taps)


def missing_thickness(values: Tensor, seen: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
    """The thickness [V, H, W] in images [V, 3, 2H, 2W] that occupancy [2Z, 2Y, 2X] does not explain, and all of it."""
    thickness = avg_pool2d(seen[:, 1:2], FINE)[:, 0]
    return thickness - thickness_of(coarse(values).flatten(), taps), thickness


def unexplained(values: Tensor, seen: Tensor, taps: Taps, factor: int = 1) -> float:
    """Root mean square of the missing thickness over that of all of it, on pixels `factor` times larger."""
    left, there = (float(avg_pool2d(part, factor).norm()) for part in missing_thickness(values, seen, taps))
    return left / max(there, torch.finfo(torch.float32).tiny)


def spread(found: Guessed, network: Guess) -> Tensor:
    """Standard deviation [Z, Y, X] of the guesses of `network` without one of the views each: where it is large, few
    frames determine the matter. Of two views, it is that of guesses of copies of the scene (`COPIES`): where it is
    large, the network guesses matter that the frames do not determine."""
    few = len(found.images) < FEWEST_VIEWS
    with torch.inference_mode():
        guesses = _of_copies(found, network) if few else _without_each(found, network)
        return torch.stack(guesses).std(0).clone()


def _without_each(found: Guessed, network: Guess) -> list[Tensor]:
    every = torch.arange(len(found.images))
    rest = [every[every != left_out] for left_out in every]
    return [torch.sigmoid(network(found.images[some], found.taps.part(some))[1]) for some in rest]


def _of_copies(found: Guessed, network: Guess) -> list[Tensor]:
    guesses = [network(copy.images(found.images), copy.taps(found.taps))[1] for copy in COPIES]
    return [torch.sigmoid(copy.back(guess)) for copy, guess in zip(COPIES, guesses)]


def _shown(scan: Scan, material: DeltaBeta) -> tuple[Tensor, Views, Grid]:
    """The network's images [V, 3, 2H, 2W], the views of H × W pixels twice as large, and the lattice in them.

    Odd frames get a row or a column of air more. Of holes in a medium, contrast is shown with the opposite sign: that
    of bodies of the same shape, to first order, of which networks learn.
    """
    contrast, thickness, noise = seen_in(scan, material)
    views = scan.views
    (h, w), more = views.shape, [n % FINE for n in views.shape]
    seen = images(material.sign * contrast, thickness, noise)
    seen = pad(seen, (0, more[1], 0, more[0]))
    whole = views.cropped(slice(0, h + more[0]), slice(0, w + more[1]))
    large = replace(whole, shape=(seen.shape[2] // FINE, seen.shape[3] // FINE), pitch=FINE * views.pitch)
    return seen, large, Grid.of_views(large)
