"""Every Triton kernel, compiled for GPUs that need not be here, with its sizes of production."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[2] / "src" / "holosplat"
MOST_REGISTERS = 8 * 168
"""Of a lane of all warps of a program: with more, it would leave room for no other on a multiprocessor."""


@pytest.fixture(scope="module")
def reports() -> list[dict]:
    """What ptxas says of every kernel: see offline_triton.py."""
    if importlib.util.find_spec("triton") is None:
        pytest.skip("triton is not installed")
    script = Path(__file__).with_name("offline_triton.py")
    usual = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=usual, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_no_kernel_spills(reports):
    assert [r for r in reports if r["spilled"] or r["stack"]] == []


def test_registers_leave_room(reports):
    assert [r for r in reports if not 0 < r["registers"] * r["warps"] <= MOST_REGISTERS] == []


def test_no_kernel_is_compiled_anew_for_another_shape(reports):
    assert [r for r in reports if r["specialised"]] == []


def test_every_kernel_was_compiled_for_every_target(reports):
    """A kernel is what a file named triton_*.py or cuda.py launches: `_name[grid](…)`."""
    launched = {
        f"{path.stem}.{name}"
        for path in (*SOURCE.rglob("triton_*.py"), *SOURCE.rglob("cuda.py"))
        for name in re.findall(r"^ +(_\w+)\[.*\]\(", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert len(launched) > 20
    for target in (80, 90):
        assert launched == {r["kernel"] for r in reports if r["target"] == target}
