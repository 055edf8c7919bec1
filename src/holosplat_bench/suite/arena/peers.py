"""What other people's programs do in the arena, as acts:
projectors and tomography; each imports its package inside, in a process of its own.

Volumes are [Z, Y, X], views turn about y by θ: x on the detector is `x cos θ + z sin θ`. Options are those of the
packages' examples, or were chosen on scenes of seeds below 100.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from holosplat.units import wavenumber

from .contest import Answer, Question

SWEEPS = 100
"""Of SIRT without negative values, as holosplat's own."""


# --- ASTRA ----------------------------------------------------------------------------------------------------


class _Astra:
    """Slices across the axis, one after the other, on the processor; ASTRA's rows run along -z."""

    def __init__(self, question: Question, model: str) -> None:
        import astra  # pyright: ignore[reportMissingImports]

        self.astra, (views, rows, side) = astra, question.lines.shape
        self.shape = (side, rows, side)
        volume = astra.create_vol_geom(side, side)
        rays = astra.create_proj_geom("parallel", 1.0, side, question.angles)
        self.projector = astra.create_projector(model, rays, volume)
        self.data = astra.data2d.create("-sino", rays)
        self.slice = astra.data2d.create("-vol", volume)
        self.seen = (views, rows, side)

    def algorithm(self, kind: str, **options: Any) -> int:
        """An algorithm from the data to the slice, or for FP back."""
        settings = self.astra.astra_dict(kind)
        ends = ("VolumeDataId", "ProjectionDataId") if kind == "FP" else ("ReconstructionDataId", "ProjectionDataId")
        settings |= {"ProjectorId": self.projector, ends[0]: self.slice, ends[1]: self.data, "option": options}
        return self.astra.algorithm.create(settings)

    def project(self, algorithm: int, volume: np.ndarray) -> np.ndarray:
        """Lines [V, H, W] of a volume."""
        lines = np.empty(self.seen, dtype=np.float32)
        for row in range(self.shape[1]):
            self.astra.data2d.store(self.slice, volume[::-1, row])
            self.astra.algorithm.run(algorithm)
            lines[:, row] = self.astra.data2d.get(self.data)
        return lines

    def reconstruct(self, algorithm: int, lines: np.ndarray, iterations: int = 1) -> np.ndarray:
        """A volume of lines [V, H, W]."""
        volume = np.empty(self.shape, dtype=np.float32)
        for row in range(self.shape[1]):
            self.astra.data2d.store(self.data, lines[:, row])
            self.astra.data2d.store(self.slice, 0)
            self.astra.algorithm.run(algorithm, iterations)
            volume[:, row] = self.astra.data2d.get(self.slice)[::-1]
        return volume


def _astra_pair(model: str, question: Question) -> Callable[[], Answer]:
    astra = _Astra(question, model)
    forward, back = astra.algorithm("FP"), astra.algorithm("BP")
    volume, lines = question.volume.astype(np.float32), question.lines.astype(np.float32)
    return lambda: {"lines": astra.project(forward, volume), "volume": astra.reconstruct(back, lines)}


astra_strip = partial(_astra_pair, "strip")
"""Kernels: strips as wide as a pixel."""
astra_linear = partial(_astra_pair, "linear")
"""Kernels: Joseph's interpolation along a ray."""


def astra_backprojection(question: Question) -> Callable[[], Answer]:
    """Tomography: FBP with the ramp filter."""
    astra = _Astra(question, "strip")
    algorithm = astra.algorithm("FBP", FilterType="ram-lak")
    return lambda: {"volume": astra.reconstruct(algorithm, question.lines.astype(np.float32))}


def astra_sirt(question: Question) -> Callable[[], Answer]:
    """Tomography: SIRT without negative values."""
    astra = _Astra(question, "strip")
    algorithm = astra.algorithm("SIRT", MinConstraint=0.0)
    return lambda: {"volume": astra.reconstruct(algorithm, question.lines.astype(np.float32), SWEEPS)}


# --- svmbir and mbirjax ---------------------------------------------------------------------------------------


def svmbir_pair(question: Question) -> Callable[[], Answer]:
    """Kernels: its matrices, computed anew in each call, as the package does."""
    import tempfile

    import svmbir  # pyright: ignore[reportMissingImports]

    side = question.volume.shape[0]
    image = np.ascontiguousarray(question.volume.transpose(1, 2, 0), dtype=np.float32)
    lines = np.ascontiguousarray(question.lines, dtype=np.float32)
    told: dict[str, Any] = {"roi_radius": float(side), "num_threads": 1, "verbose": 0}

    def run() -> Answer:
        with tempfile.TemporaryDirectory() as cache:
            told["svmbir_lib_path"] = cache
            forward = svmbir.project(image, -question.angles, side, **told)
            back = svmbir.backproject(lines, -question.angles, num_rows=side, num_cols=side, **told)
        return {"lines": forward, "volume": back.transpose(2, 0, 1)}

    return run


def svmbir_volume(question: Question) -> Callable[[], Answer]:
    """Tomography: qGGMRF without negative values, with the options of the benchmark's `paganin-svmbir`."""
    import svmbir  # noqa: F401  # pyright: ignore[reportMissingImports]
    import torch

    from holosplat.geometry import Grid

    from ...opponents.mbir import Mbir
    from ...opponents.mbir import svmbir_volume as reconstructed
    from .own import views_of

    views, options = views_of(question), Mbir(threads=1)
    lines = torch.from_numpy(question.lines).float() * question.pixel

    def run() -> Answer:
        volume = reconstructed(lines, views, Grid.of_views(views), None, lambda fraction: None, options=options)
        return {"volume": volume.numpy()}

    return run


def _mbirjax(question: Question) -> Any:
    import mbirjax  # pyright: ignore[reportMissingImports]

    model = mbirjax.ParallelBeamModel(question.lines.shape, -question.angles)
    model.set_params(verbose=0, use_gpu="none", no_warning=True)
    return model


def mbirjax_pair(question: Question) -> Callable[[], Answer]:
    """Kernels: compiled by XLA before the fastest call."""
    import jax.numpy as jnp  # pyright: ignore[reportMissingImports]

    model = _mbirjax(question)
    image = jnp.asarray(question.volume.transpose(0, 2, 1), dtype=jnp.float32)
    lines = jnp.asarray(question.lines, dtype=jnp.float32)

    def run() -> Answer:
        forward, back = model.forward_project(image), model.back_project(lines)
        return {"lines": np.asarray(forward), "volume": np.asarray(back).transpose(0, 2, 1)}

    return run


def mbirjax_volume(question: Question) -> Callable[[], Answer]:
    """Tomography: qGGMRF by vectorised coordinate descent, without negative values, else as the package has it."""
    model = _mbirjax(question)
    model.set_params(positivity_flag=True, no_warning=True)

    def run() -> Answer:
        with contextlib.redirect_stdout(io.StringIO()):
            volume, _ = model.recon(question.lines.astype(np.float32), print_logs=False, logfile_path="recon.log")
        return {"volume": np.asarray(volume).transpose(0, 2, 1)}

    return run


# --- SCICO ----------------------------------------------------------------------------------------------------

FINER = 2
"""Pixels of SCICO's projector along a voxel: its shadow must not be wider than a pixel of the detector."""
TV_WEIGHT = 0.01
"""Weight of the total variation beside half the squared misfit [rad]: of the order of errors of a phase; untuned."""
ADMM_STEPS = 40
"""Iterations of ADMM with five of conjugate gradients in each, as in SCICO's examples of tomography."""
RHO = 1.0
"""Penalty of ADMM's splittings; lines and voxels are of order one."""


def _scico(question: Question) -> tuple[Any, Callable[[Any], Any]]:
    """jax, and lines [V, H, W] of voxels [Z, Y, X] by SCICO's own projector."""
    import jax  # pyright: ignore[reportMissingImports]
    import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
    from scico.linop.xray import XRayTransform2D  # pyright: ignore[reportMissingImports]

    side = question.volume.shape[0]
    shape, pitch = (FINER * side,) * 2, (1 / FINER,) * 2
    slices = XRayTransform2D(shape, jnp.asarray(question.angles), dx=jnp.asarray(pitch), det_count=side)

    def project(volume: Any) -> Any:
        fine = jnp.repeat(jnp.repeat(volume.transpose(1, 2, 0), FINER, 1), FINER, 2) / FINER**2
        return jax.vmap(slices.project, out_axes=1)(fine)

    return jax, project


def scico_pair(question: Question) -> Callable[[], Answer]:
    """Kernels: SCICO's 2D projector for every slice; back by its derivative."""
    jax, project = _scico(question)
    volume, lines = (jax.numpy.asarray(a, dtype=np.float32) for a in (question.volume, question.lines))
    forward = jax.jit(project)
    back = jax.jit(lambda y: jax.vjp(project, volume)[1](y)[0])
    return lambda: {"lines": np.asarray(forward(volume)), "volume": np.asarray(back(lines))}


def scico_step(question: Question) -> Callable[[], Answer]:
    """Steps: SCICO's projector and Fresnel propagator, differentiated and compiled by JAX."""
    from scico.linop.optics import FresnelPropagator  # pyright: ignore[reportMissingImports]

    jax, project = _scico(question)
    jax.config.update("jax_enable_x64", True)  # its kernel's phase kz of 1e10 rad would lose all digits otherwise
    jnp, k = jax.numpy, wavenumber(question.energy_kev)
    rows, columns = question.frames.shape[1:]  # padded here: scico 0.0.7 with pad_factor crops spectra, not waves
    waves = FresnelPropagator((2 * rows, 2 * columns), question.pixel, k, question.distance)
    frames, start = (jnp.asarray(a, dtype=np.float32) for a in (question.frames, question.volume))

    def misfit(volume: Any) -> Any:
        behind = jnp.exp(-(1 / question.ratio + 1j) * project(volume)) - 1
        turned = np.exp(-1j * (k * question.distance % (2 * np.pi)))  # without the constant exp(ikz)
        padded = jnp.pad(behind, ((0, 0), (0, rows), (0, columns)))
        seen = jnp.stack([jnp.asarray(waves(one)) for one in padded])[:, :rows, :columns]
        shown = jnp.abs(turned * seen + 1) ** 2
        return 0.5 * jnp.sum((shown - frames) ** 2)

    gradient = jax.jit(jax.grad(misfit))
    return lambda: {"gradient": np.asarray(gradient(start))}


def scico_volume(question: Question) -> Callable[[], Answer]:
    """Tomography: total variation without negative values by ADMM, as in SCICO's examples."""
    from scico import functional, linop, loss  # pyright: ignore[reportMissingImports]
    from scico.optimize.admm import ADMM, LinearSubproblemSolver  # pyright: ignore[reportMissingImports]

    jax, project = _scico(question)
    jnp, (_, rows, side) = jax.numpy, question.lines.shape
    shape, lines = (side, rows, side), jnp.asarray(question.lines, dtype=np.float32)

    def run() -> Answer:
        rays = linop.LinearOperator(
            input_shape=shape,
            output_shape=lines.shape,
            eval_fn=project,
            adj_fn=lambda y: jax.vjp(project, jnp.zeros(shape, np.float32))[1](y)[0],
            input_dtype=np.float32,
            output_dtype=np.float32,
            jit=True,
        )
        slopes = linop.FiniteDifference(input_shape=shape, input_dtype=np.float32, append=0)
        solver = ADMM(
            f=loss.SquaredL2Loss(y=lines, A=rays),
            g_list=[TV_WEIGHT * functional.L21Norm(), functional.NonNegativeIndicator()],
            C_list=[slopes, linop.Identity(shape, input_dtype=np.float32)],
            rho_list=[RHO, RHO],
            x0=jnp.zeros(shape, np.float32),
            maxiter=ADMM_STEPS,
            subproblem_solver=LinearSubproblemSolver(cg_kwargs={"tol": 1e-4, "maxiter": 5}),
        )
        return {"volume": np.maximum(np.asarray(solver.solve()), 0)}

    return run


# --- RTK ------------------------------------------------------------------------------------------------------


class _Rtk:
    """Images and the geometry of parallel beams, which is a source at no distance from the detector."""

    def __init__(self, question: Question) -> None:
        import itk as whole  # pyright: ignore[reportMissingImports]

        itk: Any = whole  # its parts are loaded when they are named
        self.itk, self.rtk = itk, itk.RTK
        itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(1)
        self.kind = itk.Image[itk.F, 3]
        views, rows, side = question.lines.shape
        self.shape, self.seen = (side, rows, side), (views, rows, side)
        middle = [-0.5 * (n - 1) for n in (side, rows, side)]
        self.of_volume, self.of_lines = middle, [*middle[:2], 0.0]
        self.geometry = self.rtk.ThreeDCircularProjectionGeometry.New()
        for angle in np.rad2deg(question.angles):
            self.geometry.AddProjection(1000.0, 0.0, -float(angle))

    def image(self, array: np.ndarray, origin: list[float]) -> Any:
        """An image of an array."""
        image = self.itk.image_from_array(np.ascontiguousarray(array, dtype=np.float32))
        image.SetOrigin(origin)
        return image

    def filtered(self, name: str, first: Any, second: Any, *, pair: bool) -> np.ndarray:
        """What a filter makes of two images in this geometry."""
        kinds = (self.kind, self.kind) if pair else (self.kind,)
        made = getattr(self.rtk, name)[kinds if pair else self.kind].New()
        made.SetInput(0, first)
        made.SetInput(1, second)
        made.SetGeometry(self.geometry)
        made.Update()
        return self.itk.array_from_image(made.GetOutput())


def rtk_pair(question: Question) -> Callable[[], Answer]:
    """Kernels: Joseph's interpolation along a ray, and its adjoint."""
    rtk = _Rtk(question)

    def run() -> Answer:
        nothing, empty = np.zeros(rtk.seen), np.zeros(rtk.shape)
        volume, lines = rtk.image(question.volume, rtk.of_volume), rtk.image(question.lines, rtk.of_lines)
        forward = rtk.filtered(
            "JosephForwardProjectionImageFilter", rtk.image(nothing, rtk.of_lines), volume, pair=True
        )
        back = rtk.filtered("JosephBackProjectionImageFilter", rtk.image(empty, rtk.of_volume), lines, pair=True)
        return {"lines": forward, "volume": back}

    return run


def rtk_fdk(question: Question) -> Callable[[], Answer]:
    """Tomography: FDK, which is filtered back-projection for parallel beams."""
    rtk = _Rtk(question)

    def run() -> Answer:
        empty, lines = rtk.image(np.zeros(rtk.shape), rtk.of_volume), rtk.image(question.lines, rtk.of_lines)
        return {"volume": rtk.filtered("FDKConeBeamReconstructionFilter", empty, lines, pair=False)}

    return run
