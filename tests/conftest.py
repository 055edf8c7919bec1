"""What several test modules share."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def _two_threads() -> None:
    """Torch takes at most two threads."""
    torch.set_num_threads(min(2, torch.get_num_threads()))


@pytest.fixture(scope="session")
def espresso_rbc() -> Path:
    """Folder of simulated red cells in a channel (VTK files of other programs); skips where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared/data/espresso_rbc"
    if not folder.is_dir():
        pytest.skip("the red-cell sample data is not here")
    return folder
