"""Odd files that real users have: read right, or refused by name, and never silently taken for what they are not."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from helpers.odd_files import ANGLES, FRAMES, SHAPE, N, a_scan, images, numbered, said
from holosplat.checks import InputError, MissingError
from holosplat.geometry import rotation_y
from holosplat.io.angles import in_order, read_angles
from holosplat.io.formats import read_as
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.reading import Reading, Told
from holosplat.io.stacks import open_tiff, stack_of

# --- the order of frames ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "names",
    [
        ["a_1.tif", "a_2.tif", "a_10.tif"],
        ["p_-10.tif", "p_-2.tif", "p_0.tif", "p_5.tif"],
        ["p-10.tif", "p-1.tif", "p0.tif", "p1.tif"],
        ["scan-001.tif", "scan-002.tif", "scan-010.tif"],
        ["s_10.5_0.tif", "s_3.25_1.tif", "s_100.125_2.tif"],
        ["s_111_0.tif", "s_42_1.tif", "s_153_2.tif"],
        ["s_111.25_0.tif", "s_42.5_2.tif", "s_153.75_7.tif"],
        ["v1.2.tif", "v1.9.tif", "v1.10.tif"],
        ["r1_c2.tif", "r1_c10.tif", "r2_c1.tif", "r2_c2.tif"],
        ["x_1_20240101T100000.tif", "x_2_20240101T100009.tif"],
        ["p_m10.tif", "p_m5.tif", "p_p0.tif", "p_p5.tif"],
        ["p_\u221210.tif", "p_\u22125.tif", "p_0.tif", "p_5.tif"],
        ["a_1e-3.tif", "a_2e-3.tif", "a_1e-2.tif"],
        [f"p_{10**17 + n}.tif" for n in range(3)],
        ["s_20240130_235957.tif", "s_20240131_000004.tif", "s_20240131_000011.tif"],
        ["s_2024-01-30_23-59-57.tif", "s_2024-01-31_00-00-04.tif", "s_2024-02-01_00-00-01.tif"],
        ["s_5_20240130T235957.tif", "s_6_20240131T000004.tif", "s_7_20240131T000011.tif"],
        ["s_1_a1.tif", "s_1_a10.tif", "s_1_b1.tif"],
    ],
)
def test_frames_follow_the_running_number(names):
    files = [Path("folder") / name for name in names]
    assert in_order(files[::-1]) == files


def test_two_numbers_that_count_differently_are_refused():
    with pytest.raises(InputError, match=r"several numbers in s_0_0\.tif and the others run differently"):
        in_order([Path("folder") / name for name in ("s_0_0.tif", "s_2_1.tif", "s_1_2.tif")])


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("s_31012024_000004.tif", "s_30012024_235950.tif", "s_30012024_235957.tif"), "several numbers"),
        (("s_1_40.tif", "s_2_20.tif", "s_1_30.tif"), "several numbers"),
        (("f_9.tif", "f_a.tif", "f_10.tif"), "may be hexadecimal"),
        (("f_0009.tif", "f_000a.tif", "f_0010.tif"), "may be hexadecimal"),
    ],
)
def test_an_order_that_may_be_another_is_refused(names, words):
    with pytest.raises(InputError, match=words):
        in_order([Path("folder") / name for name in names])


def test_two_files_of_one_number_are_refused():
    with pytest.raises(InputError, match=r"p_01\.tif and p_1\.tif have the same number"):
        in_order([Path("folder") / name for name in ("p_01.tif", "p_1.tif", "p_2.tif")])


def test_a_golden_scan_gets_each_frame_its_own_angle(tmp_path, caplog):
    caplog.set_level("INFO")
    angles = np.arange(N) * 111.246 % 180
    names = [f"GR_{angle:g}_{n:03d}.tif" for n, angle in enumerate(angles)]
    images(tmp_path / "scan", names, FRAMES)
    (tmp_path / "scan" / "Angles.csv").write_text("\n".join(map(str, angles)))
    scan = read_as(tmp_path / "scan", said())
    np.testing.assert_array_equal(scan.frames, FRAMES)
    assert f"first {names[0]} at 0°, last {names[-1]} at {angles[-1]:.6g}°" in caplog.text


@pytest.mark.parametrize(
    "names",
    [
        ("projections", "flats", "darks"),
        ("Proj", "FLAT_before", "Dark"),
        ("Tomo", "White", "DARKS"),
        ("radios", "refs", "dc"),
        ("raw", "OB", "df"),
        ("proj", "open beam", "black"),
    ],
)
def test_a_tree_of_folders_with_angles_is_a_scan(tmp_path, names):
    projections, flats, darks = (tmp_path / "scan" / name for name in names)
    images(projections, numbered(N), FRAMES)
    images(flats, numbered(2), np.full((2, *SHAPE), 5010, np.uint16))
    images(darks, numbered(2), np.full((2, *SHAPE), 10, np.uint16))
    (tmp_path / "scan" / "angles.txt").write_text("\n".join(map(str, ANGLES)))
    scan = read_as(tmp_path / "scan", said())
    np.testing.assert_allclose(scan.frames, (FRAMES - 10.0) / 5000, rtol=1e-6)
    np.testing.assert_allclose(scan.views.rotations, rotation_y(ANGLES), atol=1e-12)


def test_arrays_in_the_folder_of_a_scan_are_its_flats_and_darks(tmp_path, caplog):
    caplog.set_level("INFO")
    images(tmp_path / "scan" / "projections", numbered(N), FRAMES)
    images(tmp_path / "scan" / "slices", numbered(1), FRAMES)
    np.save(tmp_path / "scan" / "flats.npy", np.full((2, *SHAPE), 5010, np.uint16))
    np.savez(tmp_path / "scan" / "darks.npz", darks=np.full((2, *SHAPE), 10, np.uint16))
    (tmp_path / "scan" / "theta.txt").write_text("\n".join(map(str, ANGLES)))
    np.testing.assert_allclose(read_as(tmp_path / "scan", said()).frames, (FRAMES - 10.0) / 5000, rtol=1e-6)
    assert "the images in slices are not read" in caplog.text
    assert "2 flats, 2 darks" in caplog.text


def test_arrays_in_folders_are_flats_and_darks(tmp_path):
    images(tmp_path / "scan" / "projections", [f"darkmatter_{n}.tif" for n in range(N)], FRAMES)
    for name, level in (("flats", 5010), ("darks", 10)):
        (tmp_path / "scan" / name).mkdir()
        np.save(tmp_path / "scan" / name / "all.npy", np.full((2, *SHAPE), level, np.uint16))
    np.save(tmp_path / "scan" / "angles.npy", ANGLES)
    np.testing.assert_allclose(read_as(tmp_path / "scan", said()).frames, (FRAMES - 10.0) / 5000, rtol=1e-6)
    (tmp_path / "scan" / "flats" / "all.npy").unlink()
    with pytest.raises(InputError, match=r"flats must hold flats .* but it holds none"):
        read_as(tmp_path / "scan", said())


def test_arrays_alone_are_a_scan(tmp_path):
    for name, array in (("projections", FRAMES), ("flats", np.full((2, *SHAPE), 5000)), ("angles", ANGLES)):
        np.save(tmp_path / f"{name}.npy", array)
    np.testing.assert_allclose(read_as(tmp_path, said()).frames, FRAMES / 5000, rtol=1e-6)


def test_what_a_folder_holds_is_said(tmp_path):
    for n in range(3):
        (tmp_path / f"{n}.edf").write_bytes(b"{}")
    with pytest.raises(InputError, match=r"it holds 3 of \.edf, which is none of what is known"):
        read_as(tmp_path, said())


def test_the_folder_of_images_may_change_beside_them(tmp_path):
    images(tmp_path, numbered(N), FRAMES)
    (tmp_path / "angles.txt").write_text("\n".join(map(str, ANGLES)))
    scan = read_as(tmp_path, said())
    write_scan(tmp_path / "out.nxs", scan)
    np.testing.assert_array_equal(read_scan(tmp_path / "out.nxs").frames, FRAMES)
    tifffile.imwrite(tmp_path / numbered(N)[3], FRAMES[0])
    with pytest.raises(InputError, match=r"003\.tif must be the file that was opened, but it has changed"):
        _ = scan.source[3:4]


def test_an_array_of_frames_is_a_scan(tmp_path):
    np.save(tmp_path / "frames.npy", FRAMES)
    (tmp_path / "angles.txt").write_text("\n".join(map(str, ANGLES)))
    scan = read_as(tmp_path / "frames.npy", said(angles=tmp_path / "angles.txt"))
    np.testing.assert_array_equal(scan.frames, FRAMES)


def test_two_folders_of_projections_are_refused(tmp_path):
    for name in ("one", "two", "flats"):
        images(tmp_path / name, numbered(2), FRAMES)
    with pytest.raises(InputError, match="several folders of images: one, two"):
        read_as(tmp_path, said())


# --- angles -------------------------------------------------------------------------------------------------------

PLAIN = [f"{angle:g}" for angle in ANGLES]
LOG = "TIME STAMP,IMAGE TYPE,COUNTER\n" + "\n".join(
    ["Sun Feb 10 2019,Flat,0,counts: 5", *(f"Sun Feb 10 2019,Projection,{n},angle: {a}" for n, a in enumerate(PLAIN))]
)
READ = {
    "a byte order mark": "\ufeff" + "\n".join(PLAIN),
    "a header": "angle (deg)\n" + "\n".join(PLAIN),
    "a table": "index,angle\n" + "\n".join(f"{n},{angle}" for n, angle in enumerate(PLAIN)),
    "a table with spaces": "n theta\n" + "\n".join(f"{n} {angle}" for n, angle in enumerate(PLAIN)),
    "a log": LOG,
    "a list": "[" + ", ".join(PLAIN) + "]",
    "semicolons": ";\n".join(PLAIN),
    "millidegrees in a column": "n,angle (mdeg)\n" + "\n".join(f"{n},{1000 * a}" for n, a in enumerate(ANGLES)),
    "a log of many numbers": "\n".join(
        f"10:00:{n:02d} Projection: {n} angle: {a} counts: 45" for n, a in enumerate(PLAIN)
    ),
    "a log in radians": "\n".join(f"{n}: angle={a:.8f} rad, 0.5 s" for n, a in enumerate(np.deg2rad(ANGLES))),
    "frames in another order": "frame,angle\n" + "\n".join(f"{n},{ANGLES[n]}" for n in (3, 1, 0, 2, 7, 6, 5, 4)),
    "files in another order": "file,angle\n"
    + "\n".join(f"a_{n + 7}.tif,{ANGLES[n]}" for n in (3, 1, 0, 2, 7, 6, 5, 4)),
    "degree signs": "\n".join(f"{angle}°" for angle in PLAIN),
    "a column called by its unit": "n,rad\n" + "\n".join(f"{n},{a:.8f}" for n, a in enumerate(np.deg2rad(ANGLES))),
    "units in words": "\n".join(f"{angle:.8f} rad" for angle in np.deg2rad(ANGLES)),
    "semicolons and decimal commas": "Nr;Winkel\n"
    + "\n".join(f"{n};{a}".replace(".", ",") for n, a in enumerate(PLAIN)),
    "a list with a name": "theta = [" + " ".join(PLAIN) + "];",
    "a list over two lines": "[" + " ".join(PLAIN[:4]) + "\n " + " ".join(PLAIN[4:]) + "]",
    "radians that say so": "# rad\n" + "\n".join(f"{angle:.8f}" for angle in np.deg2rad(ANGLES)),
}


@pytest.mark.parametrize("kind", READ)
def test_angles_are_read(tmp_path, kind):
    (tmp_path / "angles.txt").write_text(READ[kind], encoding="utf-8")
    np.testing.assert_allclose(read_angles(tmp_path / "angles.txt"), ANGLES, atol=1e-5)


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_angles_in_other_encodings_are_read(tmp_path, encoding):
    (tmp_path / "angles.txt").write_text("Winkel [°]\n" + "\n".join(PLAIN), encoding=encoding)
    np.testing.assert_allclose(read_angles(tmp_path / "angles.txt"), ANGLES)


def test_angles_in_an_array_are_read(tmp_path):
    np.save(tmp_path / "angles.npy", ANGLES)
    np.testing.assert_allclose(read_angles(tmp_path / "angles.npy"), ANGLES)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("\n".join(f"{angle:.6f}" for angle in np.deg2rad(ANGLES)), "look like radians"),
        ("\n".join(angle.replace(".", ",") for angle in ("0.0", "22.5")), "with a point before the decimals"),
        ("\n".join(f"{n} {angle}" for n, angle in enumerate(PLAIN)), "a line holds 2 numbers"),
        ("\n".join(f"{angle:.0f}°30'" for angle in ANGLES), "must hold angles in degrees, but it holds"),
        ("angle (arcmin)\n" + "\n".join(f"{60 * angle:g}" for angle in ANGLES), "unknown unit 'arcmin'"),
        ("n,angle [turns]\n" + "\n".join(f"{n},{a / 360:g}" for n, a in enumerate(ANGLES)), "unknown unit 'turns'"),
        ("phi,theta\n" + "\n".join(f"{n},{angle}" for n, angle in enumerate(PLAIN)), "names one column 'angle'"),
        ("\n".join(f"{angle} {'rad' if angle == '0' else 'deg'}" for angle in PLAIN), "angles of one unit"),
    ],
)
def test_angles_that_may_mean_something_else_are_refused(tmp_path, text, words):
    (tmp_path / "angles.txt").write_text(text)
    with pytest.raises(InputError, match=words):
        read_angles(tmp_path / "angles.txt")


def test_angles_of_all_frames_are_refused_where_their_order_is_not_known(tmp_path):
    images(tmp_path / "scan" / "projections", numbered(N), FRAMES)
    images(tmp_path / "scan" / "flats", numbered(2), np.full((2, *SHAPE), 5010, np.uint16))
    (tmp_path / "scan" / "angles.txt").write_text("\n".join(["0", "0", *PLAIN]))
    with pytest.raises(InputError, match=r"each of the 8 projections \(flats and darks have none\), but there are 10"):
        read_as(tmp_path / "scan", said())


def test_steps_of_more_than_a_turn_are_warned_of(tmp_path, caplog):
    images(tmp_path / "scan", numbered(N), FRAMES)
    (tmp_path / "scan" / "angles.txt").write_text("\n".join(f"{1000 * angle:g}" for angle in ANGLES))
    read_as(tmp_path / "scan", said())
    assert "angles go on by 22500 degrees, more than a turn each" in caplog.text
    write_scan(tmp_path / "scan.nxs", a_scan())
    with h5py.File(tmp_path / "scan.nxs", "r+") as file:
        del file["entry/sample/view_rotation"]
        file["entry/sample/rotation_angle"][...] *= 1000
    caplog.clear()
    read_as(tmp_path / "scan.nxs", Reading())
    assert "rotation_angle: angles go on by 22500 degrees, more than a turn each" in caplog.text


@pytest.mark.parametrize(
    ("angles", "axis", "words"),
    [
        (np.zeros(N), None, "all 8 frames look from one side"),
        (np.deg2rad(ANGLES), None, "span 2.749 degrees only"),
        (2 * ANGLES, 3.5, ""),  # opposite frames complete each other
        (1.9 * ANGLES, 3.5, "axis is at column 3.5 of 24.*matter beyond it is cut off"),
        (ANGLES, 20.5, "axis is at column 20.5 of 24.*matter beyond it is cut off"),
        (ANGLES, None, ""),
        (2 * ANGLES, 11.0, ""),
    ],
)
def test_views_that_can_hardly_be_meant_are_warned_of(tmp_path, caplog, angles, axis, words):
    caplog.set_level("WARNING", "holosplat")
    write_scan(tmp_path / "scan.nxs", a_scan(angles))
    read_as(tmp_path / "scan.nxs", Reading(Told(axis_column=axis)))
    assert bool(caplog.records) == bool(words)
    assert re.search(words, caplog.text)


# --- TIFF ---------------------------------------------------------------------------------------------------------


def one_page(path: Path) -> bytes:
    """A stack as ImageJ writes large ones: one page, and the planes behind it."""
    tifffile.imwrite(path, FRAMES, imagej=True)
    content = path.read_bytes()
    with tifffile.TiffFile(path) as opened:
        assert opened.is_imagej
        first, count = opened.pages[0], len(opened.pages)
        place = first.offset + 2 + 12 * len(first.tags)
    if count > 1:
        content = content[:place] + b"\0\0\0\0" + content[place + 4 :]
    path.write_bytes(content)
    return content


def test_all_planes_behind_one_page_are_read(tmp_path):
    content = one_page(tmp_path / "all.tif")
    stack = stack_of(tmp_path / "all.tif")
    assert stack.shape == (N, *SHAPE)
    np.testing.assert_array_equal([stack[n, slice(0, SHAPE[0])] for n in range(N)], FRAMES)
    (tmp_path / "all.tif").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=f"hold {N} images behind its one page, but it is cut short"):
        stack_of(tmp_path / "all.tif")


@pytest.mark.parametrize("imagej", [True, False])
def test_pages_that_are_cut_short_are_refused(tmp_path, imagej):
    with tifffile.TiffWriter(tmp_path / "all.tif", imagej=imagej) as file:
        for frame in FRAMES:
            file.write(frame, contiguous=imagej)
    content = (tmp_path / "all.tif").read_bytes()
    (tmp_path / "all.tif").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="must hold its pages whole, but the one after"):
        stack_of(tmp_path / "all.tif")


@pytest.mark.parametrize("axes", ["TYX", "ZYX", "TZYX"])
def test_pages_of_ome_are_frames(tmp_path, axes):
    shape = (N, *SHAPE) if len(axes) == 3 else (4, 2, *SHAPE)
    tifffile.imwrite(tmp_path / "a.tif", FRAMES.reshape(shape), metadata={"axes": axes}, ome=True)
    stack = stack_of(tmp_path / "a.tif")
    np.testing.assert_array_equal([stack[n, slice(0, 99)] for n in range(N)], FRAMES)


def test_small_copies_between_the_pages_are_no_frames(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for frame in FRAMES:
            file.write(frame, metadata=None)
            file.write(frame[::4, ::4], metadata=None, subfiletype=1)
    stack = stack_of(tmp_path / "a.tif")
    np.testing.assert_array_equal([stack[n, slice(0, 99)] for n in range(stack.shape[0])], FRAMES)


@pytest.mark.parametrize("kind", ["imagej", "ome"])
def test_several_channels_are_no_frames(tmp_path, kind):
    tifffile.imwrite(tmp_path / "a.tif", FRAMES.reshape(4, 2, *SHAPE), metadata={"axes": "TCYX"}, **{kind: True})
    with pytest.raises(InputError, match="frames of one channel, but it has 2"):
        stack_of(tmp_path / "a.tif")


def test_planes_that_were_taken_for_colours_and_small_copies_are_told_from_frames(tmp_path):
    colours = {"photometric": "rgb", "planarconfig": "separate", "extrasamples": ["unassalpha"]}
    tifffile.imwrite(tmp_path / "a.tif", FRAMES[:4], **colours)
    stack = stack_of(tmp_path / "a.tif")
    np.testing.assert_array_equal([stack[n, slice(0, SHAPE[0])] for n in range(4)], FRAMES[:4])
    tifffile.imwrite(tmp_path / "b.tif", FRAMES[0])
    tifffile.imwrite(tmp_path / "b.tif", FRAMES[0][::4, ::4], append=True, subfiletype=1)
    assert stack_of(tmp_path / "b.tif").shape == (1, *SHAPE)


TURNED = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.T,
    6: lambda image: np.rot90(image, 1),
    7: lambda image: image[::-1, ::-1].T,
    8: lambda image: np.rot90(image, -1),
}
"""How an image that is seen upright is stored, by its orientation (TIFF 6.0)."""


@pytest.mark.parametrize("orientation", TURNED)
def test_images_are_turned_upright(tmp_path, orientation):
    stored = np.ascontiguousarray(TURNED[orientation](FRAMES[0]))
    tifffile.imwrite(tmp_path / "a.tif", stored, extratags=[(274, "H", 1, orientation, True)])
    np.testing.assert_array_equal(stack_of(tmp_path / "a.tif")[0, slice(0, 99)], FRAMES[0])


def test_white_that_is_zero_becomes_the_greatest_number(tmp_path, caplog):
    caplog.set_level("INFO")
    tifffile.imwrite(tmp_path / "a.tif", FRAMES[0], photometric="miniswhite")
    np.testing.assert_array_equal(stack_of(tmp_path / "a.tif")[0, slice(0, 99)], 65535 - FRAMES[0])
    assert "have 0 as white" in caplog.text
    tifffile.imwrite(tmp_path / "b.tif", FRAMES[0].astype(np.float32), photometric="miniswhite")
    with pytest.raises(InputError, match="0 is white, which has no meaning for float32"):
        stack_of(tmp_path / "b.tif")


def test_a_refusal_that_names_a_package_stays_one(tmp_path):
    tifffile.imwrite(file := tmp_path / "imagecodecs.tif", FRAMES[0])
    with pytest.raises(InputError, match="must be other") as refused, open_tiff(file):
        raise InputError(f"{file} must be other.")
    assert type(refused.value) is InputError


def test_the_package_for_compressed_images_is_named(tmp_path, monkeypatch):
    tifffile.imwrite(tmp_path / "a.tif", FRAMES[0], compression="zlib")

    def missing(*_: object, **__: object) -> None:
        raise ValueError("<COMPRESSION.LZW: 5> requires the 'imagecodecs' package")

    monkeypatch.setattr(tifffile.TiffPage, "asarray", missing)
    with pytest.raises(MissingError, match=r"holosplat\[codecs\]"):
        stack_of(tmp_path / "a.tif")
