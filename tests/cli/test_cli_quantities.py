"""Numbers with their units on a command line."""

from __future__ import annotations

import pytest
import tyro

from holosplat.cli.align import UncertainOptions


@pytest.mark.parametrize(
    ("words", "field", "value"),
    [
        (["--uncertain-shift", "1.5px"], "uncertain_shift", 1.5),
        (["--uncertain-shift", "1.5"], "uncertain_shift", 1.5),
        (["--uncertain-angle", "0.6deg"], "uncertain_angle", 0.6),
        (["--uncertain-roll", "0.6°"], "uncertain_roll", 0.6),
        (["--uncertain-roll", "2 mrad"], "uncertain_roll", 0.1145916),
        (["--uncertain-distance", "2%"], "uncertain_distance", 0.02),
        (["--uncertain-magnification", "0.01"], "uncertain_magnification", 0.01),
    ],
)
def test_a_number_may_say_its_unit(words, field, value):
    assert getattr(tyro.cli(UncertainOptions, args=words), field) == pytest.approx(value, rel=1e-5)


def test_another_unit_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        tyro.cli(UncertainOptions, args=["--uncertain-shift", "2deg"])
    assert ended.value.code == 2
    assert "uncertain-shift" in capsys.readouterr().err
