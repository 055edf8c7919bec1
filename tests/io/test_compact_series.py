"""Compact files of a series: what comes back, what is stored once, and what is refused."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch

from helpers.splats import cloud
from holosplat.checks import InputError
from holosplat.io.objects import Steps, names_of, read_object, read_series, write_compact, write_series
from holosplat.matter import DeltaBeta, Matter
from holosplat.representations import GaussianCloud, Stored, SurfaceMesh
from holosplat.representations.gaussians import raw_of
from holosplat.specimens.red_cells import icosphere

MATTER = Matter((DeltaBeta(4e-7, 2e-10),))


def surfaces(count: int = 4) -> dict[str, Stored]:
    """A ball that moves and breathes: the same triangles at all times."""
    points, faces = icosphere(4)
    moved = [(9 + 0.2 * k) * points + 0.7 * k for k in range(count)]
    return {
        f"t{k}": SurfaceMesh(torch.from_numpy(p), torch.from_numpy(faces.copy()), 1e-6, MATTER)
        for k, p in enumerate(moved)
    }


def gaussians(count: int = 4) -> dict[str, Stored]:
    """Gaussians of which a tenth move."""
    centres, scales, quaternions, amplitudes = cloud("ordinary", 1, 4000)
    parts = (scales.log(), quaternions, raw_of(amplitudes.abs() + 0.1))
    way = torch.zeros_like(centres)
    way[::10] = 0.8
    return {f"t{k}": GaussianCloud((centres + k * way, *parts), 1e-6, MATTER) for k in range(count)}


@pytest.mark.parametrize("make", [surfaces, gaussians])
def test_a_series_comes_back_as_its_objects_do_alone(make, tmp_path):
    objects = make()
    write_series(tmp_path / "s.h5", objects, Steps())
    found = read_series(tmp_path / "s.h5")
    assert list(found) == list(objects)
    for name, obj in objects.items():
        write_compact(tmp_path / "one.h5", obj, Steps())
        alone, shared = read_object(tmp_path / "one.h5").state(), found[name].state()
        assert shared["matter"] == alone["matter"]
        for key in obj.parameters():
            a, b = (s[key].reshape(len(s[key]), -1).double().numpy() for s in (alone, shared))
            order = [
                np.lexsort(np.round(m["centres" if make is gaussians else "vertices"].double().numpy(), 2).T)
                for m in (alone, shared)
            ]
            np.testing.assert_allclose(a[order[0]], b[order[1]], atol=1e-6)


def test_what_does_not_change_is_stored_once(tmp_path):
    """Triangles and sizes are those of the first; what moves a little takes less than by itself."""
    for objects, once in ((surfaces(), "faces"), (gaussians(), "log_scales")):
        write_series(tmp_path / "s.h5", objects, Steps())
        with h5py.File(tmp_path / "s.h5") as file:
            assert [once in group for group in file.values()] == [True, False, False, False]
            assert ["state" in group.attrs for group in file.values()] == [True, False, False, False]
        alone = 0
        for obj in objects.values():
            write_compact(tmp_path / "one.h5", obj, Steps())
            alone += (tmp_path / "one.h5").stat().st_size
        assert alone > 2 * (tmp_path / "s.h5").stat().st_size


def test_objects_of_other_sizes_and_kinds_stand_by_themselves(tmp_path):
    objects = {"a": gaussians()["t0"], "b": surfaces()["t0"], "c": gaussians()["t1"]}
    cut = {name: p[:100] for name, p in objects["c"].parameters().items()}
    objects["c"] = objects["c"].with_parameters(cut)
    write_series(tmp_path / "s.h5", objects, Steps())
    found = read_series(tmp_path / "s.h5")
    assert [obj.described for obj in found.values()] == [obj.described for obj in objects.values()]


def test_files_of_series_that_are_garbled_are_refused(tmp_path):
    path = tmp_path / "s.h5"
    write_series(path, surfaces(), Steps())
    with pytest.raises(InputError, match="series of them"):
        read_object(path)
    with h5py.File(path, "r+") as file:
        file["000001"].attrs["as_first"] = '["faces", "nothing"]'
    with pytest.raises(InputError, match="000001/nothing must be in the first object"):
        read_series(path)
    with h5py.File(path, "r+") as file:
        file["000001"].attrs["as_first"] = '["faces"]'
        assert file["000001/vertices"].attrs["from_first"]
        attributes = dict(file["000001/vertices"].attrs)
        del file["000001/vertices"]
        file["000001/vertices"] = np.zeros((3, 5), dtype=np.int16)
        file["000001/vertices"].attrs.update(attributes)
    with pytest.raises(InputError, match="must fit the first object's"):
        read_series(path)
    with pytest.raises(InputError, match="1 to"):
        write_series(tmp_path / "none.h5", {}, Steps())


def test_runs_are_named_by_what_tells_them_apart(tmp_path):
    assert names_of([tmp_path / "a" / "run", tmp_path / "b" / "run"]) == ["a/run", "b/run"]
    assert names_of([tmp_path / "a", tmp_path / "b"]) == ["a", "b"]
    with pytest.raises(InputError, match="named twice"):
        names_of([tmp_path / "a", tmp_path / "a"])
