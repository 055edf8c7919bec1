"""holosplat: quantitative 3D maps from a handful of X-ray phase-contrast images."""

__version__ = "0.1.0"
