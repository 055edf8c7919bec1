"""`evaluate`: a reconstruction, or any Object, against held-out frames and the true volume."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..backends import resolve
from ..baselines.tomography import plateau
from ..checks import as_written, require
from ..fit.residuals import Prediction
from ..geometry import Grid, Views
from ..io.atomic import write_rows
from ..matter import DeltaBeta, MatterKind
from ..metrics import ImageScores, VolumeScores, image_scores, intensity_range, volume_scores
from ..metrics.images import json_number
from ..model import Instrument, Model
from ..optics.background import Light
from ..representations import Stored
from ..scan import Exposures, Scan
from ..tables import read_rows
from ..volume import Object, Volume
from .reconstruct import Reconstruction
from .run_illumination import light_of
from .verdict import Verdict, judge, said_of_times

OTHER_FIELD = 8.0
"""A truth so many times larger or smaller than the frames is of another field."""
MOST_VOXELS = 8_000_000
"""Voxels of the volume on which the material is read off, at most."""


@dataclass(frozen=True)
class MaterialFound:
    """What a reconstruction says about the matter: mass-weighted medians of δ over its volume, and of δ/β in the
    matter; or those of the material that it is made of, and of `others` of weaker contrast beside it.

    delta_told: whether prior or frames said what δ is; else `delta` stands for β; against: the medium that both are
    differences to, empty for vacuum.
    """

    delta: float
    ratio: float
    single_material: bool
    others: tuple[DeltaBeta, ...] = ()
    delta_told: bool = True
    against: str = ""


@dataclass(frozen=True)
class Scores:
    """Scores on held-out and training frames and against the true volume; None: nothing to compare.

    predicted: the held-out frames [T, H, W] as the object gives them.
    """

    test: ImageScores | None
    train: ImageScores | None
    volume: VolumeScores | None
    predicted: np.ndarray | None

    def as_dict(self) -> dict[str, Any]:
        """The numbers, ready for JSON."""
        parts = {"test": self.test, "train": self.train, "volume": self.volume}
        scores: dict[str, Any] = {name: part.as_dict() if part else None for name, part in parts.items()}
        return {**{k: json_number(v) for k, v in self.headline().items()}, **scores}

    def headline(self) -> dict[str, float]:
        """The few numbers that matter: means over held-out frames, and the volume's."""
        numbers = dict(self.test.mean) if self.test else {}
        if self.volume:
            names = ("dice", "relative_error_delta", "mean_delta", "true_mean_delta")
            numbers |= {name: float(getattr(self.volume, name)) for name in names}
        return numbers

    def lines(self) -> list[str]:
        """The numbers as a few lines of text."""
        lines = []
        for name, scores in (("held-out frames", self.test), ("training frames", self.train)):
            if scores:
                m = scores.mean
                lines.append(
                    f"{name}: SSIM {m['ssim']:.4f}, FRCM {m['frcm']:.4f}, PSNR {m['psnr']:.1f} dB, L1 {m['l1']:.5f}"
                )
        if self.volume:
            v = self.volume
            lines.append(
                f"volume: Dice {v.dice:.4f}, relative error of δ {v.relative_error_delta:.4f}, mean δ inside "
                f"{v.mean_delta:.3e} (true {v.true_mean_delta:.3e}, {100 * v.delta_deviation:+.1f} %)"
            )
        return lines


@dataclass(frozen=True)
class Evaluation(Scores):
    """Scores of a reconstruction, the material that it found, whether it explains the held-out frames (None: there are
    none), and the light of all frames, in which they were compared (None: even)."""

    material: MaterialFound
    verdict: Verdict | None = None
    light: Light | None = None

    def as_dict(self) -> dict[str, Any]:
        """The numbers, ready for JSON."""
        found = self.material
        material: dict[str, Any] = _as_dict(found.delta, found.ratio) | {
            "single_material": found.single_material,
            "delta_told": found.delta_told,
            **({"against": found.against} if found.against else {}),
        }
        if found.others:
            material["others"] = [_as_dict(other.delta, other.ratio) for other in found.others]
        said: dict[str, Any] = {"light": self.light.in_words if self.light else "even"}
        said |= {} if self.verdict is None else {"verdict": self.verdict.as_dict()}
        return super().as_dict() | {"material": material} | said

    def lines(self) -> list[str]:
        """The numbers as a few lines of text."""
        found = self.material
        said = self.verdict.lines("held-out frames") if self.verdict else []
        if self.light is not None:
            said = [f"light: {self.light.in_words}; predictions are compared in it", *said]
        if not found.delta_told:
            beta = f"material: β {found.delta / found.ratio:.3e}; δ is not told: the frames show absorption alone"
            return [*(line.replace("δ", "β") for line in super().lines()), *said, beta]
        kind = "one for all" if found.single_material else "found apart"
        if found.others:
            kind = f"of {1 + len(found.others)}; beside: {', '.join(_as_text(*other) for other in found.others)}"
        kind += f", against {found.against}" if found.against else ""
        return [*super().lines(), *said, f"material: {_as_text(found.delta, found.delta / found.ratio)} ({kind})"]


def render(reconstruction: Reconstruction, exposures: Exposures) -> np.ndarray:
    """Frames [N, H, W] float32 that the reconstruction predicts."""
    _require_energy(reconstruction, exposures)
    found = _where_it_is_judged(reconstruction)
    return render_object(found, exposures, reconstruction.oversample, found.backend)


def render_object(obj: Object, exposures: Exposures, oversample: int, backend: str = "cpu") -> np.ndarray:
    """Frames [N, H, W] float32 that `obj` gives, one exposure at a time to bound memory.

    oversample: wave samples along a pixel; backend: of the wave optics, resolved (see `backends`).
    """
    frames = np.empty((len(exposures), *exposures.views.shape), dtype=np.float32)
    with torch.no_grad():
        for i in range(len(exposures)):
            instrument = Instrument(exposures[[i]], oversample, backend=backend)
            frames[i] = Model(obj, instrument).frames()[0].cpu().numpy()
    return frames


def evaluate(reconstruction: Reconstruction, scan: Scan | None, truth: Volume | None) -> Evaluation:
    """Score a reconstruction on the frames of `scan`, and against the true volume on the truth's own grid.

    scan: the frames that it was made of, training and held-out ones (None: no scores of frames)
    truth: of a simulation (None: no scores of the volume)

    The data range is that of the training frames. If the light of the training frames is uneven, predictions are
    compared in the light that each frame shows in its own air (`light_of`), and in the light that the training frames
    have in common. `lines()` of the result gives the scores as text. Errors: `InputError` for a scan of another photon
    energy.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> result = hs.reconstruct(scan, hs.MaterialPrior.known(water), hs.Voxels())
        >>> scores = hs.evaluate(result, scan, truth=scene.voxelise(hs.Grid.of_views(views)))
        >>> scores.volume.dice > 0.85, scores.test.mean["ssim"] > 0.85
        (True, True)
    """
    found = _where_it_is_judged(reconstruction)
    lit = None
    if scan is not None:
        _require_energy(reconstruction, scan.exposures)
        lit = light_of(scan, reconstruction.light, reconstruction.still)
    truth = of_absorption(truth) if truth is not None and not reconstruction.delta_told else truth
    scores = score_object(found, scan, truth, reconstruction.oversample, found.backend, _factor(lit))
    told = {"delta_told": reconstruction.delta_told, "against": reconstruction.choice.against}
    material = replace(material_found(found, reconstruction.choice.matter), **told)
    said = held_out_verdict(reconstruction, scan, lit) if scan is not None else None
    return Evaluation(scores.test, scores.train, scores.volume, scores.predicted, material, said, lit)


def require_same_field(grid: Grid, views: Views, path: Path) -> None:
    """`InputError` if a volume at `path` on `grid` is too large or too small for the truth of frames of `views`."""
    field, edges = max(views.width, views.height), [n * size for n, size in zip(grid.shape[::-1], grid.voxel_size)]
    require(
        field / OTHER_FIELD < max(edges) < field * OTHER_FIELD,
        f"{path} must be the truth of the scan, whose frames are {1e6 * field:.4g} µm wide, but it is "
        f"{1e6 * max(edges):.4g} µm; name the truth of this scan.",
    )


def require_overlap(scores: VolumeScores, path: Path) -> None:
    """`InputError` if a run has no matter where the truth at `path` has some, and is no nearer to it than nothing."""
    require(
        scores.dice > 0 or scores.relative_error_delta < 1,
        f"{path} has no matter where the run has some: it is of another scan, or the run found nothing; name the truth "
        "of this scan.",
    )


def held_out_verdict(reconstruction: Reconstruction, scan: Scan, lit: Light | None = None) -> Verdict | None:
    """Whether the held-out frames of `scan` are explained to within their noise; None without such frames.

    lit: the light of all its frames, which is divided out; what air does not tell of it counts as noise.
    """
    _require_energy(reconstruction, scan.exposures)
    found, test, noise = _where_it_is_judged(reconstruction), scan.test(), None
    if not len(test):
        return None
    if lit is not None:
        whole = replace(scan, frames=lit.evened(torch.from_numpy(scan.frames)).numpy())
        test, noise = whole.test(), lit.doubt[np.flatnonzero(scan.is_test)]
    return judge(Prediction(found, test.exposures, reconstruction.oversample, backend=found.backend), test, noise)


TIMES = "times.csv"
"""What a run of several times says of each one."""


def write_times(path: Path, reconstruction: Reconstruction, scan: Scan, lit: Light | None = None) -> None:
    """Write whether the training frames of each time of `scan` are explained, a row each; lit: the light of all
    frames, which divides them and whose doubt counts as noise, None where it is even."""
    found, doubt = _where_it_is_judged(reconstruction), None
    if lit is not None:
        scan, doubt = replace(scan, frames=lit.evened(torch.from_numpy(scan.frames)).numpy()), lit.doubt
    rows = []
    for number, time in enumerate(scan.train().instants):
        own = np.flatnonzero((scan.exposures.time == time) & ~scan.is_test)
        said = Prediction(found, scan.exposures[own], reconstruction.oversample, backend=found.backend)
        verdict = judge(said, scan[own], doubt and doubt[torch.from_numpy(own)])
        rows.append((number, f"{time:.9g}", int(verdict.good), verdict.words))
    write_rows(path, ("number", "time_s", "explained", "verdict"), rows)


def lines_of_times(path: Path) -> list[str]:
    """What `write_times` wrote, as lines of text; none where there is no such file."""
    if not path.is_file():
        return []
    with as_written(path, "what reconstruct wrote"):
        rows = read_rows(path, "what reconstruct wrote")
        judged = [(int(row["number"]), bool(int(row["explained"])), row["verdict"]) for row in rows]
    return said_of_times(judged, len(rows))


def of_absorption(volume: Volume) -> Volume:
    """The volume with β in the place of δ, too, as in a run whose frames show absorption alone."""
    return replace(volume, delta=volume.beta)


def _where_it_is_judged(reconstruction: Reconstruction) -> Stored:
    """The object on a GPU if there is one, or on the CPU; in plain torch if that computed it."""
    found = reconstruction.object
    return found if found.backend == "reference" else found.on(resolve("auto"))


def _factor(lit: Light | None) -> np.ndarray | None:
    """The light [N, H, W] of all frames of a scan, float32."""
    return None if lit is None else lit.factor().numpy().astype(np.float32)


def score_object(
    obj: Object,
    scan: Scan | None,
    truth: Volume | None,
    oversample: int,
    backend: str = "cpu",
    light: np.ndarray | None = None,
) -> Scores:
    """Scores of any Object: on the frames of `scan`, and against `truth` on the truth's own grid.

    The data range is that of the scan's training frames; oversample, backend: as for `render_object`; light [N, H, W]:
    of all frames of `scan`, in which predictions are compared with what was measured (default: even).
    """
    test = train = predicted = None
    if scan is not None:
        data_range = intensity_range(scan.train().frames)
        lit = np.ones((len(scan), 1, 1), dtype=np.float32) if light is None else light
        fitted = render_object(obj, scan.train().exposures, oversample, backend) * lit[~scan.is_test]
        train = image_scores(known(fitted, scan.train()), scan.train().frames, data_range)
        if len(scan.test()):
            predicted = render_object(obj, scan.test().exposures, oversample, backend) * lit[scan.is_test]
            test = image_scores(known(predicted, scan.test()), scan.test().frames, data_range)
    volume = None if truth is None else volume_scores(obj.voxelise(truth.grid), truth)
    return Scores(test, train, volume, predicted)


def known(predicted: np.ndarray, measured: Scan) -> np.ndarray:
    """Predicted frames [V, H, W] with the values of those measured in missing pixels, which score nothing so."""
    return predicted if measured.missing is None else np.where(measured.missing, measured.frames, predicted)


def material_found(found: Stored, kind: MatterKind = "levels") -> MaterialFound:
    """The materials that the object is made of, where they fill it; else what its volume says about the matter: where
    δ and β are free, and where one material of continuous density is a unit of δ alone."""
    matter = found.matter
    if matter.occupancies and not (matter.single and kind == "continuous"):
        return MaterialFound(matter.delta, matter.channels[0].ratio, matter.single, matter.others)
    volume = found.voxelise(found.enclosing_grid(MOST_VOXELS))
    size = np.abs(volume.delta)
    level = plateau(torch.from_numpy(size)) if size.any() else 0.0
    level = math.copysign(level, volume.delta.sum(dtype=np.float64))
    if matter.single:
        return MaterialFound(level, matter.channels[0].ratio, True)
    dense = size >= 0.5 * abs(level)
    ratio = size[dense] / np.maximum((np.sign(volume.delta) * volume.beta)[dense], 1e-30)
    return MaterialFound(level, _weighted_median(ratio, size[dense].astype(np.float64)), False)


def _as_text(delta: float, beta: float) -> str:
    return f"δ {delta:.3e}, " + (f"δ/β {delta / beta:.0f}" if beta else "no β seen")


def _as_dict(delta: float, ratio: float) -> dict[str, float | None]:
    return {"delta": delta, "ratio": ratio if np.isfinite(ratio) else None}


def _require_energy(reconstruction: Reconstruction, exposures: Exposures) -> None:
    energy, found = reconstruction.energy_kev, exposures.reference_energy
    require(
        abs(found / energy - 1) < 1e-3,
        f"the run's δ and β are those at {energy:g} keV, but the scan's energy is {found:g} keV.",
    )


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])
