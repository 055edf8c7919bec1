"""The pretended GPU holds tensors apart as a GPU does, and computes what main memory does."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from helpers.pretended_gpu import Mixed, OnGpu, pretended_gpu

pytest.importorskip("triton")


@pytest.fixture(autouse=True)
def _there(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with pretended_gpu(monkeypatch):
        yield


def there(*shape: int) -> torch.Tensor:
    """Numbers on the GPU."""
    return torch.arange(1.0, 1 + torch.Size(shape).numel()).reshape(shape).to("cuda")


def test_tensors_of_two_places_do_not_meet():
    ours = torch.ones(3)
    for act in (
        lambda: there(3) + ours,
        lambda: torch.cat([there(3), ours]),
        lambda: there(2, 3) @ torch.ones(3, 2),
        lambda: there(3).add_(ours),
        lambda: there(3).__setitem__(slice(2), ours[:2]),
    ):
        with pytest.raises(Mixed):
            act()
    with pytest.raises(TypeError, match="cpu"):
        there(3).numpy()
    assert (there(3) + torch.tensor(1.0)).tolist() == [2.0, 3.0, 4.0]  # a single number may come from anywhere


def test_results_are_those_of_main_memory_and_stay_there():
    x, y = there(3, 4), there(3, 4).cpu()
    assert x.device.type == "cuda"
    for act in (
        lambda a: torch.fft.irfft2(torch.fft.rfft2(a) * torch.fft.rfft2(a).conj(), s=a.shape),
        lambda a: a[0] @ a.T,
        lambda a: a.new_zeros(2, 3).index_add_(1, torch.zeros(4, dtype=torch.long, device=a.device), a[:2]),
        lambda a: torch.where(a > 3, a, 0.0).cumsum(0),
        lambda a: torch.linspace(0, 1, 4, device=a.device) * a,
        lambda a: torch.stack(list(a)).double().mean(dim=0),
    ):
        found = act(x)
        assert isinstance(found, OnGpu)
        torch.testing.assert_close(found.cpu(), act(y))


def test_changes_in_place_are_seen_by_all_views():
    x = there(2, 3)
    x[0] = 0.0
    x[1].add_(1.0)
    x[:, 2] = there(2)
    assert x.tolist() == [[0.0, 0.0, 1.0], [5.0, 6.0, 2.0]]


def test_gradients_come_back_from_there():
    leaf = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    (leaf.to("cuda") * there(3)).clamp_min(2.0).square().sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.tolist() == [0.0, 16.0, 54.0]
    on_gpu = there(3).requires_grad_()
    (slope,) = torch.autograd.grad(on_gpu.prod().cpu(), on_gpu)
    assert isinstance(slope, OnGpu)
    assert slope.tolist() == [6.0, 3.0, 2.0]
