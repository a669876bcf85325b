"""The pretended device behaves as a real one does where placement goes wrong."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

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
