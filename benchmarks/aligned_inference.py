"""How long a pixel-aligned field takes to say its values: rows of docs/data/aligned_inference.csv.

    python benchmarks/aligned_inference.py [--views 4 8] [--write]

128³ voxels, images of 128² pixels, the network of `onix` with random weights, one thread; everywhere, and in a ball of
80 voxels across. `forward` is what fits run, here without gradients in pieces of 65 536 points, as values were made
before; `told` is what values without gradients are made by. The least of three runs in turns.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable
from pathlib import Path

import torch
from machine import commit
from rows import write
from torch import Tensor

from holosplat.geometry import Grid, Views
from holosplat_bench.opponents.fields import AlignedNetwork, PixelAligned
from holosplat_bench.opponents.fields.pixel_aligned import places_of

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "aligned_inference.csv"
EDGE, ACROSS, PIECE = 128, 80, 1 << 16


def cells(where: str) -> Tensor:
    """The voxels [N] (flat) that are looked at."""
    axis = torch.arange(EDGE) - 0.5 * (EDGE - 1)
    squares = axis**2 + axis[:, None] ** 2 + axis[:, None, None] ** 2
    inside = squares < (0.5 * ACROSS) ** 2 if where == "ball" else torch.ones(3 * (EDGE,), dtype=torch.bool)
    return inside.flatten().nonzero()[:, 0]


def row(count: int, where: str) -> dict[str, str]:
    """Processor time of both ways, and by how much they differ beside the spread of what they say."""
    views = Views.evenly_spaced(count, (EDGE, EDGE), 1e-6)
    network, generator = PixelAligned(AlignedNetwork(), 0), torch.Generator().manual_seed(0)
    places = places_of(Grid.of_views(views), views, cells(where)).float()
    images = torch.randn(count, 3, EDGE, EDGE, generator=generator)
    ways: dict[str, Callable[[Tensor], Tensor]] = {
        "forward": lambda features: torch.cat([network(features, part) for part in places.split(PIECE, dim=1)]),
        "told": lambda features: network.told(features, places),
    }
    seconds, found = dict.fromkeys(ways, float("inf")), dict[str, Tensor]()
    for _ in range(3):
        for name, way in ways.items():
            began = time.process_time()
            with torch.no_grad():
                found[name] = way(network.encoded(images))
            seconds[name] = min(seconds[name], time.process_time() - began)
    first, second = (found[name][:, 0] for name in ways)
    apart = float((first - second).abs().max() / first.std())
    said = {"views": count, "where": where, "voxels": places.shape[1]}
    said |= {name: f"{value:.3f}" for name, value in seconds.items()} | {"apart": f"{apart:.2g}"}
    return {name: str(value) for name, value in said.items()} | {"machine": platform.machine(), "commit": commit()}


def main() -> None:
    """Print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", nargs="+", type=int, default=[4, 8])
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    found = []
    for count in options.views:
        for where in ("everywhere", "ball"):
            found.append(row(count, where))
            print(found[-1], flush=True)
    if options.write:
        write(found, PAGE)


if __name__ == "__main__":
    main()
