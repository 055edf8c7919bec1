"""`info`: what a file or a run folder is, and what it lacks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..checks import InputError, as_written, require
from ..io.atomic import atomic_path, read_json, require_writable
from ..io.facts import Facts, facts_of_matter, no_kind
from ..io.formats import loader_of
from ..io.provenance import origin
from ..io.reading import Reading
from ..memory import uncollected
from ..units import beam_named, in_percent, number_of
from ..workflows.choice import Choice
from ..workflows.run_folder import SERIES, RunFolder

if TYPE_CHECKING:
    from ..planning.scan_facts import ScanFacts


def info(path: str | Path, reading: Reading = Reading(), picture: Path | None = None) -> Facts:
    """Describe a scan, volume, mesh, object or run folder, as the command `holosplat info` does.

    reading: the values of a scan that its files lack, and the part of it to read
    picture: PNG file to write: two frames of a scan and their power spectrum (default: none)

    `rows` of the result holds the facts by name, `missing` a sentence for each value that is not known, `commands` the
    next steps, and `lines()` all of them as text. A few frames are read, and no more. Errors: `InputError` where there
    is nothing at `path`, and for a picture of anything but a scan. A file of no known format is described, too.

    Examples:

        >>> import holosplat as hs
        >>> views = hs.Views.evenly_spaced(6, shape=(16, 20), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, hs.DeltaBeta(5.8e-7, 2.6e-10))
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> hs.write_scan("scan.nxs", scan)
        >>> facts = hs.info("scan.nxs")
        >>> facts.missing
        ()
        >>> print(facts.rows["frames"])
        6 projections of 16 × 20 pixels (rows × columns), 1 held out of the fit
    """
    path = Path(path)
    require(path.exists(), f"{path} must be a file or a folder, but there is nothing; check the path.")
    if picture is not None:
        require(picture.suffix.lower() == ".png", f"--picture must be a .png file, but it is {picture}; name another.")
        require_writable(picture)
    reading.told.vouch(path)
    found = None
    try:
        if (path / SERIES).is_file():
            found = facts_of_series(path)
        else:
            found = facts_of_run(RunFolder(path)) if RunFolder(path).config.is_file() else facts_of_matter(path)
        scan = _of_scan(path, reading) if found is None else None
    except InputError as error:
        found, scan = no_kind(path, error), None
    require(
        scan is not None or picture is None, f"--picture is of the frames of a scan, but {path} shows none; leave it."
    )
    if scan is not None and picture is not None:
        with uncollected():
            from .light import look_figure  # needs matplotlib, which takes half a second

        with atomic_path(picture) as temporary:
            look_figure(scan).savefig(temporary, format="png")
    facts = found or (scan and scan.facts)
    assert facts is not None
    return facts


def _of_scan(path: Path, reading: Reading) -> ScanFacts:
    loader = loader_of(path)
    with uncollected():
        from ..planning.scan_facts import facts_of_scan  # needs torch, which takes longer than all else

    return facts_of_scan(loader, path, reading)


def facts_of_series(path: Path) -> Facts:
    """The facts of a series. Errors: `InputError` for files that are damaged."""
    with uncollected():
        from ..workflows.motion_choice import begun_motion
        from ..workflows.verdict import said_of_times

    with as_written(path / SERIES, "the plan of a series"):
        plan = read_json(path / SERIES)
        scans = [(str(one["path"]), len(one["times_s"])) for one in plan["scans"]]
    with as_written(path, "rows of a series"):
        files = sorted(path.glob("tasks/*/*.row.json"), reverse=True)  # of a time of two tasks, the first one's row
        rows = {row["number"]: row for row in map(read_json, files)}
        done = [row for _, row in sorted(rows.items()) if row["status"] == "done"]
        judged = [(row["number"], bool(row["good"]), str(row["words"])) for row in done if row["good"] is not None]
    chosen, count = begun_motion(path), sum(times for _, times in scans)
    said = {"what": f"a series of {number_of(count, 'time')}", "made from": ", ".join(scan for scan, _ in scans)}
    said |= {"state": f"{len(done)} of {count} times are done"}
    said |= {"verdict": "; ".join(line.strip().rstrip(".") for line in said_of_times(judged, count))} if judged else {}
    said |= {"chosen": chosen.line} if chosen else {}
    commands = (f"holosplat series collect {path}", f"holosplat export {path} --volume v.h5 --time-frame all")
    return Facts(said, (), commands)


def facts_of_run(folder: RunFolder) -> Facts:
    """The facts of a run, begun or finished. Errors: `InputError` for files that are damaged, or of another run."""
    with as_written(folder.path, "a run as it was written"):
        return _of_run(folder)


def _of_run(folder: RunFolder) -> Facts:
    config, summary = folder.read_config(), folder.read_summary() if folder.summary.is_file() else {}
    source = str(read_json(folder.source).get("scan", "")) if folder.source.is_file() else ""
    versions = config.get("versions", {})
    rows = {"what": f"a run of holosplat {versions.get('holosplat', '')}".rstrip(), "made from": source or "not known"}
    rows |= _result(summary) if summary else {"state": "begun; no result yet"}
    done, object_there = bool(summary.get("finished")), folder.result().is_file()
    scan = source or "SCAN"
    commands = []
    if not done:
        act = str(origin(folder.path).get("command", "")).split()[1:2]
        again = f"holosplat reconstruct {scan} --out {folder.path} --resume, with the options of before"
        commands.append(f"holosplat {act[0]} --resume {folder.path}" if act else again)
    if object_there:
        commands += [
            f"holosplat evaluate {folder.path} --truth VOLUME",
            f"holosplat export {folder.path} --volume v.h5",
        ]
        commands += [f"holosplat view {folder.path}"]
        if "verdict" in summary and "rehearsal" not in summary and "times_s" not in summary:
            commands += [f"holosplat rehearse {folder.path}"]
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
        rows["frames"] = f"{size} at {beam_named(summary['energy_kev'])[1]}" if "energy_kev" in summary else size
    rows["verdict"] = verdict.get("words", "none was made")
    rows |= {f"verdict {n}": text for n, text in enumerate(verdict.get("reasons", ()), 1)}
    said = summary.get("rehearsal", {}).get("words", ())
    rows |= {f"rehearsed {n}".removesuffix(" 0"): text.strip() for n, text in enumerate(said)}
    judged = Choice.read(summary).judged
    shares = ", ".join(f"{name} {in_percent(float(share))}" for name, share in judged.items())
    rows |= {"scores": f"matter that training frames leave unexplained: {shares}"} if shares else {}
    rows |= {"total": total["words"]} if "words" in total else {}
    if seconds:
        stages = ", ".join(f"{name} {value:.3g} s" for name, value in seconds.items())
        rows["time"] = f"{sum(seconds.values()):.3g} s ({stages}) on {summary.get('device', 'an unknown device')}"
    return rows
