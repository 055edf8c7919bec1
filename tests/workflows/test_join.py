"""Beams on one detector: resampling and joining."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.imaging import PIXEL, SHAPE, cells, rms, taken
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.reading import Part
from holosplat.optics.resampling import Resampling
from holosplat.scan import Scan
from holosplat.workflows.join import join


def test_resampled_frames_are_those_of_the_coarser_pixel():
    """Against simulations on the other raster: by 1.6, and by 2 exactly; blurred, so that pixels resolve all."""
    scene = cells()
    fine = simulate(scene, taken((100, 120), 2e-6, 1.5), oversample=4).frames
    for shape, pixel in (((60, 72), 3.2e-6), ((50, 60), 4e-6)):
        wanted = simulate(scene, taken(shape, pixel, 1.5 * 2e-6 / pixel), oversample=6).frames
        found = np.stack([Resampling((100, 120), 2e-6, shape, pixel)(frame) for frame in fine])
        inside = (slice(None), slice(3, -3), slice(3, -3))
        assert rms((found - wanted)[inside]) < 0.01 * wanted.std()


def test_resampling_keeps_even_light_and_tells_its_blur():
    down = Resampling((20, 31), 2e-6, (9, 14), 4.3e-6)
    assert down(np.full((20, 31), 1.7)) == pytest.approx(np.full((9, 14), 1.7))
    assert down.extra_blur == 0
    up = Resampling((20, 31), 2e-6, (40, 62), 1e-6)
    assert up.extra_blur == pytest.approx(1e-6 * 0.5)
    x = np.arange(31) + 0.5
    wave = np.cos(np.pi * 4 * x / 31)[None] * np.ones((20, 1))
    assert up(wave)[7] == pytest.approx(np.cos(np.pi * 4 * (np.arange(62) + 0.5) / 62))
    same = Resampling((20, 31), 2e-6, (20, 31), 2e-6)
    noise = np.random.default_rng(0).normal(size=(20, 31))
    assert same(noise) == pytest.approx(noise)


def beams(folder: Path) -> tuple[Path, Path]:
    """Two files of the same cells: other pixels, fields, distances and points of view; the second is reversed."""
    a = simulate(cells(), taken(psf=0.9), oversample=4)
    tilted = replace(taken((80, 96), 2.5e-6, 1.2, 2), distance=np.full(2, 0.15))
    b = simulate(cells(), tilted, oversample=4, is_test=np.array([True, False]))
    paths = folder / "a.nxs", folder / "b.nxs"
    write_scan(paths[0], a)
    write_scan(paths[1], replace(b, frames=b.frames[:, :, ::-1]))
    return paths


def test_beams_are_joined_on_pixels_of_one_size_over_the_common_field(tmp_path):
    paths = beams(tmp_path)
    join(paths, tmp_path / "scan.nxs", PIXEL, ("none", "columns"))
    found = read_scan(tmp_path / "scan.nxs")
    assert (found.views.shape, found.views.pixel_size) == ((62, 75), PIXEL)
    assert found.exposures.distance.tolist() == [0.1] * 4 + [0.15] * 2
    assert found.exposures.psf_sigma_px == pytest.approx([0.9] * 4 + [1.2 * 2.5 / 3.2] * 2)
    assert found.is_test.tolist() == [False, False, False, True, True, False]
    assert found.exposures.time == pytest.approx([0, 1e-6, 2e-6, 3e-6, 0, 1e-6])
    wanted = simulate(cells(), found.exposures, oversample=6).frames
    inside = (slice(None), slice(4, -4), slice(4, -4))
    for part in (slice(0, 4), slice(4, 6)):
        assert rms((found.frames - wanted)[part][inside]) < 0.02 * wanted.std()


def test_a_finer_raster_keeps_the_coarse_pixels_blur(tmp_path):
    paths = beams(tmp_path)
    join(paths, tmp_path / "scan.nxs", 2e-6, ("none", "columns"))
    found = read_scan(tmp_path / "scan.nxs")
    extra = np.sqrt((PIXEL**2 - 4e-12) / 12) / 2e-6
    assert found.exposures.psf_sigma_px[0] == pytest.approx(np.hypot(0.9 * 1.6, extra))
    wanted = simulate(cells(), found.exposures, oversample=4).frames
    inside = (slice(None), slice(6, -6), slice(6, -6))
    assert rms((found.frames - wanted)[:4][inside]) < 0.08 * wanted.std()


def test_beams_of_different_energies_keep_their_own(tmp_path):
    paths = beams(tmp_path)
    other = tmp_path / "other.nxs"
    exposures = replace(taken(), energy_kev=17.0)
    write_scan(other, Scan(np.ones((4, *SHAPE)), exposures, np.zeros(4, bool)))
    join((paths[0], other), tmp_path / "scan.nxs")
    found = read_scan(tmp_path / "scan.nxs").exposures
    assert found.energy_kev.tolist() == [20.0] * 4 + [17.0] * 4
    assert found.reference_energy == 20.0


def test_beams_of_several_pixel_sizes_stay_as_they_are(tmp_path):
    """Bit for bit, each with its own pixel; of other shapes after a crop."""
    a, b = (read_scan(path) for path in beams(tmp_path))
    paths = tmp_path / "a.nxs", tmp_path / "b.nxs"
    joined = join(paths, tmp_path / "scan.nxs", part=Part(crop="1:61,2:72"))
    found = read_scan(tmp_path / "scan.nxs")
    assert found.views.shape == joined.views.shape == (60, 70)
    assert found.views.pixel_sizes == pytest.approx([PIXEL] * 4 + [2.5e-6] * 2, rel=1e-15)
    np.testing.assert_array_equal(found.frames, np.concatenate([s.frames[:, 1:61, 2:72] for s in (a, b)]))
    np.testing.assert_allclose(found.views.shifts[5], b.views[[1]].cropped(slice(1, 61), slice(2, 72)).shifts[0])
    assert found.exposures.psf_sigma_px.tolist() == [0.9] * 4 + [1.2] * 2
    with pytest.raises(InputError, match=r"they have .* × .* and 80 × 96; cut all to one shape \(--crop"):
        join(paths, tmp_path / "other.nxs")


def test_what_cannot_be_joined(tmp_path):
    paths = beams(tmp_path)
    out = tmp_path / "scan.nxs"
    with pytest.raises(InputError, match=r"a\.nxs is read or written already"):
        join(paths, paths[0])
    with pytest.raises(InputError, match="needs at least two"):
        join(paths[:1], out)
    with pytest.raises(InputError, match=r"--flip must say one of .* for each of the 2 files, but it says 1"):
        join(paths, out, flips=("none",))
    with pytest.raises(InputError, match=r"would be .* pixels"):
        join(paths, out, 1e-4)
    with pytest.raises(InputError, match="--pixel-size must lie between"):
        join(paths, out, 3.2)
    assert not out.exists()


def test_joined_frames_are_where_a_geometry_says(tmp_path):
    """Whatever their files say; with pixels of its own it is refused, as is one of another number of views."""
    exposures = taken((40, 48), psf=0.9)[[0, 1]]
    for name in "ab":
        write_scan(tmp_path / f"{name}.nxs", Scan(np.ones((2, 40, 48), np.float32), exposures, np.zeros(2, dtype=bool)))
    files, angles = (tmp_path / "a.nxs", tmp_path / "b.nxs"), [0.0, 40.0, 85.0, 130.0]
    geometry = tmp_path / "geometry.toml"
    views = "".join(
        f"[[view]]\nangle_deg = {a}\nshift_px = [{n}, 0.5]\ndistance_m = 0.3\n" for n, a in enumerate(angles)
    )
    geometry.write_text(f'format = "holosplat geometry 1"\n{views}')
    join(files, tmp_path / "scan.nxs", geometry=geometry)
    found, wanted = read_scan(tmp_path / "scan.nxs"), Views.from_angles(angles, (40, 48), exposures.views.pixel_size)
    np.testing.assert_allclose(found.views.rotations, wanted.rotations, atol=1e-12)
    np.testing.assert_allclose(found.views.shifts / wanted.pixel_size, [[n, 0.5] for n in range(4)], rtol=1e-9)
    assert (found.exposures.distance == 0.3).all()
    geometry.write_text(geometry.read_text().replace("distance_m = 0.3", "pixel_size_m = 9e-6"))
    with pytest.raises(InputError, match="other pixel sizes"):
        join(files, tmp_path / "other.nxs", geometry=geometry)
