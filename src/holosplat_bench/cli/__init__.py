"""The commands of the benchmark, which `holosplat` finds by the entry points of this distribution."""

BENCH = (
    "holosplat_bench.cli.bench",
    "Compare methods on cases, under one physics and one set of scores (run, report), and other people's programs with "
    "holosplat (arena); rerun the thesis' study.",
)
"""The module of the command, and the first paragraph of its help."""
