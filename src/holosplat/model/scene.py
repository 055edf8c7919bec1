"""`Model`: matter, poses, wave optics and light in, frames out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..checks import require
from ..geometry import Poses, Views
from ..optics.background import DARKEST, Background
from ..optics.patterns import posterior_covariance
from ..scan import Exposures
from ..volume import Component, LineIntegrals, Object, TrainableObject
from .alignment import Alignment
from .instrument import Instrument


@dataclass(frozen=True)
class LightField:
    """A factor of each of V frames: `exp(Σ c_k m_k)`, above zero everywhere; coefficients of zero are even light.

    coefficients: [V, K] numbers c, those that can be fitted
    modes: [K, h, w] images m, the same for all frames

    Errors: `InputError` if the counts differ.
    """

    coefficients: Tensor
    modes: Tensor

    def __post_init__(self) -> None:
        fits = self.coefficients.ndim == 2 and self.modes.ndim == 3
        require(
            fits and self.coefficients.shape[1] == len(self.modes),
            f"a light field needs coefficients (V, K) and modes (K, h, w), but "
            f"has {tuple(self.coefficients.shape)} and "
            f"{tuple(self.modes.shape)}.",
        )

    @classmethod
    def even(cls, count: int, modes: Tensor) -> LightField:
        """Even light in `count` frames, which `modes` [K, h, w] can change."""
        return cls(modes.new_zeros(count, len(modes)), modes)

    def parameters(self) -> dict[str, Tensor]:
        """The coefficients, by name."""
        return {"coefficients": self.coefficients}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> LightField:
        """The same modes with other coefficients."""
        return replace(self, coefficients=parameters.get("coefficients", self.coefficients))

    def __len__(self) -> int:
        return len(self.coefficients)

    def factor(self, index: Tensor | None = None, images: Tensor | None = None) -> Tensor:
        """The factor [V, h, w] of all frames, or of those of `index`, whatever even light gives as `images`."""
        chosen = self.coefficients if index is None else self.coefficients.index_select(0, index)
        return torch.einsum("vk,khw->vhw", chosen, self.modes).exp()


class SolvedLight:
    """The factor of each of V frames that explains best what matter in even light does not: it has no parameters.

    In every step its coefficients c solve `(MᵀM/p + T⁻¹) c = Mᵀ log(measured / images) / p - T⁻¹ b`: a ridge regression
    on the modes M, for noise of power p at their frequencies, and a prior of variances T about -b where the frames were
    divided by `exp(Σ b m)` before. The light is thus eliminated ("variable projection", Golub & Pereyra 1973), and
    gradients by the matter are right without going through it, for c is at its optimum. Air shows the light whatever
    matter is predicted there: faint matter all over the field would otherwise pass for light, and light for it.
    """

    def __init__(self, background: Background, measured: Tensor, air: Tensor | None = None) -> None:
        """background: the light that the frames `measured` [V, h, w] were divided by, on whose device this computes;
        air: where they show no matter [V, h, w] bool (None: nowhere)."""
        on = measured.device
        modes = background.modes()
        flat = modes.double().flatten(1)
        gain = posterior_covariance((flat @ flat.T)[None], background.variances, background.powers)
        self._modes, self._measured = modes.to(on), measured
        self._air = torch.zeros_like(measured, dtype=torch.bool) if air is None else air.to(on)
        self._gain = (gain / background.powers[:, None, None]).float().to(on)
        pull = background.coefficients / background.variances.clamp_min(torch.finfo(torch.float64).tiny)
        self._before = torch.einsum("vkl,vl->vk", gain, pull).float().to(on)

    def __len__(self) -> int:
        return len(self._measured)

    def coefficients(self, images: Tensor, index: Tensor | None = None) -> Tensor:
        """The coefficients [V, K] beside `images` [V, h, w] of even light, of all frames or of those of `index`."""
        measured, air, gain, before = self._measured, self._air, self._gain, self._before
        if index is not None:
            measured, air, gain, before = (part.index_select(0, index) for part in (measured, air, gain, before))
        images = torch.where(air, 1.0, images.detach())
        seen = (measured > DARKEST) & (images > DARKEST)
        ratio = torch.where(seen, measured.clamp_min(DARKEST) / images.clamp_min(DARKEST), 1.0).log()
        right = torch.einsum("vhw,khw->vk", ratio, self._modes)
        return torch.einsum("vkl,vl->vk", gain, right) - before

    def settled(self, images: Tensor) -> LightField:
        """The light beside `images` [V, h, w] of even light, as numbers."""
        return LightField(self.coefficients(images).detach(), self._modes)

    def factor(self, index: Tensor | None = None, images: Tensor | None = None) -> Tensor:
        """The factor [V, h, w] beside `images` of even light; one without any."""
        if images is None:
            return torch.ones_like(self._measured if index is None else self._measured[index])
        return torch.einsum("vk,khw->vhw", self.coefficients(images, index), self._modes).exp()


PARTS = ("object", "alignment", "light")
"""The parts of a model that may have parameters."""


@dataclass(frozen=True)
class Model:
    """Everything that a set of exposures depends on; its parameters are named `part.parameter`.

    object: the matter
    instrument: the planned exposures and their wave optics
    alignment: corrections of where the beams are; None for none
    light: a factor of each frame; None for even light

    Errors: `InputError` if alignment or light are of another number of exposures.
    """

    object: Object
    instrument: Instrument
    alignment: Alignment | None = None
    light: LightField | SolvedLight | None = None

    def __post_init__(self) -> None:
        count = len(self.instrument.views)
        for name, part in (("alignment", self.alignment), ("light", self.light)):
            require(
                part is None or len(part) == count,
                f"the {name} of a model must be of all its {count} exposures; make it anew for them.",
            )

    @property
    def capturable(self) -> bool:
        """Whether frames are made on the device alone: those of one time, at the planned distances and blurs."""
        alignment = self.alignment
        optics = ("blurs", "energies", "bandwidths")
        moved = alignment is not None and any(getattr(alignment, name) is not None for name in optics)
        planned = alignment is None or not (alignment.moves_waves or moved)
        return planned and len(self.instrument.times) == 1

    def parameters(self) -> dict[str, Tensor]:
        """Every tensor that can be fitted, by the name `part.parameter`."""
        return {
            f"{part}.{name}": tensor
            for part in PARTS
            if isinstance(component := getattr(self, part), Component)
            for name, tensor in component.parameters().items()
        }

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Model:
        """The model with other tensors in the place of those named; `InputError` for a name that it does not have."""
        unknown = sorted(set(parameters) - set(self.parameters()))
        require(not unknown, f"the model has no parameter {', '.join(unknown)}; it has {', '.join(self.parameters())}.")
        changed: dict[str, Any] = {}
        for part in PARTS:
            own = {name.partition(".")[2]: p for name, p in parameters.items() if name.startswith(f"{part}.")}
            if own:
                changed[part] = getattr(self, part).with_parameters(own)
        return replace(self, **changed)

    def frames(self, index: Tensor | None = None, delay: float = 0.0) -> Tensor:
        """Frames [K, h, w] of the exposures `index` [K] (an integer tensor; None: all), of as many times as these have.

        delay: how long after each exposure's time [s] the matter is looked at.
        """
        times = self.instrument.times
        images = self._seen(float(times[0]) + delay, index) if len(times) == 1 else self._of_several_times(index, delay)
        return images if self.light is None else images * self.light.factor(index, images)

    def lines(self, time: float, index: Tensor | None = None) -> LineIntegrals:
        """Line integrals of the matter at `time` [s] on the instrument's raster, in the exposures `index`."""
        return self.lines_of(self.object.at(float(time)), index)

    def lines_of(self, matter: Object, index: Tensor | None = None) -> LineIntegrals:
        """Line integrals of `matter`, as it is, on the instrument's raster, in the exposures `index`."""
        if isinstance(matter, Component):  # it takes poses, which cost no time to make
            assert isinstance(matter, TrainableObject)
            return LineIntegrals.of_any(matter.project(self._poses(self.instrument.poses, index)))
        return LineIntegrals.of_any(matter.project(self._views(index)))

    def pixels(self, index: Tensor | None = None) -> Poses:
        """Places of the beams of the exposures `index` on the detector's pixels."""
        return self._poses(self.instrument.detector, index)

    @property
    def by_waves(self) -> bool:
        """Whether line integrals and waves make the frames (see `frames_of`)."""
        return frames_of.dispatch(type(self.object)) is frames_of.dispatch(object)

    def _seen(self, time: float, index: Tensor | None) -> Tensor:
        return frames_of(self.object.at(time), self, index)

    def _of_several_times(self, index: Tensor | None, delay: float) -> Tensor:
        every = np.arange(len(self.instrument.views))
        chosen = every if index is None else index.cpu().numpy()
        of = self.instrument.exposures.time[chosen]
        places = [np.flatnonzero(of == time) for time in np.unique(of)]
        device = self.instrument.device
        parts = [self._seen(float(of[at[0]]) + delay, torch.from_numpy(chosen[at]).to(device)) for at in places]
        return torch.cat(parts)[torch.from_numpy(np.argsort(np.concatenate(places))).to(device)]

    def _poses(self, planned: Poses, index: Tensor | None) -> Poses:
        if self.alignment is not None:
            return self.alignment.poses(planned, self.instrument.exposures.views.pitch, index)
        return planned if index is None else planned[index]

    def _views(self, index: Tensor | None) -> Views:
        if self.alignment is not None:
            return self._poses(self.instrument.poses, index).views()
        return self.instrument.views if index is None else self.instrument.views[index.cpu().numpy()]


@singledispatch
def frames_of(matter: Object, model: Model, index: Tensor | None) -> Tensor:
    """Frames [K, h, w] of `matter`, as it is, in the exposures `index` of `model`, without its light: line integrals
    through the waves. A kind of Object that frames show otherwise registers its own function."""
    lines, planned, alignment = model.lines_of(matter, index), model.instrument.exposures, model.alignment
    if alignment is None:
        return model.instrument.frames(lines, index)
    distance, sigma = alignment.optical_distance(planned, index), alignment.psf_sigma_px(planned, index)
    return model.instrument.frames(lines, index, distance, sigma, alignment.light(planned, index))


def measure(obj: Object, exposures: Exposures, oversample: int = 1, dtype: torch.dtype = torch.float32) -> Tensor:
    """Frames [N, H, W] (relative intensity) that `obj` gives in `exposures`, on waves `oversample` times finer."""
    return Model(obj, Instrument(exposures, oversample, dtype)).frames()
