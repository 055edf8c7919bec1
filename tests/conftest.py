"""What several test modules share."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads that spin starve whoever shares the cores

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Torch takes one thread: the problems of the tests are small."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def espresso_rbc() -> Path:
    """Folder of simulated red cells in a channel (VTK files of other programs); skips where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared/data/espresso_rbc"
    if not folder.is_dir():
        pytest.skip("the red-cell sample data is not here")
    return folder
