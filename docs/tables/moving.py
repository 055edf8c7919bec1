"""The table of other ways to reconstruct all times, from docs/data alone; `docs/figures.py` puts it into its page."""

from __future__ import annotations

from .benchmark import Row, markdown, read, rounded, table

WAYS = {
    "each-tv": "each time by itself, total variation",
    "each-voxels": "each time by itself, voxels through the waves",
    "each-surfaces": "each time by itself, surfaces",
    "each-volume": "each time by itself, smooth volume",
    "warm-voxels": "warm start, voxels",
    "warm-surfaces": "warm start, surfaces",
    "warm-volume": "warm start, smooth volume",
    "space-time-tv": "total variation in space and time",
    "low-rank": "low rank",
    "hexplane": "six planes",
    "deformed": "deformation network",
    "ours": "**ours**",
    "ours-body": "**ours**, shape at rest known",
}
"""What the table calls the methods, in order."""
KNOWN = "-body"
"""What ends the names of cases, and of our way, where the shape at rest is known."""
CASES = ("flow4", "flow3", "flow2", "stir4", "burst4")


@table(
    "moving_methods",
    "python benchmarks/moving_methods.py DATA --cases flow4 flow3 flow2 stir4 burst4 --write",
    "an hour",
    "moving_methods.csv",
    "motion.csv",
    "moving_matter.csv",
)
def moving_methods() -> str:
    """Each way beside ours, whose rows are those of docs/data/motion.csv and docs/data/moving_matter.csv."""
    rows = [r for r in read("moving_methods.csv") if (r["seed"], r["first"]) in (("1", "0"), ("1", "5"))]
    found = {(r["case"], r["method"]): r for r in [*rows, *_ours()]}
    lines = []
    for case in CASES:
        if not any(key[0] == case for key in found if not key[1].startswith("ours")):
            continue
        for method, called in WAYS.items():
            if (case, method) in found:
                r = found[case, method]
                dice = f"{rounded(r['dice'], 3)} ({rounded(r['least_dice'], 3)})" if case.startswith("flow") else ""
                worst = f" ({rounded(r['worst'], 3)})" if r["worst"] else ""
                memory = f"{float(r['memory_mb']) / 1000:.1f} GB"
                error, spent = f"{rounded(r['error'], 3)}{worst}", f"{float(r['cpu_seconds']):.0f} s"
                lines.append([f"`{case}`", called, dice, error, spent, memory])
    columns = ("case", "way", "Dice, mean (worst time)", "error of δ, mean (worst time)", "processor time", "memory")
    return markdown(columns, lines)


def _ours() -> list[Row]:
    """`track` for bodies, `reconstruct --motion flow` for other matter."""
    bodies = [
        r | {"case": r["case"].removesuffix(KNOWN), "method": f"ours{KNOWN * r['case'].endswith(KNOWN)}", "worst": ""}
        for r in read("motion.csv")
        if (r["first"], r["every"], r["seed"], r["without"]) == ("0", "1", "1", "none")
    ]
    matter = [r | {"method": "ours"} for r in read("moving_matter.csv") if r["method"] == "all times in one"]
    return [*bodies, *matter]


@table(
    "tracked-carrier",
    "python benchmarks/carrier.py DATA --cases flow4 --write, as of commit 6bfff929",
    "ten minutes",
    "carrier.csv",
)
def carrier() -> str:
    """Runs with and without a velocity field that bodies share; cells that are seen briefly, of those there are."""
    lines = []
    for r in sorted(
        read("carrier.csv"), key=lambda r: (r["case"] != "flow4", r["case"], r["first"], float(r["weight"]))
    ):
        last = int(r["first"]) + int(r["times"]) - 1
        scores = f"{rounded(r['dice'], 4)} ({rounded(r['least_dice'], 4)})", rounded(r["error"], 4)
        away = [f"{rounded(r[name], 2)} µm" if r[name] != "nan" else "" for name in ("inside_um", "beyond_um")]
        kept, with_it = f"{r['kept']} of {r['brief']}", "yes" if float(r["weight"]) > 0 else "no"
        centre = f"{rounded(r['centre_um'], 4)} µm"
        lines.append([f"`{r['case']}`, {r['first']} … {last}", with_it, *scores, centre, kept, *away])
    columns = ("case, snapshots", "shared field", "Dice, mean (worst time)", "error of occupancy", "centres, median")
    return markdown((*columns, "seen briefly and followed", "their middles in the field", "and beyond"), lines)


@table("assimilation", "python benchmarks/assimilation.py --write", "five minutes", "assimilation.csv")
def assimilation() -> str:
    """4D-Var on manufactured holograms: what each assumption finds, and where its cells then are."""
    lines = []
    for r in read("assimilation.csv"):
        told = [f"{float(r[name]):.2f}" if r[name] else "" for name in ("peak_told", "shear_told")]
        found = f"{float(r['peak_m_s']):.4f} m/s", f"{1e6 * float(r['shear_n_m']):.1f} µN/m"
        states = [f"{float(r[name]):.3f} µm" for name in ("before_um", "state_um", "later_um")]
        lines.append([r["case"], *(f"{one} ({share})" if share else one for one, share in zip(found, told)), *states])
    columns = ("assumed", "peak", "modulus", "first state, before", "after", "120 µs later")
    return markdown(columns, lines)
