"""The view in three dimensions of a run."""

from __future__ import annotations

import numpy as np
import torch

from ...representations import MovingSurfaces, Stored
from ...scan import Scan
from ...units import wavenumber
from ...volume import Volume
from ..content import view_labels
from ..style import data_uri, new_figure, styled
from .parts import SLICE_BYTES, VOLUME_BYTES, part_of, volume_part
from .view import View3D, raster_of

ENDS = (0.2, 99.8)
"""Percentiles of the frames between which the grey scale lies."""


def view_of(obj: Stored, volume: Volume, truth: Volume | None, scan: Scan, delta_told: bool = True) -> View3D:
    """What can be turned of `obj`, whose `volume` (and `truth`, where known) also gives the slices.

    volume, truth: of the middle time where something moves.
    """
    exposures = scan.exposures[np.array([0])]
    _, _, pixel = raster_of(*exposures.views.shape, exposures.views.pitch)
    times = np.unique(scan.exposures.time) if isinstance(obj, MovingSurfaces) else None
    shift = first_phase(obj, scan) * (1.0 if delta_told else 2.0)  # without δ, which is β then: the absorption 2k∫β
    sign = obj.matter.channels[0].sign
    shown = {"reconstruction": volume} | ({} if truth is None else {"truth": truth})
    parts = {"reconstruction": part_of(obj, volume, pixel, times)}
    if truth is not None and times is None:
        parts["truth"] = volume_part(truth, pixel, VOLUME_BYTES)
    low, high = np.percentile(scan.train().frames if len(scan.train()) else scan.frames, ENDS)
    return View3D(
        parts=parts,
        slices={name: volume_part(v, pixel, SLICE_BYTES) for name, v in shown.items()},
        exposures=exposures,
        views=scan.views,
        labels=view_labels(scan.views),
        grey=(float(low), float(max(high, low + 1e-6))),
        top=sign * (float(np.percentile(sign * shift, ENDS[1])) or 1.0),
        picture=still(shift, sign),
        delta_told=delta_told,
    )


def first_phase(obj: Stored, scan: Scan) -> np.ndarray:
    """k∫δ [H, W] [rad] in the first view."""
    exposures = scan.exposures[np.array([0])]
    with torch.no_grad():
        _, delta = obj.project(exposures.views)
    return float(wavenumber(exposures.energy_kev)[0]) * delta[0].numpy()


@styled
def still(phase: np.ndarray, sign: float = 1.0) -> str:
    """The picture that stands where the view cannot be turned, as a `data:` URI; sign: that of the matter's δ."""
    rows, columns = phase.shape
    figure = new_figure(2.4, 2.4 * rows / columns, layout="none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(sign * phase, cmap="magma", vmin=0.0)
    axes.axis("off")
    return data_uri(figure, "png")
