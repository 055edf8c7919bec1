"""Times of spherical matter share their total δ, where its changes are no larger than their errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.io.nxtomo import write_scan
from holosplat.io.reading import Reading
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.optics.background import LightOptions
from holosplat.scan import Exposures
from holosplat.series.folder import DONE, Row, SeriesFolder
from holosplat.series.one_time import common_totals
from holosplat.series.plan import Cut, Settings, plan_series
from holosplat.series.run import run_left
from holosplat.specimens import Substances
from holosplat_bench.specimens.gas_waves import ExpandingShock


def test_a_total_is_conserved_where_its_changes_are_within_their_errors():
    """Each time is told what the others say, weighted by their errors."""
    blank = Row(0, "scan.nxs", 0, 0.0, "done")
    rows = [replace(blank, number=k, total=v, total_error=e) for k, (v, e) in enumerate([(1, 1), (2, 2), (5, 4)])]
    told = common_totals(rows)
    assert set(told) == {0, 1, 2}
    assert told[0] == pytest.approx(((2 / 4 + 5 / 16) / (1 / 4 + 1 / 16), (1 / 4 + 1 / 16) ** -0.5))
    assert told[2] == pytest.approx(((1 + 2 / 4) / (1 + 1 / 4), (1 + 1 / 4) ** -0.5))
    assert common_totals([*rows[:2], replace(rows[2], total=20.0)]) == {}
    assert common_totals([*rows[:2], replace(rows[2], total_error=None)]) == {}
    assert common_totals(rows[:1]) == {}


def test_spherical_matter_of_several_times_shares_its_total(tmp_path):
    """A young shock whose total frames hardly tell, in three beams; a second call does nothing more."""
    water, pixel, shape = DeltaBeta(5.75e-7, 2.56e-10), 1e-6, (29, 33)
    shock = ExpandingShock(24e-6, shift=0.0).drawn(Substances(water, medium=water), 4).scene
    views = Views.from_angles([0.0, 60.0, 120.0], shape, pixel)
    exposures = Exposures.of(views, 20.0, 0.1).repeated(np.array([0.4, 0.6, 0.8]))
    aside = np.zeros(len(exposures), dtype=bool)
    write_scan(tmp_path / "scan.nxs", simulate(shock, exposures, photons_per_pixel=3000.0, seed=1, is_test=aside))
    prior = MaterialPrior.of_ratio(water.ratio).on_both_sides().about_a_point()
    settings = Settings(light=LightOptions("even", still="none", noise="white"))
    folder = SeriesFolder(tmp_path / "series")
    plan = plan_series([tmp_path / "scan.nxs"], settings, lambda energy: prior, Reading(), Cut(window=3))
    folder.create(plan)
    seen = list[Row]()
    run_left(folder, on_row=seen.append)
    first, after = seen[:3], folder.rows(folder.plan().windows()[0])
    assert [row.begun for row in after] == ["conserved"] * 3
    assert all(row.good for row in after)
    spread = [np.ptp([row.total for row in rows]) for rows in (first, after)]
    assert spread[1] < 0.5 * spread[0]
    (folder.task(0) / DONE).unlink()
    run_left(folder, on_row=lambda row: pytest.fail("nothing is left to do"))
