"""Triton's interpreter, whose time goes by programs: kernels of the splat with few of them."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest
import torch


def few_programs(monkeypatch: pytest.MonkeyPatch, gpu: torch.device, gaussians: int = 128) -> dict[ModuleType, Any]:
    """In the interpreter, each program takes so many Gaussians; gives the modules with their sizes of production."""
    from holosplat.projectors.splat import triton_boxes, triton_pixels

    usual = {module: module.BLOCKS for module in (triton_pixels, triton_boxes)}
    if gpu.type == "cpu":
        for module, blocks in usual.items():
            many = replace(blocks, gaussians=gaussians, lanes=1024, rounds=1, large=10**6, large_programs=3)
            monkeypatch.setattr(module, "BLOCKS", many)
    return usual
