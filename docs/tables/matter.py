"""Tables of matter that may fill the field, from docs/data/matter_scenes.csv."""

from __future__ import annotations

from .benchmark import Row, markdown, read, table

KINDS = ["bubbles", "flotation", "cuvette", "jet", "break-up", "crack", "shock", "keyhole", "lattice", "fibres"]
KINDS += ["channel", "star"]
BESIDE = {"shock": ["shock, no bubble"]}
"""Scenes of a kind without a picture of their own."""
HEAD = {
    ("large", "told"): "12 views, no noise: told",
    ("small", "told"): "8 noisy views: told",
    ("small", "nothing told"): "nothing told",
    ("small", "Paganin, TV"): "Paganin and total variation",
}


@table("matter", "python benchmarks/matter_scenes.py --seeds 101 102 103 104", "hours", "matter_scenes.csv")
def scenes() -> str:
    """Error of δ / Dice / total over the true one, of each kind and run: the scene of largest error."""
    rows = sorted(read("matter_scenes.csv"), key=lambda row: float(row["error"]))
    runs, lines = [run for run in HEAD if any((row["size"], row["run"]) == run for row in rows)], []
    for kind in [one for each in KINDS for one in (each, *BESIDE.get(each, []))]:
        worst = {(row["size"], row["run"]): row for row in rows if row["kind"] == kind}
        if worst:
            lines.append([f"`{kind}`", *(_three(worst.get(run)) for run in runs)])
    return markdown(("kind", *(HEAD[run] for run in runs)), lines)


def _three(row: Row | None) -> str:
    if row is None:
        return "–"
    if row["error"] == "inf":
        return "refused"
    error, dice, total = (float(row[name]) for name in ("error", "dice", "total"))
    return f"{error:.3f} / {dice:.3f} / {total:.2f}"
