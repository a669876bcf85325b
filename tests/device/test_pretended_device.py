"""The pretended device behaves as a real one does where placement goes wrong."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from tests.pretended_allocator import DEFAULT_BYTES
from tests.pretended_device import PRETENDED, Device, LostError, Pretended, pretended_device


@pytest.fixture
def device() -> Iterator[Device]:
    with pretended_device() as device:
        yield device


def test_values_go_there_and_come_back(device: Device) -> None:
    there = torch.arange(6.0).view(2, 3).to(PRETENDED)
    assert there.device == PRETENDED
    assert torch.equal((2.0 * there).cpu(), torch.tensor([[0.0, 2.0, 4.0], [6.0, 8.0, 10.0]]))
    assert (device.moved_in, device.moved_out) == (1, 1)


@pytest.mark.parametrize(
    "mix",
    [
        lambda there: there + torch.ones(3),
        lambda there: torch.where(there > 0, torch.ones(3), there),
        lambda there: there[torch.tensor([0, 1])],
        lambda there: torch.ones(3)[there > 0],
        lambda there: torch.cat([there, torch.ones(3)]),
        lambda there: torch.empty(3, device="cpu").add_(there),
    ],
)
def test_tensors_of_two_devices_do_not_mix(device: Device, mix: Callable[[Tensor], Tensor]) -> None:
    with pytest.raises(RuntimeError, match="on the pretended device and on the CPU"):
        mix(torch.ones(3, device=PRETENDED))


@pytest.mark.parametrize("name", ["numpy", "__array__", "tolist", "data_ptr", "untyped_storage"])
def test_its_memory_is_not_read_from_the_cpu(device: Device, name: str) -> None:
    with pytest.raises(TypeError, match=r"use \.cpu\(\)"):
        getattr(torch.ones(3, device=PRETENDED), name)()


def test_a_list_makes_no_tensor_on_it_unnoticed(device: Device) -> None:
    with pytest.raises(RuntimeError, match="outside of PretendedDevice"):
        torch.ones(2, device=PRETENDED) + torch.tensor([1.0, 2.0], device=PRETENDED)


def test_gradients_and_adam_are_those_of_the_cpu(device: Device) -> None:
    def fitted(where: torch.device) -> Tensor:
        weight = torch.linspace(0.1, 1.0, 6).view(2, 3).to(where).requires_grad_()
        adam = torch.optim.Adam([weight], lr=0.1)
        for _ in range(3):
            adam.zero_grad()
            (weight @ weight.mT).square().sum().backward()
            assert type(weight.grad) is type(weight.detach())
            adam.step()
        return weight.detach().cpu()

    assert torch.equal(fitted(PRETENDED), fitted(torch.device("cpu")))


def test_assignments_reach_the_values(device: Device) -> None:
    there = torch.zeros(4, device=PRETENDED)
    there[1] = 3.0
    there[there > 2.0] += 1.0
    there[2:].fill_(7.0)
    assert there.cpu().tolist() == [0.0, 4.0, 7.0, 7.0]


def test_single_numbers_are_counted_as_read(device: Device) -> None:
    assert bool(torch.ones(2, device=PRETENDED).sum() == 2.0)
    assert (device.read, device.moved_in, device.moved_out) == (1, 0, 0)


def test_threads_that_start_meanwhile_have_it_too(device: Device) -> None:
    made: list[Tensor] = []
    thread = threading.Thread(target=lambda: made.append(torch.ones(2, device=PRETENDED) + 1.0))
    thread.start()
    thread.join()
    assert isinstance(made[0], Pretended)


def test_it_runs_out_of_memory_once(device: Device) -> None:
    there = torch.ones(2, device=PRETENDED)
    device.fails_at = device.calls + 1
    with pytest.raises(torch.OutOfMemoryError):
        there + 1.0
    assert (there + 1.0).cpu().tolist() == [2.0, 2.0]


def test_once_lost_it_stays_lost(device: Device) -> None:
    there = torch.ones(2, device=PRETENDED)
    device.fails_at, device.lost = device.calls + 1, True
    for _ in range(2):
        with pytest.raises(LostError):
            there.cpu()


def test_its_memory_is_taken_by_a_storage_until_its_last_tensor_is_gone(device: Device) -> None:
    before = device.memory.allocated
    there = torch.ones(100, device=PRETENDED)
    part = there[10:20]
    there.add_(1.0)
    assert device.memory.allocated == before + 400
    del there
    assert device.memory.allocated == before + 400
    del part
    assert device.memory.allocated == before
    assert device.memory.reserved >= before + 400


def test_what_does_not_fit_its_memory_is_refused_and_what_fits_is_not(device: Device) -> None:
    device.memory.total = device.memory.allocated + 600
    try:
        there = torch.ones(100, device=PRETENDED)
        with pytest.raises(torch.OutOfMemoryError, match="Tried to allocate 400 bytes"):
            there + 1.0
        assert there.add_(1.0).cpu()[0] == 2.0
    finally:
        device.memory.total = DEFAULT_BYTES


@pytest.mark.parametrize(
    ("ask", "waits"),
    [
        (lambda there: float(there[0]), 1),
        (lambda there: there.cpu(), 1),
        (lambda there: there[there > 0.0], 1),
        (torch.nonzero, 1),
        (lambda there: torch.equal(there, there), 1),
        (lambda there: there.repeat_interleave((there > 0.0).long()), 1),
        (lambda there: there.repeat_interleave((there > 0.0).long(), output_size=3), 0),
        (lambda there: there.index_select(0, (there > 9.0).long()), 0),
        (lambda there: torch.where(there > 0.0, there, 0.0).sum(), 0),
        (lambda there: there.masked_fill_(there > 9.0, 1.0), 0),
    ],
)
def test_what_makes_the_cpu_wait_is_counted(
    device: Device, ask: Callable[[Tensor], object], waits: int
) -> None:
    there = torch.ones(3, device=PRETENDED)
    before = sum(device.waits.values())
    ask(there)
    assert sum(device.waits.values()) == before + waits
