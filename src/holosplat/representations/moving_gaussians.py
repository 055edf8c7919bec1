"""Gaussians that a flow carries, rotates and stretches, as an Object; their principal axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..checks import positive, require
from ..display import of_object
from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..projectors.splat.reference import rotation_matrices
from ..volume import LineIntegrals, Volume
from .flow import Flow, TimeBasis
from .gaussians import PARAMETERS, GaussianCloud

ALIKE = 1e-3
"""Relative difference of two variances below which a turn within their plane gives a gradient no longer: it changes
nothing there."""


def quaternions_of(turns: Tensor) -> Tensor:
    """Quaternions [N, 4] `(w, x, y, z)` of rotation matrices [N, 3, 3], of length one.

    Of the four ways to divide, the one with the largest divisor (Shepperd 1978, J. Guidance and Control 1, 223).
    """
    m = turns.double()
    trace = m.diagonal(dim1=1, dim2=2).sum(1)
    squares = torch.stack([1 + trace, *(1 - trace + 2 * m[:, k, k] for k in range(3))], 1)
    off = torch.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    sums = torch.stack([m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]], 1)
    a, b, c = off.unbind(1)
    p, q, r = sums.unbind(1)
    s = squares.unbind(1)
    rows = torch.stack(
        [
            torch.stack([s[0], a, b, c], 1),
            torch.stack([a, s[1], p, q], 1),
            torch.stack([b, p, s[2], r], 1),
            torch.stack([c, q, r, s[3]], 1),
        ],
        1,
    )
    best = rows[torch.arange(len(m), device=m.device), squares.argmax(1)]
    return (best / best.norm(dim=1, keepdim=True)).to(turns)


def principal_axes(shapes: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithms of the semi-axes [N, 3] and quaternions [N, 4] of Gaussians of the covariance `M Mᵀ`, M [N, 3, 3].

    Differentiable: a change dΣ changes a length by `uᵀ dΣ u / 2s²`, and turns two axes in their plane by
    `uᵀ dΣ v / (s_v² - s_u²)` (perturbation of eigenvectors).
    """
    covariance = shapes @ shapes.mT
    return _Principal.apply(covariance)  # type: ignore[no-any-return]


class _Principal(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, covariance: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        values, axes = torch.linalg.eigh(covariance.detach().double())
        axes = axes * torch.linalg.det(axes).sign()[:, None, None]
        quaternions = quaternions_of(axes)
        ctx.save_for_backward(values, axes, quaternions)
        return 0.5 * values.clamp_min(1e-300).log().to(covariance), quaternions.to(covariance)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_logs: Tensor, by_quaternions: Tensor) -> Tensor:  # type: ignore[override]
        values, axes, q = ctx.saved_tensors
        g = by_quaternions.double()
        w, x, y, z = q.double().unbind(1)
        a, b, c, d = g.unbind(1)
        # A small turn ω about the Gaussian's own axes is q ∘ (1, ω/2).
        turns = 0.5 * torch.stack(
            [
                -x * a + w * b + z * c - y * d,
                -y * a - z * b + w * c + x * d,
                -z * a + y * b - x * c + w * d,
            ],
            1,
        )
        own = torch.diag_embed(by_logs.double() / (2 * values))
        for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            apart = values[:, j] - values[:, i]
            softened = apart**2 + (ALIKE * (values[:, i] + values[:, j])) ** 2
            part = 0.5 * turns[:, k] * apart / softened
            own[:, i, j] += -part
            own[:, j, i] += -part
        return (axes @ own @ axes.mT).to(by_logs)


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
