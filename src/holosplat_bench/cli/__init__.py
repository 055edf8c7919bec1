"""The commands of this package, which `holosplat` finds by the entry points of this distribution: the module of each,
the first paragraph of its help, and its heading in the overview."""

BENCH = (
    "holosplat_bench.cli.bench",
    "Compare methods on cases, under one physics and one set of scores (run, report), and other people's programs with "
    "holosplat (arena); rerun the thesis' study.",
    "Benchmark and installation",
)
DATASET = (
    "holosplat_bench.cli.learn",
    "Simulate scenes for learning, drawn at random from stated ranges, into a folder of shards with a datasheet.",
    "Learn",
)
TRAIN = (
    "holosplat_bench.cli.learn",
    "Train a network on scenes of `holosplat dataset`: weights with a card, and curves.",
    "Learn",
)
