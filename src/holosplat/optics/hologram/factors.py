"""The gradient of a separable filter's factors, from which the fast backends compute the gradients of distance and
blur."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import pad


def factor_gradients(arrived: Tensor, passed: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the factors rows r [V, H] and columns c [V, W] of a filter `out = F⁻¹(r c F(in))` of images.

    passed: the spectrum F(in), not scaled, [V, H, W], or as `rfft2` gives it, [V, H, W // 2 + 1]; arrived: the spectrum
    of the gradient of `out`, likewise. With N samples, `∂L/∂r_y = Σ_x a conj(p c) / N` and likewise for c. The gradient
    of a complex number holds the gradients of its real and imaginary parts; the gradient of a real factor is real.
    """
    height, width, kept = rows.shape[1], columns.shape[1], passed.shape[2]
    product = arrived * passed.conj() / (height * width)
    if kept < width:  # each frequency within stands for its mirror image as well
        product[:, :, 1 : (width + 1) // 2] *= 2
    of_rows = (product * columns[:, None, :kept].conj()).sum(2)
    of_columns = pad((product * rows[:, :, None].conj()).sum(1), (0, width - kept))
    if rows.is_complex():
        return of_rows, of_columns
    return of_rows.real, of_columns.real


def through_correction(
    arrived: Tensor, passed: Tensor, factors: Tensor, correction: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Of a filter by factors and a correction h, both [V, H, W]: the spectrum `passed h`, with which the gradients of
    the factors are those of a filter without one, and the gradient of h. Without one the spectrum as it is, and None.
    """
    if correction is None:
        return passed, None
    count = passed.shape[1] * passed.shape[2]
    return passed * correction, arrived * (passed * factors).conj() / count
