"""Cells in a flow as a differentiable model: order of convergence, an analytic capsule, gradients, and a known flow."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from holosplat.bodies.rest_shape import moments
from holosplat.checks import InputError
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.metrics.volumes import normal_distance
from holosplat.motion.cell_model import CellModel, ChannelFrame
from holosplat.motion.dynamics import DynamicsForecast, carry, whole_cells, window_of
from holosplat.motion.forecast import History, places_of
from holosplat.motion.membrane_fit import CellFlow, Unknowns, advanced
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.flow.suspension import Channel, Medium
from holosplat.specimens.membrane.model import Elasticity, Membrane
from holosplat.specimens.membrane.rest import geodesic_sphere
from holosplat.specimens.red_cells import RedCell, icosphere

FRAME = ChannelFrame((22e-6, 17e-6))
SPHERE, FACES = icosphere(2)


def cell(place: tuple[float, float, float] = (5e-6, 0.0, -1e-6)) -> TriangleMesh:
    turn = Rotation.from_rotvec([0.5, 0.2, 0.3]).as_matrix()
    return TriangleMesh(RedCell().surface(SPHERE) @ turn.T + np.array(place), FACES)


@cache
def model() -> CellModel:
    return CellModel(FRAME, [cell()], 5e-6, 1.2e-3, 3)


def test_steps_are_of_second_order():
    """A flow that turns and grows: half the step leaves a quarter of the error, with more stages, too."""
    start = torch.tensor([[1.0, 0.0, 0.5]], dtype=torch.float64)
    turn = torch.tensor([[0.1, -1.0, 0], [1.0, 0.1, 0], [0, 0, -0.3]], dtype=torch.float64)
    right = start @ torch.linalg.matrix_exp(2.5 * turn).T
    for fastest in (torch.inf, 0.01):
        said = [advanced(lambda x: x @ turn.T, start, 2.5, h, fastest * h) for h in (0.25, 0.125)]
        errors = [float((one - right).norm()) for one in said]
        assert errors[0] / errors[1] == pytest.approx(4, rel=0.15)
    assert advanced(lambda x: 0 * x + 1, start, 0.7, 0.2) == pytest.approx(start + 0.7)


def test_what_relaxes_fast_takes_few_stages_and_does_not_grow():
    """A rate of a hundred steps: 13 stages, of which Runge's four would take a step of a fortieth each."""
    calls, start = [], torch.ones(3, dtype=torch.float64)

    def velocity(x: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return -torch.tensor([100.0, 30.0, 3.0]).double() * x

    later = advanced(velocity, start, 1.0, 1.0, 0.01)
    assert len(calls) == 13
    assert later.abs().max() < 1
    assert advanced(velocity, start, 5.0, 1.0, 0.01).abs().max() < 0.2


def test_steps_are_shortened_where_more_relaxes_than_membranes():
    """Four times as fast as the model thinks: at the end of the wait all is at rest, and not thrown about it."""
    nodes, rate = torch.from_numpy(cell().vertices)[None], 4 / model().fastest
    with torch.no_grad():
        how = -rate, nodes + 1e-6
        later = model()._advance(lambda x: how[0] * (x - how[1]), nodes, 5 * model().fastest, 0.05)
        long = advanced(lambda x: how[0] * (x - how[1]), nodes, 5 * model().fastest, 1.0, model().fastest)
    assert later.numpy() == pytest.approx(how[1].numpy(), abs=0.01e-6)
    assert (long - how[1]).abs().max() > 1e-6


def test_a_capsule_in_shear_flow_deforms_as_small_deformation_theory_says():
    """Taylor's D = 5/4 (2 + ν)/(1 + ν) Ca, ν = C/(1 + C) (Barthès-Biesel, Diaz & Dhenin 2002, J. Fluid Mech. 460,
    211), Ca = μ γ a/G, after it has come to rest in shape."""
    vertices, faces = geodesic_sphere(3)
    radius, shear, viscosity, capillary = 2e-6, 1e-5, 1e-3, 0.02
    mesh = TriangleMesh(radius * vertices, faces)
    channel = Channel((1e-3, 400e-6, 400e-6), 1.0)
    place = torch.tensor([0.0, 60e-6, 200e-6], dtype=torch.float64)
    across = torch.tensor([0.0, 1e-7, 0.0], dtype=torch.float64)
    slope = float(channel.speed(place + across) - channel.speed(place - across)) / 2e-7
    peak = capillary * shear / (viscosity * radius * slope)
    nodes = torch.from_numpy(mesh.vertices)[None] + place
    bare = Membrane(mesh, Elasticity(shear, 1.0, bending=0.0, global_area=0.0, volume=0.0))
    flow = CellFlow(bare, nodes, channel, Medium(viscosity, reach=1e-5))
    unknowns, relaxation = Unknowns.of(peak, shear), viscosity * radius / shear

    def velocity(x: torch.Tensor) -> torch.Tensor:
        """In the frame that goes with the capsule, which is at the same place for ever."""
        return flow.velocity(x, unknowns) - unknowns.peak * channel.velocity(place)

    with torch.no_grad():
        nodes = advanced(velocity, nodes, 20 * relaxation, 0.4 * relaxation)
    _, _, second = moments(TriangleMesh(nodes[0].numpy(), faces))
    short, _, long = np.sqrt(np.linalg.eigvalsh(second))
    assert (long - short) / (long + short) == pytest.approx(1.25 * 2.5 / 1.5 * capillary, rel=0.1)


def test_gradients_go_back_through_all_steps():
    """Of places after three steps, by peak, modulus and the first state, against finite differences."""
    flow, nodes, _ = model().dressed([cell()])
    target = torch.randn(nodes.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    shift = torch.tensor([1e-7, 2e-7, -1e-7], dtype=torch.float64)

    def value(scales: torch.Tensor) -> torch.Tensor:
        unknowns = Unknowns(0.05 * scales[0], 5e-6 * scales[1])
        start = nodes + scales[2] * shift * (nodes - nodes.mean()) / 1e-6
        later = advanced(lambda x: flow.velocity(x, unknowns), start, 1.2e-5, 4e-6, model().fastest)
        return 1e6 * (later * target).sum()

    at = torch.tensor([1.1, 0.8, 0.3], dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(value(at), at)
    with torch.no_grad():
        steps = 1e-4 * torch.eye(3, dtype=torch.float64)
        wanted = [float(value(at + step) - value(at - step)) / 2e-4 for step in steps]
    assert found.numpy() == pytest.approx(np.array(wanted), rel=1e-4, abs=0)


def test_surfaces_go_with_their_membranes():
    """A coarse membrane that is moved and turned takes the finer surface along, as if both were one body."""
    fine, (_, nodes, (bound,)) = cell(), model().dressed([cell()])
    assert bound.places(nodes[0]).numpy() == pytest.approx(FRAME.inward(fine.vertices), abs=1e-12)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    moved = bound.places(nodes[0] @ torch.from_numpy(turn).T + 1e-6).numpy()
    assert moved == pytest.approx(FRAME.inward(fine.vertices) @ turn.T + 1e-6, abs=1e-12)
    coarse = TriangleMesh(FRAME.outward(nodes[0].numpy()), model().membrane.mesh.faces)
    assert normal_distance(coarse, fine) < 0.12e-6  # triangles of 1.3 µm


def test_a_channel_may_lie_along_any_axis():
    points = np.random.default_rng(0).normal(size=(7, 3))
    for axis, along in zip("xyz", np.eye(3)):
        frame = ChannelFrame((3e-6, 2e-6), axis, (1.0, 2.0, 3.0))
        assert np.linalg.det(frame.rotation) == pytest.approx(1)
        assert frame.inward(points + 5 * along)[:, 0] - frame.inward(points)[:, 0] == pytest.approx(5)
        assert frame.outward(frame.inward(points)) == pytest.approx(points)
        assert frame.outside(torch.from_numpy(frame.inward(points))).numpy() == pytest.approx(points)
        middle = frame.inward(np.array([1.0, 2.0, 3.0]))
        assert middle[1:] == pytest.approx([1.5e-6, 1e-6])
    with pytest.raises(InputError, match="across must be a positive number"):
        ChannelFrame((0.0, 1e-6))


def test_whole_cells_alone_go_by_mechanics():
    """Not what reaches into the walls, is too small, or is no red cell."""
    ball = TriangleMesh(2.79e-6 * SPHERE, FACES)
    rough = TriangleMesh(cell().vertices * (1 + 0.25 * (np.arange(len(SPHERE)) % 2))[:, None], FACES)
    small = TriangleMesh(0.5 * cell().vertices, FACES)
    meshes = [cell(), cell((8e-6, 0, 0)), small, cell((-3e-6, 9e-6, 0)), rough, ball]
    assert whole_cells(meshes, FRAME) == [0, 3, 5]
    assert whole_cells([cell((30e-6, 0, 0))], FRAME) == []


def test_a_flow_is_found_and_what_is_not_told_is_said():
    """A cell that the model itself has moved: the peak is found, the modulus not at all in so short a time."""
    times, ranges = np.array([0.0, 2e-5]), {"peak": (0.046, 0.056), "shear": (1e-6, 2e-5)}
    way = model().run([cell()], times, Unknowns.of(0.049, 1e-5))
    found = model().fitted([cell()], way, times, ranges, free=False)
    assert float(found.unknowns.peak) == pytest.approx(0.049, rel=0.006)
    assert found.told["peak"] < 0.5
    assert found.told["shear"] > 0.99
    assert float(found.unknowns.shear) == pytest.approx(20e-6**0.5 * 1e-3, rel=0.1)  # the range's middle
    assert found.left[0] < 0.02e-6


def test_cells_tell_which_way_the_flow_goes():
    """A scene that is turned about has the turned forecast, by the same options."""
    times, about = 1e-5 * np.arange(10), np.diag([1.0, -1.0, -1.0])
    way = model().run([cell()], times, Unknowns.of(0.05, 5e-6))[0]
    basis, ahead = TimeBasis(times[0], times[-1], 3, 2), times[-1] + np.array([2e-5])
    found = []
    for turn in (np.eye(3), about):
        paths = [basis.fitted(times, way @ turn.T)]
        bodies = MovingSurfaces.of_bodies(paths, [FACES], basis, 0.5e-6, Matter.one(1e-7, 0.0))
        found.append(carry(History(bodies, times), ahead, DynamicsForecast(FRAME)))
    one, other = (places_of(each.bodies, ahead)[0][0] for each in found)
    assert other == pytest.approx(one @ about.T, abs=5e-9)
    assert found[1].told["peak_m_s"] == pytest.approx(found[0].told["peak_m_s"], rel=1e-3)


def test_what_paths_leave_of_the_state_is_an_error_of_mechanics():
    """Cells begin on parabolas: where their paths end beside these, so does the forecast."""
    times = 1e-5 * np.arange(10)
    way = model().run([cell()], times, Unknowns.of(0.05, 5e-6))[0]
    basis, found = TimeBasis(times[0], times[-1], 5, 3), []
    for bent in (0.0, 0.5e-6):
        bend = bent * np.exp((times - times[-1]) / 1e-5)[:, None, None] * [1.0, 0.0, 0.0]
        bodies = MovingSurfaces.of_bodies(
            [basis.fitted(times, way + bend)], [FACES], basis, 5e-7, Matter.one(1e-7, 0.0)
        )
        history = History(bodies, times)
        found.append(window_of(history, times[-1] + np.array([1e-5]), DynamicsForecast(FRAME)).spread[-1, 0])
    assert found[0] < 0.02e-6 < 0.03e-6 < found[1] < 0.2e-6
