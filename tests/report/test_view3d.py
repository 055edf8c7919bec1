"""The view in three dimensions: what the page embeds brings back the object, and a browser adds it up as we do."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.browser import needs_chromium, opened
from helpers.splats import cloud
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, Matter
from holosplat.model import Instrument
from holosplat.report.run import phase_ends
from holosplat.report.view3d import view as packing
from holosplat.report.view3d.view import View3D, ViewPart, binned, html, packed, part_of, raster_of, volume_part
from holosplat.representations import GaussianCloud, MovingSurfaces, SurfaceMesh
from holosplat.representations.flow import TimeBasis
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import icosphere
from holosplat.volume import Volume

PIXEL, SHAPE = 1e-6, (33, 48)
ROWS, COLUMNS, RASTER = raster_of(*SHAPE, PIXEL)
MATTER, FREE = Matter((DeltaBeta(4e-7, 2e-10),)), Matter.free(3e-7, 2e-9)
TIMES = np.array([0.0, 1e-6, 2e-6])
ROTATIONS = np.concatenate((np.eye(3)[None], Rotation.random(3, rng=np.random.default_rng(1)).as_matrix()))
SHIFTS = np.array([[0.0, 0.0], [0.0, 0.0], [3.2e-6, -1.7e-6], [0.0, 0.0]])
TIME_SHOWN = 5


def gaussians(kind: str = "ordinary", count: int = 120) -> GaussianCloud:
    """Gaussians of free δ and β."""
    centres, scales, quaternions, amplitudes = cloud(kind, 2, count)
    return GaussianCloud((centres, scales.log(), quaternions, raw_of(amplitudes.abs() + 0.1)), PIXEL, FREE)


def balls() -> SurfaceMesh:
    """Two balls that overlap in some views."""
    points, faces = icosphere(4)
    vertices = np.concatenate([7.0 * points + [-6, 2, 3], 5.0 * points + [9, -3, -4]])
    both = np.concatenate([faces, faces + len(points)])
    return SurfaceMesh(torch.from_numpy(vertices), torch.from_numpy(both), PIXEL, MATTER)


def moving() -> MovingSurfaces:
    """The balls on parabolas."""
    still = balls()
    paths = torch.stack([still.vertices + torch.tensor(shift) for shift in ([-3.0, 0, 0], [0, 4.0, 1], [5.0, -1, 0])])
    body = (torch.arange(len(still.faces)) >= len(still.faces) // 2).long()
    return MovingSurfaces(paths, still.faces, body, TimeBasis(0.0, 2e-6, 2), PIXEL, MATTER)


def smooth(grid: Grid, factor: float = 2e-3) -> Volume:
    """A lump of matter off the middle, whose β goes with δ."""
    z, y, x = (axis / PIXEL for axis in grid.axes()[::-1])
    r2 = (x - 3) ** 2 / 60 + (y[:, None] + 2) ** 2 / 30 + (z[:, None, None] - 4) ** 2 / 40
    delta = 5e-7 * np.exp(-r2)
    return Volume(delta, factor * delta, grid)


GRID = Grid.centred((48, 33, 48), PIXEL)
LUMP = smooth(GRID)


@pytest.fixture(scope="module")
def view() -> View3D:
    """Everything that can be turned, at once."""
    objects = {"gaussians": gaussians(), "surfaces": balls(), "moving": moving()}
    parts = {name: part_of(obj, LUMP, RASTER, TIMES) for name, obj in objects.items()}
    parts["lump"] = volume_part(LUMP, RASTER, 10**9)
    views = Views.of_pixels(ROTATIONS, SHIFTS, SHAPE, PIXEL)
    exposures = Exposures.of(views[[0]], 20.0, 0.05, 0.7)
    slices = {"lump": volume_part(LUMP, RASTER, 10**9)}
    labels = ("one", "two", "three", "<b>four</b>")
    return View3D(parts, slices, exposures, views, labels, (0.9, 1.1), (0.0, 1.0), "data:image/png;base64,")


@pytest.mark.parametrize(("sign", "ends"), [(1.0, (0.0, 2.0)), (-1.0, (0.0, -2.0))])
def test_colours_of_the_phase_begin_at_nothing_unless_matter_is_on_both_sides(sign, ends):
    phase = sign * np.linspace(0, 2, 35).reshape(5, 7)
    assert phase_ends(phase, sign) == pytest.approx(ends, abs=0.02)
    low, high = phase_ends(phase - sign, sign)
    assert (low, high) == pytest.approx((-sign, sign), abs=0.02)


# --- what is stored -----------------------------------------------------------------------------------------


def restored(part: ViewPart, name: str) -> np.ndarray:
    """Places or values of a part, from its whole numbers."""
    low, step = (
        np.array(part.facts[key]).reshape(-1, 1, 1, 1) if part.kind == "volume" else part.facts[key]
        for key in ("low", "step")
    )
    return low + step * part.arrays[name].astype(np.float64)


def test_kinds_and_places_come_back(view):
    assert [part.kind for part in view.parts.values()] == ["gaussians", "surfaces", "paths", "volume"]
    scale = PIXEL / RASTER
    cases = {"gaussians": ("centres", gaussians().centres), "surfaces": ("vertices", balls().vertices)}
    cases["moving"] = ("coefficients", moving().coefficients)
    for name, (array, wanted) in cases.items():
        np.testing.assert_allclose(restored(view.parts[name], array), scale * wanted.numpy(), atol=2e-3)
    turned = view.parts["gaussians"].arrays["quaternions"] / 32767
    np.testing.assert_allclose(np.abs(np.sum(turned * _unit(gaussians().quaternions.numpy()), axis=1)), 1, atol=1e-4)


def _unit(quaternions: np.ndarray) -> np.ndarray:
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def test_a_volume_has_one_channel_where_beta_goes_with_delta():
    one, two = volume_part(LUMP, RASTER, 10**9), volume_part(replace(LUMP, beta=LUMP.beta**2), RASTER, 10**9)
    assert (len(one.arrays["values"]), one.channels) == (1, ((1.0, pytest.approx(2e-3, rel=1e-6)),))
    assert (len(two.arrays["values"]), two.channels) == (2, ((1.0, 0.0), (0.0, 1.0)))
    np.testing.assert_allclose(restored(one, "values")[0], LUMP.delta, atol=1.1 * LUMP.delta.max() / 508)
    signed = volume_part(replace(LUMP, delta=LUMP.delta - 2e-7 * (LUMP.delta > 1e-7)), RASTER, 10**9)
    assert restored(signed, "values")[0].min() < -5e-8
    assert 0.0 in restored(signed, "values"), "what is empty stays empty"


def test_colours_end_where_values_do():
    """Whole numbers go a step beyond: of matter lighter than its medium the bar began above zero."""
    lighter = volume_part(replace(LUMP, delta=-LUMP.delta, beta=-LUMP.beta), RASTER, 10**9)
    assert lighter.facts["ends"] == [(-LUMP.delta.max(), 0.0)]
    rounded = volume_part(replace(LUMP, delta=LUMP.delta - 1e-15 * LUMP.delta.max()), RASTER, 10**9)
    assert rounded.facts["ends"][0][0] == 0


def test_a_volume_is_binned_until_it_fits():
    part = volume_part(LUMP, RASTER, 3000)
    assert len(zlib.compress(part.arrays["values"].tobytes())) <= 3000
    factor = part.facts["voxel"][0] * RASTER / PIXEL
    assert factor > 1
    np.testing.assert_allclose(part.facts["voxel"], factor * PIXEL / RASTER)
    total = restored(part, "values").sum() * factor**3
    assert total == pytest.approx(LUMP.delta.sum(), rel=0.03)


@pytest.mark.parametrize("factor", [2, 5])
def test_bins_keep_matter_in_its_place(factor):
    coarse = binned(LUMP, factor)
    assert coarse.delta.sum() * factor**3 == pytest.approx(LUMP.delta.sum(), rel=1e-6)
    for axis, (fine, wide) in enumerate(zip(LUMP.grid.axes(), coarse.grid.axes())):
        other = tuple(k for k in range(3) if k != 2 - axis)
        middles = [np.average(c, weights=v.delta.sum(axis=other)) for c, v in ((fine, LUMP), (wide, coarse))]
        assert middles[1] == pytest.approx(middles[0], abs=0.02 * PIXEL)


def test_what_the_page_cannot_hold_is_a_volume_or_lacks_the_faintest(monkeypatch):
    many = gaussians(count=300)
    monkeypatch.setattr(packing, "MOST_GAUSSIANS", 250)
    assert part_of(many, LUMP, RASTER).kind == "volume"
    raw = torch.where(torch.arange(300)[:, None] < 60, -12.0, 1.0).repeat(1, 2)
    part = part_of(many.replaced((*list(many.parameters().values())[:3], raw)), LUMP, RASTER)
    assert part.kind == "gaussians"
    assert 235 <= part.facts["count"] <= 240
    monkeypatch.setattr(packing, "MOST_FACES", 100)
    monkeypatch.setattr(packing, "MOST_COEFFICIENTS", 100)
    assert part_of(balls(), LUMP, RASTER).kind == part_of(moving(), LUMP, RASTER, TIMES).kind == "volume"


def test_the_raster_is_fine_for_small_detectors_and_bounded_for_large_ones():
    assert raster_of(33, 48, 1e-6) == (66, 96, 0.5e-6)
    assert raster_of(200, 300, 1e-6) == (200, 300, 1e-6)
    assert raster_of(1001, 2048, 1e-6) == (143, 293, 7e-6)


def test_the_page_escapes_labels_and_loads_nothing(view):
    text = str(html(view))
    assert "<b>four" not in text
    assert "\\u003cb>four" in text
    assert not re.findall(r"(?:src|href)=\"(?!data:)", text)
    header, blob = packed(view)
    assert len(base64.b64encode(zlib.compress(blob))) < 400_000
    for part in header["parts"].values():
        for array in part["arrays"].values():
            assert array["at"] % 4 == 0


# --- in a browser -------------------------------------------------------------------------------------------

CHECK = """
<script>
(async () => {
  const api = await document.getElementById("view3d").ready, found = {};
  const packed = (a) => btoa(Array.from(new Uint8Array(a.buffer), (b) => String.fromCharCode(b)).join(""));
  for (const [name, R, time, shift] of %s) {
    const { delta, beta } = api.lines(name, R, time, shift);
    (found[name] ??= []).push([packed(delta), packed(beta), packed(api.hologram(name, R, time, shift))]);
  }
  api.turn(0.3, -0.2);
  const out = document.createElement("pre");
  out.id = "found";
  out.textContent = JSON.stringify(found);
  document.body.append(out);
})();
</script>
"""


@pytest.fixture(scope="module")
def browsed(view, tmp_path_factory) -> tuple[dict[str, list[list[np.ndarray]]], str, list[str]]:
    """∫δ, ∫β [m] and hologram [rows, columns] of every part and view as the browser has them, its page and console."""
    asked = [
        (name, R.ravel().tolist(), TIME_SHOWN if name == "moving" else 0, (shift / RASTER).tolist())
        for name in view.parts
        for R, shift in zip(ROTATIONS, SHIFTS)
    ]
    page = tmp_path_factory.mktemp("page") / "view.html"
    page.write_text(f"<!DOCTYPE html><meta charset=utf-8><body>{html(view)}{CHECK % json.dumps(asked)}")
    text, console = opened(page)
    match = re.search(r'<pre id="found">(.*?)</pre>', text, re.DOTALL)
    assert match, f"{console} {text[-300:]}"
    found = {
        name: [[np.frombuffer(base64.b64decode(t), np.float32).reshape(ROWS, COLUMNS) for t in of] for of in each]
        for name, each in json.loads(match[1]).items()
    }
    return found, text, console


def ours(name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """∫δ and ∫β [m] of every view, by our projectors on the same raster."""
    views = Views.of_pixels(ROTATIONS, SHIFTS, (ROWS, COLUMNS), RASTER)
    shown = np.linspace(TIMES[0], TIMES[-1], 4 * len(TIMES) - 3)
    made = {"gaussians": gaussians, "surfaces": balls, "moving": lambda: moving().at(shown[TIME_SHOWN])}
    if name == "lump":
        from holosplat.projectors.voxels import voxel_line_integrals

        values = torch.from_numpy(np.stack([LUMP.delta, LUMP.beta])).float()
        lines = voxel_line_integrals(values, GRID, views, step=0.25)
        return [(delta, beta) for delta, beta in lines.numpy()]
    with torch.no_grad():
        beta, delta = made[name]().project(views)
    return list(zip(delta.numpy(), beta.numpy()))


@needs_chromium
@pytest.mark.parametrize("name", ["gaussians", "surfaces", "moving", "lump"])
def test_line_integrals_are_ours_within_a_hundredth(browsed, name):
    """Over pixels of the detector, of which the raster has four. Tails that 8 bits cannot hold are lost of a volume."""
    found, _, _ = browsed
    for wanted, (delta, beta, _) in zip(ours(name), found[name]):
        for theirs, mine in ((delta, wanted[0]), (beta, wanted[1])):
            a, b = (image.reshape(ROWS // 2, 2, COLUMNS // 2, 2).mean(axis=(1, 3)) for image in (theirs, mine))
            assert np.abs(a - b).max() < 0.01 * np.abs(b).max()
            assert a.sum() == pytest.approx(b.sum(), rel=0.006 if name == "lump" else 0.002, abs=0)


@needs_chromium
def test_holograms_are_ours(browsed, view):
    """The waves of the browser's own line integrals, through our wave optics at one sample a raster pixel."""
    found, _, _ = browsed
    raster = Views.of_pixels(ROTATIONS, SHIFTS, (ROWS, COLUMNS), RASTER)
    exposures = Exposures.of(raster, 20.0, 0.05, 0.7 * PIXEL / RASTER)
    instrument = Instrument(exposures, 1)
    for each in found.values():
        delta, beta, hologram = (torch.from_numpy(np.stack(images)) for images in zip(*each))
        margins = [(m, m) for m in instrument.margin]
        B, D = (torch.nn.functional.pad(lines, (*margins[1], *margins[0])) for lines in (beta, delta))
        wanted = instrument.image(B, D)
        inside = (slice(None), slice(10, -10), slice(10, -10))  # fringes of matter that the frame cuts wrap around
        contrast = float((wanted - 1).abs().max())
        assert float((hologram - wanted)[inside].abs().max()) < 0.02 * contrast


@needs_chromium
def test_nothing_goes_wrong_in_the_browser(browsed):
    _, text, console = browsed
    assert not [line for line in console if "error" in line.lower()]
    assert re.search(r'class="live"(?! hidden)', text), "the view is shown"
    assert re.search(r'<img class="still"[^>]* hidden', text), "in the place of the picture"
    assert "&lt;b&gt;four" in text


@needs_chromium
def test_a_browser_without_webgl_keeps_the_picture(view, tmp_path):
    page = tmp_path / "view.html"
    without = "<script>HTMLCanvasElement.prototype.getContext = () => null;</script>"
    page.write_text(f"<!DOCTYPE html><meta charset=utf-8><body>{without}{html(view)}")
    text, _ = opened(page)
    assert "The view cannot be turned here: this browser has no WebGL2." in text
    assert re.search(r'<img class="still"(?![^>]*hidden)', text)
