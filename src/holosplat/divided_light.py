"""What is not known of light that frames were divided by: handed on with them, for whoever tells it from matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .checks import finite, require, shaped


@dataclass(frozen=True)
class DividedLight:
    """Frames were divided by smooth light; what is left of it is `exp(Σ c m)`, and this is how sure c = 0 is.

    The K = (k + 1)² modes m are products of cosines of 0 to k half waves along the rows and columns of whole frames, of
    rms one (`optics.patterns.smooth_modes`).

    covariances: [N, K, K] of c: what the air of the frames leaves open
    variances: [N, K] expected squares of the coefficients of all light, before air is looked at
    powers: [N] power of the noise at low frequencies (white noise of variance s² on whole pixels has s²)
    whole: rows and columns of whole frames, of which the modes are
    corner: row and column of whole frames at which these frames begin
    binning: whole pixels along an edge of theirs

    Errors: `InputError` for arrays that do not fit or are not finite.
    """

    covariances: np.ndarray
    variances: np.ndarray
    powers: np.ndarray
    whole: tuple[int, int]
    corner: tuple[int, int] = (0, 0)
    binning: int = 1

    def __post_init__(self) -> None:
        n, k = len(self.powers), self.variances.shape[-1]
        require(round(k**0.5) ** 2 == k, f"light must have a square number of modes, but it has {k}; correct it.")
        for name, shape in (("covariances", (n, k, k)), ("variances", (n, k)), ("powers", (n,))):
            given = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, finite(name, shaped(name, given, shape)))

    def __len__(self) -> int:
        return len(self.powers)

    @property
    def half_waves(self) -> int:
        """Half waves across whole frames up to which light changes."""
        return round(self.variances.shape[1] ** 0.5) - 1

    def __getitem__(self, index: np.ndarray | Sequence[int] | slice) -> DividedLight:
        """That of some of the frames."""
        arrays = {name: getattr(self, name)[index] for name in ("covariances", "variances", "powers")}
        return replace(self, **arrays)

    def cropped(self, row: int, column: int) -> DividedLight:
        """That of the frames from this row and column on [their pixels]."""
        top, left = self.corner
        return replace(self, corner=(top + row * self.binning, left + column * self.binning))

    def binned(self, factor: int) -> DividedLight:
        """That of frames on pixels `factor` times larger."""
        return replace(self, binning=self.binning * factor)

    def reversed(self, rows: bool, columns: bool, shape: tuple[int, int]) -> DividedLight:
        """That of the frames, of `shape`, upside down, or mirrored: modes of odd half waves change their sign."""
        odd = (-1.0) ** np.arange(self.half_waves + 1)
        sign = np.outer(odd if rows else odd**2, odd if columns else odd**2).ravel()
        beyond = [n - at - self.binning * size for n, at, size in zip(self.whole, self.corner, shape)]
        corner = (beyond[0] if rows else self.corner[0], beyond[1] if columns else self.corner[1])
        return replace(self, covariances=self.covariances * sign[:, None] * sign, corner=corner)

    @classmethod
    def joined(cls, parts: Sequence[DividedLight]) -> DividedLight:
        """That of the frames of all parts; `InputError` unless they are of one raster and number of half waves."""
        first = parts[0]
        for part in parts[1:]:
            same = all(getattr(part, name) == getattr(first, name) for name in ("whole", "corner", "binning"))
            require(
                same and part.half_waves == first.half_waves,
                "light that frames were divided by must be of one raster, but it is of several; join frames as they "
                "were corrected, and crop or bin them afterwards.",
            )
        arrays = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("covariances", "variances", "powers")
        }
        return replace(first, **arrays)
