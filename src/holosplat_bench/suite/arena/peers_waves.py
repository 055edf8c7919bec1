"""What other people's programs do of waves in the arena: phase retrieval and steps; and pairs of two programs."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np

from holosplat.units import wavelength

from .contest import Answer, Question, located


def fresnel_number(question: Question) -> float:
    """Of a pixel."""
    return question.pixel**2 / (wavelength(question.energy_kev) * question.distance)


# --- hotopy and pyphase ---------------------------------------------------------------------------------------

CTF_LEVELS, TIKHONOV_LEVELS = (1e-3, 1e-1), (1e-2, 1e-1)
"""hotopy's regularisation at low and at high frequencies; the best of five pairs on three cases of seed 11."""


def _padded(frames: np.ndarray) -> tuple[np.ndarray, tuple[slice, slice, slice]]:
    """Frames continued by their edges to twice the size, and where they lie in that."""
    rows, columns = (n // 2 for n in frames.shape[1:])
    inner = (slice(None), slice(rows, rows + frames.shape[1]), slice(columns, columns + frames.shape[2]))
    return np.pad(frames, ((0, 0), (rows, rows), (columns, columns)), mode="edge"), inner


def hotopy_ctf(question: Question) -> Callable[[], Answer]:
    """Retrieval: contrast transfer of one material, with two levels of regularisation."""
    import torch
    from hotopy import holo  # pyright: ignore[reportMissingImports]

    frames, inner = _padded(question.frames)

    def run() -> Answer:
        number = fresnel_number(question)
        retrieve = holo.CTF(frames.shape[1:], number, CTF_LEVELS, 1 / question.ratio, dtype=torch.float64)
        return {"lines": -np.stack([np.asarray(retrieve(one)).reshape(one.shape) for one in frames])[inner]}

    return run


def hotopy_tikhonov(question: Question) -> Callable[[], Answer]:
    """Retrieval: nonlinear, of one material, without phases of the wrong sign."""
    import torch
    from hotopy import holo  # pyright: ignore[reportMissingImports]

    frames, inner = _padded(question.frames)

    def run() -> Answer:
        number, sign = fresnel_number(question), holo.Constraints(phase_max=0.0)
        retrieve = holo.Tikhonov(frames.shape[1:], number, 1 / question.ratio, TIKHONOV_LEVELS, dtype=torch.float64)
        found = [np.asarray(retrieve(torch.from_numpy(one).double(), constraints=sign)) for one in frames]
        return {"lines": -np.stack(found).reshape(frames.shape)[inner]}

    return run


PYPHASE_LEVEL = 2.0
"""Common logarithm of pyphase's regularisation beside the square of a transfer of up to δ/β; the best of seven on three
cases of seed 11."""


def pyphase_ctf(question: Question) -> Callable[[], Answer]:
    """Retrieval: contrast transfer of one material."""
    from pyphase import phaseretrieval as module  # pyright: ignore[reportMissingImports]

    phaseretrieval: Any = module  # its hints would have whole numbers alone

    def run() -> Answer:
        with contextlib.redirect_stdout(io.StringIO()):
            retrieve = phaseretrieval.CTFHOM(
                shape=question.frames.shape[1:],
                pixel_size=question.pixel,
                distance=[question.distance],
                energy=question.energy_kev,
                alpha=[PYPHASE_LEVEL] * 2,
                delta_beta=question.ratio,
            )
            found = [retrieve.reconstruct_image(one.astype(np.float64))[0] for one in question.frames]
        return {"lines": -np.stack(found)}

    return run


# --- plain torch, and pairs -----------------------------------------------------------------------------------


def torch_step(question: Question) -> Callable[[], Answer]:
    """Steps: eager PyTorch alone: slices turned by `grid_sample` and summed, waves by its FFT."""
    import torch

    views, rows, columns = question.frames.shape
    angles = torch.from_numpy(question.angles).float()
    zero = torch.zeros_like(angles)
    cos, sin = angles.cos(), angles.sin()
    turns = torch.stack([torch.stack([cos, -sin, zero], 1), torch.stack([sin, cos, zero], 1)], 1)
    side = question.volume.shape[0]
    places = torch.nn.functional.affine_grid(turns, [views, 1, side, side], align_corners=False)
    fy, fx = (torch.fft.fftfreq(2 * n, question.pixel, dtype=torch.float64) for n in (rows, columns))
    chirp = torch.pi * wavelength(question.energy_kev) * question.distance * (fy[:, None] ** 2 + fx**2)
    kernel = torch.polar(torch.ones_like(chirp), -chirp).to(torch.complex64)
    frames = torch.from_numpy(question.frames).float()

    def run() -> Answer:
        volume = torch.from_numpy(question.volume).float().requires_grad_()
        slices = volume.transpose(0, 1)[None].expand(views, -1, -1, -1)
        lines = torch.nn.functional.grid_sample(slices, places, align_corners=False).sum(2)
        wave = torch.exp(-(1 / question.ratio + 1j) * lines) - 1
        seen = torch.fft.ifft2(torch.fft.fft2(wave, s=(2 * rows, 2 * columns)) * kernel)[:, :rows, :columns] + 1
        (0.5 * (seen.abs().square() - frames).square().sum()).backward()
        assert volume.grad is not None
        return {"gradient": volume.grad.numpy()}

    return run


def pair(question: Question) -> Callable[[], Answer]:
    """Jobs: the retrieval and the tomography that the question names, one after the other."""
    from dataclasses import replace

    retrieval, tomography = (located(act) for act in question.pair)
    retrieve = retrieval(question)
    tomography(replace(question, lines=np.zeros_like(question.frames)))  # imports, which are not counted

    def run() -> Answer:
        return tomography(replace(question, lines=np.asarray(retrieve()["lines"], dtype=np.float32)))()

    return run
