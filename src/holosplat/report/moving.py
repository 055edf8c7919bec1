"""The part of a report on bodies in motion, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..geometry import Views
from ..representations import MovingSurfaces

WHOLE = 0.999
"""Part of the vertices in the field from which on a body is whole there."""


@dataclass(frozen=True)
class Moving:
    """Bodies in motion, their numbers, and one frame of each of a few times.

    - bodies: on their paths; times: [T] of the frames [s]
    - tracks: numbers by the names of tracks.csv, [T, B] each; errors: standard errors of some of them, likewise
    - low, high: corners `(x, y, z)` of the field of view [m]
    - shown: [K] indices of the times that are drawn; views: K, one of each; measured, predicted: their frames
      [K, H, W], relative intensity
    """

    bodies: MovingSurfaces
    times: np.ndarray
    tracks: Mapping[str, np.ndarray]
    low: np.ndarray
    high: np.ndarray
    shown: np.ndarray
    views: Views
    measured: np.ndarray
    predicted: np.ndarray
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def whole(self) -> np.ndarray:
        """[T, B] whether a body is whole in the field."""
        return self.tracks["in_field"] >= WHOLE

    def mean(self, name: str) -> np.ndarray:
        """[B] of a column, over the times at which a body is whole in the field; NaN where it never is."""
        return self._over_time(name, np.mean)

    def spread(self, name: str) -> np.ndarray:
        """[B] standard deviations of a column, likewise."""
        return self._over_time(name, np.std)

    def _over_time(self, name: str, what: object) -> np.ndarray:
        assert callable(what)
        columns = zip(self.tracks[name].T, self.whole.T)
        return np.array([what(values[whole]) if whole.any() else np.nan for values, whole in columns])
