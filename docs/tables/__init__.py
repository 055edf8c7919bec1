"""All tables of the documentation: what makes each, from which files of docs/data, and the command that makes these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from . import alignment, benchmark, learning, matter, measured, motion, moving, printed, runs, thesis


@dataclass(frozen=True)
class Table:
    """A table of a page: its text from data files, and the command that makes these, with its length."""

    make: Callable[[], str]
    data: tuple[str, ...]
    command: str
    takes: str


BENCH = "holosplat bench run --out bench --snapshots DIR --seeds 101 102, then python docs/figures.py benchmark bench"
TABLES = {
    "standing": Table(benchmark.standing, ("benchmark.csv",), BENCH, "a day"),
    "overview": Table(
        benchmark.overview,
        ("benchmark.csv", "families.csv"),
        f"{BENCH}; and with --seeds 101 --methods pixelnerf onix learned, to docs/data/families.csv",
        "a day",
    ),
    "before-noise": Table(
        benchmark.before_noise,
        ("before_noise.csv", "benchmark.csv"),
        "git show c7e8d51:docs/data/benchmark.csv, its rows of Gaussians in noise",
        "a second",
    ),
    "continuous": Table(
        benchmark.continuous, ("benchmark_continuous.csv",), f"{BENCH} docs/data/benchmark_continuous.csv", "hours"
    ),
    "absorbers": Table(
        benchmark.absorbers, ("benchmark_continuous.csv",), f"{BENCH} docs/data/benchmark_continuous.csv", "an hour"
    ),
    "measured": Table(
        benchmark.measured,
        ("benchmark_continuous.csv",),
        f"{BENCH} docs/data/benchmark_continuous.csv (with --data FOLDER)",
        "an hour",
    ),
    "sharp-light": Table(benchmark.sharp_light, ("sharp_light.csv",), f"{BENCH} docs/data/sharp_light.csv", "an hour"),
    "photographs": Table(
        benchmark.photographs,
        ("photographs.csv", "benchmark.csv"),
        "holosplat bench run --cases cells12 cells4 --methods alpha-3dgs nerf --seeds 101 --snapshots DIR --out bench, "
        "then python docs/figures.py benchmark-rows bench docs/data/photographs.csv",
        "ten minutes",
    ),
    "misaligned": Table(
        benchmark.misaligned, ("benchmark_misaligned.csv",), f"{BENCH} docs/data/benchmark_misaligned.csv", "hours"
    ),
    "round-cell": Table(benchmark.round_cell, ("round_cell.csv",), "python benchmarks/round_cell.py", "minutes"),
    "propagation": Table(
        runs.propagation,
        ("propagation.csv",),
        "python benchmarks/propagation.py --snapshots DIR --csv docs/data/propagation.csv",
        "ten minutes",
    ),
    "ablation": Table(
        runs.ablation,
        ("ablation.csv",),
        "python benchmarks/ablation.py --snapshots DIR --csv docs/data/ablation.csv",
        "hours",
    ),
    "trials": Table(runs.trials, ("trials.csv",), "python benchmarks/trials.py --csv docs/data/trials.csv", "an hour"),
    "neural-options": Table(
        runs.neural_options, ("tune_fields.csv",), "python benchmarks/tune_fields.py --csv FILE", "hours"
    ),
    "voxel-options": Table(
        runs.voxel_options, ("tune_fields.csv",), "python benchmarks/tune_fields.py --csv FILE", "an hour"
    ),
    "verdicts": Table(runs.verdicts, ("verdicts.csv",), "python benchmarks/verdicts.py", "ten minutes"),
    "imaging-chain": Table(
        runs.imaging_chain, ("imaging_chain.csv",), "python docs/figures.py imaging-chain WORK", "ten minutes"
    ),
    "imperfections": Table(
        runs.imperfections, ("simulation_imperfections.csv",), "python docs/figures.py simulation", "minutes"
    ),
    "few-photons": Table(runs.few_photons, ("few_photons.csv",), "python benchmarks/few_photons.py", "half an hour"),
    "series": Table(runs.series, ("series.csv",), "python benchmarks/series.py --csv docs/data/series.csv", "an hour"),
    "fibre": Table(runs.fibre, ("fibre.csv",), "python benchmarks/fibre.py", "ten minutes"),
    "skalak": Table(runs.skalak, ("tweezers.csv",), "python benchmarks/tweezers.py", "minutes"),
    "springs": Table(runs.springs, ("tweezers.csv",), "python benchmarks/tweezers.py", "minutes"),
}
TABLES |= {
    name: Table(
        make,
        ("main_job_idle.csv",),
        "python benchmarks/main_job.py --seeds 311 312 313 --csv FILE --preset auto, and again with --surfaces alone",
        "five minutes",
    )
    for name, make in (("readme", runs.readme), ("main-job", runs.main_job), ("wanted", runs.wanted))
}
TABLES["rerun"] = Table(
    runs.rerun,
    ("main_job.csv",),
    "OMP_NUM_THREADS=1 python benchmarks/main_job.py --cases cells nine ratio free noise poses plasma --surfaces --csv "
    "docs/data/main_job.csv",
    "an hour",
)
TABLES["snapshot"] = Table(
    runs.snapshot,
    ("main_job.csv",),
    "OMP_NUM_THREADS=1 python benchmarks/main_job.py --cases snapshot --meshes DIR/rbc*_049.vtk --surfaces --csv "
    "docs/data/main_job.csv",
    "two minutes",
)
TABLES["stages"] = Table(
    runs.stages, ("stages.csv",), "python benchmarks/stages.py --pixels 128 512 --csv docs/data/stages.csv", "minutes"
)
TABLES["sizes"] = Table(
    runs.sizes,
    ("sizes.csv",),
    "python benchmarks/sizes.py --pixels 128 256 512 1024 --method auto --csv docs/data/sizes.csv",
    "minutes",
)
TABLES["triangles"] = Table(
    measured.triangles,
    ("triangles.csv",),
    "python benchmarks/triangles.py --csv docs/data/triangles.csv",
    "half an hour",
)
REAL = "python benchmarks/real_data.py --data FOLDER"
TABLES |= {
    name: Table(make, ("real_data.csv",), REAL, "half an hour")
    for name, make in (
        ("dome", measured.dome),
        ("whole", measured.whole),
        ("tooth", measured.tooth),
        ("hair", measured.hair),
    )
}
ALIGN = "python benchmarks/alignment.py"
TABLES |= {
    name: Table(make, (data,), command, takes)
    for name, make, data, command, takes in (
        ("align-errors", alignment.errors, "alignment.csv", ALIGN, "ten minutes"),
        ("align-magnified", alignment.magnified, "alignment.csv", ALIGN, "ten minutes"),
        (
            "align-volumes",
            alignment.volumes,
            "alignment.csv",
            f"{ALIGN} --moments planned aligned refined true",
            "an hour",
        ),
        ("align-series", alignment.series, "alignment.csv", "python benchmarks/series_alignment.py", "half an hour"),
        (
            "align-series-volumes",
            alignment.series_volumes,
            "alignment.csv",
            "python benchmarks/series_alignment.py",
            "an hour",
        ),
        ("few-views", alignment.few_views, "few_views.csv", "python benchmarks/few_views.py", "ten minutes"),
        ("calibration", alignment.calibration, "calibration.csv", "python benchmarks/calibration.py", "minutes"),
        (
            "compact-series",
            measured.compact_series,
            "compact_series.csv",
            "python benchmarks/compact_series.py NAME RUNS --write",
            "minutes",
        ),
    )
}
TABLES["pinn"] = Table(
    runs.pinn,
    ("pinn.csv",),
    "python benchmarks/pinn.py --cases channel swirl --write (and espresso with --data)",
    "half an hour",
)
TABLES["assimilation"] = Table(
    moving.assimilation, ("assimilation.csv",), "python benchmarks/assimilation.py --write", "five minutes"
)
TABLES["tracked-carrier"] = Table(
    moving.carrier,
    ("carrier.csv",),
    "python benchmarks/carrier.py DATA --cases flow4 --write, as of commit 6bfff929",
    "ten minutes",
)
TABLES["moving_methods"] = Table(
    moving.moving_methods,
    ("moving_methods.csv", "motion.csv", "moving_matter.csv"),
    "python benchmarks/moving_methods.py DATA --cases flow4 flow3 flow2 stir4 burst4 --write",
    "an hour",
)
TABLES["learned"] = Table(
    learning.learned,
    ("learned.csv",),
    "python benchmarks/learned.py DATA --write",
    "half an hour",
)
TABLES["learned_change"] = Table(
    learning.learned_change, ("learned.csv",), "python benchmarks/learned.py DATA --write", "half an hour"
)
TABLES["onix-scenes"] = Table(
    learning.onix_scenes,
    ("onix_scenes.csv",),
    "python benchmarks/onix_scenes.py FOLDER --write",
    "an hour",
)
TABLES["aligned-inference"] = Table(
    learning.aligned_inference,
    ("aligned_inference.csv",),
    "python benchmarks/aligned_inference.py --write",
    "a minute",
)
TABLES["few-families"] = Table(
    learning.few_families,
    ("few_families.csv", "learned.csv", "photographs.csv", "families.csv", "benchmark.csv"),
    "python benchmarks/few_families.py DATA --write, python benchmarks/learned.py DATA --write",
    "half an hour",
)
TABLES["moving-families"] = Table(
    learning.moving_families,
    ("motion.csv", "pinn.csv", "moving_matter.csv"),
    "python benchmarks/motion.py DATA --write, and pinn.py and moving_matter.py with --write",
    "hours",
)
TABLES["ellipsoids"] = Table(
    learning.ellipsoids,
    ("ellipsoids.csv",),
    "python benchmarks/ellipsoids.py --write",
    "hours",
)
TABLES["random_scenes"] = Table(
    runs.random_scenes,
    ("random_scenes.csv",),
    "python benchmarks/random_scenes.py --write",
    "half an hour",
)
DECIDED = "python benchmarks/families.py --data FOLDER"
TABLES |= {
    f"families-{name}": Table(make, ("decision_families.csv",), DECIDED, "an hour")
    for name, make in (("rules", runs.families_rules), ("scenes", runs.families_scenes))
}
TABLES["cell"] = Table(
    measured.cell, ("measured_cell.csv",), "python benchmarks/measured_cell.py --data FOLDER", "a quarter of an hour"
)
TABLES["bed"] = Table(
    measured.bed, ("real_data.csv",), "python benchmarks/packed_bed.py --data FOLDER --work FOLDER", "an hour"
)
TRACKED = "python benchmarks/motion.py DATA --write"
FORECAST = "python benchmarks/forecast.py DATA --write"
TABLES |= {
    name: Table(make, data, command, takes)
    for name, make, data, command, takes in (
        ("tracked", motion.tracked, ("motion.csv",), f"{TRACKED} --cases flow4 flow3 …", "an hour"),
        ("tracked-windows", motion.windows, ("motion.csv", "motion_ablation.csv"), TRACKED, "half an hour"),
        ("tracked-others", motion.others, ("motion.csv",), f"{TRACKED} --cases flow2-body --first 8", "an hour"),
        ("tracked-ablation", motion.ablation, ("motion_ablation.csv",), f"{TRACKED} --ablation", "an hour"),
        ("forecast", motion.forecast, ("forecast.csv",), FORECAST, "an hour"),
        ("forecast-mechanics", motion.mechanics, ("forecast.csv",), FORECAST, "an hour"),
        (
            "moving-matter",
            motion.moving_matter,
            ("moving_matter.csv",),
            "python benchmarks/moving_matter.py --write",
            "ten minutes",
        ),
        ("espresso", motion.espresso, ("espresso_flow.csv",), "python benchmarks/espresso_flow.py DATA", "minutes"),
    )
}


TABLES["faults"] = Table(
    runs.faults, ("faults.csv",), "python benchmarks/faults.py --trials 200 --csv docs/data/faults.csv", "an hour"
)
TABLES["matter"] = Table(
    lambda: matter.scenes("small"), ("matter_scenes.csv",), "python benchmarks/matter_scenes.py --seeds 101", "hours"
)
THESIS = "python benchmarks/thesis_runs.py run RUNS --snapshots DIR, then collect RUNS"
TABLES |= {
    f"thesis-{name}": Table(make, ("thesis_study/runs.csv",), THESIS, "a day")
    for name, make in (
        ("short", lambda: thesis.configurations("short")),
        ("third", lambda: thesis.configurations("third")),
        ("full", lambda: thesis.configurations("full")),
        ("others", lambda: thesis.others("short")),
        ("others-third", lambda: thesis.others("third")),
        ("others-full", lambda: thesis.others("full")),
        ("findings", thesis.verdicts),
        ("left", thesis.left),
    )
}
TABLES |= {
    name: Table(make, (printed.file_of(name),), *printed.PRINTED[name]) for name, make in printed.makers().items()
}
