"""What an install promises: the compiler is explained, the kernels can be left out, and both sides of the ABI agree."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from holosplat import native
from holosplat.projectors.splat import splat

NATIVE = Path(__file__).resolve().parents[2] / "native"
CMAKE = shutil.which("cmake", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
GCC = shutil.which("g++")
needs_cmake = pytest.mark.skipif(CMAKE is None, reason="cmake is not installed (pip install cmake)")


def configure(build: Path, compiler: Path | str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run CMake as pip does, with `compiler` as the environment's CXX."""
    command = [str(CMAKE), "-S", str(NATIVE), "-B", str(build), *options]
    environment = os.environ | {"CXX": str(compiler)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def script(path: Path, text: str) -> Path:
    """An executable file."""
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def words(text: str) -> str:
    """The text without the line breaks that CMake puts in."""
    return " ".join(text.split())


def explained(done: subprocess.CompletedProcess[str], found: str) -> None:
    """Holds that configuration stopped, said what it had found, and named every way out."""
    assert done.returncode != 0
    assert found in words(done.stderr)
    for advice in (
        "GCC 9 or newer, or clang 11 or newer",
        "apt install g++",
        "dnf install gcc-c++",
        "xcode-select --install",
        "conda install -c conda-forge cxx-compiler",
        "Windows",
        "pip install . -C cmake.define.HOLOSPLAT_KERNELS=OFF",
    ):
        assert advice in words(done.stderr)
    assert done.stderr.count("CMake Error") == 1


# --- configuration ------------------------------------------------------------------------------------------


@needs_cmake
def test_a_missing_compiler_is_explained(tmp_path):
    missing = tmp_path / "no-such-compiler"
    explained(configure(tmp_path / "build", missing), "is missing or does not work")


@needs_cmake
@pytest.mark.skipif(os.name != "posix" or GCC is None, reason="needs g++ and shell scripts")
def test_compilers_that_will_not_do_are_explained_and_forgotten(tmp_path):
    """A broken one, an old one, none any more; after each, a good one works in the same build folder."""
    build = tmp_path / "build"
    broken = script(tmp_path / "broken", "exit 1")
    old = script(tmp_path / "old", f'exec "{GCC}" -U__GNUC__ -D__GNUC__=8 "$@"')
    good = script(tmp_path / "good", f'exec "{GCC}" "$@"')
    explained(configure(build, broken), f"CXX={broken}, is missing or does not work")
    explained(configure(build, old), "will not do: GNU 8.")
    assert configure(build, good).returncode == 0
    good.unlink()
    explained(configure(build, good), "is gone")
    assert configure(build, str(GCC)).returncode == 0


@needs_cmake
def test_the_kernels_can_be_left_out_without_a_compiler(tmp_path):
    build, target = tmp_path / "build", tmp_path / "target"
    done = configure(build, tmp_path / "no-such-compiler", "-DHOLOSPLAT_KERNELS=OFF")
    assert done.returncode == 0, done.stderr
    assert "without its kernels" in done.stdout
    assert "Looking for a CXX compiler" not in done.stdout
    subprocess.run([str(CMAKE), "--install", str(build), "--prefix", str(target)], check=True, capture_output=True)
    assert not list(target.rglob("*.*"))


# --- without the kernels ------------------------------------------------------------------------------------


def test_a_missing_library_names_both_ways_out(tmp_path, monkeypatch):
    """Nothing falls back by itself: the compiled path fails, the plain one works when it is asked for."""
    monkeypatch.setattr(native, "_candidates", lambda: [tmp_path / "a", tmp_path / "a", tmp_path / "b"])
    monkeypatch.setattr(native, "_folder", native._folder.__wrapped__)
    monkeypatch.setattr(native, "_library", native._library.__wrapped__)
    cloud = (torch.zeros(1, 3), torch.ones(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 1))
    views = (torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 2, dtype=torch.float64), (5, 6))
    with pytest.raises(RuntimeError, match="not installed") as caught:
        splat(*cloud, *views, backend="cpu")
    message = str(caught.value)
    for advice in ("C++ compiler", "pip install .", "backend='reference'", "HOLOSPLAT_KERNELS=OFF"):
        assert advice in message
    assert message.count(str(tmp_path / "a")) == 1
    assert splat(*cloud, *views, backend="reference").max() > 0


# --- the two sides of the ABI -------------------------------------------------------------------------------


def header() -> str:
    """abi.hpp without comments."""
    return re.sub(r"//[^\n]*", "", (NATIVE / "abi.hpp").read_text(encoding="utf-8"))


def ctype(declaration: str) -> str:
    """The ctypes name of a C parameter or field: `const HoloViews*` → `Views*`, `const float* x` → `c_void_p`."""
    structure = re.search(r"\bHolo(\w+)\s*\*", declaration)
    if structure:
        return structure[1] + "*"
    if "*" in declaration:
        return "c_void_p"
    return {"int64_t": "c_int64", "double": "c_double"}[declaration.split()[0]]


def name_of(kind: type) -> str:
    """The same for one of Python's types."""
    if issubclass(kind, ctypes._Pointer):
        return kind._type_.__name__ + "*"
    if issubclass(kind, ctypes.Array):
        return f"{name_of(kind._type_)}[{kind._length_}]"
    return {ctypes.c_void_p: "c_void_p", ctypes.c_int64: "c_int64", ctypes.c_double: "c_double"}[kind]


def test_the_versions_agree():
    version = re.search(r"holosplat_abi\(\)\s*\{\s*return (\d+);", (NATIVE / "library.cpp").read_text(encoding="utf-8"))
    assert version is not None
    assert int(version[1]) == native.ABI


def test_the_functions_agree():
    """Names, and the kinds of all arguments in their order."""
    declared = {
        name: [ctype(p) for p in parameters.split(",") if p.strip()]
        for name, parameters in re.findall(r"HOLO_EXPORT int64_t (\w+)\(([^)]*)\);", header())
    }
    assert len(declared) > 10
    assert {name: [name_of(t) for t in types] for name, types in native._FUNCTIONS.items()} == declared


def test_the_structures_agree():
    """Every structure of the header has its twin, with the same fields in the same order."""
    declared = {}
    for name, body in re.findall(r"struct Holo(\w+)\s*\{([^}]*)\};", header()):
        fields = []
        for line in filter(str.strip, body.split(";")):
            first, *others = line.split(",")
            for field in (first, *others):
                label, length = re.search(r"(\w+)\s*(\[\d+\])?\s*$", field).groups()
                fields.append((label, ctype(first) + (length or "")))
        declared[name] = fields
    assert len(declared) > 5
    mirrored = {name: getattr(getattr(native, name, None), "_fields_", []) for name in declared}
    assert {name: [(f, name_of(t)) for f, t, *_ in fields] for name, fields in mirrored.items()} == declared
