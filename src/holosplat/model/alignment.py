"""Corrections of the planned exposures, as parameters that can be fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..checks import require
from ..geometry import Poses
from ..scan import Exposures

WIDTHS: dict[str, tuple[int, ...]] = {
    "turns": (3,),
    "shifts": (2,),
    "stretches": (),
    "blurs": (),
    "magnified": (),
    "energies": (),
    "bandwidths": (),
}
"""The corrections by name, and how many numbers each view has of them."""


@dataclass(frozen=True)
class Alignment:
    """Corrections of V planned exposures, float64; None costs nothing, and zeros leave the plan as it is.

    turns: [V, 3] rotation vectors ω [rad] about the lab axes: `R' = exp([ω]×) R`
    shifts: [V, 2] shifts e of the detector along x and y [pixels p of the view]: `s' = s + p e`
    stretches: [V] changes ε of the propagation distance, as a share of it: `z' = z (1 + ε)`
    blurs: [V] changes b of the width of the point-spread function [pixels]: `σ' = |σ + b|`
    magnified: [V] changes m of the magnification, as a share of it: the pixel in the sample's plane is `p / (1 + m)`
    energies: [V] changes e of the photon energy, as a share of it: `E' = E (1 + e)`
    bandwidths: [V] changes b of the relative bandwidth: `ΔE/E' = |ΔE/E + b|`

    The signs are those of `beamline.misalignment`. Errors: `InputError` for shapes that do not fit together.
    """

    turns: Tensor | None = None
    shifts: Tensor | None = None
    stretches: Tensor | None = None
    blurs: Tensor | None = None
    magnified: Tensor | None = None
    energies: Tensor | None = None
    bandwidths: Tensor | None = None

    def __post_init__(self) -> None:
        shapes = {name: tuple(p.shape) for name, p in self.parameters().items()}
        wanted = {name: (len(self), *WIDTHS[name]) for name in shapes}
        require(shapes == wanted, f"an alignment of {len(self)} views needs the shapes {wanted}, but got {shapes}.")

    @classmethod
    def planned(cls, count: int, *names: str, device: torch.device | str = "cpu") -> Alignment:
        """No correction yet of `count` exposures, with room for those called `names`; `InputError` for other names."""
        unknown = sorted(set(names) - set(WIDTHS))
        require(not unknown, f"an alignment corrects {', '.join(WIDTHS)}, but {', '.join(unknown)} is asked for.")
        return cls(**{n: torch.zeros(count, *WIDTHS[n], dtype=torch.float64, device=device) for n in names})

    def __len__(self) -> int:
        return max((len(p) for p in self.parameters().values()), default=0)

    def parameters(self) -> dict[str, Tensor]:
        """The corrections by name."""
        return {name: tensor for name in WIDTHS if (tensor := getattr(self, name)) is not None}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Alignment:
        """The alignment with other corrections in the place of those named."""
        return replace(self, **dict(parameters))

    @property
    def moves_waves(self) -> bool:
        """Whether waves travel otherwise than planned."""
        return self.stretches is not None or self.magnified is not None

    def poses(self, planned: Poses, pixel: float, index: Tensor | None = None) -> Poses:
        """The `planned` poses of all views, corrected; only those of `index` [K] if it is given.

        pixel: the detector's pitch [m], whatever raster the poses are on; scales of the views come on top.
        """
        chosen = planned if index is None else planned[index]
        rotations, shifts, scales = chosen.rotations, chosen.shifts, chosen.scales
        if self.turns is not None:
            rotations = rotation_matrices(_picked(self.turns, index)) @ rotations
        if self.shifts is not None:
            moved = pixel * _picked(self.shifts, index)
            shifts = shifts + (moved if scales is None else moved * scales[:, None])
        if self.magnified is not None:
            larger = 1 + _picked(self.magnified, index)
            scales = 1 / larger if scales is None else scales / larger
        return replace(chosen, rotations=rotations, shifts=shifts, scales=scales)

    def distance(self, planned: Exposures, index: Tensor | None = None) -> Tensor | None:
        """Propagation distances [K] [m], float64; None where they are as planned."""
        return None if self.stretches is None else self._stretched(planned.distance, index)

    def optical_distance(self, planned: Exposures, index: Tensor | None = None) -> Tensor | None:
        """Distances [K] [m] on pixels of the views' pitch (`Exposures.optical`), float64; None: as planned.

        Of z and the pixel waves know only z/p²: magnified frames look like those of a distance (1 + m)² longer.
        """
        if not self.moves_waves:
            return None
        distance = self._stretched(planned.optical.distance, index)
        return distance if self.magnified is None else distance * (1 + _picked(self.magnified, index)) ** 2

    def _stretched(self, distance: np.ndarray, index: Tensor | None) -> Tensor:
        like = next(iter(self.parameters().values()))
        lengths = _picked(torch.from_numpy(distance).to(like), index)
        return lengths if self.stretches is None else lengths * (1 + _picked(self.stretches, index))

    def psf_sigma_px(self, planned: Exposures, index: Tensor | None = None) -> Tensor | None:
        """Widths [K] of the point-spread functions [pixels], float64; None where they are as planned."""
        if self.blurs is None:
            return None
        blurs = _picked(self.blurs, index)
        return (_picked(torch.from_numpy(planned.psf_sigma_px).to(blurs), index) + blurs).abs()

    def light(self, planned: Exposures, index: Tensor | None = None) -> tuple[Tensor | None, Tensor | None] | None:
        """Energies [K] over the planned ones, and bandwidths [K], float64, as `Instrument.frames` takes them.

        None: as planned."""
        if self.energies is None and self.bandwidths is None:
            return None
        widths = None
        if self.bandwidths is not None:
            changes = _picked(self.bandwidths, index)
            widths = (_picked(torch.from_numpy(planned.bandwidth).to(changes), index) + changes).abs()
        return None if self.energies is None else 1 + _picked(self.energies, index), widths

    def exposures(self, planned: Exposures) -> Exposures:
        """The `planned` exposures, corrected."""
        on = next((p.device for p in self.parameters().values()), "cpu")
        with torch.no_grad():
            poses = self.poses(Poses.of(planned.views, on), planned.views.pitch)
            distance, sigma = self.distance(planned), self.psf_sigma_px(planned)
            energy, bandwidth = self.light(planned) or (None, None)
        return replace(
            planned,
            views=poses.views(),
            distance=planned.distance if distance is None else distance.cpu().numpy(),
            psf_sigma_px=planned.psf_sigma_px if sigma is None else sigma.cpu().numpy(),
            energy_kev=planned.energy_kev if energy is None else planned.energy_kev * energy.cpu().numpy(),
            reference_kev=planned.reference_kev if energy is None else planned.reference_energy,
            bandwidth=planned.bandwidth if bandwidth is None else bandwidth.cpu().numpy(),
        )


def _picked(values: Tensor, index: Tensor | None) -> Tensor:
    return values if index is None else values.index_select(0, index)


def rotation_matrices(vectors: Tensor) -> Tensor:
    """`exp([ω]×)` [V, 3, 3] of rotation vectors [V, 3] [rad], smooth at zero (Rodrigues' formula)."""
    x, y, z = vectors.unbind(1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    angle = (vectors.square().sum(dim=1) + torch.finfo(vectors.dtype).tiny).sqrt()[:, None, None] / torch.pi
    first, second = torch.sinc(angle), 0.5 * torch.sinc(0.5 * angle).square()
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + first * cross + second * (cross @ cross)
