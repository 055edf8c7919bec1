"""What the tests of the contract of methods share: two balls, and the methods in a few steps."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

import holosplat as hs
from helpers.unjudged import unjudged
from holosplat.baselines import HolographicTV
from holosplat.fit.density import DensityControl
from holosplat.methods import SmoothVolume
from holosplat.specimens.red_cells import icosphere
from holosplat_bench.opponents.fields import AlignedNetwork, Encoding, Network
from holosplat_bench.opponents.onix import AlignedFit, Onix, PixelNerf
from holosplat_bench.opponents.photographs import AlphaRates, AlphaSplats, RadianceFields
from holosplat_bench.suite.methods import METHODS, BenchMethod, methods
from holosplat_bench.suite.methods import PHOTOGRAPHS as PHOTOGRAPHIC

MATERIAL = hs.DeltaBeta(2e-7, 2e-10)
PITCH = 1e-6
SHAPE = (18, 25)
SPLATS = AlphaSplats(0.15, rates=AlphaRates(0.05, 0.03, 0.01, 0.2, 0.1), reset_every=0)
SPLATS = replace(SPLATS, schedule=replace(SPLATS.schedule, steps=30, decay=0.2), density=DensityControl(20))
FIELD = RadianceFields(Network(Encoding(kind="octaves"), hidden=32), rays=96, rate=0.02).with_effort(0.06)
PHOTOGRAPHS = {
    method.name: replace(method, options=SPLATS if method.name == "alpha-3dgs" else FIELD)
    for method in methods().values()
    if method.family == PHOTOGRAPHIC
}
"""Methods without waves, in few and larger steps."""
_ALIGNED = AlignedFit(network=AlignedNetwork((4, 6), 8, 2), rate=0.05)
_ALIGNED = replace(_ALIGNED, schedule=replace(_ALIGNED.schedule, steps=30))
ALIGNED = {
    name: replace(METHODS[name], options=options)
    for name, options in {"onix": Onix(_ALIGNED), "pixelnerf": PixelNerf(_ALIGNED)}.items()
}
"""Pixel-aligned networks, small ones in few and larger steps."""
START = HolographicTV(retrieval=20, iterations=40, corrections=2, inner=6, noisy=1.0, refine=1, upper=0.0)
VOLUME = {"volume": replace(METHODS["volume"], options=SmoothVolume(START, coarser=(2,), rounds=1, iterations=4))}
"""The method that takes no share of its steps, in few."""
QUICK = methods(effort=0.05) | {"neural-field": methods(effort=0.12)["neural-field"]} | PHOTOGRAPHS | VOLUME | ALIGNED
"""The same methods with a small part of their steps: the contract is about form, not about quality."""
QUICKER = methods(effort=0.05) | PHOTOGRAPHS | VOLUME | ALIGNED
"""With a still smaller part, where finite numbers are all that is asked for."""
NEEDS = {"paganin-svmbir": "svmbir"}
"""Methods that need a package of the extra `bench`."""


def ball(centre: tuple[float, float, float], radius: float) -> hs.mesh.TriangleMesh:
    """A ball [pixels]."""
    vertices, faces = icosphere(3)
    return hs.mesh.TriangleMesh(PITCH * (radius * vertices + np.array(centre)), faces)


SCENE = hs.MeshScene.of_one_material([ball((-6, 2, 3), 5), ball((7, -3, -4), 4)], MATERIAL)


def two_balls() -> hs.Scan:
    """Six training frames of two balls, and two held out."""
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(8, SHAPE, PITCH), 20.0, 0.02)
    return hs.simulate(SCENE, exposures, oversample=2)


def usable(name: str, methods: dict[str, BenchMethod]) -> BenchMethod:
    """The method, if what it needs is installed; else the test is skipped."""
    package = NEEDS.get(name)
    if package and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    return methods[name]


def run(method: BenchMethod, scan: hs.Scan, seed: int = 0, prior: hs.MaterialPrior | None = None) -> hs.volume.Object:
    """What the method makes of the training frames; not judged, but for the first result of test_bench_contract.py."""
    known = hs.MaterialPrior.known(MATERIAL)
    with unjudged():
        return method.run(scan.train(), prior or known, seed, lambda stage, fraction: None)
