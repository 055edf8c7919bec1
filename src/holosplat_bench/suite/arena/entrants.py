"""Who competes in the arena: one table."""

from __future__ import annotations

from .contest import Contestant, Track

OWN, PEERS, WAVES = ("holosplat_bench.suite.arena." + name for name in ("own", "peers", "peers_waves"))
"""Modules of acts."""
BEST_PAIR = "best-pair"
"""The pair of peers that was best on a case, known from the rows of the two tracks before."""


def _ours(track: Track, *rows: tuple[str, str, str]) -> list[Contestant]:
    return [Contestant(f"holosplat-{name}", track, "", f"{OWN}:{act}", said) for name, act, said in rows]


def _theirs(module: str, track: Track, *rows: tuple[str, str, str, str]) -> list[Contestant]:
    return [Contestant(name, track, pip, f"{module}:{act}", said) for name, pip, act, said in rows]


CONTESTANTS = [
    *_ours("kernels", ("slices", "slices", "slice matrices, exact strips")),
    *_theirs(
        PEERS,
        "kernels",
        ("astra-strip", "astra-toolbox", "astra_strip", "ASTRA, strips"),
        ("astra-linear", "astra-toolbox", "astra_linear", "ASTRA, Joseph's interpolation"),
        ("rtk-joseph", "itk-rtk", "rtk_pair", "RTK, Joseph's interpolation"),
        ("svmbir", "svmbir", "svmbir_pair", "svmbir, matrices made in each call"),
        ("mbirjax", "mbirjax", "mbirjax_pair", "MBIRJAX"),
        ("scico", "scico", "scico_pair", "SCICO on voxels of half the size, which it needs"),
    ),
    *_ours("steps", ("voxels", "step", "compiled kernels with adjoints")),
    *_theirs(
        WAVES,
        "steps",
        ("torch-eager", "torch", "torch_step", "eager PyTorch: grid_sample and FFT"),
    ),
    *_theirs(PEERS, "steps", ("scico-jax", "scico", "scico_step", "SCICO's operators, differentiated by JAX")),
    *_ours(
        "retrieval",
        ("ctf", "contrast_transfer", "linear inverse"),
        ("tikhonov", "tikhonov", "nonlinear, with positivity"),
    ),
    *_theirs(
        WAVES,
        "retrieval",
        ("hotopy-ctf", "hotopy", "hotopy_ctf", "hotopy, linear inverse"),
        ("hotopy-tikhonov", "hotopy", "hotopy_tikhonov", "hotopy, nonlinear, with positivity"),
        ("pyphase-ctf", "pyphase", "pyphase_ctf", "PyPhase, linear inverse"),
    ),
    *_ours(
        "tomography",
        ("fbp", "backprojection", "filtered back-projection"),
        ("sirt", "sirt", "SIRT without negative values"),
        ("tv", "total_variation", "total variation without negative values"),
    ),
    *_theirs(
        PEERS,
        "tomography",
        ("astra-fbp", "astra-toolbox", "astra_backprojection", "ASTRA, filtered back-projection"),
        ("astra-sirt", "astra-toolbox", "astra_sirt", "ASTRA, SIRT without negative values"),
        ("rtk-fdk", "itk-rtk", "rtk_fdk", "RTK, filtered back-projection (FDK)"),
        ("svmbir", "svmbir", "svmbir_volume", "svmbir, qGGMRF without negative values"),
        ("mbirjax", "mbirjax", "mbirjax_volume", "MBIRJAX, qGGMRF without negative values"),
        ("scico-tv", "scico", "scico_volume", "SCICO, total variation without negative values"),
    ),
    *_ours(
        "jobs",
        ("default", "default", "holosplat reconstruct, as it decides by itself"),
        ("two-steps", "two_steps", "nonlinear retrieval of each view, total variation"),
    ),
    Contestant(BEST_PAIR, "jobs", "numpy", f"{WAVES}:pair", "the peers' best retrieval and best tomography"),
]
"""All contestants, in the order of the tables."""
