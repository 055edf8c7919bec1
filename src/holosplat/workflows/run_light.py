"""The light of frames that a reconstruction is compared with, each by its own air: no matter is predicted for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from ..methods import Task
from ..optics.background import Light, LightOptions
from ..scan import Scan
from ..tables import from_table

EVEN = LightOptions("even")
"""Frames are compared as they are."""


def found_in(task: Task) -> LightOptions:
    """What a run assumes of other frames of its scan: smooth light if that of the training frames is uneven."""
    return EVEN if task.uneven is None else replace(task.light, kind="smooth")


def read_light_options(config: Mapping[str, Any], summary: Mapping[str, Any]) -> LightOptions:
    """The same of a run folder; older ones say nothing of light, which is then even."""
    if summary.get("light", "even") == "even":
        return EVEN
    return replace(from_table(LightOptions, config.get("light", {}), "light"), kind="smooth")


def light_of(scan: Scan, assumed: LightOptions) -> Light | None:
    """The light of all frames of `scan`, held-out ones too, by their air; None where it is even.

    How strong light of each number of half waves is, all frames say together; the light itself is each frame's own. A
    frame without air has the light that is expected before it is seen: even. None too where no frame has air.
    """
    if assumed.kind == "even":
        return None
    frames = torch.from_numpy(scan.frames)
    if not bool(assumed.air_of(frames).any()):
        return None
    found = Light.of(frames, assumed)
    return None if found.background is None else found
