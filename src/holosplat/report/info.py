"""`info`: what a file or a run folder is, and what it lacks."""

from __future__ import annotations

from pathlib import Path

from ..checks import InputError, require
from ..io.atomic import atomic_path, require_writable
from ..io.facts import Facts, facts_of_matter, no_kind
from ..io.reading import Reading
from ..planning.scan_facts import facts_of_scan
from ..workflows.run_folder import RunFolder
from ..workflows.run_status import facts_of_run


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
    found = None
    try:
        found = facts_of_run(RunFolder(path)) if RunFolder(path).config.is_file() else facts_of_matter(path)
        scan = facts_of_scan(path, reading) if found is None else None
    except InputError as error:
        found, scan = no_kind(path, error), None
    require(
        scan is not None or picture is None, f"--picture is of the frames of a scan, but {path} shows none; leave it."
    )
    if scan is not None and picture is not None:
        from .look import look_figure  # needs matplotlib, which takes half a second

        with atomic_path(picture) as temporary:
            look_figure(scan).savefig(temporary, format="png")
    facts = found or (scan and scan.facts)
    assert facts is not None
    return facts
