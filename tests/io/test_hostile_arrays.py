"""Plain arrays that are none, or none of real numbers: refused in one sentence, whatever holds them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.io.formats import read
from holosplat.io.guard import read_archive, read_array
from holosplat.io.samples import _unpacked
from holosplat.io.stacks import stack_of

SAID = {"energy_kev": 9.3, "distance": 0.4, "pixel_size": 3.2e-6, "angles_deg": np.zeros(2)}
FRAMES = np.ones((2, 5, 7), dtype=np.float32)
STRANGE = {
    "complex": FRAMES.astype(np.complex64),
    "texts": np.full(FRAMES.shape, "1", dtype=h5py.string_dtype()),
    "references": h5py.ref_dtype,
    "of any length": h5py.vlen_dtype(np.float32),
    "records": np.zeros(FRAMES.shape, dtype=[("r", "f4"), ("i", "f4")]),
}


@pytest.mark.parametrize("name", ["data", "flats", "darks", "angles_deg", "energy_kev"])
@pytest.mark.parametrize("kind", STRANGE)
def test_datasets_that_hold_no_real_numbers_are_refused(tmp_path, kind, name):
    """Of complex frames the imaginary part was dropped, which says as much as the real one."""
    values = STRANGE[kind]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"] = FRAMES
        if name in file:
            del file[name]
        if isinstance(values, np.ndarray):
            file[name] = values
        else:
            file.create_dataset(name, FRAMES.shape, values)
    with pytest.raises(InputError, match=f"a.h5: /{name} must hold numbers, but its type is"):
        read(tmp_path / "a.h5", SAID)


@pytest.mark.parametrize("count", [0, 2])
def test_one_number_is_one(tmp_path, count):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"], file["energy_kev"] = FRAMES, np.full(count, 9.3)
    with pytest.raises(InputError, match=f"energy_kev must be one number, but there are {count}"):
        read(tmp_path / "a.h5", {**SAID, "energy_kev": None})


def header_of(shape: str, kind: str = "<f4") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + len(text + "\n").to_bytes(2, "little") + (text + "\n").encode()


NONE = {
    "nothing": b"",
    "words": b"words",
    "a huge shape": header_of("(" + "9" * 400 + ",)"),
    "a huge empty shape": header_of("(0, 10000000000000000000000)"),
    "a negative shape": header_of("(-1, 5, 7)"),
    "a shape of texts": header_of("('a',)"),
    "a deep shape": header_of("(" * 300 + ")" * 300),
    "objects": header_of("(2,)", "|O"),
    "no type": header_of("(2,)", "nonsense"),
}


@pytest.mark.parametrize("kind", NONE)
def test_what_is_no_array_is_refused(tmp_path, kind):
    """As a file, as flats, and within an archive."""
    path = tmp_path / "a.npy"
    path.write_bytes(NONE[kind])
    for reading in (lambda: read_array(path, "an array"), lambda: stack_of(path)):
        with pytest.raises(InputError, match=r"a\.npy must be an? .*array \(\.npy\), but it is damaged or none"):
            reading()
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("data.npy", NONE[kind])
    with pytest.raises(InputError, match=r"a\.npz"):
        read(tmp_path / "a.npz", SAID)


def test_an_archive_in_place_of_an_array_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", data=FRAMES)
    (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    with pytest.raises(InputError, match="it is an archive"):
        stack_of(tmp_path / "a.npy")


@pytest.mark.parametrize("content", [b"", b"words", b"PK\x03\x04"])
def test_what_is_no_archive_is_refused(tmp_path: Path, content, monkeypatch):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(InputError, match="must be a NumPy archive"):
        read_archive(tmp_path / "a.npz")
    (tmp_path / "a.zip").write_bytes(content)
    monkeypatch.setattr("holosplat.io.samples.cache", lambda: tmp_path)
    with pytest.raises(InputError, match=r"a\.zip must be a ZIP archive"):
        _unpacked(tmp_path / "a.zip", "inner", "0" * 64)


def test_a_member_that_is_no_array_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        content = io.BytesIO()
        np.save(content, FRAMES)
        archive.writestr("data.npy", content.getvalue())
        archive.writestr("flats", b"words")
    with pytest.raises(InputError, match="flats is no array"):
        read(tmp_path / "a.npz", SAID)
