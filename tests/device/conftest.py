"""The pretended device for every test in this folder, and the same map on it and on the CPU."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from aquaflow.mapping.mapper import Mapper
from aquaflow.render.contract import CPU
from tests.device.device_scenes import counted, mapped, without_kernels
from tests.pretended_allocator import DEFAULT_BYTES
from tests.pretended_device import PRETENDED, Device, pretended_device


@pytest.fixture(scope="module")
def kernels_off() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        without_kernels(patch)
        yield


@pytest.fixture(scope="module")
def device(kernels_off: None) -> Iterator[Device]:
    with pretended_device() as device:
        yield device


@pytest.fixture(scope="module")
def twins(device: Device) -> tuple[Mapper, Mapper]:
    """The same map on the CPU and on the device; tests look at them and change neither."""
    on_cpu = mapped(CPU)
    assert device.calls == 0
    began = counted()
    away = mapped(PRETENDED)
    assert device.named == counted() - began > 0
    return on_cpu, away


@pytest.fixture
def nothing_strays(device: Device) -> Iterator[None]:
    """Whatever a test does, tensors are moved by the named functions alone."""
    began, named = counted(), device.named
    yield
    assert not device.strays
    assert device.named - named == counted() - began


@pytest.fixture
def repaired(device: Device) -> Iterator[None]:
    """The test has a device that works to begin with, with memory enough."""
    _repair(device)
    yield
    _repair(device)


def _repair(device: Device) -> None:
    device.fails_at, device.lost = None, False
    device.memory.total = DEFAULT_BYTES
