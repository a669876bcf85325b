"""A whole map lives on the device of its renderer, and comes out as on the CPU."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from tests.device.device_scenes import assert_alike, counted, mapped, on_host, without_kernels
from tests.pretended_device import PRETENDED, Device, pretended_device

CPU = torch.device("cpu")


@pytest.fixture
def device() -> Iterator[Device]:
    with pretended_device() as device:
        yield device


@pytest.fixture(autouse=True)
def torch_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    without_kernels(monkeypatch)


def test_a_map_grown_on_a_device_is_that_of_the_cpu(device: Device) -> None:
    wanted = mapped(CPU)
    began = counted()
    assert device.calls == 0
    got = mapped(PRETENDED)
    assert not device.strays  # nothing is moved outside of the named places
    assert device.crossings == counted() - began > 0
    assert got.steps == wanted.steps > 20
    assert_alike(on_host(got), on_host(wanted))
