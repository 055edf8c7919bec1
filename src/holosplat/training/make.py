"""Making a dataset: its shards one after the other, or in several processes, and its datasheet."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

import torch

from ..io.provenance import command_now, take_up
from ..progress import Advance
from .datasheet import write_datasheet
from .folder import Dataset


def make(dataset: Dataset, jobs: int, on_progress: Advance) -> int:
    """Simulate what `dataset` lacks and write its datasheet; the number of files that were made.

    What is interrupted keeps its whole files. Errors: those of `Dataset.begin`.
    """
    dataset.begin()
    write_datasheet(dataset)
    missing, whole = dataset.missing(), len(dataset.shards())
    done = whole - len(missing)
    if jobs == 1:
        for shard in missing:
            before = done
            dataset.make(shard, lambda part, before=before: on_progress((before + part) / whole))
            done += 1
        return len(missing)
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), take_up, (command_now(),))
    try:
        for future in as_completed([pool.submit(_made, dataset, shard) for shard in missing]):
            future.result()
            done += 1
            on_progress(done / whole)
    finally:
        pool.shutdown(cancel_futures=True)
    return len(missing)


def _made(dataset: Dataset, shard: range) -> None:
    """In a process of its own, which shares the machine."""
    torch.set_num_threads(1)
    dataset.make(shard)
