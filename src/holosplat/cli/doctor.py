"""`holosplat doctor`: whether the installation works."""

from __future__ import annotations


def doctor() -> None:
    """Look at the installation: versions, kernels, threads, memory, disk, and a small run with its error.

    Exits with 1 where something is wrong, after it has said what to do.
    """
    from ..workflows.doctor import checks

    wrong = 0
    for check in checks():
        print(check.line(), flush=True)
        wrong += bool(check.remedy)
    print("all is well" if not wrong else f"{wrong} of these are wrong; what to do stands below each")
    if wrong:
        raise SystemExit(1)
