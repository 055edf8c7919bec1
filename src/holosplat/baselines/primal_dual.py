"""Total-variation tomography with a box on the values, by a preconditioned primal–dual method."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..backends import implementation
from ..projectors.voxels import Projector


class PrimalDual:
    """`min_u ½‖A u - b‖² + λ Σ|∇u|` with `lower ≤ u ≤ upper`, warm-started from call to call; float32.

    Chambolle & Pock (2011), algorithm 1, with the diagonal steps of Pock & Chambolle (2011), eq. 10 (α = 1).
    `coupling` scales the gradient operator against the projector and changes only how fast it converges.
    Lengths are in voxels or pixels, as the projector has them; `upper=None` bounds from below only, `lower=-inf` not at
    all.
    """

    def __init__(
        self,
        projector: Projector,
        start: Tensor,
        weight: float,
        upper: float | None,
        coupling: float = 1.0,
        backend: str = "cpu",
        lower: float = 0.0,
    ) -> None:
        self._backend = backend
        self._steps = implementation(f"{__package__}.tv_steps", backend)
        self.projector, self.coupling = projector, coupling
        self.radius = weight / coupling
        self.bounds = (lower, float("inf") if upper is None else upper)
        self._array = projector.volume_in(start).float().contiguous().clone()
        path = projector.project(torch.ones_like(self._array)).clamp_min(1e-3)
        self._dual_step = 1 / path
        self._primal_step = 1 / (projector.backproject(torch.ones_like(path)) + 6 * coupling)
        self._extrapolated = self._array.clone()
        self._residual_dual = torch.zeros_like(path)
        self._gradient_dual = self._array.new_zeros(3, *self._array.shape)
        self._damping: Tensor | None = None
        self._softening = 1 + self._dual_step
        self._inside: Tensor | None = None
        self._still: StillLight | None = None

    @property
    def volume(self) -> Tensor:
        """The volume [Z, Y, X] as it is now."""
        return self.projector.volume_out(self._array)

    def lines(self) -> Tensor:
        """Line integrals [V, H, W] of the volume as it is now."""
        return self.projector.lines_out(self.projector.project(self._array))

    def on_finer(self, projector: Projector, factor: int, weight: float) -> PrimalDual:
        """A solver on voxels and pixels `factor` times finer, those of `projector`, which goes on from this one.

        It takes over the volume (interpolated), the bounds, and the dual of total variation, without which its first
        iterations would blur what is there; the residuals' dual starts anew, and with all frequencies trusted alike.
        """
        volume, dual = self.volume, self._gradient_dual
        if factor > 1:
            volume = interpolate(volume[None, None], scale_factor=factor, mode="trilinear", align_corners=False)[0, 0]
            for axis in (1, 2, 3):
                dual = dual.repeat_interleave(factor, axis)
        lower, upper = self.bounds
        finer = PrimalDual(projector, volume, weight, upper, self.coupling / factor**2, self._backend, lower)
        finer._gradient_dual.copy_(dual * factor**2)
        return finer

    def discount(self, spectrum: Tensor) -> None:
        """From now on trust frequencies of the lines by `spectrum`: the data term is `½ Σ |F[A u - b]|² / spectrum`.

        spectrum: positive, broadcast to `rfft2` (unitary) of lines in the projector's order; 1 is how it begins.
        All rays then have one dual step, the shortest: the proximal map is diagonal in frequency.
        """
        self._dual_step = self._dual_step.min()
        self._damping = 1 / (1 + self._dual_step * spectrum)

    def weigh(self, weights: Tensor) -> None:
        """From now on the data term is `½ Σ w (A u - b)²`, w > 0 for each ray [V, H, W]; 1 is how it begins."""
        self._softening = 1 + self._dual_step / self.projector.lines_in(weights)

    def set_weight(self, weight: float) -> None:
        """From now on λ is `weight`."""
        self.radius = weight / self.coupling

    def keep_inside(self, inside: Tensor) -> None:
        """From now on the volume is zero but for the voxels `inside` [Z, Y, X] bool."""
        self._inside = self.projector.volume_in(inside.float())

    def with_still_light(self, modes: Tensor) -> None:
        """From now on the lines may hold any sum of `modes` [K, H, W] that is the same in all views: still light.

        The data term is its least over such sums. `weigh` and the steps' lengths must be settled before.
        """
        self._still = StillLight(self, modes)

    def still_light(self, images: Tensor) -> Tensor:
        """What all line integrals [V, H, W] hold beside the volume, of the modes of `with_still_light`: [H, W]."""
        if self._still is None:
            return images.new_zeros(images.shape[1:])
        return self._still.of(images - self.lines())

    def completed(self, images: Tensor, gaps: Tensor | None) -> Tensor:
        """Line integrals [V, H, W], in the `gaps` [V, H, W] bool those of the volume."""
        return images if gaps is None else torch.where(gaps, self.lines(), images)

    def run(self, images: Tensor, iterations: int, gaps: Tensor | None = None) -> None:
        """`iterations` more steps towards the volume that explains the line integrals [V, H, W], of which those in
        the `gaps` have no weight."""
        lines = self.projector.lines_in(images)
        for _ in range(iterations):
            self._iterate(lines if gaps is None else self.projector.lines_in(self.completed(images, gaps)))

    def _iterate(self, lines: Tensor) -> None:
        difference = self.projector.project(self._extrapolated) - lines
        ascended = self._residual_dual + self._dual_step * difference
        if self._damping is None:
            self._residual_dual = ascended / self._softening
            if self._still is not None:
                self._still.take_out_of(self._residual_dual)
        else:
            spectrum = torch.fft.rfft2(ascended, norm="ortho") * self._damping
            self._residual_dual = torch.fft.irfft2(spectrum, s=ascended.shape[-2:], norm="ortho")
        # σ = 1 / (2 coupling) for the gradient's rows, so that σ · coupling = ½
        self._steps.ascend(self._extrapolated, self._gradient_dual, 0.5, self.radius)
        slope = self.projector.backproject(self._residual_dual)
        tau, arrays = self._primal_step, (self._array, self._extrapolated)
        self._steps.descend(slope, tau, self._gradient_dual, self.coupling, self.bounds, *arrays)
        if self._inside is not None:
            for array in arrays:
                array.mul_(self._inside)


class StillLight:
    """Smooth light that is the same in all views, as an unknown of a `PrimalDual` that needs no steps of its own.

    With residuals r and weights w the data term is `min_c ½ Σ w (r - M c)²`, M the modes in every view. Its conjugate
    is that of `½ Σ w r²`, and infinite but for duals q with `Mᵀ q = 0`. So the proximal map in the metric of the steps
    σ is that without light, `q / s` with `s = 1 + σ/w`, less `(σ/s) M c`, where c makes `Mᵀ q` vanish.
    """

    def __init__(self, solver: PrimalDual, modes: Tensor) -> None:
        self._projector, self._modes = solver.projector, modes.flatten(1).double()
        self._shape = modes.shape[1:]
        path, softening = 1 / solver._dual_step, solver._softening.expand_as(solver._residual_dual)
        trust = 1 / (path.expand_as(softening) * softening)
        self._trust = solver.projector.lines_out(trust)
        count = self._trust.double().sum(dim=0).flatten()
        self._inverse = torch.linalg.pinv((self._modes * count) @ self._modes.T)
        means = torch.full_like(count, len(self._trust))
        self._plain = torch.linalg.pinv((self._modes * means) @ self._modes.T)

    def of(self, lines: Tensor) -> Tensor:
        """The sum of modes [H, W] that is nearest to lines [V, H, W] in the mean."""
        total = lines.double().sum(dim=0).flatten()
        return ((self._plain @ (self._modes @ total)) @ self._modes).reshape(self._shape).float()

    def take_out_of(self, dual: Tensor) -> None:
        """Make the sum over views of the duals, in the projector's order, orthogonal to all modes; in place."""
        total = self._projector.lines_out(dual).double().sum(dim=0).flatten()
        light = ((self._inverse @ (self._modes @ total)) @ self._modes).reshape(self._shape).float()
        dual.sub_(self._projector.lines_in(self._trust * light))
