"""Fits of a few steps: smooth volumes that would begin again with weaker priors, in vain, for a few steps explain no
frames; the likelihood of δ/β; and all first volumes and flows of a command.

tests/methods/test_volume.py holds that priors are weakened, and that a fit that was stopped goes on with them, and
tests/methods/test_uncertain.py what the likelihood finds.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import pytest

from helpers.unjudged import VERDICT
from holosplat.baselines import HolographicTV
from holosplat.methods import SmoothVolume, levels, smooth_fit
from holosplat.methods.profile import ProfileOptions
from holosplat.methods.uncertain import likeliest_ratio
from holosplat.motion.flow_forecast import FlowHistory
from holosplat.motion.flow_reconstruction import FlowOptions
from holosplat.workflows.track import reconstruct_moving

QUICK = ProfileOptions(
    iterations=10, start=HolographicTV(retrieval=15, iterations=30, corrections=0, noisy=1.0, refine=1, upper=0.0)
)
"""Volumes of few steps, whose likelihood says what that of the usual ones does of small frames without noise."""


@contextlib.contextmanager
def in_one_go() -> Iterator[None]:
    """Within, smooth volumes take their frames for explained, and keep the prior that they have."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(smooth_fit, "EXPLAINED", math.inf)
        patch.setattr(smooth_fit, "WEAKER", math.inf)
        yield


@contextlib.contextmanager
def in_few_steps() -> Iterator[None]:
    """Within, the likeliest δ/β of frames is that of `QUICK` volumes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(levels, "likeliest_ratio", partial(likeliest_ratio, options=QUICK))
        yield


FLOW = FlowOptions(
    SmoothVolume(coarser=(), rounds=1, iterations=4),
    cells=2,
    most_cells=2,
    most_degree=0,
    steps=2,
    iterations=3,
    final=3,
)
"""A flow that is found fast, and shows that something moves."""


@contextlib.contextmanager
def in_short_fits() -> Iterator[None]:
    """Within, whatever a command fits takes few steps: first volumes, the likelihood of δ/β, and flows.

    Bodies in motion are not judged, and other matter is not asked whether it moves.
    """
    module = import_module("holosplat.baselines.holographic_tv")

    def shortened(options: HolographicTV) -> HolographicTV:
        few = {"retrieval": 30, "iterations": 80, "corrections": 1, "relit": 1}
        return replace(options, **{name: min(steps, getattr(options, name)) for name, steps in few.items()})

    def short(function: Any) -> Any:
        """The same function of a scan and a material; options are its third argument, or the fourth after a start."""

        def made(*given: Any, **more: Any) -> Any:
            return function(*(shortened(one) if isinstance(one, HolographicTV) else one for one in given), **more)

        return made

    def moving(scan: Any, prior: Any, options: FlowOptions, *rest: Any, **more: Any) -> Any:
        return reconstruct_moving(scan, prior, replace(FLOW, fading=options.fading), *rest, ask=False, **more)

    with in_few_steps(), in_one_go(), pytest.MonkeyPatch.context() as patch:
        for name in ("_holographic_tv", "retrieved", "agreed"):
            patch.setattr(module, name, short(getattr(module, name)))
        patch.setattr("holosplat.workflows.track.judge", lambda *run: VERDICT)
        patch.setattr("holosplat.cli.track.reconstruct_moving", moving)
        patch.setattr("holosplat.workflows.forecast.FlowHistory", partial(FlowHistory, options=FLOW))
        patch.setattr("holosplat.motion.flow_forecast.FROM_REST", 5)
        yield
