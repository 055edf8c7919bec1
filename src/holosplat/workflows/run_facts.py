"""What `holosplat info` says of a run folder: what it was made from, how far it came, its verdict and totals."""

from __future__ import annotations

from ..checks import as_written
from ..io.facts import Facts
from ..io.json import read_json
from ..units import in_percent
from .choice import Choice
from .run_folder import RunFolder


def facts_of_run(folder: RunFolder) -> Facts:
    """The facts of a run, begun or finished. Errors: `InputError` for files that are damaged, or of another run."""
    with as_written(folder.path, "a run as it was written"):
        return _facts(folder)


def _facts(folder: RunFolder) -> Facts:
    config, summary = folder.read_config(), folder.read_summary() if folder.summary.is_file() else {}
    source = str(read_json(folder.source).get("scan", "")) if folder.source.is_file() else ""
    versions = config.get("versions", {})
    rows = {"what": f"a run of holosplat {versions.get('holosplat', '')}".rstrip(), "made from": source or "not known"}
    rows |= _result(summary) if summary else {"state": "begun; no result yet"}
    done, object_there = bool(summary.get("finished")), folder.result().is_file()
    scan = source or "SCAN"
    commands = []
    if not done:
        commands.append(f"holosplat reconstruct {scan} --out {folder.path} --resume, with the options of before")
    if object_there:
        commands += [
            f"holosplat evaluate {folder.path} --truth VOLUME",
            f"holosplat export {folder.path} --volume v.h5",
        ]
        commands += [f"holosplat view {folder.path}"]
    missing = [] if source else [f"{folder.path} does not say which scan it is of; name it with --scan."]
    return Facts(rows, tuple(missing), tuple(commands))


def _result(summary: dict) -> dict[str, str]:
    """What summary.json says, by the names of rows."""
    seconds = {name: float(value) for name, value in summary.get("timing_s", {}).items()}
    detector, verdict, total = (summary.get(name, {}) for name in ("detector", "verdict", "total"))
    rows = {"state": "finished" if summary.get("finished") else "interrupted; what is there can be used"}
    rows["method"] = f"{summary.get('method', 'gaussians')}; object: {summary.get('size', summary.get('kind', ''))}"
    if detector:
        size = f"{detector['rows']} × {detector['columns']} pixels of {1e6 * detector['pixel_size_m']:.4g} µm"
        rows["frames"] = f"{size} at {summary.get('energy_kev', 0):g} keV"
    rows["verdict"] = verdict.get("words", "none was made")
    rows |= {f"verdict {n}": text for n, text in enumerate(verdict.get("reasons", ()), 1)}
    judged = Choice.read(summary).judged
    shares = ", ".join(f"{name} {in_percent(float(share))}" for name, share in judged.items())
    rows |= {"scores": f"matter that training frames leave unexplained: {shares}"} if shares else {}
    rows |= {"total": total["words"]} if "words" in total else {}
    stages = ", ".join(f"{name} {value:.3g} s" for name, value in seconds.items())
    rows["time"] = f"{sum(seconds.values()):.3g} s ({stages}) on {summary.get('device', 'an unknown device')}"
    return rows
