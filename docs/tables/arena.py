"""The table of the arena in the docs, from the last entry of docs/data/arena alone."""

from __future__ import annotations

from holosplat_bench.suite.arena.history import read_history
from holosplat_bench.suite.pages.arena import front, overall, shown

from .benchmark import DATA, markdown, table

TRACKS = ("kernels", "steps", "retrieval", "tomography", "jobs")
NUMBERS = ("error", "dice", "ssim", "seconds")


@table("arena", "holosplat bench arena --history docs/data/arena", "an hour", "arena/")
def arena() -> str:
    """Means over the cases of every track; those on the Pareto front in bold."""
    entry, lines = read_history(DATA / "arena")[-1], []
    for track in TRACKS:
        found = overall(entry, track)
        best = front(found)
        for name, numbers in found.items():
            cells = [shown(number, numbers.get(number)) for number in NUMBERS]
            lines.append([track, f"**{name}**" if name in best else name, *cells])
    missing = sorted({row["contestant"] for row in entry.rows if row["status"] != "done"})
    cases = len({row["case"] for row in entry.rows})
    said = f"{cases} cases of {entry.size}² pixels, seed {entry.seed}, commit {entry.commit}, "
    said += f"{entry.machine['processor']}, one thread, shared. "
    said += f"Without a result on some case: {', '.join(missing)}." if missing else "All have results on all cases."
    return f"{markdown(('track', 'contestant', 'error', 'Dice', 'SSIM', 'processor time / s'), lines)}\n\n{said}"
