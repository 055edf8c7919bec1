"""Red cells by their shape at rest, in two beams at one time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.inference import Decision, Score
from holosplat.learning.network import Taps
from holosplat.learning.start import Card, Guessed, LearnedStart, Trained
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior, Matter
from holosplat.mesh import TriangleMesh
from holosplat.methods import Gaussians, Task
from holosplat.methods import learned as method
from holosplat.methods.learned import red_cells
from holosplat.methods.method import Near
from holosplat.methods.surfaces import BodiesStage
from holosplat.metrics import volume_scores
from holosplat.representations import SurfaceMesh
from holosplat.specimens.red_cells import evans_fung_cell

ENERGY, PIXEL, SHAPE = 20.0, 0.9e-6, (31, 27)
MATERIAL = HAEMOGLOBIN.delta_beta(ENERGY)
PRIOR = MaterialPrior.known(MATERIAL)
TURNS = ([0.9, 0.3, 0.4], [-0.2, 0.5, 1.3])
CENTRES = np.array([[3.5e-6, -6.0e-6, -3.0e-6], [-4.0e-6, 5.5e-6, 2.5e-6]])


class AllFull(nn.Module):
    """A network that guesses matter everywhere."""

    def forward(self, images: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
        """Logits on voxels of a pixel."""
        logits = torch.ones([2 * n for n in taps.grid])
        return logits, logits


def cells(size: float = 1.0) -> list[TriangleMesh]:
    """Two red cells, tilted."""
    rest = evans_fung_cell()
    return [
        TriangleMesh(size * rest.vertices @ Rotation.from_rotvec(turn).as_matrix().T + centre, rest.faces, f"cell{k}")
        for k, (turn, centre) in enumerate(zip(TURNS, CENTRES))
    ]


def scanned(angles: tuple[float, ...] = (0.0, 90.0), size: float = 1.0) -> tuple[hs.Scan, hs.MeshScene]:
    scene = hs.MeshScene.of_one_material(cells(size), MATERIAL)
    exposures = hs.Exposures.of(hs.Views.from_angles(np.array(angles), SHAPE, PIXEL), ENERGY, 0.1)
    return hs.simulate(scene, exposures, is_test=np.zeros(len(angles), dtype=bool), oversample=4), scene


def guess(scan: hs.Scan, radius: float = 3.0e-6) -> Guessed:
    """Two balls where the cells are: their places, and about their volumes."""
    grid = Grid.of_views(scan.views)
    axes = [o + s * np.arange(n) for o, s, n in zip(grid.origin[::-1], grid.voxel_size[::-1], grid.shape)]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    away = [np.sqrt((x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2) for c in CENTRES]
    values = 1 / (1 + np.exp((np.minimum(*away) - radius) / (0.3 * PIXEL)))
    return Guessed(torch.from_numpy(values.astype(np.float32)), grid, torch.zeros(0), None)  # type: ignore[arg-type]


@pytest.fixture
def short(monkeypatch):
    """Few steps, of a search and of fits."""
    for name in ("PATIENCE", "TRIES"):
        monkeypatch.setattr(f"holosplat.bodies.neighbourhood_search.{name}", 1)
    for name, steps in (("FIRST_STEPS", 120), ("TRIAL_STEPS", 60), ("LAST_STEPS", 60), ("ROUNDS", 2)):
        monkeypatch.setattr(method, name, steps)


@pytest.mark.parametrize("size", [1.0, 1.2])
def test_cells_are_found_with_their_shapes_and_size(short, size):
    scan, scene = scanned(size=size)
    found = red_cells(Task(scan, PRIOR), guess(scan, 3.0e-6 * size), MATERIAL)
    assert isinstance(found, SurfaceMesh)
    grid = Grid.of_views(scan.views)
    scores = volume_scores(found.voxelise(grid), scene.voxelise(grid))
    assert len(found.bodies()) == 2
    assert scores.dice > 0.93


def test_a_guess_of_cells_that_are_too_small_or_large_is_put_right(short):
    """Of a guess by a tenth too narrow or too wide frames tell the size at rest, before any surface is fitted."""
    scan, scene = scanned(size=1.2)
    true = np.mean([mesh.volume for mesh in scene.meshes])
    for radius in (3.0e-6, 3.7e-6):
        seen = method.cut_bodies(guess(scan, radius).values.numpy(), guess(scan).grid, PIXEL)
        began = np.mean([mesh.volume for mesh in seen])
        posed = method._posed(Task(scan, PRIOR), MATERIAL, method.guessed_cells(method.extent_like(seen)), seen)
        assert posed is not None
        found = posed.rest.volume * PIXEL**3
        assert abs(found / true - 1) < 0.1
        assert abs(found / true - 1) < 0.5 * abs(began / true - 1)


def test_a_cell_that_begins_as_its_twin_is_told(short, monkeypatch):
    """Both cells are put in their twins' places before anything is fitted."""
    scan, scene = scanned()
    grid, found = Grid.of_views(scan.views), {}
    posed = method._posed

    def as_twins(task, material, body, seen):
        right = posed(task, material, body, seen)
        beams = method.two_beams(task.scan.views)
        for k in range(len(right.nodes)):
            middle, plain = right.plain(k)
            right = right.with_cell(k, middle + plain @ method.twin_map(right.second(plain), beams).T)
        return right

    monkeypatch.setattr(method, "_posed", as_twins)
    for rounds in (0, 2):
        monkeypatch.setattr(method, "ROUNDS", rounds)
        made = red_cells(Task(scan, PRIOR), guess(scan), MATERIAL)
        assert made is not None
        found[rounds] = volume_scores(made.voxelise(grid), scene.voxelise(grid)).dice
    assert found[2] > 0.93
    assert found[2] > found[0] + 0.02


def test_other_beams_times_and_sizes_are_left_alone():
    scan, _ = scanned()
    three, _ = scanned((0.0, 40.0, 90.0))
    assert red_cells(Task(three, PRIOR), guess(three), MATERIAL) is None
    empty = guess(scan)
    assert red_cells(Task(scan, PRIOR), replace(empty, values=0 * empty.values), MATERIAL) is None
    assert red_cells(Task(scan, PRIOR), guess(scan, 1.9e-6), MATERIAL) is None  # of less than three pixels


def test_cells_unlike_the_guess_are_left(short, monkeypatch):
    """The guess has the cells at places where the frames show none."""
    scan, _ = scanned()
    elsewhere = guess(scan)
    elsewhere = replace(elsewhere, values=elsewhere.values.flip(0).flip(2))
    assert red_cells(Task(scan, PRIOR), elsewhere, MATERIAL, typical=0.7) is None
    monkeypatch.setattr(method, "MOST_CELLS", 1)
    assert red_cells(Task(scan, PRIOR), guess(scan), MATERIAL) is None


@pytest.mark.parametrize(("better", "of"), [(True, ["red-cells"]), (False, ["red-cells"]), (True, ["capsules"])])
def test_cells_are_begun_with_where_they_do_better(monkeypatch, better, of):
    scan, _ = scanned()
    trained = Trained(AllFull(), Card(trained_on={"kinds": of}))  # type: ignore[arg-type]
    monkeypatch.setattr(LearnedStart, "network", property(lambda self: trained))
    parts = [(mesh.vertices / PIXEL, mesh.faces) for mesh in cells()]
    faces = np.concatenate([one + k * len(parts[0][0]) for k, (_, one) in enumerate(parts)])
    vertices = torch.from_numpy(np.concatenate([one for one, _ in parts]))
    made = SurfaceMesh(vertices, torch.from_numpy(faces), PIXEL, Matter.one(*MATERIAL))
    asked = []
    monkeypatch.setattr(method, "red_cells", lambda *given: asked.append(given) or made)
    taken = better and of == ["red-cells"]
    powers = {method.CELLS: 0.5 if better else 2.0, method.GUESS: 0.5 if taken else 1.0}

    def left(self, name: str) -> Score:
        return Score(powers.get(name, 1.0) * np.ones((8, 3)), 2)

    monkeypatch.setattr(method._Fits, "_score", left)
    told = list[Decision]()
    task = Task(scan, PRIOR, on_start=lambda decision, guess: told.append(decision))
    begun = BodiesStage(Gaussians(start="learned").with_effort(0.05)).start(task, None)
    assert len(asked) == (of == ["red-cells"])
    assert told[0].choice == (method.CELLS if taken else method.PLAIN)
    assert (isinstance(begun, Near) and begun.object is made) == taken
