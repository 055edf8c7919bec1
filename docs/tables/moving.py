"""Tables of matter that moves or changes, from docs/data alone; `docs/figures.py` puts them into their page."""

from __future__ import annotations

from itertools import groupby

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


@table("changing", "python benchmarks/changing.py --seeds 101 102", "an hour", "changing.csv")
def changing() -> str:
    """Series of matter that changes, of seeds for reporting, by the worst of their times."""
    rows, lines = [r for r in read("changing.csv") if r["use"] == "reporting"], []
    for name, seed in dict.fromkeys((r["series"], r["seed"]) for r in rows):
        own = [r for r in rows if (r["series"], r["seed"]) == (name, seed)]
        lines.append([f"{name}, {seed}", str(len(own)), *_worst(own), _events(own), _front(own), _spent(own)])
    columns = ("series, seed", "times", "error of δ", "Dice", "total", "holes", "explained", "events told of true ones")
    return markdown((*columns, "front, pixels", "time taken"), lines)


@table("chosen_motion", "python benchmarks/chosen_motion.py", "a quarter of an hour", "chosen_motion.csv")
def chosen_motion() -> str:
    """What `--motion auto` chose for each scene, and its errors beside those of each time by itself."""
    lines = []
    for name, group in groupby(read("chosen_motion.csv"), key=lambda r: r["scene"]):
        own = list(group)
        pairs = [(float(r["error"]), float(r["each_error"])) for r in own]
        errors = [" – ".join(f"{ends(found):.3f}" for ends in (min, max)) for found in zip(*pairs)]
        explained = [f"{sum(r[key] == '1' for r in own)} of {len(own)}" for key in ("explained", "each_explained")]
        told = (own[0]["choice"], own[0]["gains"].replace("-", "−"), *errors, *explained)
        lines.append([f"{name}, {own[0]['pixels']} px", *told, f"{float(own[0]['seconds']):.0f} s"])
    gains = "logarithm of the ratio of residuals of frames set aside × 100"
    columns = ("scene", "taken", gains, "error of δ", "by `each`")
    return markdown((*columns, "explained", "by `each`", "processor time"), lines)


def _worst(rows: list[Row]) -> list[str]:
    """Error, Dice, total, and Dice of holes of the worst times, and how many are explained."""
    numbers = {name: [float(r[name]) for r in rows if r[name]] for name in ("error", "dice", "total", "holes")}
    total = "–" if _front(rows) else f"{max(numbers['total'], key=lambda one: abs(one - 1)):.3f}"
    holes = f"{min(numbers['holes']):.2f}" if numbers["holes"] else ""
    explained = f"{sum(r['verdict'] == 'good' for r in rows)} of {len(rows)}"
    return [f"{max(numbers['error']):.3f}", f"{min(numbers['dice']):.3f}", total, holes, explained]


def _events(rows: list[Row]) -> str:
    """How many true events are told within a time, and how many others."""
    true, told = ([r[name].split("; ") if r[name] else [] for r in rows] for name in ("true_events", "events"))
    left, found = [list(each) for each in told], 0
    for k, events in enumerate(true):
        for event in events:
            near = [n for n in (k, k - 1, k + 1) if 0 <= n < len(left) and event in left[n]]
            found += bool(near)
            if near:
                left[near[0]].remove(event)
    there, others = sum(map(len, true)), sum(map(len, left))
    return f"{found} of {there}" + (f", {others} others" if others else "") if there + others else ""


def _front(rows: list[Row]) -> str:
    """By how much the radius of a front is off at most."""
    away = [abs(float(r["radius"]) - float(r["true_radius"])) for r in rows if r["radius"]]
    return f"{max(away):.2f}" if away else ""


def _spent(rows: list[Row]) -> str:
    return f"{sum(float(r['seconds']) for r in rows):.0f} s"
