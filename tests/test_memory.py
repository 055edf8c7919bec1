"""Memory is kept inside the outermost block only, and nothing is slower afterwards."""

from __future__ import annotations

import subprocess
import sys

import pytest

from holosplat import memory
from holosplat.memory import INSIDE, OUTSIDE, memory_kept


class Recorder:
    """A C library that writes down what it is told."""

    def __init__(self) -> None:
        self.told: list[tuple[int, int]] = []
        self.trimmed = 0

    def mallopt(self, parameter: int, value: int) -> None:
        self.told.append((parameter, value))

    def malloc_trim(self, pad: int) -> None:
        self.trimmed += 1


def test_only_the_outermost_block_counts(monkeypatch):
    told = Recorder()
    monkeypatch.setattr(memory, "_glibc", lambda: told)
    with memory_kept():
        assert told.told == list(INSIDE.items())
        with pytest.raises(KeyError), memory_kept():
            raise KeyError
        assert told.trimmed == 0
    assert told.told == [*INSIDE.items(), *OUTSIDE.items()]
    assert told.trimmed == 1


def test_other_c_libraries_are_left_alone(monkeypatch):
    monkeypatch.setattr(memory, "_glibc", lambda: None)
    with memory_kept():
        pass


FAULTS = """
import resource, torch
from holosplat.memory import memory_kept

def faults(repeat=20):
    for _ in range(repeat):  # until everything has found its place
        torch.empty(1 << 22).fill_(1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(repeat):
        torch.empty(1 << 22).fill_(1)
    return (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / repeat

torch.set_num_threads(1)
with memory_kept():
    with memory_kept():
        pass
    inside = faults()
print(inside, faults())
"""


@pytest.mark.skipif(memory._glibc() is None, reason="the C library is not glibc")
def test_arrays_of_16_megabytes_are_mapped_once():
    """Page faults a repetition, of some 4000 pages, inside and afterwards."""
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    inside, after = map(float, done.stdout.split())
    assert inside < 400
    assert after < 400
