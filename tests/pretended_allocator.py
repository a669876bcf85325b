"""The pretended device's memory, as torch's caching allocator of CUDA has it.

A block is taken for every storage and freed with the last tensor on it; what was freed stays
reserved until it is given back to the driver. A block that does not fit is refused as torch does.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

DEFAULT_BYTES = 1 << 40
"""Memory of a device that is never full."""


class Allocator:
    """Counts bytes; the values themselves are in the CPU's memory."""

    def __init__(self) -> None:
        self.total = DEFAULT_BYTES
        self.allocated = self.reserved = self.peak = 0
        self.refused = self.emptied = 0
        """Blocks that did not fit; how often idle blocks were given back."""
        self._tensors: dict[int, int] = {}
        """By a block's address, how many tensors are on it."""

    def block(self, values: torch.Tensor) -> Block | None:
        """What a tensor on the device holds while it lives; None for one without values.

        Raises:
            torch.OutOfMemoryError: there is no room for it.
        """
        storage = values.untyped_storage()
        if storage.nbytes() == 0:
            return None
        block = Block(self, storage.data_ptr(), storage.nbytes())
        tensors = self._tensors.get(block.address, 0)
        if tensors == 0:
            self._take(block.size)
        self._tensors[block.address] = tensors + 1
        block.taken = True
        return block

    def _take(self, size: int) -> None:
        if self.allocated + size > self.total:
            self.refused += 1
            raise torch.OutOfMemoryError(f"CUDA out of memory. Tried to allocate {size} bytes.")
        self.allocated += size
        self.reserved = max(self.reserved, self.allocated)
        self.peak = max(self.peak, self.allocated)

    def free(self, block: Block) -> None:
        self._tensors[block.address] -= 1
        if self._tensors[block.address] == 0:
            del self._tensors[block.address]
            self.allocated -= block.size

    def empty_cache(self) -> None:
        self.reserved = self.allocated
        self.emptied += 1


class Block:
    """One tensor's share of a block."""

    __slots__ = ("address", "allocator", "size", "taken")

    def __init__(self, allocator: Allocator, address: int, size: int) -> None:
        self.allocator, self.address, self.size, self.taken = allocator, address, size, False

    def __del__(self) -> None:
        if self.taken:
            self.allocator.free(self)


@contextmanager
def asked_through_torch(allocator: Allocator) -> Iterator[None]:
    """Within it, torch.cuda answers for this allocator."""
    answers = {
        "get_device_properties": lambda device: SimpleNamespace(is_integrated=False),
        "mem_get_info": lambda device: (allocator.total - allocator.reserved, allocator.total),
        "memory_reserved": lambda device: allocator.reserved,
        "memory_allocated": lambda device: allocator.allocated,
        "empty_cache": allocator.empty_cache,
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, answer in answers.items():
            patch.setattr(torch.cuda, name, answer)
        yield
