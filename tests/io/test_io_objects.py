"""Files of objects: a neural field comes back whole, and every damage is said in a sentence that names the file.

tests/io/test_io_round_trips.py draws Gaussians, voxels and surfaces of any values.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.io.objects import FORMAT, read_gaussians, read_object, write_object
from holosplat.matter import Matter
from holosplat.representations import (
    KINDS,
    Flow,
    GaussianCloud,
    Lattice,
    MovingGaussians,
    MovingSurfaces,
    Stored,
    SurfaceMesh,
    TimeBasis,
    VoxelGrid,
)
from holosplat.specimens.red_cells import icosphere
from holosplat_bench.opponents.fields import (
    AlignedNetwork,
    Encoding,
    Network,
    NeuralField,
    PixelAligned,
    PixelAlignedField,
    SpaceTime,
    SpaceTimeField,
)
from holosplat_bench.opponents.moving.deformed_voxels import Deformation, DeformedVoxels
from holosplat_bench.opponents.moving.hexplane_field import HexPlaneField, HexPlanes
from holosplat_bench.opponents.moving.moving_voxels import LowRankVoxels, VoxelSeries
from holosplat_bench.opponents.photographed import AlphaCloud, RadianceField

PITCH = 2e-6
GRID = Grid((7, 5, 9), (PITCH, PITCH, PITCH), (-8e-6, 1e-6, -5e-6))
CELL = Matter.one(3e-7, 2e-10)
ALIGNED = AlignedNetwork((4, 6), 5, 1)
KNOWN = "kinds " + ", ".join(KINDS)
OLD = Path(__file__).resolve().parents[1] / "data/run_0_1_0/gaussians.h5"


def objects() -> dict[str, Stored]:
    """One of every kind."""
    torch.manual_seed(0)
    n = 6
    cloud = (torch.randn(n, 3), torch.rand(n, 3), torch.randn(n, 4), torch.randn(n, 2))
    sphere, faces = (torch.from_numpy(array.copy()) for array in icosphere(1))
    mask = torch.rand(GRID.shape) > 0.3
    free = GaussianCloud(cloud, PITCH, Matter.free(*CELL.channels[0]))
    lattice = Lattice.around((9.0, 5.0, 7.0), 3)
    flow = Flow(torch.randn(2, 3, *lattice.counts), lattice, TimeBasis(0, 1e-5, 1), 5e-6, 4)
    small = Network(Encoding(levels=2, features=2, log2_size=6), hidden=5, layers=1)
    return {
        "gaussians": free,
        "moving-gaussians": MovingGaussians(free, flow, torch.randn(2, n)),
        "voxels": VoxelGrid(torch.rand(2, *GRID.shape), GRID, Matter.several((3e-7, 2e-10), (1e-7, 1e-11))),
        "surfaces": SurfaceMesh(3 * sphere, faces.long(), PITCH, CELL, 3),
        "moving-surfaces": MovingSurfaces(
            torch.stack([3 * sphere, 3 * sphere + 1]), faces.long(), 0 * faces[:, 0], TimeBasis(0, 1e-5, 1), PITCH, CELL
        ),
        "neural-field": NeuralField(GRID, CELL, small, mask, seed=4, upper=0.7),
        "alpha-gaussians": AlphaCloud((*cloud[:3], torch.randn(n, 1), torch.randn(n, 1)), PITCH, CELL),
        "radiance-field": RadianceField(GRID, CELL, small, mask, seed=4),
        "pixel-aligned-field": PixelAlignedField(
            dict(PixelAligned(ALIGNED, 3).named_parameters()),
            torch.randn(2, 3, 11, 14),
            Views.from_angles([5.0, 70.0], (11, 14), PITCH),
            mask,
            GRID,
            CELL,
            network=ALIGNED,
            upper=0.8,
        ),
        "space-time-field": SpaceTimeField.still(
            torch.rand(3, *GRID.shape), GRID, np.array([0, 1e-5, 3e-5]), CELL, SpaceTime(pieces=1), 5, 0.9
        ),
        **on_voxels(),
    }


def on_voxels() -> dict[str, Stored]:
    """Those whose matter at any time is voxels of one grid."""
    times, planes, deformation = [0.0, 1e-5, 3e-5], HexPlanes(features=3, hidden=4), Deformation(2, 5, 1, 1, 3.0, 2.0)
    volumes, wanted = torch.rand(3, *GRID.shape), planes.shapes(GRID, 3)
    return {
        "voxel-series": VoxelSeries(volumes, GRID, times, CELL, 0.8),
        "low-rank-voxels": LowRankVoxels((volumes[:2], torch.rand(2, 3)), GRID, times, CELL),
        "hexplane-field": HexPlaneField(
            {name: torch.rand(shape) for name, shape in wanted.items()}, GRID, times, CELL, 0.9, planes
        ),
        "deformed-voxels": DeformedVoxels.still(volumes[0], GRID, times, CELL, 0.9, deformation, 3),
    }


@pytest.fixture(params=KINDS)
def obj(request) -> Stored:
    return objects()[request.param]


@pytest.fixture
def file(obj, tmp_path) -> Path:
    path = tmp_path / "object.h5"
    write_object(path, obj)
    return path


def assert_same_state(found: dict, wanted: dict) -> None:
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        if isinstance(value, dict):
            assert_same_state(found[name], value)
        elif isinstance(value, torch.Tensor):
            assert found[name].dtype == value.dtype
            assert torch.equal(found[name], value), name
        else:
            assert found[name] == value, name


def test_every_kind_comes_back(obj, file):
    found = read_object(file)
    assert type(found) is type(obj)
    assert_same_state(found.state(), obj.state())
    assert (found.described, found.matter) == (obj.described, obj.matter)
    views = Views.from_angles([0.0, 35.0], (11, 14), PITCH)
    with torch.no_grad():
        for ours, theirs in zip(obj.project(views), found.project(views), strict=False):
            assert torch.equal(ours, theirs)
    assert np.array_equal(found.voxelise(GRID).delta, obj.voxelise(GRID).delta)
    assert float(np.abs(found.voxelise(GRID).delta).max()) > 0


@pytest.mark.parametrize("encoding", [Encoding(kind="fourier", waves=6), Encoding(levels=3, log2_size=4)])
def test_a_field_of_any_encoding_comes_back(encoding, tmp_path):
    """The random waves are part of the file, for no seed tells them."""
    field = NeuralField(GRID, Matter.free(3e-7, 2e-10), Network(encoding, 4, 2), torch.ones(GRID.shape), seed=9)
    write_object(tmp_path / "f.h5", field)
    found = read_object(tmp_path / "f.h5")
    assert isinstance(found, NeuralField)
    at = torch.rand(20, 3) * 5
    assert torch.equal(found(at), field(at))
    assert found.network == field.network


def test_a_field_of_matter_on_both_sides_comes_back(tmp_path):
    network = Network(Encoding(levels=2, features=2, log2_size=6), hidden=5, layers=1)
    field = NeuralField(GRID, CELL, network, torch.ones(GRID.shape), upper=0.0, lower=-math.inf)
    write_object(tmp_path / "field.h5", field)
    found = read_object(tmp_path / "field.h5")
    assert isinstance(found, NeuralField)
    assert found.lower == -math.inf
    assert_same_state(found.state(), field.state())


def test_gradients_do_not_enter_a_file(tmp_path):
    """An object in the middle of a fit can be written, too."""
    values = torch.rand(1, *GRID.shape, requires_grad=True)
    write_object(tmp_path / "v.h5", VoxelGrid(values, GRID, CELL))
    found = read_object(tmp_path / "v.h5")
    assert not found.parameters()["values"].requires_grad
    assert torch.equal(found.parameters()["values"], values.detach())


# --- damage -------------------------------------------------------------------------------------------------


def with_state(change: Callable[[dict], object]) -> Callable[[h5py.File], None]:
    """A change of the plain values."""

    def act(file: h5py.File) -> None:
        state = json.loads(file.attrs["state"])
        change(state)
        file.attrs["state"] = json.dumps(state)

    return act


def with_channels(*channels: list[float]) -> Callable[[h5py.File], None]:
    """A change of δ and β of the matter."""
    return with_state(lambda state: state["matter"].update(channels=channels))


def replaced(name: str, act: Callable[[np.ndarray], object]) -> Callable[[h5py.File], None]:
    """A change of a dataset."""

    def change(file: h5py.File) -> None:
        array = file[name][()]
        del file[name]
        file[name] = act(array)

    return change


def first(value: float) -> Callable[[np.ndarray], np.ndarray]:
    """The first entry becomes `value`."""

    def act(array: np.ndarray) -> np.ndarray:
        array.reshape(-1)[0] = value
        return array

    return act


ANY: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "no format": (lambda f: f.attrs.__delitem__("format"), "its format is ''"),
    "a later format": (lambda f: f.attrs.update(format="holosplat object 2"), "its format is 'holosplat object 2'"),
    "no kind": (lambda f: f.attrs.__delitem__("kind"), KNOWN),
    "unknown kind": (lambda f: f.attrs.update(kind="sponge"), KNOWN),
    "no state": (lambda f: f.attrs.__delitem__("state"), "state"),
    "state that is no JSON": (lambda f: f.attrs.update(state="{"), "lacks or garbles"),
    "state that is no table": (lambda f: f.attrs.update(state="[1]"), "lacks or garbles"),
    "no matter": (with_state(lambda s: s.pop("matter")), "matter"),
    "matter that is none": (with_state(lambda s: s.update(matter=3)), "matter"),
    "three materials": (with_state(lambda s: s["matter"].update(channels=[[1, 2]] * 3)), "must be a whole object"),
    "text for a number": (with_state(lambda s: s["matter"].update(channels=[["a", 2]])), "matter"),
}
SOME: dict[tuple[str, str], tuple[Callable[[h5py.File], object], str]] = {
    ("gaussians", "no centres"): (lambda f: f.__delitem__("centres"), "centres"),
    ("gaussians", "other counts"): (replaced("centres", lambda a: a[1:]), "shapes"),
    ("gaussians", "another matter"): (with_state(lambda s: s["matter"].update(channels=[[1e-7, 0]])), "a channel each"),
    ("gaussians", "text"): (replaced("centres", lambda a: "far away"), "must hold numbers"),
    ("gaussians", "NaN"): (replaced("centres", first(math.nan)), "finite"),
    ("gaussians", "no unit"): (with_state(lambda s: s.pop("unit_length")), "unit_length"),
    ("gaussians", "a unit of zero"): (with_state(lambda s: s.update(unit_length=0)), "unit_length"),
    ("gaussians", "a group for a dataset"): (
        lambda f: (f.__delitem__("centres"), f.create_group("centres")),
        "centres",
    ),
    ("voxels", "infinite"): (replaced("values", first(math.inf)), "finite"),
    ("voxels", "a number"): (replaced("values", lambda a: 1.0), "shape"),
    ("voxels", "flat"): (replaced("values", lambda a: a[0, 0]), "grid|shape"),
    ("voxels", "no origin"): (with_state(lambda s: s.pop("origin")), "origin"),
    ("voxels", "no voxel"): (with_state(lambda s: s.update(voxel_size=[1e-6, 0, 1e-6])), "voxel"),
    ("surfaces", "faces of no vertices"): (replaced("faces", first(10_000)), "faces"),
    ("surfaces", "negative faces"): (replaced("faces", first(-1)), "faces"),
    ("surfaces", "quads"): (replaced("faces", lambda a: a.reshape(-1, 4)), "face"),
    ("surfaces", "NaN"): (replaced("vertices", first(math.nan)), "finite"),
    ("surfaces", "two materials"): (with_channels([1e-7, 1e-9], [1e-7, 1e-9]), "each of 2 materials"),
    ("gaussians", "dense beyond belief"): (with_channels([1e30, 0]), "channels must be at most"),
    ("gaussians", "δ of 20"): (with_channels([20, 0], [0, 1e-9]), "δ of matter"),
    ("gaussians", "an infinite number"): (with_channels([1e400, 0]), "finite"),
    ("gaussians", "far away"): (replaced("centres", first(1e30)), "centres must hold numbers of at most"),
    ("surfaces", "lines of text"): (with_state(lambda s: s.update(lines="two")), "garbles"),
    ("neural-field", "a weight less"): (lambda f: f.__delitem__("weights/output.bias"), "output.bias"),
    ("neural-field", "another shape"): (replaced("weights/output.bias", lambda a: np.ones(7, "f4")), "output.bias"),
    ("neural-field", "another network"): (with_state(lambda s: s["network"].update(hidden=6)), "weights|shape"),
    ("neural-field", "no network"): (with_state(lambda s: s.update(network={"depth": 2})), "network.depth"),
    ("neural-field", "NaN"): (replaced("weights/output.bias", first(math.nan)), "finite"),
    ("neural-field", "no mask"): (lambda f: f.__delitem__("mask"), "mask"),
}


def broken(file: Path, change: Callable[[h5py.File], object]) -> str:
    """What reading says of a file after a change of it; it names the file, in a sentence."""
    with h5py.File(file, "r+") as opened:
        change(opened)
    with pytest.raises(InputError) as caught:
        read_object(file)
    message = str(caught.value)
    assert str(file) in message
    assert message.endswith((".", "?"))
    return message


@pytest.mark.parametrize("fault", ANY)
def test_damage_of_any_file_is_told(file, fault):
    change, words = ANY[fault]
    assert words in broken(file, change)


@pytest.mark.parametrize("fault", SOME, ids=": ".join)
def test_damage_of_one_kind_is_told(tmp_path, fault):
    change, words = SOME[fault]
    path = tmp_path / "object.h5"
    write_object(path, objects()[fault[0]])
    message = broken(path, change)
    assert any(word in message for word in words.split("|")), message


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        (b"", "does not start like one"),
        (b"hello", "does not start like one"),
        (0.5, "truncated"),
    ],
)
def test_files_that_are_no_hdf5_are_refused(file, content, words):
    if content is None:
        file.unlink()
    else:
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2] if content == 0.5 else content)
    with pytest.raises(InputError, match=words):
        read_object(file)


def test_a_file_that_cannot_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    """It is replaced as a whole or not at all."""
    path = tmp_path / "object.h5"
    write_object(path, objects()["voxels"])
    before = path.read_bytes()

    def full(*arguments: object, **more: object) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr(h5py.Group, "create_dataset", full)
    with pytest.raises(InputError, match="the disk is full"):
        write_object(path, objects()["surfaces"])
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["object.h5"]


# --- Gaussians of version 0.1 -------------------------------------------------------------------------------


def test_gaussians_of_version_0_1_are_read_and_written_anew(tmp_path):
    old = read_object(OLD)
    assert (old.kind, old.described) == ("gaussians", "164 Gaussians")
    write_object(tmp_path / "new.h5", old)
    assert_same_state(read_object(tmp_path / "new.h5").state(), old.state())
    with h5py.File(tmp_path / "new.h5") as file:
        assert file.attrs["format"] == FORMAT


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.__delitem__("quaternions"), "quaternions must be there, but it is missing"),
        (lambda f: f.attrs.__delitem__("delta"), "@delta must hold numbers"),
        (lambda f: f.attrs.update(unit_length="long"), "@unit_length must hold numbers"),
        (lambda f: f.attrs.update(second=[1.0]), "@second"),
        (replaced("centres", lambda a: a[1:]), "shapes"),
        (replaced("centres", first(math.nan)), "finite"),
    ],
)
def test_damaged_gaussians_of_version_0_1_are_refused(tmp_path, change, words):
    path = tmp_path / "gaussians.h5"
    path.write_bytes(OLD.read_bytes())
    assert words in broken(path, change)


def test_two_materials_and_free_channels_of_version_0_1(tmp_path):
    """`second` tells two materials from free channels."""
    path = tmp_path / "gaussians.h5"
    path.write_bytes(OLD.read_bytes())
    with h5py.File(path, "r+") as file:
        replaced("raw_amplitudes", lambda a: np.repeat(a, 2, axis=1))(file)
        delta, beta = (float(np.asarray(file.attrs[name]).reshape(-1)[0]) for name in ("delta", "beta"))
    assert read_gaussians(path).matter == Matter.free(delta, beta)
    with h5py.File(path, "r+") as file:
        file.attrs["second"] = [1e-7, 1e-11]
    assert read_gaussians(path).matter == Matter.several((delta, beta), (1e-7, 1e-11))
