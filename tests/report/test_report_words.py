"""The words and numbers of a report: the verdict over it, µ where δ is not known, labels."""

import math
from dataclasses import replace

import numpy as np

from helpers.browser import needs_chromium, opened
from helpers.report_page import PITCH, Page, content, scene
from holosplat.geometry import Views
from holosplat.inference import Decision
from holosplat.metrics import robust_material_delta, volume_scores
from holosplat.report import (
    render_page,
    view_labels,
)
from holosplat.report.blocks import _ends
from holosplat.report.content import flatten
from holosplat.report.curves import history_figure
from holosplat.report.page import NOT_REHEARSED, VERDICTS, duration, headline, percent
from holosplat.report.style import format_length, in_print, scientific
from holosplat.report.surface import camera
from holosplat.units import wavelength
from holosplat.volume import Volume
from holosplat.workflows.rehearsal import Rehearsal
from holosplat.workflows.verdict import Verdict

# --- the figures over the report ---


@needs_chromium
def test_no_figure_of_a_narrow_page_reaches_into_another(undrawn_reports, tmp_path):
    """On a phone's 420 pixels, a long one included."""
    script = """<style>body { width: 420px; }</style><script>
        const box = (one) => { const range = document.createRange(); range.selectNodeContents(one); return range; };
        document.title = [...document.querySelectorAll(".key div")].every((one) =>
            box(one).getBoundingClientRect().right <= one.getBoundingClientRect().right
            && one.getBoundingClientRect().right <= 420) ? "fits" : "overflows";</script>"""
    page = tmp_path / "page.html"
    text = render_page(content()).replace("42.5 dB", "1.28 × 10⁻²⁰ m³")
    page.write_text(text.replace("</body>", f"{script}</body>"), encoding="utf-8")
    assert "<title>fits</title>" in opened(page)[0]


# --- the verdict ---


def judged(good, cause="", words="The frames are not explained: the residual is 3 times the noise."):
    return Verdict(
        good, words, ("Likely cause: light.",), np.array([[1e-6, np.inf]]), *[np.ones((3, 1))] * 4, {}, cause
    )


def test_the_verdict_is_the_headline_with_its_cause_and_the_next_command(undrawn_reports):
    shown = headline(content(explained=judged(False, "shift_x"), scan="'my scan.nxs'"))
    assert shown.trusted is False
    assert shown.text == "Do not trust this volume: the frames are not explained"
    assert shown.words[:2] == ("The residual is 3 times the noise.", "Likely cause: light.")
    page = Page(render_page(content(explained=judged(False, "shift_x"), scan="'my scan.nxs'"))).text
    assert "holosplat align 'my scan.nxs' --axis-only --out aligned.nxs" in page
    assert page.index("Do not trust this volume") < page.index("Likely cause: light.") < page.index("mean SSIM")


def test_a_good_verdict_is_the_headline_unless_held_out_frames_are_not_explained():
    good = judged(True, words="The frames are explained to within their noise: the residual is 1 of it.")
    assert headline(content(explained=good)).text == "The frames are explained to within their noise"
    held_out = replace(content().held_out, explained=judged(False))
    shown = headline(content(explained=good, held_out=held_out))
    assert shown.text == "Do not trust this volume: the held-out frames are not explained"
    assert headline(content()).trusted is None


def test_rehearsals_give_the_headline_one_of_three_words():
    unexplained = judged(False, "mass", words="The frames are not explained: the residual is 3 times the noise.")
    run = {"residual": [1.0], "cause": "mass"}
    limited = Rehearsal(1, 1e-6, unexplained, (run, run))
    shown = headline(content(explained=unexplained, rehearsal=limited))
    assert (shown.text, shown.trusted, shown.step) == (VERDICTS["limited"], None, None)
    assert "limited" in shown.words[0]
    wrong = replace(limited, cause=Decision("", "angles", "held-out frames"))
    shown = headline(content(explained=unexplained, rehearsal=wrong))
    assert (shown.text, shown.trusted) == (VERDICTS["wrong"], False)
    assert shown.step is not None
    assert "--angles FILE" in shown.step.command
    good = judged(True, words="The frames are explained to within their noise: the residual is 1 of it.")
    shown = headline(content(explained=good, rehearsal=replace(limited, explained=good)))
    assert shown.text == VERDICTS["consistent"]
    assert good.words in shown.words  # whole, for the headline says no noise
    assert NOT_REHEARSED in headline(content(explained=good)).words
    assert NOT_REHEARSED not in headline(content(explained=good, at_rest=False)).words


# --- absorption alone ---


def test_absorption_alone_is_shown_as_attenuation_and_nothing_is_said_of_phase():
    truth, found = (Volume(v.beta, v.beta, v.grid) for v in scene())
    changes = {"reconstruction": found, "truth": truth, "volume_scores": volume_scores(found, truth)}
    page = Page(render_page(content(**changes, delta_told=False))).text
    mu = 4 * np.pi / wavelength(11.0) * robust_material_delta(truth)
    assert f"The material's µ is {scientific(mu)}\u00a0m⁻¹".replace("\u00a0", " ") in page.replace("\u00a0", " ")
    assert "Absorption 2k∫β dz = ∫µ dz" in page
    for words in ("Phase", "phase", "Mean δ", "mean δ", "mean β", "where δ"):
        assert words not in page
    assert page.count("δ") == 2  # "δ, and with it δ/β, is not known"


# --- words and numbers ---


def test_labels_numbers_and_settings_read_well():
    assert view_labels(Views.from_angles([0.0, 15.0, 359.99], (4, 4), PITCH)) == (
        "θ = 0.0°",
        "θ = 15.0°",
        "θ = 0.0°",
    )
    assert view_labels(Views.from_rotations(camera()[None], (4, 4), PITCH)) == ("view 1",)
    across = Views.from_angles([-88.2, 0.0, 45.0, 88.2], (4, 4), PITCH)
    assert view_labels(across) == ("θ = −88.2°", "θ = 0.0°", "θ = 45.0°", "θ = 88.2°")
    assert view_labels(Views.from_angles([0.0, 90.0, 180.0, 270.0], (4, 4), PITCH))[-1] == "θ = 270.0°"
    assert flatten({"a": {"b": 1, "c": {"d": 0.5}}, "e": (1, 2)}) == {
        "a.b": "1",
        "a.c.d": "0.5",
        "e": "(1, 2)",
    }
    assert scientific(4.123e-7).replace("\u00a0", " ") == "4.12 × 10⁻⁷"
    assert scientific(-9.999e-7, 2).replace("\u00a0", " ") == "−1.0 × 10⁻⁶"
    assert scientific(-0.0) == "0"
    assert scientific(999.7) == "1,000"
    assert format_length(3.43) == "3430\u00a0mm"
    assert in_print("β 9.1e-19 m³, -2e+06").replace("\u00a0", " ") == "β 9.1 × 10⁻¹⁹ m³, −2 × 10⁶"
    assert scientific(None) == "–"
    assert scientific(math.inf) == "∞"
    assert scientific(1300.2, 4) == "1,300"
    assert format_length(4.2e-7).replace("\u00a0", " ") == "420 nm"
    assert format_length(9.999e-7).replace("\u00a0", " ") == "1 µm"
    assert percent(-0.0123) == "−1.2 %"
    assert percent(None) == "–"
    assert percent(-1e-9) == percent(0.0) == "0 %"


def test_ends_of_values_that_are_rounding_are_zero():
    assert _ends(np.array([-4.9e-22, 7.4e-7])) == (0.0, 7.4e-7)
    assert _ends(np.array([-4.9e-9, 7.4e-7])) == (-4.9e-9, 7.4e-7)
    shown = content()
    inside = np.arange(shown.reconstruction.delta[0, 0].size) > 2
    faint = np.where(inside, shown.reconstruction.delta, 1e-21)
    found = replace(
        shown, reconstruction=replace(shown.reconstruction, delta=faint), seen=np.broadcast_to(inside, faint.shape)
    )
    assert "Beyond it lies 0 % of the matter" in found.trust
    assert [duration(t) for t in (1.25, 54.2, 600, 3700)] == ["1.2 s", "54 s", "10 min 00 s", "1 h 01 min"]


def test_a_volume_below_half_of_its_material_says_that_no_surface_is_drawn(undrawn_reports):
    """Gaussians of a single view were drawn as an empty box, with β said to be zero."""
    shown = content()
    thin = replace(shown.reconstruction, delta=0.3 * shown.reconstruction.delta)
    page = Page(render_page(replace(shown, reconstruction=thin, material_delta=shown.surface_material()))).text
    assert "No voxel of the reconstruction reaches it." in page
    assert "No voxel of the reconstruction does." in page
    assert "Matter on the other side" not in page
    both = replace(shown.reconstruction, delta=np.sin(np.arange(thin.delta.size)).reshape(thin.delta.shape))
    page = Page(render_page(replace(shown, reconstruction=both, material_delta=1.0))).text
    assert "Matter on the other side of the medium's is not drawn here" in page
    assert "β is zero" not in page


def test_the_size_of_voxels_is_no_term_of_the_loss():
    """It was drawn among them, as \"voxel px\"."""
    steps = np.arange(1.0, 9.0)
    figure = history_figure({"step": steps, "loss": 1 / steps, "voxel_px": np.repeat([2.0, 1.0], 4)})
    assert figure is not None
    assert len(figure.axes[0].lines) == 1


def test_a_loss_that_is_a_logarithm_is_drawn_whole():
    """It is negative, which an axis by powers of ten does not show."""
    steps = np.arange(1.0, 9.0)
    figure = history_figure({"step": steps, "loss": -np.sqrt(steps), "frames": -steps, "rounded": 1 / steps})
    assert figure is not None
    (line,) = figure.axes[0].lines
    np.testing.assert_array_equal(line.get_ydata(), -np.sqrt(steps))
    assert (figure.axes[0].get_yscale(), figure.axes[0].get_ylabel()) == ("linear", "log of loss")
