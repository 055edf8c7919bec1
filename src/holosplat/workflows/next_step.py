"""What to try next where frames are not explained: a sentence and a command for each likely cause."""

from __future__ import annotations

from dataclasses import dataclass, replace

STIFF = "stiff"
"""The cause where no change of the frames explains them: the model of the matter, or views that do not agree."""


@dataclass(frozen=True)
class Step:
    """why: a sentence on what the command does; command: as it is typed, with SCAN for the scan."""

    why: str
    command: str


STEPS = {
    "mass": Step("let the frames find the distance in a range [m] of yours:", "--distance LOW:HIGH"),
    "distance": Step("let the frames find the distance in a range [m] of yours:", "--distance LOW:HIGH"),
    "absorption": Step("let the frames find δ/β in a range of yours:", "--delta-beta LOW:HIGH"),
    "shift_x": Step("find the axis of rotation, then reconstruct the new scan:", "--axis-only"),
    "shift_y": Step("find where the beams are, then reconstruct the new scan:", ""),
    "shifts": Step("find where the beam of each view is, then reconstruct the new scan:", ""),
    "light": Step("find the uneven light of each frame:", "--light smooth"),
    "sign": Step("name the medium, from which δ of the matter differs to the other side:", "--medium MEDIUM"),
    "angles": Step("give the angles of the frames in degrees, in the frames' order:", "--angles FILE"),
    "beyond": Step("let matter lie beyond the field:", "--method volume --set volume.beside=0.5"),
    STIFF: Step("take the matter as continuous, without sharp edges:", "--matter continuous"),
}
"""What to do, by the likeliest cause of a verdict, with the options of the command; of others there is none."""
ALIGNED = ("shift_x", "shift_y", "shifts")
"""Causes that `align` finds; all others are found by `reconstruct`."""


def next_step(cause: str, scan: str = "SCAN") -> Step | None:
    """What to try where `cause` is the likeliest one; None where no command mends it. scan: its name, as typed."""
    step = STEPS.get(cause)
    if step is None:
        return None
    act, out = ("align", "aligned.nxs") if cause in ALIGNED else ("reconstruct", "another_run")
    return replace(step, command=" ".join(filter(None, ("holosplat", act, scan, step.command, "--out", out))))
