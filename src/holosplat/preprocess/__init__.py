"""From raw counts to relative intensities: dark and flat fields, defective pixels, flat fields that change."""

from .eigen_flats import EigenFlats, TotalVariationWeights, eigen_flats, significant
from .pixels import PixelRepair, defective_pixels, fixed_pattern, relative_intensity, unlit
from .relative import fault_of, require_relative

__all__ = [
    "EigenFlats",
    "PixelRepair",
    "TotalVariationWeights",
    "defective_pixels",
    "eigen_flats",
    "fault_of",
    "fixed_pattern",
    "relative_intensity",
    "require_relative",
    "significant",
    "unlit",
]
