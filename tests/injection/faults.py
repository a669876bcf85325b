"""What is done to a call: the ways in which a library may fail."""

from __future__ import annotations

import errno
import os
import signal
from enum import Enum
from typing import Any

import numpy as np


class Kind(str, Enum):
    """What happens in place of a call, or to what it returned."""

    RAISE = "raise"
    """The library's own exception; EIO of a file."""
    NAN = "nan"
    """All numbers of the result are NaN."""
    INTERRUPT = "interrupt"
    """SIGINT comes while the call is made."""
    MEMORY = "memory"
    """MemoryError."""
    FULL = "full disk"
    """ENOSPC of a file that is written."""


def error_of(library: str) -> Exception:
    """What ``library`` raises when it fails for reasons of its own."""
    said = "injected fault"
    if library == "cv2":
        import cv2

        return cv2.error(f"OpenCV(injected) {said}")
    if library == "numpy.linalg":
        return np.linalg.LinAlgError(said)
    if library == "scipy":
        return ValueError(said)
    if library == "onnxruntime":
        from onnxruntime.capi.onnxruntime_pybind11_state import Fail

        return Fail(said)  # type: ignore[no-any-return]
    if library == "file":
        return OSError(errno.EIO, os.strerror(errno.EIO))
    return RuntimeError(said)


def strike(kind: Kind, library: str) -> None:
    """Before the call.

    Raises:
        Exception: what ``kind`` says of ``library``.
    """
    if kind is Kind.RAISE:
        raise error_of(library)
    if kind is Kind.MEMORY:
        raise MemoryError("injected fault")
    if kind is Kind.FULL:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    if kind is Kind.INTERRUPT:
        os.kill(os.getpid(), signal.SIGINT)


def without_numbers(result: Any) -> Any:
    """``result`` with NaN for each of its floating-point numbers; the same object without any."""
    import torch

    if isinstance(result, float):
        return type(result)(np.nan)
    if isinstance(result, np.ndarray) and np.issubdtype(result.dtype, np.floating):
        return np.full_like(result, np.nan)
    if isinstance(result, torch.nn.Parameter):
        return torch.nn.Parameter(torch.full_like(result, float("nan")))
    if (
        isinstance(result, torch.Tensor)
        and result.is_floating_point()
        and result.layout is torch.strided
    ):
        return (
            result * float("nan") if result.requires_grad else torch.full_like(result, float("nan"))
        )
    if type(result) in (tuple, list):
        parts = [without_numbers(part) for part in result]
        changed = any(new is not old for new, old in zip(parts, result, strict=True))
        return type(result)(parts) if changed else result
    return result
