"""What commands say: sentences on standard error, what a job takes and whether there is room, and the end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from ..matter import MaterialPrior, MatterKind
    from ..methods import Method
    from ..planning.needs import Needs
    from ..scan import Exposures, Scan
    from ..workflows.reconstruction import Reconstruction
    from ..workflows.run_folder import RunFolder

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def put(lines: Iterable[str]) -> None:
    """Print lines on standard output."""
    for line in lines:
        print(line)


def say(text: str) -> None:
    """Print `text` on standard error."""
    print(text, file=sys.stderr)


def say_that_libraries_load() -> None:
    """Say it where that takes seconds, and once."""
    if "torch" not in sys.modules and not _loading:
        _loading.append(True)
        say("loading libraries …")


_loading = list[bool]()


@contextmanager
def interruptible(sentence: Callable[[], str]) -> Iterator[None]:
    """In the block, Ctrl-C says a `sentence`, and ends with `INTERRUPTED`."""
    try:
        yield
    except KeyboardInterrupt:
        say(sentence())
        raise SystemExit(INTERRUPTED) from None


def cut_off(folder: RunFolder) -> str:
    """How a run goes on that was interrupted before its end."""
    begun = folder.config.is_file()
    return f"interrupted; {f'go on with --resume {folder.path}' if begun else 'nothing was kept yet, so begin anew'}"


def give_up(sentence: str) -> NoReturn:
    """Say `sentence` on standard error, and end with 2."""
    text = f"holosplat: {sentence}\n"
    sys.stderr.write(text.encode("utf-8", "backslashreplace").decode("utf-8"))
    raise SystemExit(2) from None


def tell_reconstruction(
    scan: Scan, out: Path, method: Method, prior: MaterialPrior, matter: MatterKind | None, whole: bool = False
) -> None:
    """Say what the reconstruction of the training frames of `scan` takes; `InputError` where there is less. Of a known
    material frames nearly always say that it has levels. whole: whether it works on whole frames in any case."""
    from ..matter import Known
    from ..planning.needs import Sizes, of_reconstruction
    from ..planning.scan_facts import seen_of, smaller

    exposures = scan.exposures[~scan.is_test]
    if len(exposures) == 0:
        return  # there is nothing to fit, as the fit will say
    kind = matter or ("levels" if isinstance(prior, Known) else None)
    needs = of_reconstruction(Sizes.of(exposures), method, kind, seen_of(scan, method, whole), prior.fixes_ratio)
    if needs is not None:
        tell(method.kind, needs, out, smaller(exposures, method, kind))


def tell_result(folder: RunFolder, result: Reconstruction, report: Path) -> None:
    """Say what a run has found and where its report is, and print whether that explains the frames."""
    from ..workflows.evaluate import TIMES, lines_of_times

    say(f"{sum(result.timing.values()):.1f} s, {result.object.described}; report: {report}")
    put((*(result.verdict.lines("training frames") if result.verdict else ()), *lines_of_times(folder.path / TIMES)))


def tell(what: str, needs: Needs, out: Path, others: Iterable[tuple[str, Needs]] = ()) -> None:
    """Say what a job takes; `InputError` where there is less, with the first of the `others` that fits."""
    from ..planning.needs import require_room

    require_room(needs, out, others)
    say(f"{what} {needs.line()}")


def tell_frames(what: str, exposures: Exposures, out: Path, of: Callable[[Exposures], Needs | None]) -> None:
    """The same of a job of which `of` says what it takes for such frames, where it is known; larger pixels may fit."""
    from ..planning.scan_facts import coarser

    # without any frames there is nothing to do, as the job will say
    if len(exposures) and (needs := of(exposures)) is not None:
        tell(what, needs, out, coarser(exposures, of))
