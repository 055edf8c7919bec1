"""`holosplat surface`: the bodies of a run as closed surfaces, fitted to its frames."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from ..checks import require
from ..io.atomic import atomic_folder, write_json
from ..io.formats import read_volume_file
from ..io.reading import Reading
from ..io.vtk import write_mesh
from ..mesh import TriangleMesh
from ..methods.surface_fit import SurfaceOptions, oversampling
from ..methods.surfaces import refine_surfaces
from ..planning.acts import of_surfaces
from ..representations import MovingSurfaces
from ..workflows.evaluate import evaluate as score
from ..workflows.evaluate import score_object
from ..workflows.provenance import scan_hash
from ..workflows.reconstruct import load_reconstruction
from ..workflows.reconstruction import instants_of
from ..workflows.run_folder import RunFolder
from .places import Output
from .progress import ProgressBar
from .room import tell_frames
from .scans import run_and_scan
from .sentence import say

LENGTH_UNIT = "um"


def surface(
    run: Positional[Path],
    out: Output,
    scan: Path | None = None,
    truth: Path | None = None,
    how: SurfaceOptions = SurfaceOptions(),
    reading: Reading = Reading(),
) -> None:
    """Cut the bodies of a run out as closed surfaces, fit these to the frames, and write them as VTK files (µm).

    Args:
        run: Run folder, of a reconstruction as one material: any but those that fit δ and β apart. Of a run of track,
            --time-frame says at which time; bodies keep their names.
        out: Folder to make: body000.vtk …, the largest first, each with its cavities, and summary.json.
        scan: Scan (default: the one that was reconstructed).
        truth: Volume file of the truth, to score both against.
    """
    folder = RunFolder(run)
    folder.require_run()
    times = instants_of(folder)
    require(
        not times or isinstance(reading.part.time_frame, int),
        f"{run} holds bodies in motion, whose surfaces are fitted at one time; choose it with --time-frame 0 … "
        f"{len(times) - 1}, or write the bodies as they are with export --bodies.",
    )
    (result, measured), volume = run_and_scan(folder, scan, reading), read_volume_file(truth) if truth else None
    name = "Gaussians" if result.object.kind == "gaussians" else "run"
    if not times and not folder.is_of(scan_hash(measured)):
        say("this is not the scan that was reconstructed: its held-out frames may have been fitted")
    if folder.read_config().get("prior", {}).get("kind") == "free":
        known = "δ and β" if result.delta_told else "β"
        say(f"nothing was known of the matter: {known} of the surfaces are what the run estimated")
    train = measured.exposures[~measured.is_test]
    tell_frames("surface", train, out, lambda seen: of_surfaces(seen, how))
    before = score(result, measured, volume)
    began = time.perf_counter()
    with ProgressBar() as bar:
        found = refine_surfaces(result.object, measured, how, lambda *now: bar.show(now[0], now[1], {}))
    seconds = time.perf_counter() - began
    after = score_object(found, measured, volume, oversampling(measured.train(), how.fit))
    said = {"seconds": seconds, "settings": asdict(how), name.lower(): before.as_dict(), "surfaces": after.as_dict()}
    whole = load_reconstruction(folder).object
    bodies = whole.parted(found.vertices.detach().cpu()) if isinstance(whole, MovingSurfaces) else found.bodies()
    write_bodies(out, bodies, result.contents.of_matter(found.matter), said)
    for of, scores in ((name, before), ("surfaces", after)):
        print(f"{of}:", *scores.lines(), sep="\n  ")
    say(f"wrote {out}: {len(bodies)} bodies of {len(found.faces)} triangles, {seconds:.1f} s")


def write_bodies(
    out: Path, bodies: Sequence[TriangleMesh], constants: Mapping[str, float], said: Mapping[str, Any]
) -> None:
    """Write one VTK file a body (µm), and summary.json with what is `said` beside their sizes and the `constants` of
    their matter."""
    with atomic_folder(out) as temporary:
        for body in bodies:
            write_mesh(temporary / f"{body.name}.vtk", body, LENGTH_UNIT)
        about = {
            "bodies": {body.name: {"triangles": len(body.faces), "volume_m3": body.volume} for body in bodies},
            "length_unit": LENGTH_UNIT,
            "material": dict(constants),
        }
        write_json(temporary / "summary.json", {**about, **said})
