"""holosplat: quantitative 3D maps from a handful of X-ray phase-contrast images.

At the top are the acts (`simulate`, `reconstruct`, `evaluate` …), the nouns they take, and the methods; the rest is in
namespaces: `holosplat.io`, `.align`, `.materials`, `.specimens`, `.beamline`, `.planning`, `.optics`, `.model`,
`.methods`, `.representations`, `.preprocess`, `.metrics`, `.report` and `.workflows`. The names are in the stub here;
each is imported from its module when it is first used, so that `import holosplat` costs nothing.
"""

from __future__ import annotations

from .lazy import exports
from .version import __version__ as __version__

__getattr__, __dir__, __all__ = exports(__name__, __file__)
