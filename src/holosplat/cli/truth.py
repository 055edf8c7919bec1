"""What `holosplat simulate` writes beside the scan, for judging."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..checks import InputError, require
from ..ranges import ranged
from .places import Output

if TYPE_CHECKING:
    from ..volume import Object


@dataclass(frozen=True)
@ranged
class TruthOptions:
    """What is also written, for judging."""

    truth: Output | None = None
    """Volume file (as `export --volume`): the true δ and β, of a series at its first time."""
    truth_frames: tuple[int, ...] = ()
    """Series: write the true volume at these times instead, counted from 0, to TRUTH_t0000.h5 and so on."""
    truth_regions: bool = False
    """Matter that may fill the field: also write its named parts, such as bubbles, beside --truth as TRUTH_bubbles.h5
    and so on; their δ is the share of each voxel that the part fills."""
    truth_mesh: Output | None = None
    """STL file: the surfaces of the truth, where it has them, in micrometres."""
    true_exposures: Output | None = None
    """Scan file: the same frames, with poses and distances as they were, not as --out tells them."""

    def require_usable(self, out: Path) -> None:
        """`InputError` unless all files, `out` among them, can be written."""
        from ..io.atomic import require_writable
        from ..io.volume_formats import volume_format

        require(self.truth is not None or not self.truth_frames, "--truth-frames needs --truth.")
        require(self.truth is not None or not self.truth_regions, "--truth-regions needs --truth.")
        if self.truth_mesh is not None and self.truth_mesh.suffix.lower() != ".stl":
            raise InputError(f"--truth-mesh must be a file whose name ends with .stl, but it is {self.truth_mesh}.")
        if self.truth is not None:
            volume_format(self.truth, "--truth")
        for path in filter(None, (out, self.truth, self.truth_mesh, self.true_exposures)):
            require_writable(path)

    def volumes(self, times: int) -> list[tuple[Path, int]]:
        """Each volume file to write, and the number of its time, one of `times`."""
        from ..io.volume_formats import of_time

        if self.truth is None:
            return []
        for n in self.truth_frames:
            require(0 <= n < times, f"--truth-frames must be times of the scan, 0 to {times - 1}, but {n} is none.")
        named = [(of_time(self.truth, frame), frame) for frame in self.truth_frames]
        return named or [(self.truth, 0)]

    def of_regions(self, regions: Mapping[str, Object]) -> dict[Path, Object]:
        """Each volume file of a named part to write, and the part; `InputError` where they are wanted of none."""
        if self.truth is None or not self.truth_regions:
            return {}
        require(len(regions) > 0, "--truth-regions is of matter that may fill the field (--specimen); leave it.")
        return {self.truth.with_stem(f"{self.truth.stem}_{name}"): one for name, one in regions.items()}

    def write_mesh(self, matter: object) -> bool:
        """The surfaces of `matter` to the STL file, if one is wanted; `InputError` where there are none."""
        from ..io.solids import write_stl
        from ..specimens.scene import MeshScene

        if self.truth_mesh is None:
            return False
        if not isinstance(matter, MeshScene):
            raise InputError("--truth-mesh needs a still truth of surfaces, but this one has none; leave it.")
        write_stl(self.truth_mesh, matter.meshes)
        return True
