"""The system calls of V4L2, as a protocol that a simulated kernel also speaks."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import select
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Argument: TypeAlias = ctypes.Structure | ctypes.c_int32


class KernelInterface(Protocol):
    """What a driver asks of the kernel; every call raises OSError as the kernel does."""

    def open(self, path: str) -> int: ...

    def close(self, fd: int) -> None: ...

    def ioctl(self, fd: int, request: int, argument: Argument) -> None:
        """Fill or read ``argument`` in place; may be interrupted (EINTR)."""
        ...

    def mmap(self, fd: int, length: int, offset: int) -> npt.NDArray[np.uint8]:
        """The device's memory itself, [length]; unmapped when the last view of it goes."""
        ...

    def wait(self, fd: int, timeout_s: float) -> bool:
        """True when there is a picture or an error to fetch."""
        ...


class Kernel:
    """The real one."""

    def open(self, path: str) -> int:
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, fd: int) -> None:
        os.close(fd)

    def ioctl(self, fd: int, request: int, argument: Argument) -> None:
        import fcntl

        fcntl.ioctl(fd, request, argument)  # type: ignore[call-overload]

    def mmap(self, fd: int, length: int, offset: int) -> npt.NDArray[np.uint8]:
        mapped = mmap.mmap(
            fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset
        )
        return np.frombuffer(mapped, np.uint8)

    def wait(self, fd: int, timeout_s: float) -> bool:
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        return bool(poll.poll(timeout_s * 1e3))


def call(system: KernelInterface, fd: int, request: int, argument: Argument) -> None:
    """An ioctl that no signal ends: repeated while interrupted."""
    while True:
        try:
            system.ioctl(fd, request, argument)
            return
        except InterruptedError:
            continue


def supports(system: KernelInterface, fd: int, request: int, argument: Argument) -> bool:
    """An ioctl that a driver may lack; False if it does.

    Raises:
        OSError: the device is gone.
    """
    try:
        call(system, fd, request, argument)
    except OSError as error:
        if error.errno in {errno.ENODEV, errno.ENXIO}:
            raise
        return False
    return True
