"""The recipes of a release agree with pyproject.toml: wheels, conda, Apptainer. None of the tools is needed here."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from rattler_build import Stage0Recipe, VariantConfig

from holosplat import __version__
from holosplat.cli import entry

ROOT = Path(__file__).resolve().parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
CONDA_NAMES = {"matplotlib": "matplotlib-base", "torch": "pytorch", "vtk": "vtk-base"}
"""Names on conda-forge that differ from pip's."""


# --- conda --------------------------------------------------------------------------------------------------


def conda_complaints(recipe: dict[str, Any]) -> list[str]:
    """Where a conda recipe differs from pyproject.toml."""
    wanted = {f"python {PROJECT['requires-python']}"}
    for requirement in map(Requirement, PROJECT["dependencies"]):
        wanted.add(f"{CONDA_NAMES.get(requirement.name, requirement.name)} {requirement.specifier}")
    runs = set(recipe["requirements"]["run"])
    scripts = {f"{name} = {target}" for name, target in PROJECT["scripts"].items()}
    pairs = {
        "version": (recipe["context"]["version"], __version__),
        "name": (recipe["package"]["name"], PROJECT["name"]),
        "run": (runs, wanted),
        "entry points": (set(recipe["build"]["python"]["entry_points"]), scripts),
        "build backend": (set(PYPROJECT["build-system"]["requires"]), conda_backend(recipe)),
        "license": (recipe["about"]["license"], PROJECT["license"]),
        "summary": (recipe["about"]["summary"], PROJECT["description"]),
    }
    return [f"{name}: {is_}, not {must}" for name, (is_, must) in pairs.items() if is_ != must]


def conda_backend(recipe: dict[str, Any]) -> set[str]:
    """What the recipe's host has of the build backend, as pip would write it."""
    return {word.replace(" ", "") for word in recipe["requirements"]["host"] if word.startswith("scikit-build-core")}


@pytest.fixture
def recipe() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "packaging/recipe/recipe.yaml").read_text(encoding="utf-8"))


def test_the_conda_recipe_agrees(recipe):
    assert recipe["schema_version"] == 1
    assert recipe["package"]["version"] == "${{ version }}"
    assert (ROOT / "packaging/recipe" / recipe["source"]["path"] / "pyproject.toml").is_file()
    assert (ROOT / recipe["about"]["license_file"]).is_file()
    assert conda_complaints(recipe) == []


def test_the_conda_recipe_renders():
    """By rattler-build itself, which refuses keys that it does not know."""
    recipe = Stage0Recipe.from_file(str(ROOT / "packaging/recipe/recipe.yaml"))
    variants = recipe.render(VariantConfig({"python": ["3.11"], "cxx_compiler": ["gxx"], "c_stdlib": ["sysroot"]}))
    assert [variant.recipe.package.version for variant in variants] == [__version__]


def test_a_conda_recipe_that_differs_is_seen(recipe):
    recipe["context"]["version"] = "0.0.1"
    recipe["requirements"]["run"].remove("pytorch >=2.4")
    assert [complaint.split(":")[0] for complaint in conda_complaints(recipe)] == ["version", "run"]


# --- Apptainer ----------------------------------------------------------------------------------------------


def sections(text: str) -> dict[str, str]:
    """Section → body of an Apptainer definition file; what stands before the first one is its header."""
    header, *rest = re.split(r"^%(\w+).*\n", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE), flags=re.MULTILINE)
    return {"header": header, **dict(zip(rest[::2], rest[1::2], strict=True))}


def test_the_container_agrees():
    found = sections((ROOT / "packaging/holosplat.def").read_text(encoding="utf-8"))
    assert list(found) == ["header", "arguments", "labels", "files", "post", "environment", "runscript", "test", "help"]
    assert re.match(r"Bootstrap: docker\nFrom: \S", found["header"])
    assert re.search(r"version (\S+)", found["labels"])[1] == __version__  # type: ignore[index]
    assert re.search(r"licenses (\S+)", found["labels"])[1] == PROJECT["license"]  # type: ignore[index]
    python = re.search(r"PYTHON=(\S+)", found["arguments"])
    assert python is not None
    assert Requirement(f"python{PROJECT['requires-python']}").specifier.contains(python[1])
    files = dict(line.split() for line in found["files"].splitlines() if line.strip())
    assert all((ROOT / source).exists() for source in files)
    kept = {word.lstrip("!/") for word in PYPROJECT["tool"]["scikit-build"]["sdist"]["exclude"] if word.startswith("!")}
    assert set(files) == kept | {"constraints.txt"}
    extras = re.search(r"/opt/holosplat\[([\w,]+)\]", found["post"])
    assert extras is not None
    assert set(extras[1].split(",")) <= set(PROJECT["optional-dependencies"])
    commands = re.findall(r"holosplat (\S+)$", found["test"], re.MULTILINE)
    assert set(commands) - {"--version"} <= set(entry.COMMANDS)


@pytest.mark.parametrize("section", ["post", "runscript", "test"])
def test_the_shell_of_the_container_parses(section):
    text = sections((ROOT / "packaging/holosplat.def").read_text(encoding="utf-8"))[section]
    done = subprocess.run(["sh", "-n"], input=text, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# --- wheels -------------------------------------------------------------------------------------------------


def test_both_kinds_of_linux_wheels_are_made():
    """By packaging/wheels.py and by cibuildwheel in its containers, for the same processors and the same glibc."""
    script = (ROOT / "packaging/wheels.py").read_text(encoding="utf-8")
    processors = set(re.findall(r'"(\w+)"', re.search(r"^PROCESSORS = \((.*)\)$", script, re.MULTILINE)[1]))  # type: ignore[index]
    glibc = re.search(r'^GLIBC = "(.*)"$', script, re.MULTILINE)
    boxes = PYPROJECT["tool"]["cibuildwheel"]["linux"]
    assert processors == {"x86_64", "aarch64"} == set(boxes["archs"])
    assert glibc is not None
    images = {f"manylinux_{glibc[1].replace('.', '_')}"}
    assert {boxes[f"manylinux-{processor}-image"] for processor in processors} == images
    assert set(PYPROJECT["tool"]["cibuildwheel"]["macos"]["archs"]) == {"x86_64", "arm64"}


@pytest.mark.slow
def test_a_wheel_holds_all_that_the_package_reads(tmp_path):
    """Every file of src/holosplat, the licence, the entry points and, of the kernels, one library at least."""
    command = [sys.executable, "-m", "pip", "wheel", ROOT, "--no-deps", "--no-build-isolation", "-w", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("holosplat-*.whl")
    assert re.fullmatch(rf"holosplat-{re.escape(__version__)}-py3-none-\w+\.whl", wheel.name)
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {str(path.relative_to(ROOT / "src")) for path in (ROOT / "src").rglob("*") if path.is_file()}
    assert len(wanted) > 300
    assert {name for name in wanted - held if "__pycache__" not in name} == set()
    assert any(re.fullmatch(r"holosplat/_native/holosplat_\w+\.(so|dylib|dll)", name) for name in held)
    info = f"holosplat-{__version__}.dist-info"
    assert {f"{info}/entry_points.txt", f"{info}/licenses/LICENSE"} <= held
