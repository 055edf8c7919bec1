"""The network that carries cells on: its symmetries, what it is begun with, its training, and cells of another code."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre
from safetensors.torch import load_file
from scipy.spatial.transform import Rotation

from holosplat.beamline.grow import COMPACT, Growth, SeriesFolder, grow, read_compact
from holosplat.checks import InputError
from holosplat.io.vtk import read_meshes
from holosplat.learning.start import Card
from holosplat.matter import Matter
from holosplat.metrics.volumes import normal_distance
from holosplat.motion.forecast import History, PathForecast, decided, extrapolate, places_of
from holosplat.motion.learned import (
    DEGREE,
    NEAR,
    SPREADS,
    Dynamics,
    DynamicsSize,
    GraphForecast,
    Scene,
    State,
    ahead_of,
    base,
    learned,
    spread_nodes,
    spread_of,
    write_dynamics,
)
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere
from holosplat.workflows.forecast import ForecastOptions, _others, require_way
from holosplat_bench.training.dynamics import DynamicsTraining, FlowSeries, _noise, draw_lesson, train_dynamics
from holosplat_bench.training.options import TrainOptions

SPHERE, FACES = icosphere(2)
TIMES = 1e-5 * np.arange(12)
AHEAD = TIMES[-1] + 1e-5 * np.array([1.0, 6.0, 11.0])
SIZE = DynamicsSize(8, 6, 2)


def a_network(seed: int = 0) -> Dynamics:
    """Every weight at random, those that begin at zero too."""
    torch.manual_seed(seed)
    network = Dynamics(SIZE).double()
    for value in network.parameters():
        torch.nn.init.normal_(value, std=0.3)
    return network.eval().requires_grad_(False)


def a_scene(seed: int = 0) -> Scene:
    """Two bodies a tenth of a radius apart, and one far away."""
    random = torch.Generator().manual_seed(seed)
    nodes = torch.tensor(SPHERE)
    own = 0.1 * torch.randn(3, len(nodes), DEGREE + 1, 3, generator=random, dtype=torch.float64)
    own[:, :, 0] += nodes
    own -= own.mean(1, keepdim=True)
    middle = torch.randn(3, DEGREE + 1, 3, generator=random, dtype=torch.float64)
    middle[:, 0] = torch.tensor([[0.0, 0, 0], [2.4, 0, 0], [40.0, 0, 0]]) - middle[:, 1:].sum(1)
    normals = torch.nn.functional.normalize(own.sum(2), dim=-1)
    return Scene.of(own, middle, normals, torch.full((3,), 0.4).double(), torch.full((3,), 0.01).double())


def turned(scene: Scene, rotation: torch.Tensor) -> Scene:
    """The same scene turned by `rotation` [3, 3]."""
    own, middle, normals = (x @ rotation.mT for x in (scene.own, scene.middle, scene.normals))
    return replace(scene, own=own, middle=middle, normals=normals)


@pytest.mark.parametrize("mirrored", [False, True], ids=["turned", "mirrored"])
def test_a_turned_scene_has_the_turned_forecast(mirrored):
    network, scene = a_network(), a_scene()
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()) * (-1 if mirrored else 1)
    found, spread = network(scene)
    other, same = network(turned(scene, turn))
    assert found.abs().max() > 0.01
    assert torch.allclose(other, found @ turn.mT, atol=1e-10)
    assert torch.allclose(same, spread, atol=1e-10)
    parts = scene.own, scene.middle, scene.normals
    moved = network.direct(*(x @ turn.mT for x in parts))
    assert torch.allclose(moved, network.direct(*parts) @ turn.mT, atol=1e-10)


def test_a_shifted_scene_has_the_shifted_forecast():
    network, scene = a_network(), a_scene()
    middle = scene.middle.clone()
    middle[:, 0] += torch.tensor([3.0, -2.0, 1.0])
    moved = replace(scene, middle=middle)
    assert torch.allclose(network(moved)[0], network(scene)[0], atol=1e-9)
    horizon = torch.tensor([0.5, 1.0])
    apart = base(moved.own, moved.middle, horizon) - base(scene.own, scene.middle, horizon)
    assert torch.allclose(apart, torch.tensor([3.0, -2.0, 1.0]).double().expand_as(apart))


def test_bodies_in_another_order_have_the_same_forecast():
    network, scene = a_network(), a_scene()
    order = torch.tensor([2, 0, 1])
    other = Scene.of(
        scene.own[order], scene.middle[order], scene.normals[order], scene.said[order, 0].exp(), torch.full((3,), 0.01)
    )
    assert torch.allclose(network(other)[0], network(scene)[0][order], atol=1e-8)


def test_edges_are_of_near_nodes_and_of_bodies_that_are_near():
    scene = a_scene()
    to, from_ = scene.edges
    count = len(SPHERE)
    assert torch.equal(torch.bincount(to[~scene.foreign], minlength=3 * count), torch.full((3 * count,), NEAR))
    assert (to[~scene.foreign] // count == from_[~scene.foreign] // count).all()
    pairs = {(int(a), int(b)) for a, b in zip(to[scene.foreign] // count, from_[scene.foreign] // count)}
    assert pairs == {(0, 1), (1, 0)}


def test_polynomials_of_the_horizon():
    """Base: straight on from the end of a parabola; what is decoded and its error: sums of powers."""
    scaled = np.linspace(-1, 1, 9)
    path = np.stack([1 + 2 * scaled + 3 * scaled**2, 0 * scaled, -scaled], axis=1)
    fitted = torch.from_numpy(legendre.legfit(scaled, path, DEGREE))
    said = base(torch.zeros(1, 1, DEGREE + 1, 3).double(), fitted[None], torch.tensor([0.0, 0.25]).double())
    end, slope = np.array([6.0, 0, -1]), np.array([8.0, 0, -1])  # a horizon of 1/4 is half a unit of the scaled time
    assert said[0, 0].numpy() == pytest.approx(np.array([end, end + 0.5 * slope]), abs=1e-12)
    powers = torch.arange(1.0, 6.0)[None, None, :, None].expand(1, 1, 5, 3)
    assert ahead_of(powers, torch.tensor([2.0]))[0, 0, 0, 0] == 1 + 2 * 2 + 3 * 4 + 4 * 8 + 5 * 16
    spread = torch.arange(1.0, SPREADS + 1)[None, None]
    assert float(spread_of(spread, torch.tensor([2.0]))) == pytest.approx(np.sqrt(1 + 16 + 144 + 1024), rel=1e-6)


def test_nodes_are_spread():
    chosen = spread_nodes(SPHERE, 12)
    apart = np.linalg.norm(SPHERE[chosen][:, None] - SPHERE[chosen], axis=2) + 9 * np.eye(12)
    assert len(set(chosen)) == 12
    assert apart.min() > 0.6
    assert len(spread_nodes(SPHERE, 1000)) == len(SPHERE)


def straight(times: np.ndarray = TIMES) -> MovingSurfaces:
    """Two balls of different sizes that go straight on."""
    basis = TimeBasis(times[0], times[-1], 2)
    paths = [
        basis.fitted(times, np.array([size * SPHERE + [8e-6 * k, 0.3 * t, 0.1 * t] for t in times]))
        for k, size in enumerate((3e-6, 2e-6))
    ]
    return MovingSurfaces.of_bodies(paths, [FACES, FACES], basis, 0.5e-6, Matter.one(1e-7, 0.0))


@pytest.fixture
def untrained(tmp_path) -> str:
    """Weights that say nothing yet: bodies go straight on."""
    write_dynamics(tmp_path / "none.safetensors", Dynamics(SIZE), Card(typical_misfit={"spread": 2.0}))
    return str(tmp_path / "none.safetensors")


def test_without_training_bodies_go_straight_on(untrained):
    found = learned(History(straight(), TIMES), AHEAD, GraphForecast(untrained))
    for body, size in enumerate((3e-6, 2e-6)):
        for time in AHEAD:
            vertices = found.bodies.bodies(time)[body].vertices
            wanted = size * SPHERE + [8e-6 * body, 0.3 * time, 0.1 * time]
            assert vertices == pytest.approx(wanted, abs=1e-10)
    assert (np.diff(found.band, axis=0) > 0).all()
    assert found.band[:, 1] / found.band[:, 0] == pytest.approx(2 / 3, rel=1e-3)


def halves(velocity: float, place: float) -> tuple[MovingSurfaces, MovingSurfaces]:
    """Of `straight`, off by so much [m/s, m] each way, along normals."""
    bodies, found = straight(), []
    normals = torch.tensor(np.tile(SPHERE, (2, 1)))[None]
    waits = torch.tensor(bodies.basis.fitted(TIMES, TIMES[:, None] - TIMES[-1]))[..., None]
    for sign in (1, -1):
        off = sign * (place + velocity * waits) * normals / bodies.unit_length
        found.append(bodies.with_parameters({"coefficients": bodies.coefficients + off.to(bodies.coefficients)}))
    return found[0], found[1]


def test_the_network_is_told_the_error_of_the_motion(untrained):
    """Errors of places that stay are no errors of the motion, and remain; those of velocities are told in the size
    that errors have which are alike in all coefficients, as trained on: σ² Σ (k (k + 1))²/(D + 1) at the end."""
    length = float(TIMES[-1] - TIMES[0])
    rates = np.sqrt(np.mean([(k * (k + 1)) ** 2 for k in range(DEGREE + 1)]))
    faces = FACES.astype(np.int64)
    for speed, place in ((0.0, 5e-8), (1e-3, 0.0), (1e-3, 5e-8)):
        both = halves(speed, place)
        states = [State.of(places_of(one, TIMES)[0], faces, TIMES) for one in both]
        exact = State.of(places_of(straight(), TIMES)[0], faces, TIMES)
        assert exact.apart(*states) * exact.radius == pytest.approx(speed * length / rates, rel=0.02, abs=1e-12)
        band = learned(History(straight(), TIMES, both), AHEAD, GraphForecast(untrained)).band[0, 0]
        without = learned(History(straight(), TIMES), AHEAD, GraphForecast(untrained)).band[0, 0]
        stays = max(place**2 - (speed * length / rates) ** 2, 0)
        assert band == pytest.approx(np.hypot(without, np.sqrt(stays)), rel=0.02)


def test_what_cannot_be_foretold_is_refused(untrained, tmp_path):
    how = GraphForecast(untrained)
    with pytest.raises(InputError, match=r"at least, but the run has 4; take --by paths"):
        learned(History(straight(TIMES[:4]), TIMES[:4]), AHEAD, how)
    with pytest.raises(InputError, match=r"up to 1.2 windows.*fewer --times"):
        learned(History(straight(), TIMES), TIMES[-1] + np.array([2e-4]), how)
    (tmp_path / "other.safetensors").write_bytes(b"no weights")
    with pytest.raises(InputError, match="must be a safetensors file"):
        learned(History(straight(), TIMES), AHEAD, GraphForecast(str(tmp_path / "other.safetensors")))
    run = SimpleNamespace(object=straight())
    options = ForecastOptions(learned=GraphForecast(str(tmp_path / "other.safetensors")), decides=True)
    with pytest.raises(InputError, match="must be a safetensors file"):
        require_way(run, TIMES, options)  # type: ignore[arg-type]


def test_a_network_that_cannot_look_so_far_is_left_out_and_said_to_be(untrained):
    options = ForecastOptions(learned=GraphForecast(untrained), decides=True)
    history = History(straight(), TIMES, early=(straight(TIMES[:8]), straight(TIMES[:8])))
    others, left_out = _others(options, history, TIMES[-1] + np.array([2e-4]))
    assert others == []
    assert "graph was not asked" in left_out
    assert "fewer --times" in left_out
    assert _others(options, history, AHEAD) == ([options.learned], "")
    others, left_out = _others(options, History(straight(), TIMES), AHEAD)
    assert others == []
    assert "needs half-sets" in left_out


def test_paths_and_the_network_are_decided_by_times_that_neither_saw(untrained):
    """Where both are alike, and where the network cannot be asked, paths go on."""
    history = History(straight(), TIMES)
    assert decided(history, PathForecast(), [GraphForecast(untrained)]).choice == "paths"
    short = decided(History(straight(TIMES[:6]), TIMES[:6]), PathForecast(), [GraphForecast(untrained)])
    assert short.choice == "paths"
    assert "graph was not asked" in short.by


@pytest.fixture(scope="module")
def series(tmp_path_factory) -> Path:
    """Two series of two ellipsoids that turn ever faster, as `grow --compact` would write them."""
    folder = tmp_path_factory.mktemp("flows")
    for seed in (1, 2):
        own = folder / f"flow{seed}"
        own.mkdir()
        (own / "grow.json").write_text("{}")
        for k in range(52):
            turns = [Rotation.from_rotvec([0, 0.01 * seed * k, 2e-4 * (cell + 1) * k**2]) for cell in range(2)]
            nodes = [
                turn.apply(SPHERE * [3e-6, 2.2e-6, 1.4e-6]) + [1e-6 * k, 7e-6 * c, 0] for c, turn in enumerate(turns)
            ]
            np.savez(own / COMPACT.format(k), nodes=np.array(nodes), faces=FACES, time=np.array(1.7e-5 * k))
    return folder


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr("holosplat_bench.training.dynamics.SIZE", SIZE)


OPTIONS = TrainOptions(steps=4, keep_every=2, warm_up=1, network="dynamics")


def test_a_training_goes_on_where_it_was_cut_off(series, tmp_path):
    whole, judged = train_dynamics(series, tmp_path / "whole", OPTIONS, False, lambda _: None, {})
    assert np.isfinite(judged.rows).all()

    def cut_off(training) -> None:
        if training.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_dynamics(series, tmp_path / "cut", OPTIONS, False, cut_off, {})
    again, _ = train_dynamics(series, tmp_path / "cut", OPTIONS, True, lambda _: None, {})
    for name, tensor in load_file(whole).items():
        assert torch.equal(load_file(again)[name], tensor), name
    found = learned(History(straight(), TIMES), AHEAD, GraphForecast(str(whole)))
    assert np.isfinite(found.band).all()


def test_a_training_learns(series, tmp_path):
    """The likelihood of lessons that it was not given rises."""
    data = FlowSeries.read(series)
    training = DynamicsTraining.begun(data, tmp_path / "made", replace(OPTIONS, steps=40, rate=0.02))  # pyright: ignore[reportArgumentType]
    lessons = [draw_lesson(data.validation()[0], np.random.default_rng(seed)) for seed in range(3)]

    def misfit() -> float:
        with torch.no_grad():
            parts = [one.errors(training.network) for one in lessons]  # pyright: ignore[reportArgumentType]
        return float(sum((0.5 * a / t**2 + t.log()).mean() for a, _, t in parts))

    before = misfit()
    for _ in range(40):
        training.advance()
    assert misfit() < before - 0.3


def test_noise_is_as_large_as_said_across_surfaces(series):
    nodes = torch.tensor(SPHERE)[None, :, None]
    whole = torch.cat([nodes, torch.zeros(1, len(SPHERE), DEGREE, 3)], dim=2)
    noise = _noise(whole, torch.tensor(SPHERE)[None], 0.03, np.random.default_rng(0))
    across = (noise.sum(2) * nodes[:, :, 0]).sum(-1)
    assert float(across.square().mean().sqrt()) == pytest.approx(0.03, rel=1e-6)
    with pytest.raises(InputError, match=r"must hold folders of holosplat grow --compact, two at least"):
        FlowSeries.read(series / "flow1")


def test_series_that_are_too_short_begin_no_training(series, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(series / "flow1", tmp_path / "flows" / name)
        for late in sorted((tmp_path / "flows" / name).glob("cells_*.npz"))[49:]:
            late.unlink()
    with pytest.raises(InputError, match="must have 50 snapshots at least, but it has 49"):
        train_dynamics(tmp_path / "flows", tmp_path / "made", OPTIONS, False, lambda _: None, {})
    assert not (tmp_path / "made").exists()


def test_a_compact_series_is_what_meshes_say(tmp_path):
    """In one file a snapshot, on from where it was cut off; nodes are not folded."""
    what = Growth(2, (30e-6, 24e-6, 20e-6), 0.05, 2, frequency=3, compact=True)
    grow(replace(what, snapshots=1), tmp_path / "short")
    grow(what, tmp_path / "short", resume=True)
    grow(replace(what, compact=False), tmp_path / "meshes")
    nodes, faces, times = read_compact(SeriesFolder(tmp_path / "short"))
    (mesh,) = read_meshes(tmp_path / "meshes" / "rbc01_001.vtp", "um")
    assert nodes.shape == (2, 2, 92, 3)
    assert np.array_equal(faces, mesh.faces)
    assert times == pytest.approx([0, 2e-5])
    apart = nodes[1, 1] - mesh.vertices
    assert apart == pytest.approx(np.tile(np.round(apart[0] / 30e-6) * 30e-6, (92, 1)), abs=1e-11)
    with pytest.raises(InputError, match="must hold what grow --compact wrote"):
        read_compact(SeriesFolder(tmp_path / "meshes"))


def test_cells_of_another_simulator(espresso_rbc):
    """ESPResSo's cells, never trained on: nearer after 15 and 25 snapshots than paths are, by bands that hold."""
    times, last, chosen = 1.77305e-5 * np.arange(50), 23, (0, 5)
    basis, paths = TimeBasis(float(times[0]), float(times[last]), 2, 3), []
    for cell in chosen:
        files = [espresso_rbc / "vtk" / f"rbc{cell:02d}_{t:03d}.vtk" for t in (*range(24), last + 15, last + 25)]
        meshes = [mesh for file in files for mesh in read_meshes(file, "um")]
        places = np.array([mesh.vertices for mesh in meshes])
        centre = places[..., 0].mean(1)
        places[..., 0] += (np.unwrap(centre, period=80e-6) - centre)[:, None]
        paths.append([replace(meshes[0], vertices=one) for one in places])
    fitted = [basis.fitted(times[:24], np.array([mesh.vertices for mesh in path[:24]])) for path in paths]
    bodies = MovingSurfaces.of_bodies(fitted, [path[0].faces for path in paths], basis, 1e-6, Matter.one(1e-7, 0.0))
    ahead = times[[last + 15, last + 25]]
    found, others = learned(History(bodies, times[:24]), ahead), extrapolate(History(bodies, times[:24]), ahead)
    for n, time in enumerate(ahead):
        for k, path in enumerate(paths):
            missed = normal_distance(found.bodies.bodies(time)[k], path[24 + n])
            assert missed < 0.6 * normal_distance(others.bodies.bodies(time)[k], path[24 + n])
            assert missed < 3 * found.band[n, k]
