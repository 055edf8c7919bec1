"""What Jupyter shows: every kind of object, scans, volumes and runs, with all text escaped."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
import pytest
import torch
from PIL import Image

import holosplat as hs
from helpers.splats import cloud
from holosplat.display import card
from holosplat.geometry import Grid, Views
from holosplat.io.objects import write_object
from holosplat.matter import DeltaBeta, Matter
from holosplat.representations import KINDS, GaussianCloud, SurfaceMesh
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import icosphere
from holosplat.volume import Volume

MATTER = Matter((DeltaBeta(4e-7, 2e-10),))


def pictures(text: str) -> list[np.ndarray]:
    """The pictures in a page."""
    found = re.findall(r'src="data:image/png;base64,([^"]*)"', text)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)), formats=("PNG",))) for data in found]


def ball() -> SurfaceMesh:
    points, faces = icosphere(3)
    return SurfaceMesh(torch.from_numpy(9.0 * points), torch.from_numpy(faces.copy()), 2e-6, MATTER)


def test_an_object_shows_its_line_integrals():
    """Of a ball: brightest in the middle, as long as its diameter."""
    text = ball()._repr_html_()
    (image,) = pictures(text)
    assert image.shape == (128, 128)
    assert image[64, 64] >= 250
    assert image[0, 0] == 0
    longest = float(re.findall(r"0 to ([\d.e-]+) nm", text)[0])
    assert longest == pytest.approx(1e9 * 4e-7 * 36e-6, rel=0.02)
    assert "surfaces of 1280 triangles" in text
    centres, scales, quaternions, amplitudes = cloud("ordinary", 1, 30)
    gaussians = GaussianCloud((centres, scales.log(), quaternions, raw_of(amplitudes.abs() + 0.1)), 2e-6, MATTER)
    assert "30 Gaussians" in gaussians._repr_html_()


def test_every_kind_has_a_display():
    assert all(callable(getattr(kind, "_repr_html_", None)) for kind in KINDS.values())


def test_scans_read_the_frames_that_they_show_alone():
    frames = np.random.default_rng(0).random((4, 5, 300)).astype(np.float32)
    exposures = Exposures.of(Views.from_angles([0.0, 30.0, 60.0, 90.0], (5, 300), 2e-6), 20.0, 0.1)
    text = Scan(frames, exposures, np.array([0, 0, 0, 1], dtype=bool), {})._repr_html_()
    assert "4 of 5 × 300 pixels, 1 held out" in text
    assert "20 keV" in text
    assert [image.shape for image in pictures(text)] == [(3, 150), (3, 150)]


def test_volumes_show_their_middle_slices():
    grid = Grid.centred((3, 5, 7), 1e-6)
    values = np.arange(105, dtype=np.float32).reshape(grid.shape)
    shown = pictures(Volume(values, 0 * values, grid)._repr_html_())
    assert [image.shape for image in shown] == [(5, 7), (3, 7), (3, 5)]
    assert shown[0][-1, -1] == 255


def test_runs_say_how_far_they_are(tmp_path):
    folder = hs.RunFolder(tmp_path / "<run>")
    assert "empty" in folder._repr_html_()
    folder.begin({"method": {}})
    assert "begun" in folder._repr_html_()
    folder.write_summary({"method": "sur<faces", "finished": True})
    write_object(folder.object, ball())
    text = folder._repr_html_()
    assert "&lt;run&gt;" in text
    assert "sur&lt;faces" in text
    assert len(pictures(text)) == 1


def test_text_is_escaped():
    text = card("<b>", {"<script>": '"&'}, [("<i>", np.zeros((2, 2)))])
    assert not re.search(r"<script|<i>|<b><b>", text)
    assert "&lt;script&gt;" in text
    assert "&quot;&amp;" in text
