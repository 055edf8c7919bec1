"""Classical reconstructions, from a scan to a volume: phase retrieval and total-variation tomography."""

from .holographic_tv import HolographicTV, holographic_tv
from .primal_dual import PrimalDual

__all__ = ["HolographicTV", "PrimalDual", "holographic_tv"]
