"""A GPU that is pretended: tensors in main memory that may not meet those that are said to be there.

Where there is no GPU, kernels run in Triton's interpreter on tensors in main memory, and nobody notices that a tensor
was left on the wrong side. Here tensors on "cuda" are wrapped: an operation on wrapped and plain tensors together is an
error, as on a GPU, and so is `numpy()` of a wrapped one. What autograd sees is a tensor on the device "meta".
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

GPU = torch.device("cuda", 0)
ATEN = torch.ops.aten
INDEXING = {ATEN.index.Tensor, ATEN.index_put_.default, ATEN.index_put.default, ATEN._index_put_impl_.default}
"""What takes indices from main memory on a GPU, too."""
PRODUCTS = (torch.matmul, Tensor.matmul, Tensor.__matmul__)


class Mixed(RuntimeError):
    """An operation on tensors of two devices."""


class OnGpu(Tensor):
    """A tensor that is said to be on the GPU; `inner` is in main memory."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> OnGpu:
        return Tensor._make_wrapper_subclass(  # type: ignore[attr-defined,no-any-return]
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device="meta",
        )  # fmt: skip

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: GPU)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)

    def __repr__(self) -> str:  # type: ignore[override]
        return f"OnGpu({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return done(func, args, dict(kwargs or {}))


class Made(TorchDispatchMode):
    """What torch itself makes on the device "meta", such as the zeros of a backward pass."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        there = _is_gpu(kwargs.get("device")) or any(isinstance(each, OnGpu) for each in tensors((args, kwargs)))
        return done(func, args, kwargs) if there else func(*args, **kwargs)


def done(func: Any, args: Any, kwargs: Any) -> Any:
    """The operation `func` on tensors of which some are on the GPU, or that makes some there."""
    if func is ATEN.copy_.default:
        plain(args[0]).copy_(plain(args[1]))
        return args[0]
    wanted = kwargs.get("device")
    there = wanted is None or torch.device(wanted).type != "cpu"
    if func is ATEN._to_copy.default and wanted is None:
        there = isinstance(args[0], OnGpu)
    elif func not in INDEXING and func is not ATEN._to_copy.default:
        refuse_mixed(func, (args, kwargs))
    if wanted is not None:
        kwargs["device"] = torch.device("cpu")
    wrappers = {id(each.inner): each for each in tensors((args, kwargs)) if isinstance(each, OnGpu)}
    found = func(*plain(args), **plain(kwargs))
    if func is ATEN._local_scalar_dense.default or func is ATEN.equal.default:
        return found

    def given_back(each: Tensor) -> Tensor:
        if id(each) in wrappers:  # changed in place
            return wrappers[id(each)]
        return OnGpu(each.resolve_conj().resolve_neg()) if there else each  # wrappers do not know of such bits

    return changed(found, Tensor, given_back)


def tensors(value: Any) -> Iterator[Tensor]:
    """The tensors in nested lists, tuples and dictionaries; torch's own trees take five times as long."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from tensors(each)
    elif isinstance(value, dict):
        yield from tensors(list(value.values()))


def changed(value: Any, kind: type, change: Callable[[Any], Any]) -> Any:
    """Nested lists, tuples and dictionaries with `change` of all that is of `kind`."""
    if isinstance(value, kind):
        return change(value)
    if isinstance(value, tuple) and type(value) is not tuple:  # a named one, such as what `max` gives
        return type(value)(changed(list(value), kind, change))
    if isinstance(value, (list, tuple)):
        return type(value)(changed(each, kind, change) for each in value)
    if isinstance(value, dict):
        return {name: changed(each, kind, change) for name, each in value.items()}
    return value


def plain(value: Any) -> Any:
    """The same with tensors in main memory."""
    return changed(value, OnGpu, lambda each: each.inner)


def refuse_mixed(func: Any, value: Any) -> None:
    """`Mixed` if a tensor in main memory with more than one number is among the arguments."""
    for each in tensors(value):
        if not isinstance(each, OnGpu) and each.dim() > 0:
            raise Mixed(f"{func}: tensors on the GPU and in main memory, {tuple(each.shape)} {each.dtype}")


class _Moved(torch.autograd.Function):
    """From main memory to the GPU."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor) -> Tensor:  # type: ignore[override]
        return OnGpu(tensor.detach().clone())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        return plain(gradient)


class _Back(torch.autograd.Function):
    """From the GPU to main memory."""

    @staticmethod
    def forward(ctx: Any, tensor: OnGpu) -> Tensor:  # type: ignore[override]
        return tensor.inner.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        return OnGpu(gradient)


def _is_gpu(value: Any) -> bool:
    return isinstance(value, (str, torch.device)) and str(value).partition(":")[0] in ("cuda", "meta")


def _is_cpu(value: Any) -> bool:
    return isinstance(value, (str, torch.device)) and str(value) == "cpu"


class Pretence(TorchFunctionMode):
    """Factories and `to` with the device "cuda" give wrapped tensors."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is Tensor.to:
            return _to(args[0], *args[1:], **kwargs)
        if func is Tensor.cpu:
            return _Back.apply(args[0]) if isinstance(args[0], OnGpu) else args[0]
        if func is Tensor.numpy and isinstance(args[0], OnGpu):
            raise TypeError("can't convert cuda:0 device type tensor to numpy; use .cpu() first.")
        if func is Tensor.tolist and isinstance(args[0], OnGpu):
            return args[0].inner.tolist()
        if func is Tensor.new_tensor and isinstance(args[0], OnGpu):
            return OnGpu(args[0].inner.new_tensor(*args[1:], **kwargs))
        if func in PRODUCTS and isinstance(args[0], OnGpu) and args[0].ndim == 1 and args[1].ndim == 2:
            return (args[0][None] @ args[1])[0]  # torch changes a shape in place, which wrappers do not notice
        if func is embedding_bag and isinstance(args[1], OnGpu):  # torch makes its offsets past all modes
            return (args[1][args[0]] * kwargs["per_sample_weights"][..., None]).sum(1)
        if func is Tensor.__setitem__ and isinstance(args[0], OnGpu):
            return _set(*args)
        if func is torch.as_tensor and isinstance(args[0], Tensor) and _is_gpu(kwargs.get("device")):
            return _to(args[0], **kwargs)
        if _is_gpu(kwargs.get("device")):
            kwargs["device"] = "cpu"
            asked = bool(kwargs.pop("requires_grad", False))
            made = func(*plain(args), **kwargs)
            return OnGpu(made).requires_grad_(asked) if isinstance(made, Tensor) else made
        return func(*args, **kwargs)


def _to(tensor: Tensor, *others: Any, **options: Any) -> Tensor:
    like = [each for each in others if isinstance(each, Tensor)]
    rest = [each.dtype if isinstance(each, Tensor) else each for each in others]
    asked = [each for each in (*rest, options.get("device")) if _is_gpu(each) or _is_cpu(each)]
    to_gpu = _is_gpu(asked[0]) if asked else isinstance((like or [tensor])[0], OnGpu)
    options.pop("device", None)
    rest = [each for each in rest if not (_is_gpu(each) or _is_cpu(each))]
    if to_gpu and not isinstance(tensor, OnGpu):
        tensor = _Moved.apply(tensor)
    elif not to_gpu and isinstance(tensor, OnGpu):
        tensor = _Back.apply(tensor)
    return tensor.to(*rest, **options) if rest or options else tensor


def _set(tensor: OnGpu, index: Any, value: Any) -> None:
    if tensor.requires_grad or (isinstance(value, Tensor) and value.requires_grad):
        raise NotImplementedError("the pretended GPU does not differentiate assignments")
    if isinstance(value, Tensor):
        refuse_mixed("assignment", value)
    tensor.inner[plain(index)] = plain(value)


def _module_to(module: nn.Module, device: Any) -> nn.Module:
    """A network moved as `nn.Module.to` does it, with parameters that are wrapped anew: torch would swap their data."""
    for part in module.modules():
        for name, weight in part._parameters.items():
            if weight is not None:
                part._parameters[name] = nn.Parameter(_to(weight.detach(), device), weight.requires_grad)
    return module


class _Products:
    """Slice matrices in main memory, dense arrays on the GPU: wrapped tensors cannot be sparse."""

    def __init__(self, entries: Callable[[bool], tuple[Tensor, ...]], shape: tuple[int, int]) -> None:
        from holosplat.projectors.voxels.slice_products import reference

        self._products = reference.Products(lambda transposed: plain(entries(transposed)), shape)

    def project(self, volume: Tensor) -> Tensor:
        return OnGpu(self._products.project(plain(volume)))

    def backproject(self, lines: Tensor) -> Tensor:
        return OnGpu(self._products.backproject(plain(lines)))


def _twin(name: str, package: str) -> Any:
    """The plain twin of a module of kernels for the GPU."""
    if name == ".cuda" and package.endswith(".slice_products"):
        return SimpleNamespace(Products=_Products)
    return import_module(".reference" if name == ".cuda" else name, package)


@contextmanager
def pretended_gpu(patch: pytest.MonkeyPatch, kernels: bool = True) -> Iterator[None]:
    """Within, there is a GPU; kernels run in the interpreter, steps are not captured as graphs.

    kernels: False for their plain twins, on wrapped tensors, which are faster: then only the way to them is tried.
    """
    from triton.runtime.interpreter import GridExecutor

    if not kernels:
        patch.setattr("holosplat.backends.import_module", _twin)

    launch: Callable[..., Any] = GridExecutor.__call__

    def unwrapped(self: Any, *args: Any, **kwargs: Any) -> Any:
        refuse_mixed(self.fn.__name__, (args, kwargs))
        os.environ["TRITON_INTERPRET"] = "1"
        try:
            return launch(self, *plain(args), **plain(kwargs))
        finally:
            del os.environ["TRITON_INTERPRET"]

    differentiate: Callable[..., Any] = torch.autograd._engine_run_backward  # type: ignore[attr-defined]

    def backward(*args: Any, **kwargs: Any) -> Any:
        with Pretence():  # which is off within the function that asks for it
            return differentiate(*args, **kwargs)

    patch.setattr(GridExecutor, "__call__", unwrapped)
    patch.setattr(torch.autograd, "_engine_run_backward", backward)
    patch.setattr(nn.Module, "to", _module_to)
    patch.setattr(torch, "inference_mode", torch.no_grad)  # wrappers have no tensors of inference
    patch.setattr(torch.cuda, "is_available", lambda: True)
    patch.setattr(torch.cuda, "device", lambda device: nullcontext())
    patch.setattr(torch.cuda, "get_device_name", lambda *_: "a pretended GPU")
    patch.setattr("holosplat.model.Model.capturable", property(lambda self: False))
    with Pretence(), Made():
        yield
