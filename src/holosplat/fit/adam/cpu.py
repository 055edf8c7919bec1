"""Adam on the CPU: one call of the compiled kernel for all arrays, in float32.

Bitwise the same for every number of threads (torch's: `torch.set_num_threads`) and in every run.
"""

from __future__ import annotations

from ctypes import addressof, c_int64, c_void_p

import torch
from torch import Tensor

from ... import native


def step(
    parameters: list[Tensor], gradients: list[Tensor], first: list[Tensor], second: list[Tensor], factors: Tensor
) -> None:
    """One step in place; as the package's `step`, already checked."""
    held, count = [g.contiguous() for g in gradients], len(parameters)
    lengths = (c_int64 * count)(*(p.numel() for p in parameters))
    groups = [(c_void_p * count)(*(a.data_ptr() for a in arrays)) for arrays in (parameters, held, first, second)]
    adam = native.Adam(count, *(addressof(table) for table in (lengths, *groups)))
    native.call("holosplat_adam", adam, c_void_p(factors.data_ptr()), torch.get_num_threads())
