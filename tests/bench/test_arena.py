"""The arena: contestants in processes of their own, what they are held against, the Pareto front and the 3 % rule."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import holosplat as hs
from helpers.cli import holosplat
from holosplat.projectors.voxels import SliceProjector
from holosplat_bench.suite.arena import contest
from holosplat_bench.suite.arena import run as arena_run
from holosplat_bench.suite.arena.cases import FAMILIES, SealedCase, prepare_case
from holosplat_bench.suite.arena.contest import Contestant, Question, compete
from holosplat_bench.suite.arena.history import Entry, changes, previous, read_history
from holosplat_bench.suite.arena.run import Arena, ArenaFolder, entry_of, forward, gradient, run_arena
from holosplat_bench.suite.families import SIMULATED
from holosplat_bench.suite.folder import Row
from holosplat_bench.suite.pages.arena import front, overall, write_arena

SIDE, SEED, NAME = 16, 11, "few-photons"
ACTS = "helpers.arena_peers"


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> SealedCase:
    """Up to three balls, on few pixels."""
    return prepare_case(NAME, SEED, SIDE, tmp_path_factory.mktemp("case"))


def question(seed: int = 0) -> Question:
    """Random arrays in views at odd angles."""
    rng = np.random.default_rng(seed)
    angles, shape = np.array([0.0, 0.4, 1.1, 2.0, 3.0]), (5, SIDE, SIDE)
    volume = np.zeros((SIDE,) * 3)
    volume[4:12, 4:12, 4:12] = 0.05 * rng.random((8, 8, 8))
    frames = 1 + 0.1 * rng.normal(size=shape)
    return Question(frames, angles, 1e-6, 20.0, 0.05, 500.0, rng.random(shape), volume)


def peer(name: str, act: str, track="retrieval", distribution: str = "numpy") -> Contestant:
    return Contestant(name, track, distribution, f"{ACTS}:{act}", "a pretended peer")


# --- processes ------------------------------------------------------------------------------------------------


def test_an_answer_comes_back_with_what_it_took():
    asked = question()
    done = compete(f"{ACTS}:busy", asked, 2, 60)
    assert done.reason == ""
    assert done.answer is not None
    assert np.array_equal(done.answer["lines"], asked.lines)
    assert done.seconds is not None
    assert 0.2 < done.seconds < 0.4  # of one call of the two, and the child's time is in it
    assert done.memory_bytes is not None
    assert done.memory_bytes > 200e6  # 200 MB are touched


@pytest.mark.parametrize(
    ("act", "limit", "words"),
    [
        ("crash", 60, "ended by signal SIGKILL"),
        ("slow", 3, "stopped after 3 s"),
        ("wrong", 60, "ValueError: no such geometry"),
        ("silent", 60, "ended with code 0 and no answer"),
    ],
)
def test_a_failing_peer_is_an_outcome_that_says_so(act, limit, words):
    done = compete(f"{ACTS}:{act}", question(), 1, limit)
    assert done.answer is None
    assert words in done.reason


# --- what answers are held against ----------------------------------------------------------------------------


def test_exact_strips_are_those_of_the_slice_matrices():
    asked = question()
    views = hs.Views.from_angles(np.rad2deg(asked.angles), (SIDE, SIDE), 1.0)
    projector = SliceProjector(hs.Grid.of_views(views), views)
    volume = projector.volume_in(hs_tensor(asked.volume))
    found = projector.lines_out(projector.project(volume)).numpy()
    np.testing.assert_allclose(forward(asked, asked.volume), found, atol=1e-6)


def hs_tensor(array: np.ndarray):
    import torch

    return torch.from_numpy(array).float()


def test_the_gradient_is_that_of_finite_differences():
    asked = question()
    step = np.random.default_rng(1).normal(size=asked.volume.shape)
    step[asked.volume == 0] = 0
    sides = [misfit(replace(asked, volume=asked.volume + sign * 1e-5 * step)) for sign in (1, -1)]
    assert (sides[0] - sides[1]) / 2e-5 == pytest.approx(float((gradient(asked) * step).sum()), rel=1e-6)


def misfit(asked: Question) -> float:
    """Half the squared misfit, written out once more."""
    fy, fx = (np.fft.fftfreq(2 * SIDE, asked.pixel),) * 2
    chirp = np.pi * hs.units.wavelength(asked.energy_kev) * asked.distance * (fy[:, None] ** 2 + fx**2)
    wave = np.pad(np.exp(-(1 / asked.ratio + 1j) * forward(asked, asked.volume)) - 1, ((0, 0), (0, SIDE), (0, SIDE)))
    seen = np.fft.ifft2(np.fft.fft2(wave) * np.exp(-1j * chirp))[:, :SIDE, :SIDE] + 1
    return 0.5 * float(((np.abs(seen) ** 2 - asked.frames) ** 2).sum())


def test_every_case_is_of_a_family_and_sealed_by_its_seed(case, tmp_path):
    assert len(FAMILIES) == 12
    assert set(FAMILIES.values()) <= set(SIMULATED)
    again, other = (prepare_case(NAME, seed, SIDE, tmp_path / str(seed)) for seed in (SEED, SEED + 1))
    assert np.array_equal(again.scan.frames, case.scan.frames)
    assert not np.array_equal(other.scan.frames, case.scan.frames)
    assert case.scan.is_test.sum() == 2
    found = forward(arena_run._Judge.of(case).question("steps"), arena_run._Judge.of(case)._radians())
    assert np.linalg.norm(found - case.lines) < 0.1 * np.linalg.norm(case.lines)  # one scene, on few voxels
    with pytest.raises(hs.InputError, match="another size or seed"):
        prepare_case(NAME, SEED, 2 * SIDE, tmp_path / str(SEED))
    with pytest.raises(hs.InputError, match="size must"):
        prepare_case(NAME, SEED, 4, tmp_path / "small")


# --- the run and its page -------------------------------------------------------------------------------------


@pytest.fixture
def arena() -> Arena:
    rows = [peer("right", "right"), peer("crash", "crash"), peer("slow", "slow"), peer("shape", "other_shape")]
    rows += [peer("nan", "not_finite"), peer("elsewhere", "right", distribution="no-such-distribution")]
    return Arena([NAME], ["retrieval"], SEED, SIDE, 20.0, tuple(rows))


def test_a_run_goes_on_past_its_peers_and_keeps_rows(arena, case, tmp_path, monkeypatch):
    np.save(tmp_path / "lines.npy", case.lines)
    monkeypatch.setenv("ARENA_LINES", str(tmp_path / "lines.npy"))
    limits = {"slow": 2.0}
    real = compete
    monkeypatch.setattr(
        arena_run, "compete", lambda act, q, n, limit: real(act, q, n, limits.get(act.split(":")[1], limit))
    )
    folder, told = ArenaFolder(tmp_path / "arena"), []
    run_arena(arena, folder, on_row=lambda row, left: told.append((row.method, row.reason, left)))
    assert [name for name, _, _ in told] == [f"retrieval+{n}" for n in ("right", "crash", "slow", "shape", "nan")]
    assert [left for _, _, left in told] == [4, 3, 2, 1, 0]
    assert told[0][1] == ""
    assert "SIGKILL" in told[1][1]
    assert told[2][1] == "stopped after 2 s"
    assert "its shape is" in told[3][1]
    assert "finite" in told[4][1]
    rows = {row.method: row for row in folder.read_rows()}
    assert rows["retrieval+right"].test["error"] == pytest.approx(0.0, abs=1e-9)
    run_arena(arena, folder, on_row=lambda row, left: told.append(row))
    assert len(told) == 5  # nothing is made again
    entry = entry_of(arena, folder)
    assert entry.absent == ["no-such-distribution"]
    html, markdown = write_arena(entry, [], folder.path)
    text = html.read_text(encoding="utf-8")
    for words in ("Not installed: no-such-distribution", "crash: no result on few-photons: ended by signal SIGKILL"):
        assert words in text
        assert words.split(":")[0] in markdown.read_text(encoding="utf-8")
    assert 'src="data:image' in text
    assert "http" not in text.replace("http://www.w3.org", "")


def test_the_best_pair_is_of_the_best_rows_and_needs_them(case, tmp_path):
    folder = ArenaFolder(tmp_path / "arena")
    folder.create()
    table = (
        peer("bad", "right"),
        peer("good", "right"),
        peer("volume", "right", "tomography"),
        peer("best-pair", "right", "jobs"),
    )
    arena, judge = Arena([case.name], ["jobs"], SEED, SIDE, 20.0, table), arena_run._Judge.of(case)
    assert contest.BEST_PAIR == "best-pair"
    assert "run these tracks" in judge.row(table[3], arena, folder).reason
    for contestant, error in zip(table, (0.5, 0.2, 0.3)):
        row = replace(judge.blank, method=arena_run.row_name(contestant), family=contestant.track, status="done")
        folder.write_row(replace(row, test={"error": error}))
    assert [one.name for one in judge._best_pair(arena, folder)] == ["good", "volume"]


# --- the front and the 3 % rule -------------------------------------------------------------------------------


def entry(when: str, commit: str = "abc", machine: str = "one", **numbers: tuple[float, float]) -> Entry:
    """Of two cases; contestant → error and seconds on both."""
    rows = []
    for name, (error, seconds) in numbers.items():
        for case in ("a", "b"):
            known = {"ssim": 0.9, "dice": 0.8, "error": error}
            row = Row(case, 1, f"tomography+{name}", "tomography", "said", 0, "done", "", "", commit, when)
            rows.append(replace(row, test=known, seconds=seconds, memory_bytes=10**8, machine={"processor": machine}))
    return Entry.of(rows, 48, [], {})


def test_the_front_is_of_those_whom_none_beats_in_both():
    shown = entry("2026", quick=(0.5, 1.0), right=(0.1, 9.0), slow=(0.5, 2.0), wrong=(0.9, 1.0), between=(0.3, 3.0))
    assert front(overall(shown, "tomography")) == {"quick", "right", "between"}


@pytest.mark.parametrize(
    ("error", "seconds", "worse"),
    [(0.1029, 1.029, []), (0.1031, 1.0, ["error"]), (0.1, 1.031, ["seconds"]), (0.05, 0.5, [])],
)
def test_three_percent_more_error_or_time_is_worse(error, seconds, worse):
    before, now = entry("2026-01", us=(0.1, 1.0)), entry("2026-02", us=(error, seconds))
    assert [change.number for change in changes(now, before) if change.worse] == worse
    assert not any(change.worse for change in changes(now, None))


def test_less_dice_is_worse_and_only_shared_cases_count():
    before, now = entry("2026-01", us=(0.1, 1.0)), entry("2026-02", us=(0.1, 1.0))
    for row in now.rows:
        row["numbers"]["dice"] = 0.7
    assert [(c.number, round(c.factor, 3)) for c in changes(now, before) if c.worse] == [("dice", 1.143)]
    before.rows[:] = [row for row in before.rows if row["case"] == "a"]
    now.rows[1]["numbers"]["error"] = 5.0  # of the case that the entry before lacks
    assert "error" not in [c.number for c in changes(now, before) if c.worse]


def test_entries_are_compared_on_one_machine_and_red_on_the_page(tmp_path):
    line = [entry("2026-01", "aaa", holosplat=(0.1, 1.0)), entry("2026-02", "other7", "two", holosplat=(0.2, 9.0))]
    now = entry("2026-03", "ccc", holosplat=(0.11, 1.0))
    for one in (*line, now):
        one.write(tmp_path / one.file)
    history = read_history(tmp_path)
    assert [one.commit for one in history] == ["aaa", "other7", "ccc"]
    assert previous(now, history) == line[0]
    html, _ = write_arena(now, history, tmp_path)
    text = html.read_text(encoding="utf-8")
    assert '<span class="worse">0.11 (worse by 10 %)</span>' in text
    assert "other7" not in text
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(hs.InputError, match="must be an entry"):
        read_history(tmp_path)


# --- the command, and the real peers --------------------------------------------------------------------------


def test_the_command_lists_and_refuses(tmp_path):
    listed = holosplat("bench", "arena", "--list").out
    assert all(name in listed for name in (*FAMILIES, "astra-sirt", "hotopy-ctf", "best-pair"))
    for words, said in (
        (("--cases", "nothing"), "--cases must be among"),
        (("--tracks", "nothing"), "--tracks must be among"),
        (("--limit", "0"), "limit must be above 0 s"),
        (("--history", str(tmp_path / "no")), "--history must be a folder"),
    ):
        done = holosplat("bench", "arena", "--out", str(tmp_path / "arena"), *words)
        assert done.code != 0
        assert said in done.err
    assert not (tmp_path / "arena").exists()


QUICK = [c for c in contest.CONTESTANTS if c.distribution in ("", "torch", "astra-toolbox", "svmbir")]
BOUNDS = {"kernels": 0.02, "steps": 1.0, "retrieval": 1.0, "tomography": 1.0}
"""Right orientation, sign and units; a mirrored or negative answer is further away."""


@pytest.mark.parametrize("contestant", [c for c in QUICK if c.track in BOUNDS], ids=arena_run.row_name)
def test_contestants_see_what_is_asked(case, contestant, tmp_path):
    if not contestant.installed:
        pytest.skip(f"needs the package {contestant.distribution}")
    judge = arena_run._Judge.of(case)
    asked = judge.question(contestant.track)
    answer = arena_run_act(contestant)(asked)()
    numbers = judge.numbers(contestant.track, asked, answer)
    assert numbers["error"] is not None
    assert numbers["error"] < BOUNDS[contestant.track]
    assert (numbers.get("adjoint") or 0) < 1e-4


def arena_run_act(contestant: Contestant):
    from holosplat_bench.suite.arena.contest import located

    return located(contestant.act)


def test_files_of_the_time_line_hold_no_paths():
    """Those that are committed."""
    for path in (Path(__file__).parents[2] / "docs" / "data" / "arena").glob("*.json"):
        assert "/" not in Entry.read(path).file
        assert "/work" not in path.read_text(encoding="utf-8")
