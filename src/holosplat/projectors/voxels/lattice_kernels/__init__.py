"""The hats of a lattice of voxels on a detector, their adjoint, and gradients of poses; `..lattice` is made of them.

Backends: `cpu` (C++), `cuda` (Triton), `reference`, each with a class `Kernels`.
"""
