"""Wave optics: exit wave, Fresnel propagation, detector, and phase retrieval of single views."""

from .detector import bin_pixels, blur, poisson
from .propagation import exit_wave, exit_wave_minus_one, fresnel_propagate, fresnel_reach_px, fresnel_transfer
from .retrieval import invert_contrast, retrieve_thickness

__all__ = [
    "bin_pixels",
    "blur",
    "exit_wave",
    "exit_wave_minus_one",
    "fresnel_propagate",
    "fresnel_reach_px",
    "fresnel_transfer",
    "invert_contrast",
    "poisson",
    "retrieve_thickness",
]
