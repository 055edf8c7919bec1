"""What compact files cost: rows of docs/data/compact.csv, bytes against the scores of a run.

    python benchmarks/compact.py RUN TRUTH [--scene NAME] [--write]

RUN is a finished run beside its scan, TRUTH its true volume. Files: that of the run (float32 Gaussians and voxels,
float64 surfaces), compact ones of several steps of places, and for comparison the run's δ on the scan's pixels and on
half of them, as 8-bit and 16-bit voxels of its range and as float32, in Zarr's chunks by blosc (zstd, shuffled bytes),
as `export --volume NAME.ome.zarr` writes the last. Scores are of held-out frames and of the volume. With --write, rows
stand in the table in place of earlier ones of the same scene and kind.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import zarr
from machine import commit
from numcodecs import Blosc
from rows import merge

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.io.objects import read_object, steps_of, write_compact
from holosplat.io.ome import CHUNK
from holosplat.matter import Matter
from holosplat.representations import Stored, VoxelGrid
from holosplat.workflows.evaluate import score_object

OUT = Path(__file__).resolve().parents[1] / "docs" / "data" / "compact.csv"
PLACES = (1 / 128, 1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4)
"""Steps [pixels]."""
COLUMNS = ("scene", "kind", "file", "bytes", "ssim", "frcm", "dice", "error_delta", "commit")


def files(obj: Stored, path: Path, grid: Grid, folder: Path) -> Iterator[tuple[str, int, Stored]]:
    """What a file is called, its bytes, and the object that it brings back."""
    yield "object.h5", path.stat().st_size, obj
    made = folder / "made.h5"
    for place in PLACES:
        write_compact(made, obj, steps_of(place))
        yield f"compact 1/{round(1 / place)} px", made.stat().st_size, read_object(made)
    for refine in (1, 2):
        fine = grid.divided((refine,) * 3)
        volume = obj.voxelise(fine).delta
        for bits in (8, 16, 32):
            step = float(volume.max()) / (2**bits - 1)
            stored = volume if bits == 32 else np.rint(volume / step).astype(f"u{bits // 8}")
            size = zarr_bytes(stored, folder / f"{refine}_{bits}.zarr")
            back = torch.from_numpy(np.asarray(volume if bits == 32 else step * stored, dtype=np.float32)[None])
            matter = Matter.one(1.0, float(obj.matter.channels[0].beta / obj.matter.channels[0].delta))
            yield f"voxels of 1/{refine} px and {bits} bits", size, VoxelGrid(back, fine, matter)


def zarr_bytes(values: np.ndarray, folder: Path) -> int:
    """Bytes of all files of a Zarr array; chunks that are empty take none."""
    how = Blosc(cname="zstd", clevel=5, shuffle=Blosc.SHUFFLE)
    chunks = tuple(min(CHUNK, n) for n in values.shape)
    array = zarr.create_array(
        folder, shape=values.shape, chunks=chunks, dtype=values.dtype, compressors=how, fill_value=0, zarr_format=2
    )
    array[:] = values
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def rows(run: Path, truth_path: Path, scene: str) -> Iterator[dict[str, str]]:
    """A row a file."""
    folder = hs.RunFolder(run)
    scan, truth = hs.io.read_scan(folder.source_scan()), hs.io.read_volume(truth_path)
    obj = read_object(folder.result())
    with tempfile.TemporaryDirectory() as temporary:
        for name, size, back in files(obj, folder.result(), Grid.of_views(scan.views), Path(temporary)):
            found = score_object(back, scan, truth, hs.load_reconstruction(folder).oversample)
            assert found.test is not None
            assert found.volume is not None
            values = {
                "ssim": found.test.mean["ssim"],
                "frcm": found.test.mean["frcm"],
                "dice": found.volume.dice,
                "error_delta": found.volume.relative_error_delta,
            }
            row = {"scene": scene, "kind": obj.kind, "file": name, "bytes": str(size)}
            yield row | {key: f"{value:.5f}" for key, value in values.items()} | {"commit": commit()}


def main() -> None:
    """Print the rows, and write them where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    made = []
    for row in rows(given.run, given.truth, given.scene):
        made.append(row)
        print(row, flush=True)
    if given.write:
        merge(made, OUT, "scene", "kind", columns=COLUMNS)


if __name__ == "__main__":
    main()
