"""Gaussians that a flow carries along, turning and stretching each, as an Object."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..checks import positive, require
from ..display import of_object
from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..projectors.splat.reference import rotation_matrices
from ..volume import LineIntegrals, Volume
from .flow import Flow
from .gaussians import PARAMETERS, GaussianCloud
from .paths import TimeBasis
from .principal import principal_axes

FLOW = "flow_"
"""What the names of the flow's tensors begin with among the parameters."""


class MovingGaussians:
    """A cloud of Gaussians at the reference time of a flow, which carries their centres and shapes along.

    At the time t a centre is where the flow takes it, and its covariance is `F Σ Fᵀ`, F the flow's Jacobian there; the
    determinant of F is one for a flow without sources, so that each keeps its volume and its amplitude. fading:
    [2, N] changes of the raw amplitudes, linear and square in time, of a length of the flow's basis from the reference
    on; or None, where Gaussians keep their amplitudes. The flow's unit of length is the cloud's. As it stands, the
    object is that of the first time. Errors: `InputError` if the arrays do not fit.
    """

    kind: ClassVar[str] = "moving-gaussians"
    """The name of this kind of Object in files."""
    _repr_html_ = of_object

    def __init__(self, cloud: GaussianCloud, flow: Flow, fading: Tensor | None = None) -> None:
        self.cloud, self.flow, self.fading = cloud, flow, fading
        self.matter, self.backend = cloud.matter, cloud.backend
        require(
            fading is None or tuple(fading.shape) == (2, len(cloud)),
            f"fading must have the shape (2, {len(cloud)}), one column a Gaussian, but it has "
            f"{None if fading is None else tuple(fading.shape)}.",
        )

    @property
    def unit_length(self) -> float:
        """The unit [m] of centres, scales and flow."""
        return self.cloud.unit_length

    @property
    def basis(self) -> TimeBasis:
        """That of the flow."""
        return self.flow.basis

    def __len__(self) -> int:
        return len(self.cloud)

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensors by name: those of the cloud, of the flow, and how amplitudes change."""
        flow = {FLOW + name: tensor for name, tensor in self.flow.parameters().items()}
        fading = {} if self.fading is None else {"fading": self.fading}
        return {**self.cloud.parameters(), **flow, **fading}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> MovingGaussians:
        """The same kind of motion with other tensors in the place of those named."""
        flow = {name.removeprefix(FLOW): tensor for name, tensor in parameters.items() if name.startswith(FLOW)}
        fading = parameters.get("fading", self.fading)
        return MovingGaussians(self.cloud.with_parameters(parameters), self.flow.with_parameters(flow), fading)

    def at(self, time: float) -> GaussianCloud:
        """The Gaussians as they are at `time` [s], between frames too."""
        cloud, flow = self.cloud, self.flow
        if time == flow.reference:
            return cloud
        centres, turned = flow.carried_with_jacobian(cloud.centres, flow.reference, float(time))
        log_scales, quaternions = principal_axes(
            turned @ (rotation_matrices(cloud.quaternions) * cloud.scales[:, None])
        )
        raw = cloud.raw_amplitudes
        if self.fading is not None:
            later = (time - flow.reference) / (flow.basis.last - flow.basis.first)
            raw = raw + (later * self.fading[0] + later**2 * self.fading[1])[:, None]
        return cloud.replaced((centres, log_scales, quaternions, raw))

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D) at the first time."""
        return self.at(self.flow.basis.first).project(views)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid` at the first time."""
        return self.at(self.flow.basis.first).voxelise(grid)

    def on(self, backend: str) -> MovingGaussians:
        """The same for another backend (resolved), on its device."""
        cloud = self.cloud.on(backend)
        moved = {name: tensor.to(cloud.centres.device) for name, tensor in self.flow.parameters().items()}
        fading = None if self.fading is None else self.fading.to(cloud.centres.device)
        return MovingGaussians(cloud, self.flow.with_parameters(moved), fading)

    @property
    def described(self) -> str:
        """How large it is, in words."""
        z, y, x = self.flow.lattice.counts
        basis = self.flow.basis
        of = f"degree {basis.degree}" + (f" in {basis.pieces} pieces" if basis.pieces > 1 else "")
        return f"{len(self)} Gaussians carried by a flow of {x} × {y} × {z} nodes and {of} in time"

    @property
    def stored_bytes(self) -> int:
        """Size of the parameters as a run folder stores them, float32."""
        return 4 * sum(p.numel() for p in self.parameters().values())

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """A grid around all centres at the first, the last and the reference time."""
        basis = self.flow.basis
        with torch.no_grad():
            clouds = [self.at(time).centres for time in (basis.first, self.flow.reference, basis.last)]
        return Grid.around(torch.cat(clouds).double().cpu().numpy(), self.unit_length, most_voxels)

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same of."""
        flow = self.flow.state()
        tensors = {FLOW + name: flow.pop(name) for name in self.flow.parameters()}
        fading = {} if self.fading is None else {"fading": self.fading}
        plain = {"unit_length": self.unit_length, "matter": self.matter.as_dict(), "flow": flow}
        return {**self.cloud.parameters(), **tensors, **fading, **plain}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> MovingGaussians:
        """What `state` described; `InputError` where it does not fit together."""
        unit = positive("unit_length", state["unit_length"], "metres")
        cloud = GaussianCloud([state[name] for name in PARAMETERS], unit, Matter.from_dict(state["matter"]))
        tensors = {name.removeprefix(FLOW): value for name, value in state.items() if name.startswith(FLOW)}
        return cls(cloud, Flow.from_state({**state["flow"], **tensors}), state.get("fading"))
