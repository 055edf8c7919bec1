"""Projectors: pure functions from an object's data and the views to line integrals along the beam.

One folder a method: its public, checked functions in `__init__.py`, a plain torch `reference.py` that is the
specification, and the fast twins beside it. Kernels work in pixels; whoever calls them scales in and out.
"""
