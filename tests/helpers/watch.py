"""What the tests of the GPU's code forbid: waiting for the device."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode


class Watch(TorchDispatchMode):
    """Refuses whatever would wait for a GPU: a look at values, a shape that depends on them, another device."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        if name == "index" and any(a is not None and a.dtype == torch.bool for a in args[1]):
            name = "masked_select"
        waits = name in ("_local_scalar_dense", "nonzero", "masked_select", "unique_dim", "is_nonzero", "equal")
        assert not waits, f"{name} waits for the device"
        out = func(*args, **(kwargs or {}))
        copies = name in ("_to_copy", "copy_")  # all others take a single number from main memory as an argument
        places = {a.device for a in (*args, out) if isinstance(a, Tensor) and (copies or a.ndim)}
        assert len(places) <= 1, f"{name} moves {places}"
        return out
