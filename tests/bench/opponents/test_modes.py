"""Forecasts by modes of a body's own past: motions that the modes hold go on exactly."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from holosplat.checks import InputError, MissingError
from holosplat.matter import Matter
from holosplat.motion.forecast import History
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere
from holosplat_bench.opponents.modes import DmdForecast, SindyForecast, _dmd, _sindy

SPHERE, FACES = icosphere(1)
TIMES = 1e-5 * np.arange(18)
AHEAD = TIMES[-1] + 1e-5 * np.array([1.0, 4.0, 6.5])


def places(times: np.ndarray, body: int = 0) -> np.ndarray:
    """A ball that swings between two ellipsoids, damped, and whose middle is on a parabola."""
    phase = 0.35 * times / 1e-5
    swing = (0.97 ** (times / 1e-5) * np.cos(phase))[:, None, None] * SPHERE * [0.4, -0.3, 0.1]
    turn = (0.97 ** (times / 1e-5) * np.sin(phase))[:, None, None] * SPHERE[:, [1, 2, 0]] * 0.2
    middle = np.stack([2e5 * times, 1e-5 + 0 * times, (times / 1e-4) ** 2 + 9 * body], axis=1)
    return 1e-6 * (3 * SPHERE + swing + turn + middle[:, None])


def bodies() -> MovingSurfaces:
    """Two of them, on splines fine enough to hold the swing."""
    basis = TimeBasis(TIMES[0], TIMES[-1], 3, 12)
    fine = np.linspace(TIMES[0], TIMES[-1], 80)
    paths = [basis.fitted(fine, places(fine, body)) for body in range(2)]
    return MovingSurfaces.of_bodies(paths, [FACES, FACES], basis, 0.5e-6, Matter.one(1e-7, 0.0))


@pytest.mark.parametrize(
    ("by", "library"), [(DmdForecast(keep_volume=False), "pydmd"), (SindyForecast(keep_volume=False), "pysindy")]
)
def test_a_damped_swing_goes_on(by, library):
    pytest.importorskip(library)
    found = by.fit(History(bodies(), TIMES)).ahead(AHEAD)
    for body in range(2):
        still = np.abs(places(TIMES[-1:], body) - places(AHEAD[-1:], body)).max()
        for time in AHEAD:
            error = np.abs(found.bodies.bodies(time)[body].vertices - places(np.array([time]), body)[0])
            assert error.max() < 0.1 * still
    assert found.band.shape == (3, 2)
    assert (np.diff(found.band, axis=0) > 0).all()


def test_modes_of_linear_motion_are_exact():
    """Two decaying oscillations: their DMD of rank four with delays has no error but rounding."""
    pytest.importorskip("pydmd")
    t = np.arange(30)
    waves = [0.98**t * np.exp(0.3j * t), 0.95**t * np.exp(0.7j * t)]
    mixing = np.random.default_rng(0).normal(size=(4, 7))
    whole = np.stack([part for wave in waves for part in (wave.real, wave.imag)], axis=1) @ mixing
    assert _dmd(whole[:20], 10, (4, 2)) == pytest.approx(whole[20:], abs=1e-6)


def test_equations_that_run_away_leave_the_last_shape():
    """x' = x² from 1 on is infinite after one unit of time."""
    pytest.importorskip("pysindy")
    t = np.linspace(0, 0.95, 20)
    past = np.stack([1 / (1 - t), np.zeros_like(t)], axis=1) * [[1.0, 1.0]]
    said = _sindy(past, 40, (1, 2))
    assert np.isfinite(said).all()


def test_what_is_missing_is_said(monkeypatch):
    short = History(bodies(), TIMES[:6])
    with pytest.raises(InputError, match=r"--by dmd must see 9 times at least, but the run has 6; take --by paths"):
        DmdForecast().fit(short)
    loaded = importlib.import_module

    def gone(name: str, *rest: str):
        if name == "pydmd":
            raise ImportError
        return loaded(name, *rest)

    monkeypatch.setattr(importlib, "import_module", gone)
    with pytest.raises(MissingError, match=r"needs pydmd: pip install 'holosplat\[dynamics\]'"):
        DmdForecast().fit(History(bodies(), TIMES))


def test_bodies_keep_their_volume():
    pytest.importorskip("pydmd")
    found = DmdForecast().fit(History(bodies(), TIMES)).ahead(AHEAD).bodies
    usual = np.mean([bodies().bodies(t)[0].volume for t in TIMES])
    assert [found.bodies(t)[0].volume for t in AHEAD] == pytest.approx([usual] * 3, rel=1e-6, abs=0)
