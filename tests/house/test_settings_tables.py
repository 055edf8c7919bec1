"""Nested dataclasses as tables: round trips, merging, changing a field by its path, and what is refused."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import pytest

from holosplat.checks import InputError, at_least
from holosplat.methods import Voxels
from holosplat.tables import changed, from_table, merged, overridden, paths, read_table, to_table


@dataclass(frozen=True)
class Schedule:
    steps: int = 400
    decay: float = 0.1
    warm: bool = False

    def __post_init__(self) -> None:
        at_least(self, 0, "steps")


@dataclass(frozen=True)
class Fit:
    schedule: Schedule = Schedule()
    backend: Literal["auto", "cpu"] = "auto"
    stop: float | None = None
    levels: tuple[int, ...] = (4, 2)
    pair: tuple[float, str] = (1.0, "px")


@dataclass(frozen=True)
class Density:
    every: int = 100


@dataclass(frozen=True)
class Cloud:
    kind: ClassVar[str] = "cloud"
    spacing: float = 1.0
    fit: Fit = field(default_factory=Fit)
    density: Density | None = None


@dataclass(frozen=True)
class Lattice:
    kind: ClassVar[str] = "lattice"
    edge: int
    fit: Fit = Fit(Schedule(steps=9))


@dataclass(frozen=True)
class Whole:
    name: str = "plain"
    method: Cloud | Lattice = field(default_factory=Cloud)
    note: str | None = None
    folder: Path | None = None


UNUSUAL = Whole(
    "two words",
    Cloud(0.5, Fit(Schedule(7, 1e-3, True), "cpu", 0.25, (), (3.0, "m")), Density(3)),
    None,
    Path("a/b"),
)


@pytest.mark.parametrize("value", [Whole(), UNUSUAL, Whole(method=Lattice(5)), Cloud(), Lattice(3)])
def test_a_dataclass_goes_round_through_json(value):
    text = json.dumps(to_table(value), allow_nan=False)
    assert from_table(type(value), json.loads(text)) == value


def test_a_table_says_which_member_of_a_union_it_is():
    assert to_table(Whole())["method"]["kind"] == "cloud"
    assert from_table(Cloud | Lattice, {"kind": "lattice", "edge": 4}) == Lattice(4)
    with pytest.raises(InputError, match="kind must be one of cloud, lattice, but it is 'mesh'"):
        from_table(Cloud | Lattice, {"kind": "mesh"})
    with pytest.raises(InputError, match="kind is missing; add one of cloud, lattice"):
        from_table(Cloud | Lattice, {})
    with pytest.raises(InputError, match="kind must be one of cloud, but it is 'lattice'"):
        from_table(Cloud, {"kind": "lattice"})


def test_a_partial_table_changes_what_it_names():
    new = changed(UNUSUAL, {"method": {"fit": {"schedule": {"steps": 8}, "levels": [1, 2, 3]}}})
    assert new.method.fit.schedule == Schedule(8, 1e-3, True)
    assert new.method.fit.levels == (1, 2, 3)
    assert (new.name, new.method.density) == (UNUSUAL.name, UNUSUAL.method.density)


def test_another_member_of_a_union_starts_from_its_own_defaults():
    assert changed(UNUSUAL, {"method": {"kind": "lattice", "edge": 2}}).method == Lattice(2)
    assert changed(UNUSUAL, {"method": {"kind": "cloud", "spacing": 2}}).method.fit == UNUSUAL.method.fit
    assert changed(Cloud(), {"kind": "lattice", "edge": 1}, kind=Cloud | Lattice) == Lattice(1)
    assert changed(Cloud(2.0), {"density": {}}, kind=Cloud | Lattice) == Cloud(2.0, density=Density())


def test_a_field_called_kind_is_a_field():
    """Only a class variable is the name of a member: a field of that name leaves its neighbours alone."""

    @dataclass(frozen=True)
    class Encoding:
        kind: str = "hash"
        levels: int = 4

    @dataclass(frozen=True)
    class Network:
        encoding: Encoding = Encoding()

    Network.__annotations__["encoding"] = Encoding
    assert overridden(Network(Encoding(levels=9)), ["encoding.kind=fourier"]) == Network(Encoding("fourier", 9))


def test_merging_leaves_both_tables_alone():
    table, changes = {"a": {"b": 1, "c": {"d": 2}}}, {"a": {"c": {"e": 3}}, "f": 4}
    assert merged(table, changes) == {"a": {"b": 1, "c": {"d": 2, "e": 3}}, "f": 4}
    assert (table, changes) == ({"a": {"b": 1, "c": {"d": 2}}}, {"a": {"c": {"e": 3}}, "f": 4})
    same = {"b": {"kind": "x", "c": 2}}
    assert merged(same, {"b": {"kind": "x", "d": 3}}) == {"b": {"kind": "x", "c": 2, "d": 3}}
    assert merged(same, {"b": {"kind": "y", "d": 3}}) == {"b": {"kind": "y", "d": 3}}


# --- one field ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("assignment", "read"),
    [
        ("method.fit.schedule.steps=500", lambda w: w.method.fit.schedule.steps == 500),
        (" fit.steps = 500 ", lambda w: w.method.fit.schedule.steps == 500),
        ("steps=0", lambda w: w.method.fit.schedule.steps == 0),
        ("decay=1e-4", lambda w: w.method.fit.schedule.decay == 1e-4),
        ("decay=.5", lambda w: w.method.fit.schedule.decay == 0.5),
        ("decay=1", lambda w: repr(w.method.fit.schedule.decay) == "1.0"),
        ("warm=true", lambda w: w.method.fit.schedule.warm is True),
        ("backend=cpu", lambda w: w.method.fit.backend == "cpu"),
        ("stop=0.5", lambda w: w.method.fit.stop == 0.5),
        ("stop=none", lambda w: w.method.fit.stop is None),
        ("levels=[8, 4, 2]", lambda w: w.method.fit.levels == (8, 4, 2)),
        ('pair=[2, "mm"]', lambda w: w.method.fit.pair == (2.0, "mm")),
        ("name=a=b", lambda w: w.name == "a=b"),
        ("name=500", lambda w: w.name == "500"),
        ('name="quoted"', lambda w: w.name == "quoted"),
        ("folder=/tmp", lambda w: w.folder == Path("/tmp")),
        ("note=None", lambda w: w.note is None),
        ("density.every=7", lambda w: w.method.density == Density(7)),
        ("method.density=none", lambda w: w.method.density is None),
    ],
)
def test_a_field_is_changed_by_its_path(assignment, read):
    for base in (Whole(), UNUSUAL):
        assert read(overridden(base, [assignment]))


def test_assignments_follow_one_another():
    assert overridden(Whole(), ["steps=1", "steps=2", "name=x"]) == Whole("x", Cloud(fit=Fit(Schedule(2))))
    assert overridden(Whole(), []) == Whole()
    weights = ["fit.objective.spectral=0", "fit.objective.l1=1"]  # neither order may pass through an empty objective
    for order in (weights, weights[::-1]):
        objective = overridden(Voxels(), order).fit.objective
        assert (objective.spectral, objective.l1) == (0.0, 1.0)
    changed_kind = overridden(Whole(method=Lattice(3)), ["method.kind=cloud", "spacing=3"])
    assert changed_kind.method == Cloud(3.0)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("steps", "a setting must read PATH=VALUE, as fit.steps=500, but it is 'steps'"),
        ("=3", "a setting must read PATH=VALUE"),
        ("fit.stepz=3", r"the setting fit.stepz is not known; did you mean .*method\.fit\.schedule\.steps"),
        ("method.fit.scheduel.steps=3", r"did you mean method\.fit\.schedule\.steps"),
        ("qqqq=3", r"the setting qqqq is not known; use one of name, method\.kind, method\.spacing"),
        ("method.fit=3", "the setting method.fit is not known"),
        ("steps=many", r"method\.fit\.schedule\.steps must be a whole number, but it is 'many'"),
        ("steps=1.5", r"method\.fit\.schedule\.steps must be a whole number, but it is 1.5"),
        ("steps=true", r"method\.fit\.schedule\.steps must be a whole number, but it is True"),
        ("steps=none", r"method\.fit\.schedule\.steps must be a whole number, but it is 'none'"),
        ("steps=-1", r"method\.fit\.schedule: steps must not be negative, but it is -1"),
        ("decay=inf", r"decay must be a number, but it is inf"),
        ("warm=1", "warm must be true or false, but it is 1"),
        ("backend=gpu", "backend must be one of auto, cpu, but it is 'gpu'"),
        ("levels=3", "levels must be a list, but it is 3"),
        ("method.kind=mesh", "method.kind must be one of cloud, lattice, but it is 'mesh'"),
        ("method.density=3", "method.density must be a table, but it is 3"),
    ],
)
def test_what_cannot_be_set_is_said(assignment, message):
    with pytest.raises(InputError, match=message):
        overridden(Whole(), [assignment])


def test_an_ambiguous_path_names_the_candidates():
    @dataclass(frozen=True)
    class Two:
        first: Density = Density()
        second: Density = Density()

    with pytest.raises(InputError, match=r"every may mean first\.every, second\.every; write one of these"):
        overridden(Two(), ["every=3"])
    assert overridden(Two(), ["second.every=3"]) == Two(second=Density(3))


def test_paths_are_those_of_the_member_at_hand():
    assert "method.spacing" in paths(Whole())
    assert "method.spacing" not in paths(Whole(method=Lattice(2)))
    assert paths(Whole(method=Lattice(2)))["method.edge"] is int
    assert paths(Cloud())["fit.schedule.decay"] is float


# --- files --------------------------------------------------------------------------------------------------


def test_files_are_toml_or_json_by_their_names(tmp_path):
    toml, plain = tmp_path / "a.TOML", tmp_path / "b.settings"
    toml.write_text("[a]\nb = 1\n")
    plain.write_text('{"a": {"b": 1}}')
    assert read_table(toml) == read_table(plain) == {"a": {"b": 1}}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.toml", b"a = = 1", r"a\.toml must be valid TOML, but"),
        ("a.json", b"{", r"a\.json must be valid JSON, but.*; the name of a TOML file ends with \.toml\."),
        ("a.json", b"[1]", r"a\.json must hold a table, but it holds list"),
        ("a.json", b"\xff", r"a\.json must be a readable JSON file"),
        ("a.toml", None, r"a\.toml must be a TOML file, but there is no such file"),
    ],
)
def test_damaged_files_are_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_table(tmp_path / name)
