"""Tables of runs that printed their numbers and kept no rows: docs/data/printed has what they printed, cell by cell.

A run of the command prints them anew, and its numbers then go into the file. What can be counted anew from rows belongs
into another module.
"""

from __future__ import annotations

import csv
from functools import partial

from .benchmark import DATA, TABLES, markdown, table

TUNE = "python benchmarks/tune_tomography.py"
FIELDS = "python benchmarks/tune_fields.py --options noise_weight"
MAIN_JOB = "python benchmarks/main_job.py"
SURFACES = "python benchmarks/surfaces.py --threads 1"
PRINTED = {
    "axes": ("tests/align/test_axis.py holds the numbers", "a minute"),
    "field-projections": ("a trial that no script keeps", "minutes"),
    "field-noise": (f"{FIELDS} --methods neural", "hours"),
    "voxel-noise": (f"{FIELDS} --methods voxels --cases noise12-500 noise12-2000 plasma8-1e4 --seeds 12 13", "hours"),
    "flat-fields": ("OMP_NUM_THREADS=1 python benchmarks/flat_fields.py", "minutes"),
    "two-levels": ("python benchmarks/two_levels.py --snapshots DIR", "an hour"),
    "two-materials": (
        'python benchmarks/ablation.py --cases two_materials8 --seeds 5 6 7 8 --variants "as it is" "one ratio for '
        'all matter"',
        "an hour",
    ),
    "retrievals": ("OMP_NUM_THREADS=1 python benchmarks/phase_retrieval.py --views 3", "half an hour"),
    "photons": ("holosplat plan, as the page has it", "a minute"),
    "versions": ("both versions one after the other, as the page says", "an hour"),
    "simulation-costs": ("python benchmarks/simulate.py", "minutes, alone on two cores"),
    "simulation-errors": ("python benchmarks/simulate.py", "minutes"),
    "simulation-projection": ("python benchmarks/simulate.py", "minutes, alone on two cores"),
    "prototypes": ("trials before the code was written, which no script keeps", "minutes"),
    "real-data": ("python benchmarks/real_data.py --data FOLDER", "an hour"),
    "step": ("python benchmarks/step.py --json", "a minute, alone on two cores"),
    "kernels": ("python benchmarks/kernels.py --json", "minutes, alone on two cores"),
    "kernel-rates": ("python benchmarks/kernels.py --json", "minutes, alone on two cores"),
    "registers": ("python tests/house/offline_triton.py", "minutes"),
    "surfaces": (SURFACES, "an hour"),
    "surface-settings": (f"{SURFACES} --variants --cases main4 noise12-2000 --seeds 101", "an hour"),
    "surfaces-faint": ("python benchmarks/surfaces.py --cases plasma8-1e4 --seeds 101", "minutes"),
    "random-start": (f"{MAIN_JOB} --cases cells free --seeds 1 2 --preset random", "half an hour"),
    "tomography-options": (TUNE, "an hour"),
    "tomography-frames": (f"{TUNE} --defaults", "half an hour"),
    "tomography-tikhonov": (f"{TUNE} --defaults --retrieval tikhonov", "half an hour"),
}
"""Name → what printed it, and how long that takes."""


def printed(name: str) -> str:
    """A table as it was printed."""
    with (DATA / TABLES[name].data[0]).open(newline="", encoding="utf-8") as file:
        head, *lines = csv.reader(file)
    return markdown(head, lines).replace("|  |", "| |").replace("|  |", "| |")


for _name, (_command, _takes) in PRINTED.items():
    table(_name, _command, _takes, f"printed/{_name}.csv")(partial(printed, _name))
