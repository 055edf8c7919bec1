"""The two half-steps of primal–dual total variation on a volume, in place.

Backends: `cpu` (C++), `cuda` (Triton), `reference`.
"""
