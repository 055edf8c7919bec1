"""The options of bodies in motion: what is known of their shape, and how they are found."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..bodies.rest_shape import KnownBody
from ..checks import positive
from ..motion.track import TrackOptions
from ..ranges import Metres, Share, Weight, ranged


@dataclass(frozen=True)
@ranged
class BodyFlags:
    """What is known of the bodies' shape."""

    body: str = ""
    """Shape at rest of all bodies: red-cell, or a file of one closed mesh (.stl, .ply, .obj, .vtk, .vtp, .vtu)."""
    body_unit: str = "um"
    """Unit of the mesh file's coordinates."""
    body_size: Metres = 0.0
    """Largest extent at rest [m] (0: a red cell's 7.82 µm, or the file's)."""
    body_uncertain: Share = 0.1
    """By which part all bodies may be larger or smaller than that, at most."""
    body_stiffness: Weight = 100.0
    """Minus the logarithm of the probability of strains of about one."""

    def known(self) -> KnownBody | None:
        """None without a shape."""
        if not self.body:
            return None
        return KnownBody(self.body, self.body_unit, self.body_size, self.body_uncertain, self.body_stiffness)


@dataclass(frozen=True)
@ranged
class MotionFlags:
    """How bodies are found and move."""

    degree: int = 2
    """Degree of the paths' polynomials."""
    pieces: int = 0
    """Pieces of the paths' splines over the whole time (0: as many as predict held-out frames best)."""
    rounds: int = 4
    """How often bodies are looked for beside those that are known, at most."""
    learned: bool = True
    """Bodies of single times are found in what the package's network guesses, where frames do not contradict it and its
    bodies explain clearly more: red cells in two or three beams."""
    cells: bool = True
    """In two beams, bodies that the network guesses are followed as red cells, too, by their shape at rest; these are
    kept unless bodies of any shape leave clearly less of the frames."""
    least_volume: float = 30.0
    """Bodies of fewer voxels, of a pixel's edge, are not followed."""
    volume_kept: Weight = 0.006
    """Standard deviation of a body's volume over time, as a share (0: volumes are free)."""
    area_kept: Weight = 0.03
    """The same of its area (0: areas are free)."""
    apart: Weight = 0.2
    """How deep bodies may lie in each other, a standard deviation in pixels (0: as they like)."""
    acceleration: float = 1e-6
    """Weight of bent paths (0: as bent as splines can be)."""
    bending: float = 1.0
    """Weight of bent surfaces (0: free)."""
    twins: bool = True
    """Bodies of known shape in two beams are told from others whose shadows have the same size and tilt, by fits."""
    intervals: bool = True
    """Standard errors from fits to halves of the frames, which take about as long as the last fit."""
    effort: float = 1.0
    """Factor of the numbers of steps."""

    def options(self) -> TrackOptions:
        """The options of the method."""
        usual = TrackOptions().with_effort(positive("--effort", self.effort))
        paths = replace(usual.paths, degree=self.degree, pieces=self.pieces)
        found = replace(usual.sightings, least_volume=self.least_volume)
        known = {name: getattr(self, name) for name in ("volume_kept", "area_kept", "apart", "acceleration")}
        fits = {
            name: replace(fit, objective=replace(fit.objective, bending=self.bending), **known)
            for name, fit in (("stiff", usual.stiff), ("soft", usual.soft), ("half", usual.half))
        }
        usual = usual if self.learned else replace(usual, learned=None)
        return replace(
            usual,
            paths=paths,
            sightings=found,
            rounds=self.rounds,
            twins=self.twins,
            cells=self.cells,
            intervals=self.intervals,
            **fits,
        )
