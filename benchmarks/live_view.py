"""What a live view costs a fit: rows of docs/data/live_view.csv.

    python benchmarks/live_view.py SCAN [--material haemoglobin] [--pairs 3] [--bin 1] [--chromium] [--write]

The same fit of Gaussians without a view and with one, in turn, that a process reads as the page would, or that headless
Chromium shows (--chromium), which draws with the same processors where there is no GPU. Measured is what lies between
the first step of the fit and its last: processor time of this process (all threads, the server's too) and wall time;
beside them the processor time of the threads that draw and send updates. With --write, rows join the table.

    python benchmarks/live_view.py SCAN --first [--write]       # rows of docs/data/first_picture.csv

Times from the call of `reconstruct` to the first picture, of runs that end with it; the first of them loads modules.
Scans of the committed rows: `holosplat demo` (meshes), and `holosplat simulate demo/meshes/*.vtk --material haemoglobin
--detector 512 512 --pixel-size 0.8e-6 --views 16 --out SCAN`; for 128 pixels the same with 128 and 3.2e-6.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from machine import commit
from rows import merge

import holosplat as hs
from holosplat.io.formats import read_as
from holosplat.io.reading import Part, Reading
from holosplat.show.server import HOST, LiveView, Watch

OUT = Path(__file__).resolve().parents[1] / "docs" / "data" / "live_view.csv"
FIRST = OUT.with_name("first_picture.csv")
COLUMNS = ("scan", "view", "run", "steps", "gaussians", "updates", "view_cpu_s", "cpu_s", "wall_s", "commit")
FLAGS = ("--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-proxy-server")


class Timed:
    """Passes on what a fit tells, and takes the times of its first step and its last."""

    def __init__(self, on_state: Callable[..., None] | None) -> None:
        self._on_state = on_state
        self.steps, self.first, self.last = 0, (0.0, 0.0), (0.0, 0.0)

    def __call__(self, stage: str, fraction: float, record: dict[str, float], state: Callable[[], Any]) -> None:
        if record:  # a step, and not what a stage begins or ends with
            now = (time.process_time(), time.perf_counter())
            self.first = self.first if self.steps else now
            self.steps, self.last = self.steps + 1, now
        if self._on_state is not None:
            self._on_state(stage, fraction, record, state)


class Counted(LiveView):
    """A view that counts its updates, and what processor time they and its server's thread take."""

    updates, drawing = 0, 0.0
    watched = True  # also by a reader, which sends no camera

    def show(self, part: Any) -> None:
        """Run by a thread that does nothing but draw the update."""
        super().show(part)
        self.updates += 1
        self.drawing += time.thread_time()

    def seconds(self) -> float:
        """Processor time so far."""
        thread = self._server._websock_server._server_thread
        assert thread is not None
        assert thread.ident is not None
        return self.drawing + time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


READER = """
import sys
from websockets.sync.client import connect
url, kind, cookie = sys.argv[1:]
with connect(url, subprotocols=[kind], additional_headers={"Cookie": cookie}, proxy=None, max_size=None) as socket:
    for message in socket:
        pass
"""


@contextmanager
def reader(view: LiveView) -> Iterator[None]:
    """A process that reads all that the page would."""
    import viser

    url, kind = f"ws://{HOST}:{view.port}", f"viser-v{viser.__version__}"
    cookie = view.guard.set_cookie().partition(";")[0]
    process = subprocess.Popen([sys.executable, "-c", READER, url, kind, cookie], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


@contextmanager
def browser(view: LiveView) -> Iterator[None]:
    """Headless Chromium on the page."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    assert program, "this needs Chromium"
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [program, *FLAGS, f"--user-data-dir={profile}", "--remote-debugging-port=0", view.url]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            yield
        finally:
            process.terminate()
            process.wait()


def fitted(scan: hs.Scan, prior: hs.matter.MaterialPrior, watch: Watch | None) -> tuple[Timed, int]:
    """The times of a fit, and how many Gaussians it has."""
    timed = Timed(watch.on_state if watch else None)
    done = hs.reconstruct(scan, prior, hs.Gaussians(), matter="levels", on_state=timed)
    return timed, len(done.object.centres)  # type: ignore[attr-defined]


class Seen(Exception):
    """Ends a run with its first picture."""


def until_first_picture(scan: hs.Scan, prior: hs.matter.MaterialPrior) -> tuple[float, float]:
    """Processor and wall time [s] from the call to the first picture."""
    began = (time.process_time(), time.perf_counter())

    def seen(stage: str, fraction: float, record: dict[str, float], state: Callable[[], Any]) -> None:
        state()
        raise Seen

    with suppress(Seen):
        hs.reconstruct(scan, prior, on_state=seen)
    return time.process_time() - began[0], time.perf_counter() - began[1]


def main() -> None:
    """Print the rows, and write them where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--material", default="haemoglobin")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--bin", type=int, default=1)
    parser.add_argument("--chromium", action="store_true")
    parser.add_argument("--first", action="store_true")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    scan = read_as(given.scan, Reading(part=Part(bin=given.bin))).in_memory()
    material = hs.materials.parse_material(given.material).delta_beta(scan.exposures.reference_energy)
    who = "chromium" if given.chromium else "reader"
    rows, prior = [], hs.MaterialPrior.known(material)
    size = "×".join(map(str, scan.views.shape))
    named = f"{size}, {len(scan.train())} views"
    if given.first:
        for run in range(given.pairs):
            cpu, wall = until_first_picture(scan, prior)
            rows.append({"scan": named, "run": run, "cpu_s": f"{cpu:.2f}", "wall_s": f"{wall:.2f}", "commit": commit()})
            print(rows[-1], flush=True)
        if given.write:
            merge(rows, FIRST, "scan")
        return
    for run in range(2 * given.pairs):
        seen, updates, own = run % 2 == 1, 0, 0.0
        if seen:
            view = Counted("benchmark")
            with (browser if given.chromium else reader)(view):
                timed, count = fitted(scan, prior, Watch(view))
            updates, own = view.updates, view.seconds()
            view.close()
        else:
            timed, count = fitted(scan, prior, None)
        cpu, wall = (b - a for a, b in zip(timed.first, timed.last))
        about = {"scan": named, "view": who if seen else "none", "run": run}
        times = {"view_cpu_s": f"{own:.2f}", "cpu_s": f"{cpu:.2f}", "wall_s": f"{wall:.2f}", "commit": commit()}
        rows.append(about | {"steps": timed.steps, "gaussians": count, "updates": updates} | times)
        print(rows[-1], flush=True)
    if given.write:
        merge(rows, OUT, columns=COLUMNS)


if __name__ == "__main__":
    main()
