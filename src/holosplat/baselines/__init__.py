"""Classical reconstructions, from a scan to a volume: phase retrieval, and tomography of the retrieved thickness."""

from .holographic_tv import HolographicTV, holographic_tv
from .primal_dual import PrimalDual
from .tomography import TOMOGRAPHIES, Tomography

__all__ = ["TOMOGRAPHIES", "HolographicTV", "PrimalDual", "Tomography", "holographic_tv"]
