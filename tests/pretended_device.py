"""A pretended accelerator: tensors with real values that are on another device.

CI has no GPU. A ``Pretended`` tensor holds a tensor of the CPU and reports the device ``PRETENDED``
instead. As on CUDA it does not mix with tensors of the CPU (those of no dimension excepted), has no
numpy array and no address, and comes back by ``.cpu()``; autograd and optimisers work. Stricter
than CUDA, it takes no index and no list from the CPU. The device counts what crosses to it and
back and what makes the CPU wait for it; and it can fail like a real one: out of memory once, or
whenever its memory is full (pretended_allocator.py), or lost for good.

Torch's own name for a device without data, "meta", is borrowed for it: autograd runs such a
device's gradients in the caller's thread, and needs no driver. Factories and moves with this device
work only within :class:`PretendedDevice`, for the thread that entered it.
"""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

import aquaflow
from tests.pretended_allocator import Allocator, asked_through_torch

PRETENDED = torch.device("meta")
OWN = str(Path(aquaflow.__file__).parent)
TRANSFERS = str(Path(OWN, "render", "transfers.py"))
"""Folder of our modules, and the one that may move tensors."""
aten: Any = torch.ops.aten


class LostError(RuntimeError):
    """What torch raises for every call once a GPU has failed, in its words."""

    def __init__(self) -> None:
        super().__init__("CUDA error: unspecified launch failure")


@dataclass
class Device:
    """The state of the device, for all threads."""

    moved_in: int = 0
    moved_out: int = 0
    """Tensors that crossed."""
    named: int = 0
    """Of them, those moved by the named functions of ``TRANSFERS``."""
    strays: Counter[str] = field(default_factory=Counter)
    """Those that another of our modules moved: file and function. The others are the test's."""
    read: int = 0
    """Single numbers that Python asked for."""
    waits: Counter[str] = field(default_factory=Counter)
    """Places of ours where the CPU waited for the device: for such a number, for tensors that
    crossed, and for results whose size depends on values, such as indices of True."""
    memory: Allocator = field(default_factory=Allocator)
    calls: int = 0
    """Operations on the device."""
    fails_at: int | None = None
    """The call that fails."""
    lost: bool = False
    """From then on every call fails."""

    def cross(self, moved_in: bool, waits: bool = True) -> None:
        """Count a tensor that moves, and whose doing it was."""
        self.moved_in += moved_in
        self.moved_out += not moved_in
        place = _place()
        if place.startswith(TRANSFERS):
            self.named += 1
        elif place:
            self.strays[place] += 1
        if waits:
            self.waits[place] += 1

    def call(self) -> None:
        """Count an operation, which may fail."""
        self.calls += 1
        if self.lost and self.fails_at is not None and self.calls >= self.fails_at:
            raise LostError
        if self.calls == self.fails_at:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB.")


DEVICE = Device()


def _place() -> str:
    """File and function of ours that is at work; nothing if it is the test itself."""
    frame = sys._getframe()
    while frame is not None and not frame.f_code.co_filename.startswith(OWN):
        frame = frame.f_back  # type: ignore[assignment]
    return "" if frame is None else f"{frame.f_code.co_filename}: {frame.f_code.co_name}"


class Pretended(torch.Tensor):
    """A tensor on the pretended device."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> Pretended:
        made: Pretended = torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=PRETENDED,
            requires_grad=inner.requires_grad,
        )
        return made

    def __init__(self, inner: torch.Tensor) -> None:
        self.inner, self._block = inner, DEVICE.memory.block(inner)

    def __repr__(self, **_: Any) -> str:
        return f"Pretended({self.inner!r})"

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise TypeError("the pretended device's memory cannot be read by the CPU; use .cpu() first")

    numpy = __array__ = tolist = data_ptr = untyped_storage = _refuse

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        return run(func, args, kwargs or {})


class PretendedDevice(TorchDispatchMode):
    """Within it this thread can make tensors on the device, and move tensors to it."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        return run(func, args, kwargs or {})


def run(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """The operation on the values; its result is where it would be with a real device."""
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    away = [x for x in tensors if isinstance(x, Pretended)]
    target = kwargs.get("device")
    to_device = bool(away) if target is None else torch.device(target) == PRETENDED
    if not away and not to_device:
        return func(*args, **kwargs)
    DEVICE.call()
    _check_devices(func, tensors)
    args, kwargs = tree_map(lambda x: x.inner if isinstance(x, Pretended) else x, (args, kwargs))
    if target is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    found = func(*args, **kwargs)
    if func._schema.is_mutable and func._schema.name.endswith("_"):
        found = tensors[0]
    elif to_device:
        found = tree_map(_pretended, found)
    _count(func, tensors, kwargs, to_device)
    return found


def _pretended(value: Any) -> Any:
    plain = isinstance(value, torch.Tensor) and not isinstance(value, Pretended)
    return Pretended(value) if plain else value


def _check_devices(func: Any, tensors: list[torch.Tensor]) -> None:
    """Raise as CUDA does for tensors of several devices."""
    here = [x for x in tensors if not isinstance(x, Pretended)]
    if any(x.is_meta for x in here):
        raise RuntimeError(f"{func}: a tensor made on the device outside of PretendedDevice")
    is_move = func in {aten.copy_.default, aten._to_copy.default}
    if not is_move and len(here) < len(tensors) and any(x.dim() > 0 for x in here):
        raise RuntimeError(f"{func}: tensors on the pretended device and on the CPU")


ANSWERS = {
    aten._local_scalar_dense.default, aten.equal.default, aten.nonzero.default,
    aten.masked_select.default, aten.bincount.default, aten.unique_consecutive.default,
    aten._unique2.default, aten.repeat_interleave.Tensor,
}  # fmt: skip
"""For their result, or its size, CUDA waits; what gets its output's size does not."""
INDEXED = {aten.index.Tensor, aten.index_put_.default, aten.index_put.default}


def _is_sized_by_values(of: torch.Tensor, *others: torch.Tensor) -> bool:
    """True for an index by a mask; one that is filled with one number needs no indices."""
    masks = [each for each in others if each.dtype in {torch.bool, torch.uint8}]
    filled = len(others) == 2 and others[1].numel() == 1  # the mask, and what is put there
    return bool(masks) and not filled


def _count(func: Any, tensors: list[torch.Tensor], kwargs: dict[str, Any], to_device: bool) -> None:
    DEVICE.read += func is aten._local_scalar_dense.default
    answers = func in ANSWERS and kwargs.get("output_size") is None
    if answers or (func in INDEXED and _is_sized_by_values(*tensors)):
        DEVICE.waits[_place()] += 1
    elif func is aten._to_copy.default:
        if isinstance(tensors[0], Pretended) != to_device:
            DEVICE.cross(to_device, waits=not kwargs.get("non_blocking", False))
    elif func is aten.copy_.default:
        to, of = (isinstance(x, Pretended) for x in tensors)
        if to != of:
            DEVICE.cross(to)


@contextmanager
def pretended_device() -> Iterator[Device]:
    """A fresh device for this thread and for every thread that starts meanwhile."""
    DEVICE.__init__()  # type: ignore[misc]
    plain_run = threading.Thread.run

    def run_there(thread: threading.Thread) -> None:
        with PretendedDevice():
            plain_run(thread)

    threading.Thread.run = run_there  # type: ignore[method-assign]
    try:
        with PretendedDevice(), asked_through_torch(DEVICE.memory):
            yield DEVICE
    finally:
        threading.Thread.run = plain_run  # type: ignore[method-assign]
