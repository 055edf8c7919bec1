"""Other ways to reconstruct all times of a scan, beside which ours are measured (docs/notebook/motion.md)."""

from __future__ import annotations

from .deformed_voxels import Deformed
from .each_time import EachTime, Snapshots, SpaceTimeFit, SpaceTimeTV, each_time
from .hexplane_field import HexPlane, LowRank
from .times import TimesFit

__all__ = [
    "Deformed",
    "EachTime",
    "HexPlane",
    "LowRank",
    "Snapshots",
    "SpaceTimeFit",
    "SpaceTimeTV",
    "TimesFit",
    "each_time",
]
