"""What is left of a device's memory, as torch tells it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from aquaflow.render.contract import CPU
from aquaflow.render.gsplat import usable_share
from tests.pretended_allocator import Allocator, asked_through_torch

CUDA = torch.device("cuda")


def gone(device: object) -> None:
    raise RuntimeError("CUDA error: unspecified launch failure")


def test_what_torch_holds_without_using_it_is_left() -> None:
    memory = Allocator()
    memory.total, memory.reserved, memory.allocated = 1000, 900, 300
    with asked_through_torch(memory):
        assert usable_share(CUDA) == pytest.approx(0.7)
        memory.empty_cache()
        assert usable_share(CUDA) == pytest.approx(0.7)
        memory.reserved = memory.allocated = 990
        assert usable_share(CUDA) == pytest.approx(0.01)


def test_only_a_device_with_memory_of_its_own_runs_short_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert usable_share(CPU) is None
    with asked_through_torch(Allocator()):
        assert usable_share(CUDA) == 1.0
        shared = SimpleNamespace(is_integrated=True)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: shared)
        assert usable_share(CUDA) is None


def test_a_device_that_is_gone_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with asked_through_torch(Allocator()):
        monkeypatch.setattr(torch.cuda, "mem_get_info", gone)
        assert usable_share(CUDA) is None
