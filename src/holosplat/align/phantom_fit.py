"""Least squares of all numbers of a calibration: those of each view, the places of beads, and the size of a pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..matter import DeltaBeta
from ..model import Alignment, Instrument
from ..scan import Exposures
from ..volume import LineIntegrals
from .derivatives import NUMBERS
from .newton import blurred
from .phantom import Phantom

STEPS = (0.05, 0.05, 1e-3, 1e-3, 1e-3)
"""Small changes of shifts [pixels] and turns [rad] by which derivatives are taken."""
STRETCH = 5e-3
"""The same for the logarithms of the distance and of the pixel size."""
NUDGE = 0.05
"""The same for the place of a bead [pixels]."""


@dataclass(frozen=True)
class Linear:
    """Frames [V, H, W] of a phantom, and their derivatives: of_views [V, 8, H, W] by the `NUMBERS` of each view (zero
    by the magnification, for there is one of all), of_all [K, V, H, W] by the places of free bodies [pixels] and, last,
    the logarithm of the pixel size."""

    frames: Tensor
    of_views: Tensor
    of_all: Tensor


def linearised(phantom: Phantom, exposures: Exposures, material: DeltaBeta, oversample: int, pixel: bool) -> Linear:
    """The frames in `exposures` and their derivatives, by differences; pixel: whether that by its size is asked for."""
    instrument, pitch = Instrument(exposures, oversample), exposures.views.pixel_size
    matter, count = phantom.surfaces(material, pitch), len(exposures)
    lines = matter.project(instrument.poses)

    def seen(channels: Tensor, through: Instrument = instrument) -> Tensor:
        return through.frames(LineIntegrals(channels, lines.materials)).detach().double()

    here = seen(lines.channels)
    columns = []
    for k, step in enumerate(STEPS):
        name, width = ("shifts", 2) if k < 2 else ("turns", 3)
        changed = torch.zeros(count, width, dtype=torch.float64)
        changed[:, k if k < 2 else k - 2] = step
        poses = Alignment(**{name: changed}).poses(instrument.poses, pitch)
        columns.append((seen(matter.project(poses).channels) - here) / step)
    farther = Instrument(replace(exposures, distance=exposures.distance * math.exp(STRETCH)), oversample)
    columns += [(seen(lines.channels, farther) - here) / STRETCH, torch.zeros_like(here), here]
    others = []
    for n in range(len(phantom) if phantom.free else 0):
        before = phantom.surfaces(material, pitch, [n]).project(instrument.poses).channels
        for k in range(3):
            by = np.zeros((len(phantom), 3))
            by[n, k] = NUDGE * pitch
            after = phantom.shifted(by).surfaces(material, pitch, [n]).project(instrument.poses).channels
            others.append((seen(lines.channels + after - before) - here) / NUDGE)
    if pixel:
        views = replace(exposures.views, pitch=pitch * math.exp(STRETCH))
        views = replace(views, shifts=views.shifts * math.exp(STRETCH))
        larger = Instrument(replace(exposures, views=views), oversample)
        there = phantom.surfaces(material, views.pixel_size).project(larger.poses)
        others.append((larger.frames(there).detach().double() - here) / STRETCH)
    together = torch.stack(others) if others else torch.zeros(0, *here.shape, dtype=torch.float64)
    return Linear(here, torch.stack(columns, dim=1), together)


@dataclass(frozen=True)
class Solution:
    """of_views: [V, 8] and of_all: [K] after a step; covariances: [K + 8 V] squared, those of all first."""

    of_views: Tensor
    of_all: Tensor
    covariances: Tensor


def solved(
    measured: Tensor, found: Linear, numbers: tuple[Tensor, Tensor], expected: tuple[Tensor, Tensor], blur: float
) -> Solution:
    """One Gauss–Newton step of all numbers together, damped by what is expected of them.

    measured: [V, H, W]; numbers: of views [V, 8] and of all [K], now; expected: [8] and [K] standard deviations about
    zero, 0 for those that stay. The noise of a view is what it leaves unexplained after a Gaussian of `blur` [pixels].
    """
    views, count = len(measured), len(numbers[1])
    missing = blurred(measured.double() - found.frames, blur).flatten(1)
    of_views = blurred(found.of_views, blur).flatten(2)
    of_all = (blurred(found.of_all, blur) if count else found.of_all).flatten(2)
    independent = 1 / (4 * math.pi * blur**2)
    scale = independent / missing.square().mean(1).clamp_min(1e-18)
    size = count + len(NUMBERS) * views
    information, slope = torch.zeros(size, size, dtype=torch.float64), torch.zeros(size, dtype=torch.float64)
    information[:count, :count] = torch.einsum("kvp,lvp,v->kl", of_all, of_all, scale)
    slope[:count] = torch.einsum("kvp,vp,v->k", of_all, missing, scale)
    for v in range(views):
        at = slice(count + len(NUMBERS) * v, count + len(NUMBERS) * (v + 1))
        information[at, at] = scale[v] * of_views[v] @ of_views[v].T
        information[:count, at] = scale[v] * of_all[:, v] @ of_views[v].T
        information[at, :count] = information[:count, at].T
        slope[at] = scale[v] * of_views[v] @ missing[v]
    flat = torch.cat([numbers[1], numbers[0].flatten()])
    deviations = torch.cat([expected[1], expected[0].repeat(views)])
    free = torch.nonzero(deviations > 0)[:, 0]
    prior = deviations[free] ** -2
    covariance = torch.linalg.inv(information[free[:, None], free] + torch.diag(prior))
    after = flat.clone()
    after[free] += covariance @ (slope[free] - prior * flat[free])
    whole = torch.zeros(size, size, dtype=torch.float64)
    whole[free[:, None], free] = covariance
    return Solution(after[count:].reshape(views, len(NUMBERS)), after[:count], whole)
