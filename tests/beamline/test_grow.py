"""`holosplat grow`: the files, the series that ParaView and our reader open, going on after a break, bad input."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from holosplat.beamline.grow import Growth, SeriesFolder, grow
from holosplat.checks import InputError
from holosplat.cli import main
from holosplat.io.paraview import TimeStep, read_pvd, write_pvd
from holosplat.io.vtk import read_meshes
from holosplat.specimens.membrane.model import Elasticity

SMALL = Growth(cells=2, box=(24e-6, 17e-6, 13e-6), flow=0.02, snapshots=3, interval=1e-5, frequency=3, seed=4)


@pytest.fixture(scope="module")
def series(tmp_path_factory) -> Path:
    """A short series."""
    folder = tmp_path_factory.mktemp("grown") / "series"
    seen: list[float] = []
    grown = grow(SMALL, folder, on_progress=seen.append)
    assert grown.snapshots == 3
    assert grown.volume < 0.01
    assert grown.area < 0.05
    assert seen == sorted(seen)
    assert seen[-1] == 1
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in (".vtp", ".pvd")}


def test_the_series_reads_back(series):
    assert {path.name for path in series.iterdir()} == {
        *(f"rbc{c:02d}_{t:03d}.vtp" for c in range(2) for t in range(3)),
        "cells.pvd",
        "grow.json",
        "state.npz",
    }
    steps = read_pvd(series / "cells.pvd")
    assert [step.time for step in steps] == pytest.approx([0, 1e-5, 2e-5])
    suspension = SMALL.suspension()
    rest = suspension.membrane.mesh
    before = None
    for step in steps:
        meshes = read_meshes(step.files, "um")
        assert [mesh.name for mesh in meshes] == [file.name for file in step.files]
        for mesh in meshes:
            assert np.array_equal(mesh.faces, rest.faces)
            assert mesh.volume == pytest.approx(rest.volume, rel=0.01)
            assert 0 <= mesh.vertices[:, 0].mean() < 24e-6
            low, high = mesh.bounds
            assert (low[1:] > 0).all()
            assert (high[1:] < SMALL.box[1:]).all()
        centres = np.array([mesh.vertices.mean(0) for mesh in meshes])
        if before is not None:
            moved = np.mod(centres - before, 24e-6)[:, 0]
            assert (moved > 0.02e-6).all()
            assert (moved <= 0.02 * 1e-5).all()  # no faster than the fluid anywhere
        before = centres
    first = read_meshes(steps[0].files, "um")
    lengths = [np.linalg.norm(m.vertices[rest.faces[:, 0]] - m.vertices[rest.faces[:, 1]], axis=1) for m in first]
    assert np.allclose(lengths, np.linalg.norm(np.diff(rest.vertices[rest.faces[:, :2]], axis=1)[:, 0], axis=1))


def test_an_interrupted_run_goes_on_to_the_same_files(series, tmp_path):
    def stop(fraction: float) -> None:
        if fraction > 0.6:
            raise KeyboardInterrupt

    folder = tmp_path / "broken"
    with pytest.raises(KeyboardInterrupt):
        grow(SMALL, folder, on_progress=stop)
    assert len(read_pvd(folder / "cells.pvd")) == 2
    grow(SMALL, folder, resume=True)
    assert contents(folder) == contents(series)


def test_more_snapshots_later(series, tmp_path):
    folder = tmp_path / "longer"
    grow(replace(SMALL, snapshots=1), folder)
    grow(SMALL, folder, resume=True)
    assert contents(folder) == contents(series)
    assert grow(SMALL, folder, resume=True).snapshots == 3  # nothing left to do
    with pytest.raises(InputError, match="has 3 snapshots already"):
        grow(replace(SMALL, snapshots=2), folder, resume=True)
    with pytest.raises(InputError, match="with the options of the start, but seed was 4"):
        grow(replace(SMALL, seed=5), folder, resume=True)
    with pytest.raises(InputError, match="new or empty"):
        grow(SMALL, folder)
    (folder / "state.npz").write_bytes(b"PK nonsense")
    with pytest.raises(InputError, match="damaged"):
        grow(SMALL, folder, resume=True)


def test_a_cell_that_swells_too_far_stops_the_run(tmp_path):
    soft = replace(SMALL, flow=0.5, elasticity=Elasticity(global_area=0.0))
    with pytest.raises(InputError, match=r"the area of a cell must stay within 5 % .* raise --global-area"):
        grow(soft, tmp_path / "soft")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--cells", "0"], "cells must be from 1"),
        (["--snapshots", "0"], "snapshots must be from 1"),
        (["--flow", "-1"], "--flow must not be negative"),
        (["--box", "80e-6", "34", "26e-6"], "--box must be at most 1 metres, but it is 34; give it in metres"),
        (["--box", "20e-6", "3e-6", "20e-6"], "must fit into the box"),
        (["--cells", "900"], "they would fill 119% of it"),
        (["--frequency", "2"], "frequency must be a whole number from 3 to 20"),
        (["--global-area", "-1"], "--global-area must not be negative"),
        (["--viscosity", "0"], "viscosity must be a positive number"),
        (["--interval", "0"], "interval must be a positive number"),
        (["--warm-up", "-1"], "--warm-up must not be negative"),
        (["--seed", "-1"], "--seed must not be negative"),
        (["--tolerance", "1"], "tolerance must lie between"),
        (["--resume"], "--resume needs a folder that grow began"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(arguments, said, tmp_path, monkeypatch, capsys):
    out = tmp_path / "series"
    monkeypatch.setattr(sys, "argv", ["holosplat", "grow", "--out", str(out), *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not out.exists()


def test_the_command(tmp_path, monkeypatch, capsys):
    out = tmp_path / "series"
    options = "--cells 1 --box 15e-6 15e-6 12e-6 --flow 0.01 --snapshots 2 --interval 2e-6 --frequency 3"
    monkeypatch.setattr(sys, "argv", ["holosplat", "grow", "--out", str(out), *options.split()])
    main()
    assert "2 snapshots of 1 cell" in capsys.readouterr().err
    assert SeriesFolder(out).file(0, 1).is_file()


def test_interrupting_the_command(tmp_path, monkeypatch, capsys):
    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("holosplat.cli.imaging.grow_cells", interrupted)
    monkeypatch.setattr(sys, "argv", ["holosplat", "grow", "--out", str(tmp_path / "series")])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 130
    assert "go on with --resume" in capsys.readouterr().err


def test_collections(tmp_path):
    """Odd names survive; files of one time come in the order of their parts, times in theirs."""
    files = [tmp_path / 'a & "b".vtp', tmp_path / "c.vtu"]
    for file in files:
        file.touch()
    path = tmp_path / "all.pvd"
    write_pvd(path, [TimeStep(2e-6, tuple(files)), TimeStep(1e-6, (files[1],))])
    assert read_pvd(path) == [TimeStep(1e-6, (files[1],)), TimeStep(2e-6, tuple(files))]
    good = path.read_text()
    for damage, said in (
        (good[:60], "readable ParaView collection"),
        ("<other/>", "must be a ParaView collection"),
        (good.replace("c.vtu", "d.vtu"), "names 'd.vtu'"),
        (good.replace('timestep="1e-06"', 'timestep="soon"'), "must be a number, but it is 'soon'"),
        ('<VTKFile type="Collection"><Collection/></VTKFile>', "at least one file"),
    ):
        path.write_text(damage)
        with pytest.raises(InputError, match=said):
            read_pvd(path)
    with pytest.raises(InputError, match="there is no such file"):
        read_pvd(tmp_path / "none.pvd")
    with pytest.raises(InputError, match="times must be finite"):
        write_pvd(path, [TimeStep(float("nan"), (files[0],))])
    with pytest.raises(InputError, match=r"legacy one; write it as \.vtp"):  # ParaView would not open it
        write_pvd(path, [TimeStep(0.0, (tmp_path / "a.vtk",))])
