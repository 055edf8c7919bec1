"""NXtomo: what is written comes back, what other programs write is understood, what is wrong is named."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_y
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.scan import Exposures, Scan

DETECTOR = "/entry/instrument/detector/"
ENERGY = "/entry/instrument/beam/incident_energy"
ANGLE = "/entry/sample/rotation_angle"
N, H, W = 6, 4, 5


def scan(rotations=None) -> Scan:
    """A scan in which every number is different, with poses of any orientation."""
    rng = np.random.default_rng(0)
    rotations = Rotation.random(N, random_state=1).as_matrix() if rotations is None else rotations
    views = Views(rotations, rng.normal(size=(N, 2)) * 1e-6, (H, W), 3.2e-6)
    exposures = Exposures(views, 20.0, 0.1 + 0.01 * np.arange(N), 0.1 * np.arange(N), 1e-6 * np.arange(N))
    provenance = {"command": "holosplat simulate", "a/b %2F": "é\nü", ".": "dot", "empty": ""}
    return Scan(rng.uniform(0.5, 1.5, (N, H, W)), exposures, np.arange(N) % 3 == 2, provenance)


def minimal(path, also=None):
    """The least an NXtomo file must hold, from another program; `also` replaces or (None) removes fields."""
    angles = np.arange(N) * 30.0
    datasets = {
        DETECTOR + "data": (np.arange(N * H * W).reshape(N, H, W) + 1.0, None),
        DETECTOR + "x_pixel_size": (3.2, "um"),
        DETECTOR + "y_pixel_size": (3.2, "um"),
        DETECTOR + "distance": (12.0, "cm"),
        ENERGY: (20000.0, "eV"),
        ANGLE: (angles, "deg"),
    }
    for name, entry in (also or {}).items():
        datasets[name if name.startswith("/") else DETECTOR + name] = entry
    with h5py.File(path, "w") as file:
        for name, entry in datasets.items():
            if entry is None:
                continue
            value, unit = entry
            file[name] = value
            if unit is not None:
                file[name].attrs["units"] = unit
    return path


def same(a: Scan, b: Scan) -> None:
    assert np.array_equal(a.frames, b.frames)
    assert np.array_equal(a.views.rotations, b.views.rotations)
    assert np.array_equal(a.views.shifts, b.views.shifts)
    assert (a.views.shape, a.views.pixel_size) == (b.views.shape, b.views.pixel_size)
    np.testing.assert_array_equal(a.exposures.energy_kev, b.exposures.energy_kev)
    for name in ("distance", "psf_sigma_px", "time"):
        assert np.array_equal(getattr(a.exposures, name), getattr(b.exposures, name)), name
    assert np.array_equal(a.is_test, b.is_test)
    assert a.provenance == b.provenance


# --- writing


def test_everything_comes_back_exactly(tmp_path):
    write_scan(tmp_path / "scan.h5", scan())
    same(read_scan(tmp_path / "scan.h5"), scan())
    assert [p.name for p in tmp_path.iterdir()] == ["scan.h5"]


def test_file_is_nexus(tmp_path):
    write_scan(tmp_path / "scan.nxs", scan(rotation_y(np.arange(N) * 25.0)))
    with h5py.File(tmp_path / "scan.nxs") as file:
        assert file["/entry/definition"].asstr()[()] == "NXtomo"
        classes = {"/": "NXroot"}
        file.visititems(
            lambda name, item: (
                classes.update({name: item.attrs.get("NX_class")}) if isinstance(item, h5py.Group) else None
            )
        )
        assert classes == {
            "/": "NXroot",
            "entry": "NXentry",
            "entry/data": "NXdata",
            "entry/instrument": "NXinstrument",
            "entry/instrument/beam": "NXbeam",
            "entry/instrument/detector": "NXdetector",
            "entry/instrument/source": "NXsource",
            "entry/process": "NXprocess",
            "entry/process/provenance": "NXcollection",
            "entry/sample": "NXsample",
        }
        plot = file[file.attrs["default"]][file[file.attrs["default"]].attrs["default"]]
        assert plot[plot.attrs["signal"]] == file[DETECTOR + "data"]
        assert plot["rotation_angle"] == file[ANGLE]
        assert file[ANGLE].attrs["units"] == "deg"
        assert file[ANGLE][()] == pytest.approx(np.arange(N) * 25.0)
        assert file["/entry/sample/view_rotation"].dtype == np.float64
        assert file[DETECTOR + "image_key"][()].tolist() == [0] * N
        assert file[DETECTOR + "data"].dtype == np.float32
        assert file["/entry/process/program"].asstr()[()] == "holosplat"
        units = {
            DETECTOR + "x_pixel_size": "m",
            DETECTOR + "distance": "m",
            ENERGY: "keV",
            "/entry/sample/time": "s",
        }
        assert {name: file[name].attrs["units"] for name in units} == units


def test_rotation_angle_of_tilted_views_is_the_nearest(tmp_path):
    write_scan(tmp_path / "scan.h5", scan())
    with h5py.File(tmp_path / "scan.h5") as file:
        written = file[ANGLE][()]
    candidates = np.arange(-180, 180, 0.05)
    overlap = np.einsum("aij,nij->na", rotation_y(candidates), scan().views.rotations)
    assert np.cos(np.deg2rad(written - candidates[overlap.argmax(1)])) == pytest.approx(np.ones(N), abs=1e-6)


def test_angle_alone_gives_the_poses_of_a_tomogram(tmp_path):
    path = tmp_path / "scan.h5"
    write_scan(path, scan(rotation_y([0, 30, 60, 90, 179, 271])))
    with h5py.File(path, "a") as file:
        del file["/entry/sample/view_rotation"]
    assert read_scan(path).views.rotations == pytest.approx(rotation_y([0, 30, 60, 90, 179, 271]), abs=1e-14)


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "scan.h5"
    write_scan(path, scan())
    before = path.read_bytes()

    def fail(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr("holosplat.io.nxtomo._write_process", fail)
    with pytest.raises(InputError, match=r"scan\.h5 must be writable.*No space left"):
        write_scan(path, scan())
    monkeypatch.setattr("holosplat.io.nxtomo._write_process", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_scan(path, scan())
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["scan.h5"]


def test_writing_where_one_cannot(tmp_path):
    with pytest.raises(InputError, match="existing folder"):
        write_scan(tmp_path / "none" / "scan.h5", scan())
    odd = Scan(scan().frames, scan().exposures, scan().is_test, {"n": 3})  # type: ignore[dict-item]
    with pytest.raises(InputError, match="provenance"):
        write_scan(tmp_path / "scan.h5", odd)
    assert list(tmp_path.iterdir()) == []


# --- what other programs write


def test_minimal_file_and_its_units(tmp_path):
    read = read_scan(minimal(tmp_path / "scan.h5"))
    assert read.frames.dtype == np.float32
    assert read.frames[1, 0, 0] == H * W + 1
    assert read.views.rotations == pytest.approx(rotation_y(np.arange(N) * 30.0), abs=1e-14)
    assert read.views.pixel_size == pytest.approx(3.2e-6, rel=1e-12, abs=0)
    assert read.exposures.distance == pytest.approx(np.full(N, 0.12))
    assert read.exposures.energy_kev == pytest.approx(20.0)
    for zeros in (read.views.shifts, read.exposures.psf_sigma_px, read.exposures.time, read.is_test):
        assert not zeros.any()
    assert read.provenance == {}


@pytest.mark.parametrize(
    ("name", "entry", "value"),
    [
        ("x_pixel_size", (3.2e-6, None), 3.2e-6),
        ("x_pixel_size", (3.2e-6, "m"), 3.2e-6),
        ("x_pixel_size", (0.0032, b"mm"), 3.2e-6),
        ("x_pixel_size", (np.array([3200.0]), np.array(["nm"], dtype=object)), 3.2e-6),
        ("distance", (0.12, None), 0.12),
        ("distance", (np.full(N, 120.0), "mm"), 0.12),
        ("/entry/sample/propagation_distance", (70.0, "mm"), 0.07),
        (ENERGY, (20.0, None), 20.0),
        (ENERGY, (np.full(N, 20.0), "keV"), 20.0),
        (ENERGY, (3.204353268e-15, "J"), 20.0),
        (ANGLE, (np.deg2rad(np.arange(N) * 30.0), None), None),
        (ANGLE, (np.deg2rad(np.arange(N) * 30.0), "rad"), None),
        (ANGLE, (np.arange(N) * 30, "degree"), None),
        ("psf_sigma", (0.7, None), 0.7),
        ("psf_sigma", (np.full(N, 0.7), "pixels"), 0.7),
        ("/entry/sample/time", (np.arange(N) * 2.0, "ms"), 0.002),
        ("/entry/sample/time", (np.arange(N) * 2.0, None), 2.0),
        ("shift", (np.full((N, 2), 4.0), "um"), 4e-6),
        ("shift", (np.full((N, 2), 4e-6), None), 4e-6),
        ("/entry/split", (np.array([0, 1, 0, 0, 0, 1]), None), True),
    ],
)
def test_units_and_shapes(tmp_path, name, entry, value):
    also = {name: entry} | ({"y_pixel_size": None} if name == "x_pixel_size" else {})
    read = read_scan(minimal(tmp_path / "scan.h5", also=also))
    exposures, views = read.exposures, read.views
    got = {
        "x_pixel_size": views.pixel_size,
        "distance": exposures.distance[1],
        "/entry/sample/propagation_distance": exposures.distance[1],
        ENERGY: exposures.energy_kev[0],
        "psf_sigma": exposures.psf_sigma_px[1],
        "/entry/sample/time": exposures.time[1],
        "shift": views.shifts[1, 0],
        "/entry/split": read.is_test[1],
    }.get(name)
    assert got == (value if value is None else pytest.approx(value, rel=1e-9, abs=0))
    assert views.rotations == pytest.approx(rotation_y(np.arange(N) * 30.0), abs=1e-12)


def test_energy_beside_the_instrument(tmp_path):
    path = minimal(tmp_path / "scan.h5", also={ENERGY: None, "/entry/beam/incident_energy": (17.0, "keV")})
    assert read_scan(path).exposures.one_energy("it") == 17.0


def test_view_rotation_overrides_rotation_angle(tmp_path):
    rotations = scan().views.rotations
    path = minimal(tmp_path / "scan.h5", also={"/entry/sample/view_rotation": (rotations, None), ANGLE: None})
    assert np.array_equal(read_scan(path).views.rotations, rotations)
    path = minimal(tmp_path / "scan.h5", also={"/entry/sample/view_rotation": (rotations, None)})
    assert np.array_equal(read_scan(path).views.rotations, rotations)


@pytest.mark.parametrize("everywhere", [True, False], ids=["all frames", "projections"])
@pytest.mark.parametrize("darks", [True, False])
def test_flats_and_darks_correct_and_invalid_frames_go(tmp_path, everywhere, darks):
    rng = np.random.default_rng(3)
    key = np.array([2, 1, 0, 0, 3, 0, 1, 2, 0, 0, 0])
    key[key == 2] = 2 if darks else 3
    truth, gain, offset = (
        rng.uniform(0.5, 1.5, (6, H, W)),
        rng.uniform(900, 1000, (H, W)),
        rng.uniform(90, 100, (H, W)),
    )
    offset = offset * darks
    raw = np.full((len(key), H, W), np.nan)
    raw[key == 0] = truth * gain + offset
    raw[key == 1] = gain + offset + np.array([-5.0, 5.0])[:, None, None]
    raw[key == 2] = offset + np.array([-3.0, 3.0])[: (key == 2).sum(), None, None]
    angles, times = np.full(len(key), np.nan), np.arange(len(key)) * 1.0
    angles[key == 0] = np.arange(6) * 30.0
    chosen = slice(None) if everywhere else key == 0
    also = {
        "data": (raw, None),
        "image_key": (key, None),
        ANGLE: (angles[chosen], "deg"),
        "/entry/sample/time": (times[chosen], "s"),
        "distance": (np.full(len(key), 0.1), "m"),
    }
    read = read_scan(minimal(tmp_path / "scan.h5", also=also))
    assert read.frames == pytest.approx(truth, rel=1e-6)
    assert read.views.rotations == pytest.approx(rotation_y(np.arange(6) * 30.0), abs=1e-12)
    assert read.exposures.time.tolist() == times[key == 0].tolist()


def test_integer_counts_and_other_entry_names(tmp_path):
    path = tmp_path / "scan.h5"
    counts = np.full((N, H, W), 60000, dtype=np.uint16)
    minimal(path, also={"data": (counts, None)})
    with h5py.File(path, "a") as file:
        file.move("/entry", "/scan_0001")
        file["/scan_0001"].attrs["NX_class"] = "NXentry"
    assert (read_scan(path).frames == 60000).all()


def test_no_training_frame_is_found_only_when_asked_for(tmp_path):
    read = read_scan(minimal(tmp_path / "scan.h5", also={"/entry/split": (np.ones(N), None)}))
    assert read.is_test.all()
    with pytest.raises(InputError, match="no training frame"):
        read.train()


# --- what is wrong

FRAMES = np.ones((N, H, W))
NAN_FRAME = np.where(np.arange(N)[:, None, None] == 3, np.nan, FRAMES)
FLIPPED = np.broadcast_to(np.diag([1.0, 1.0, -1.0]), (N, 3, 3))


@pytest.mark.parametrize(
    ("name", "entry", "said"),
    [
        ("data", None, "missing"),
        ("data", (np.ones((H, W)), None), r"shape \[N, H, W\]"),
        ("data", (np.ones((0, H, W)), None), r"shape \[N, H, W\]"),
        ("data", (FRAMES * 1j, None), "must hold numbers"),
        ("data", (np.full((N, H, W), b"dark"), None), "must hold numbers"),
        ("data", (NAN_FRAME, None), "but 100% of frame . are not"),
        ("data", (np.inf * FRAMES, None), "but 100% of frame . are not"),
        ("image_key", (np.zeros(N - 1), None), "shape"),
        ("image_key", (np.full(N, 4), None), "0 .projection."),
        ("image_key", (np.full(N, -1), None), "0 .projection."),
        ("image_key", (np.full(N, 1), None), "at least one projection"),
        ("image_key", (np.array([2, 0, 0, 0, 0, 0]), None), "must mark flats"),
        ("x_pixel_size", (3.2, "m"), "x_pixel_size must lie between"),
        ("x_pixel_size", (-3.2, "um"), "x_pixel_size must be a positive"),
        ("x_pixel_size", (np.nan, "um"), "x_pixel_size must hold finite"),
        ("x_pixel_size", (3.2, "parsec"), "x_pixel_size has the unknown unit 'parsec'"),
        ("x_pixel_size", (np.ones(N), "um"), "square pixels"),
        ("x_pixel_size", (np.ones(N + 2), "um"), "x_pixel_size must hold one value or an entry for each frame"),
        ("y_pixel_size", (3.3, "um"), "square pixels"),
        ("distance", None, "distance"),
        ("distance", (-12.0, "cm"), "distance must be a positive"),
        ("distance", (np.full(N - 1, 0.1), "m"), "distance must hold one value or an entry for each frame"),
        ("distance", ("far", None), "distance must hold numbers"),
        ("/entry/sample/propagation_distance", (1e6, "m"), "propagation_distance must lie between"),
        (ENERGY, None, "incident_energy .or /entry/beam/incident_energy. .or .* must be there"),
        (ENERGY, (-20.0, "keV"), "incident_energy must be a positive"),
        (ENERGY, (20000.0, "keV"), "incident_energy must lie between"),
        (ENERGY, (20.0, "kcal"), "incident_energy has the unknown unit"),
        (ENERGY, ("hard", None), "incident_energy must hold numbers"),
        (ENERGY, (np.linspace(20, 2000, N), "keV"), "incident_energy must lie between"),
        (ANGLE, None, "rotation_angle .or /entry/data/rotation_angle. must be there"),
        (ANGLE, (np.arange(N - 1), "deg"), r"rotation_angle must hold .* \[6\], but its shape is \[5\]"),
        (ANGLE, (np.full(N, np.nan), "deg"), "rotation_angle must hold finite"),
        (ANGLE, (np.arange(N) * 30.0, None), "rotation_angle must carry @units"),
        (ANGLE, (np.arange(N) * 30.0, "gradians"), "rotation_angle has the unknown unit"),
        ("/entry/sample/view_rotation", (2 * np.broadcast_to(np.eye(3), (N, 3, 3)), None), "proper rotation"),
        ("/entry/sample/view_rotation", (FLIPPED, None), "view_rotation.*proper rotation"),
        ("/entry/sample/view_rotation", (np.eye(3), None), "view_rotation must hold an entry"),
        ("/entry/sample/view_rotation", (FLIPPED * np.nan, None), "view_rotation must hold finite"),
        ("shift", (np.zeros((N, 3)), "m"), "shift must hold an entry"),
        ("shift", (np.full((N, 2), np.nan), "m"), "shift must hold finite"),
        ("psf_sigma", (-1.0, None), "psf_sigma must not be negative"),
        ("psf_sigma", (1.0, "um"), "psf_sigma has the unknown unit"),
        ("/entry/sample/time", (np.zeros(3), "s"), "time must hold"),
        ("/entry/sample/time", (np.zeros(N), "years"), "time has the unknown unit"),
        ("/entry/split", (np.arange(N), None), "split must hold 0 .train. or 1 .test."),
        ("/entry/split", (np.full(N, 0.5), None), "split must hold 0 .train. or 1 .test."),
        ("/entry/split", (np.zeros(N - 2), None), "split must hold"),
    ],
)
def test_wrong_fields_are_named(tmp_path, name, entry, said):
    path = minimal(tmp_path / "scan.h5", also={name: entry})
    with pytest.raises(InputError, match=said) as error:
        read_scan(path).frames  # noqa: B018  # which are read then
    message = str(error.value)
    assert message.startswith(f"{path}: /entry/")
    assert "\n" not in message
    assert len(message) < 450


def test_missing_pixel_size(tmp_path):
    path = minimal(tmp_path / "scan.h5", also={"x_pixel_size": None, "y_pixel_size": None})
    with pytest.raises(InputError, match="x_pixel_size must be there"):
        read_scan(path)


def test_flats_no_brighter_than_darks(tmp_path):
    frames = np.array([FRAMES[0], np.where(np.indices((H, W)).any(axis=0), 2.0, 1.0), *FRAMES[2:]])
    also = {"data": (frames, None), "image_key": (np.array([2, 1, 0, 0, 0, 0]), None)}
    assert np.argwhere(read_scan(minimal(tmp_path / "scan.h5", also=also)).missing.all(axis=0)).tolist() == [[0, 0]]
    frames[1, 0] = 1.0
    with pytest.raises(InputError, match="in 25% of the pixels they are not"):
        read_scan(minimal(tmp_path / "scan.h5", also=also))


def test_group_or_broken_link_where_a_dataset_should_be(tmp_path):
    path = minimal(tmp_path / "scan.h5", also={"distance": None})
    with h5py.File(path, "a") as file:
        file.create_group(DETECTOR + "distance")
    with pytest.raises(InputError, match="distance must be a dataset"):
        read_scan(path)
    path = minimal(tmp_path / "scan.h5", also={"data": None})
    with h5py.File(path, "a") as file:
        file[DETECTOR + "data"] = h5py.ExternalLink("elsewhere.h5", "/data")
    with pytest.raises(InputError, match="data"):
        read_scan(path)


def test_files_that_are_no_scans(tmp_path):
    with pytest.raises(InputError, match=r"none\.h5 must be an HDF5 file, but there is no such file"):
        read_scan(tmp_path / "none.h5")
    with pytest.raises(InputError, match="folder"):
        read_scan(tmp_path)
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(InputError, match=r"text\.h5 must be an HDF5 file"):
        read_scan(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["something"] = 1
    with pytest.raises(InputError, match=r"other\.h5 must hold the group /entry.*something"):
        read_scan(tmp_path / "other.h5")


def test_truncated_files(tmp_path):
    path = tmp_path / "scan.h5"
    write_scan(path, scan())
    whole = path.read_bytes()
    for cut in [*range(0, len(whole), len(whole) // 60), len(whole) - 1]:
        path.write_bytes(whole[:cut])
        with pytest.raises(InputError, match=r"scan\.h5 must be"):
            read_scan(path)
