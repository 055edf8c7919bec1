"""Triton's interpreter without what it does again for every call: a third of the time of tests of kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def spare_repetitions() -> None:
    """Functions that a kernel calls are not prepared anew at each call, nor are the types of NumPy looked up anew.

    A launch replaces the functions of `triton.language` by those of the interpreter, and puts them back at its end.
    Triton 3.7 goes through all of them again for each call of a function within the kernel, and finds nothing to do
    where a function of the same module was prepared in the same launch.
    """
    from triton.runtime import interpreter

    interpreter._patch_lang = once_a_launch(interpreter._patch_lang)
    interpreter._get_np_dtype = by_name(interpreter._get_np_dtype)


def once_a_launch(prepare: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`prepare` of a function, for the first one of each module from a launch's beginning to its end."""
    from triton.runtime.interpreter import _LangPatchScope

    prepared: set[int] = set()

    class Launch(_LangPatchScope):
        """What was replaced; when it is put back, nothing is prepared any more."""

        def restore(self) -> None:
            prepared.clear()
            super().restore()

    def prepare_once(function: Any) -> Any:
        module = id(function.__globals__)
        scope = Launch()
        if module not in prepared:
            prepared.add(module)
            scope._changes = prepare(function)._changes
        return scope

    return prepare_once


def by_name(of_type: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`of_type` of Triton's types, each of which has a name of its own."""
    known: dict[str, Any] = {}

    def remembered(kind: Any) -> Any:
        found = known.get(kind.name)
        if found is None:
            found = known[kind.name] = of_type(kind)
        return found

    return remembered
