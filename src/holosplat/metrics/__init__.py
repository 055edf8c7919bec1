"""Numbers and curves that compare images and volumes; docs/conventions.md defines them. No plotting."""

from .images import (
    FIXED_THRESHOLD,
    ImageScores,
    fourier_ring_correlation,
    fourier_shell_correlation,
    half_bit_threshold,
    image_scores,
    intensity_range,
    peak_signal_to_noise,
    resolution,
    ring_counts,
    ring_weighted_mean,
    structural_similarity,
)
from .volumes import VolumeScores, dice, require_same_grid, robust_material_delta, volume_scores

__all__ = [
    "FIXED_THRESHOLD",
    "ImageScores",
    "VolumeScores",
    "dice",
    "fourier_ring_correlation",
    "fourier_shell_correlation",
    "half_bit_threshold",
    "image_scores",
    "intensity_range",
    "peak_signal_to_noise",
    "require_same_grid",
    "resolution",
    "ring_counts",
    "ring_weighted_mean",
    "robust_material_delta",
    "structural_similarity",
    "volume_scores",
]
