"""What the GPU's kernels of all operations share: the device on which Triton launches."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor


def launching(array: Tensor) -> AbstractContextManager[Any]:
    """The device of `array` made current: Triton launches on the current one."""
    return torch.cuda.device(array.device) if array.is_cuda else nullcontext()
