"""Products of sparse slice matrices and dense arrays; `..slices` is made of them.

Backends: `cpu` (C++), `cuda` (Triton), `reference`, each with a class `Products`.
"""
