"""A small scene with everything that a report may show of it, and a reader of its page."""

from html.parser import HTMLParser

import numpy as np
from scipy.ndimage import gaussian_laplace

from holosplat.geometry import Grid, Views
from holosplat.metrics import image_scores, intensity_range, volume_scores
from holosplat.report import (
    HeldOutViews,
    ProjectedMaps,
    ReportContent,
    view_labels,
)
from holosplat.volume import Volume

DELTA, PITCH = 4e-7, 1e-7


def ball(grid, radius, centre=(0.0, 0.0, 0.0)):
    """Fill factor [Z, Y, X] of a ball, smooth over two voxels."""
    x, y, z = (axis - c for axis, c in zip(grid.axes(), centre))
    distance = np.sqrt(x[None, None] ** 2 + y[None, :, None] ** 2 + z[:, None, None] ** 2)
    return np.clip(0.5 + 0.5 * (radius - distance) / max(grid.voxel_size), 0, 1)


def scene(shape=(24, 20, 28)):
    grid = Grid.centred(shape, PITCH)
    fill = np.maximum(ball(grid, 5e-7, (4e-7, 0, 1e-7)), ball(grid, 4e-7, (-5e-7, 2e-7, -3e-7)))
    truth = Volume(DELTA * fill, DELTA / 500 * fill, grid)
    rng = np.random.default_rng(0)
    noisy = fill * 0.97 + 0.02 * rng.standard_normal(grid.shape)
    return truth, Volume(DELTA * noisy, DELTA / 480 * noisy, grid)


def content(**changes):
    """A full report of a small scene; `changes` replace fields."""
    truth, found = scene()
    views = Views.from_angles([10.0, 80.0], (20, 28), PITCH)
    projected_delta = [np.stack([v.delta.sum(axis=0)] * 2) * PITCH for v in (found, truth)]
    projected_beta = [np.stack([v.beta.sum(axis=0)] * 2) * PITCH for v in (found, truth)]
    predicted, measured = (1 + 2e10 * np.stack([gaussian_laplace(d, 1.5) for d in maps]) for maps in projected_delta)
    scores = image_scores(predicted, measured, intensity_range(measured))
    labels = view_labels(views)
    steps = np.arange(0, 100, 10)
    fields = {
        "title": "Two balls & a <test>",
        "reconstruction": found,
        "truth": truth,
        "energy_kev": 11.0,
        "pixel_size": PITCH,
        "held_out": HeldOutViews(measured, predicted, labels, scores),
        "projections": ProjectedMaps(
            projected_beta[0], projected_delta[0], labels, projected_beta[1], projected_delta[1]
        ),
        "volume_scores": volume_scores(found, truth),
        "history": {
            "step": steps,
            "loss": np.exp(-steps / 30),
            "data": 0.5 * np.exp(-steps / 30),
            "count": 10 + steps,
            "val_ssim": np.where(steps % 20 == 0, steps / 100, np.nan),
        },
        "seconds": 61.0,
        "settings": {"fit": {"steps": 100, "rate": 1e-3}, "seed": 0},
        "versions": {"holosplat": "0"},
        "input_hash": "abc123",
    }
    return ReportContent(**(fields | changes))


BARE = {"truth": None, "held_out": None, "projections": None, "volume_scores": None, "history": {}}
VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}


class Page(HTMLParser):
    """Checks that tags are nested, and collects what the page refers to."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.sources, self.words, self.links, self.ids = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        names = [name for name, _ in attributes]
        assert len(names) == len(set(names))
        told = [value for name, value in attributes if name in ("src", "href", "srcset", "data", "poster")]
        self.links += [value[1:] for value in told if value.startswith("#")]
        self.sources += [value for value in told if not value.startswith("#")]
        self.ids += [value for name, value in attributes if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())
