"""Kinds of matter that may fill the field: volumes in closed form, regions, materials, frames at the field's edge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta
from holosplat.scan import Exposures
from holosplat.specimens import ContinuousScene, Drawn, MeshScene, Substances
from holosplat_bench.specimens.fluids import FASTEST, BreakUp, Bubbles, Cuvette, Flotation, Jet, Shock
from holosplat_bench.specimens.matter import CHANGING, MATTER
from holosplat_bench.specimens.rods import RodScene
from holosplat_bench.specimens.solids import Channel, Crack, Fibres, Keyhole, Lattice, Star

KINDS = {**MATTER, **CHANGING}
PIXEL = 1e-6
SIZE = 40e-6
VIEWS = Views.from_angles([0.0, 50.0], (45, 57), PIXEL)
"""Rectangular and odd-sized."""
SUBSTANCES = Substances(DeltaBeta(5e-7, 2e-10), DeltaBeta(7e-7, 4e-10), DeltaBeta(1e-7, 3e-11))


def drawn(kind, seed: int = 0) -> Drawn:
    return kind.drawn(SUBSTANCES, seed)


def means(scene, views: Views = VIEWS) -> np.ndarray:
    """δ on the voxels of `views` [Z, Y, X]."""
    return scene.voxelise(Grid.of_views(views)).delta.astype(np.float64)


def shares(found: Drawn) -> dict[str, np.ndarray]:
    return {name: means(one) for name, one in found.regions.items()}


def meshes(found: Drawn, name: str) -> list:
    assert isinstance(found.scene, MeshScene)
    return [mesh for mesh in found.scene.meshes if mesh.name.startswith(name)]


@pytest.mark.parametrize("name", KINDS)
def test_a_kind_follows_its_seed_and_names_its_parts(name):
    kind = KINDS[name](KINDS[name].extent * 45e-6)
    first, again, other = (drawn(kind, seed) for seed in (1, 1, 2))
    assert np.array_equal(means(first.scene), means(again.scene))
    assert not np.array_equal(means(first.scene), means(other.scene))
    assert "seed 1" in first.text
    parts = shares(first)
    assert parts
    for share in parts.values():
        assert share.min() >= -1e-6
        assert 1e-3 < share.max() <= 1 + 1e-6
    reach = first.scene.missing_field(VIEWS)
    assert (reach > 0) <= kind.goes_on
    _, delta = first.scene.project(VIEWS)
    assert float(delta.std()) > 0


@pytest.mark.parametrize("name", KINDS)
def test_line_integrals_are_those_of_the_voxels(name):
    """In the view along z, where they are sums of voxels, in means over 3 × 3 pixels, for some bodies are thinner."""
    kind = KINDS[name](0.8 * 45e-6)
    scene = drawn(kind, 3).scene
    views = VIEWS[[0]]
    depth = 201  # voxels along z, beyond the matter
    rows, columns = views.shape
    grid = Grid.centred((depth, rows, columns), PIXEL)
    summed = scene.voxelise(grid).delta.sum(axis=0, dtype=np.float64) * PIXEL
    lines = scene.project(views)[1][0].numpy()
    summed, lines = (image.reshape(15, 3, 19, 3).mean(axis=(1, 3)) for image in (summed, lines))
    assert np.linalg.norm(summed - lines) < 0.1 * np.linalg.norm(lines)


def test_a_break_up_conserves_the_volume_of_its_threads():
    for seed in range(4):
        kind = BreakUp(SIZE)
        found = drawn(kind, seed)
        assert isinstance(found.scene, MeshScene)
        assert sum(mesh.volume for mesh in found.scene.meshes) == pytest.approx(kind.volume, rel=1e-9, abs=0)
        low, high = found.scene.bounds
        assert (np.abs([low, high]) <= 0.5 * SIZE).all()
    whole = drawn(replace(kind, ligaments=0.0))
    assert len(meshes(whole, "drop")) == 3 * 4
    assert len(meshes(whole, "satellite")) == 2 * 4
    assert len(meshes(drawn(replace(kind, ligaments=1.0)), "ligament")) == 4


def test_a_jet_has_the_volume_of_the_undisturbed_one():
    """Over whole waves of Rayleigh's length, whatever the disturbance; with bubbles, less theirs."""
    kind = Jet(SIZE, count=0)
    (jet,) = meshes(drawn(kind), "jet")
    waves = 4
    assert jet.volume == pytest.approx(np.pi * (0.5 * SIZE) ** 2 * waves * FASTEST * 0.5 * SIZE, rel=1e-3, abs=0)
    reach = np.hypot(jet.vertices[:, 0], jet.vertices[:, 2])
    assert reach.max() / reach[reach > 0].min() == pytest.approx(1.25 / 0.75, rel=1e-3, abs=0)
    found = drawn(Jet(SIZE, count=3))
    assert found.scene.missing_field(VIEWS) > 0
    grid = Grid.of_views(VIEWS)
    inside = found.regions["bubbles"].voxelise(grid).delta > 0.99999
    assert inside.any()
    assert np.abs(found.scene.voxelise(grid).delta[inside]).max() < 1e-10  # the medium again


def test_bubbles_hold_the_material_against_the_medium():
    found = drawn(Bubbles(SIZE, count=4))
    assert isinstance(found.scene, RodScene)
    assert found.scene.matter == SUBSTANCES.contrast
    radii = found.scene.radii / SIZE
    assert (radii.min(), radii.max()) == pytest.approx((0.05, 0.14))
    assert means(found.scene) == pytest.approx(SUBSTANCES.contrast.delta * shares(found)["bubbles"], rel=1e-5)


def test_flotation_has_matter_on_both_sides_of_its_medium():
    """Bubbles of the material and beads of the core, apart, and of sizes that chance gives to either."""
    gas, bead, liquid = DeltaBeta(1e-9, 1e-12), DeltaBeta(7e-7, 4e-10), DeltaBeta(3e-7, 1e-10)
    found = Flotation(SIZE, count=3, beads=2).drawn(Substances(gas, bead, liquid), 1)
    delta, parts = means(found.scene), shares(found)
    expected = gas.against(liquid).delta * parts["bubbles"] + bead.against(liquid).delta * parts["beads"]
    assert delta == pytest.approx(expected, rel=1e-5, abs=1e-12)
    assert delta.min() < -2e-7 < 2e-7 < delta.max()
    assert not ((parts["bubbles"] > 0.5) & (parts["beads"] > 0.5)).any()
    assert found.text == "3 bubbles and 2 beads, seed 1"


def test_a_cuvette_has_four_levels():
    """Wall and liquid against the medium, and bubbles of it; outside there is nothing."""
    found = drawn(Cuvette(SIZE, count=2, radii=(0.1, 0.15)))
    delta, parts = means(found.scene), shares(found)
    medium = SUBSTANCES.medium
    assert delta[parts["wall"] > 0.99999] == pytest.approx(4e-7, rel=1e-5)
    assert np.abs(delta[parts["bubbles"] > 0.99999]).max() < 1e-10
    assert SUBSTANCES.core is not None
    assert delta.max() == pytest.approx(SUBSTANCES.core.delta - medium.delta, rel=1e-5)
    assert delta[0].max() == delta[:, :, 0].max() == 0
    across = parts["wall"][:, 0].sum() * PIXEL**2  # at the edge of the field, where the tube goes on
    assert across == pytest.approx(SIZE**2 * (1 - 0.84**2), rel=1e-2, abs=0)


def test_a_shock_jumps_by_its_share_of_the_medium():
    kind = Shock(SIZE, jump=0.2, shift=0.0)
    found = drawn(kind)
    assert isinstance(found.scene, ContinuousScene)
    front, bubble = found.scene.elements
    along = np.array([[0.5 * SIZE * s, 0, 0] for s in (1.001, 0.999, 0.6)])
    density = front.density(along) * front.matter.delta / SUBSTANCES.medium.delta
    assert density[0] == 0
    assert density[1] == pytest.approx(0.2, rel=2e-2)
    assert density[2] < 0  # rarefaction
    assert bubble.matter == SUBSTANCES.contrast
    assert len(drawn(replace(kind, bubble=0.0)).scene.elements) == 1  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(InputError, match="a shock needs a medium"):
        kind.drawn(Substances(DeltaBeta(5e-7, 2e-10)), 0)


def test_a_crack_has_the_volume_of_its_opening():
    kind = Crack(SIZE, opening=0.1)
    (crack,) = meshes(drawn(kind, 5), "crack")
    assert crack.volume == pytest.approx(2 / 3 * np.pi * (0.5 * SIZE) ** 2 * 0.1 * SIZE, rel=1e-3, abs=0)
    heights = kind._modes(np.random.default_rng(5))[:, 3]
    assert np.sqrt(0.5 * (heights**2).sum()) == pytest.approx(0.02 * SIZE)


def test_a_keyhole_is_empty_and_open_above():
    found = drawn(Keyhole(SIZE))
    delta, parts = means(found.scene), shares(found)
    for name in ("keyhole", "pores"):
        assert np.abs(delta[parts[name] > 0.99999]).max() < 1e-10
    rows = np.flatnonzero(parts["keyhole"].sum(axis=(0, 2)) > 0.5)
    top = 45 / 2 - 0.5 * 40
    assert rows[0] == pytest.approx(top, abs=1)
    assert len(rows) == pytest.approx(0.75 * 40, abs=2)
    assert not delta[:, 0].any()
    assert delta[:, -1].max() == pytest.approx(SUBSTANCES.contrast.delta, rel=1e-5)
    with pytest.raises(InputError, match="lean must be at most"):
        drawn(Keyhole(SIZE, lean=0.4))


def test_a_lattice_has_its_struts():
    whole = drawn(Lattice(SIZE, missing=0.0))
    assert isinstance(whole.scene, RodScene)
    assert len(whole.scene.rods) == 8 * 8
    low, high = whole.scene.bounds
    assert high - low == pytest.approx(np.full(3, SIZE))
    lengths = np.linalg.norm(np.ptp(whole.scene.ends, axis=1), axis=1)
    assert lengths == pytest.approx(0.5 * np.sqrt(3) * SIZE / 2.14)
    assert len(drawn(Lattice(SIZE, missing=1.0 / 8)).scene.rods) < 64  # pyright: ignore[reportAttributeAccessIssue]


def test_fibres_are_thin_and_go_on():
    found = drawn(Fibres(SIZE, count=1, lean=0.0, diameter=0.05))
    share = shares(found)["fibres"]
    assert share.sum(axis=(0, 2)) * PIXEL**2 == pytest.approx(np.pi * (0.025 * SIZE) ** 2, rel=0.05)


def test_a_channel_has_three_materials():
    found = drawn(Channel(SIZE, count=3))
    delta, parts = means(found.scene), shares(found)
    assert SUBSTANCES.core is not None
    assert delta[parts["liquid"] > 0.99999] == pytest.approx(SUBSTANCES.contrast.delta, rel=1e-5)
    inside = SUBSTANCES.core.delta - SUBSTANCES.medium.delta
    assert delta[parts["cells"] > 0.99999] == pytest.approx(inside, rel=1e-5)
    assert (parts["liquid"] + parts["cells"])[:, 0].sum() * PIXEL**2 == pytest.approx(0.7 * SIZE**2, rel=1e-3, abs=0)
    with pytest.raises(InputError, match="needs the material that is inside"):
        Channel(SIZE).drawn(Substances(DeltaBeta(5e-7, 2e-10)), 0)


def test_a_star_has_the_area_of_its_wedges():
    kind = Star(SIZE, spokes=9, thickness=0.2)
    found = drawn(kind)
    assert isinstance(found.scene, MeshScene)
    outer, inner, angle = 0.5 * SIZE, 0.05 * SIZE, np.pi / 9
    area = 0.5 * (8 * outer**2 * np.sin(angle / 8) - inner**2 * np.sin(angle))  # of polygons
    volume = sum(mesh.volume for mesh in found.scene.meshes)
    assert volume == pytest.approx(9 * area * 0.2 * SIZE, rel=1e-9, abs=0)


@pytest.mark.parametrize("kind", [Jet(0.9 * 33e-6), Channel(0.7 * 33e-6, count=3), Fibres(33e-6), Crack(60e-6)])
def test_frames_are_right_at_the_edge_of_the_field(kind):
    """They are the middle of frames of a field twice as large: matter that goes on is no edge."""
    scene = kind.drawn(Substances(DeltaBeta(6e-7, 3e-10), DeltaBeta(7e-7, 3e-10)), 1).scene
    small, large = (
        simulate(scene, Exposures.of(Views.from_angles([20.0], shape, PIXEL), 20.0, 0.05), oversample=4).frames[0]
        for shape in ((33, 41), (67, 83))
    )
    whole = large[17:50, 21:62]
    contrast = np.std(whole)
    assert contrast > 0.005
    assert np.sqrt(np.mean((small - whole) ** 2)) < 0.02 * contrast


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: drawn(Cuvette(SIZE, wall=0.45)), "wall must be below 0.4"),
        (lambda: drawn(Cuvette(SIZE, radii=(0.2, 0.1))), "radii must be"),
        (lambda: drawn(Jet(SIZE, amplitude=0.8)), "amplitude must be below 0.7"),
        (lambda: drawn(BreakUp(SIZE, count=40, waves=1)), "only .* do; take fewer"),
        (lambda: drawn(Lattice(SIZE, count=9)), "count must be at most 8"),
        (lambda: drawn(Star(SIZE, spokes=2)), "spokes must be at least 3"),
        (lambda: drawn(Star(SIZE, hole=0.95)), "hole must be below 0.9"),
        (lambda: Shock(0.0), "size must"),
    ],
)
def test_bad_requests_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
