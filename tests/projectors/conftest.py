"""Backends of the projectors."""

from __future__ import annotations

import pytest
import torch

from helpers.kernels import few_programs


@pytest.fixture(params=["cpu", "cuda"])
def fast(request, monkeypatch) -> tuple[str, torch.device]:
    """A fast backend and its device: the GPU's is Triton's interpreter where there is none."""
    if request.param == "cpu":
        return "cpu", torch.device("cpu")
    device = request.getfixturevalue("gpu")
    few_programs(monkeypatch, device)
    return "cuda", device
