"""Find, build if need be, and load the shared library with the C++ kernels.

Tracking calls some of them with numpy arrays: this module loads no torch.
"""

from __future__ import annotations

import ctypes
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.native import build as native

_POINTER = ctypes.c_void_p
_INT = ctypes.c_int
_FLOAT = ctypes.c_float
_DOUBLE = ctypes.c_double
"""C types of the kernels' arguments and results."""
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "aq_constants": (None, [_POINTER]),
    "aq_context_new": (_POINTER, []),
    "aq_context_free": (None, [_POINTER]),
    "aq_forward": (_INT, [_POINTER] + [_INT] * 5 + [_POINTER] * 12),
    "aq_backward": (_INT, [_POINTER] * 15),
    "aq_stage_ms": (None, [_POINTER] * 2),
    "aq_photometric": (_INT, [_POINTER] * 4 + [_INT] * 2 + [_FLOAT, _INT] + [_POINTER] * 2),
    "aq_outlier_mask": (_INT, [_POINTER] * 3 + [_FLOAT] + [_INT] * 2 + [_POINTER]),
    "aq_range_loss": (_INT, [_POINTER] * 4 + [_FLOAT] + [_INT] * 2 + [_POINTER] * 2),
    "aq_compose_water": (_INT, [_POINTER] * 5 + [_INT] * 2 + [_POINTER] * 2),
    "aq_compose_water_backward": (_INT, [_POINTER] * 5 + [_INT] * 2 + [_POINTER] * 5),
    "aq_activate": (_INT, [_POINTER] * 5 + [_INT] * 2 + [_POINTER] * 3),
    "aq_activate_backward": (_INT, [_POINTER] * 5 + [_INT] * 2 + [_POINTER] * 9),
    "aq_decode_view": (_INT, [_POINTER, _INT] + [_POINTER] * 3),
    "aq_decode_view_backward": (_INT, [_POINTER, _INT, _POINTER]),
    "aq_check_flow": (_INT, [_POINTER] * 4 + [_INT] * 2 + [_FLOAT] * 3 + [_POINTER] * 2),
    "aq_fuse_depths": (_INT, [_POINTER]),
    "aq_fuse_ranges": (_INT, [_POINTER]),
    "aq_add_colours": (_INT, [_POINTER] * 2),
    "aq_add_information": (_INT, [_POINTER] * 2),
    "aq_pose_equations": (_INT, [_POINTER] * 3),
    "aq_anchor_errors": (_INT, [_POINTER] * 2),
    "aq_anchor_equations": (_INT, [_POINTER] * 2),
    "aq_project_rays": (_INT, [_POINTER, _INT]),
    "aq_search_descriptors": (_INT, [_POINTER, _INT]),
    "aq_refine_flow": (
        _INT,
        [_POINTER] * 3 + [_INT] * 2 + [_POINTER, _INT] * 2 + [_FLOAT] * 3 + [_POINTER],
    ),
    "aq_adam_step": (
        _INT,
        [_INT, _POINTER, _INT] + [_POINTER] * 2 + [_DOUBLE] * 2 + [_FLOAT, _POINTER] + [_INT] * 2,
    ),
}
"""Result and parameters of each function of the library."""
_COUNTING = {"aq_adam_step", "aq_fuse_depths"}
"""Functions whose result is a count; they need no memory of their own."""
_BUILD_LOCK = threading.Lock()
"""One thread builds; the others wait for its library."""

STAGES = ("project", "sort and bin", "blend", "blend backward", "project backward")
"""Stages of drawing and differentiating, in the order of ``aq_stage_ms``."""


class NativeUnavailableError(AquaFlowError):
    """No kernel library can be had here; the message says why and what to do."""


class Library:
    """The loaded kernels of one instruction set."""

    def __init__(self, path: Path, isa: str) -> None:
        self.isa = isa
        self.path = path
        self._dll = ctypes.CDLL(str(path))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(self._dll, name)
            function.restype = result
            function.argtypes = arguments

    def call(self, name: str, *arguments: object) -> int:
        """Run a kernel: the count that it returns, or 0; MemoryError when it ran out of memory."""
        status = int(getattr(self._dll, name)(*arguments))
        if name not in _COUNTING and status != 0:
            raise MemoryError(f"{name} ran out of memory")
        return status

    def new_context(self) -> int:
        """State of one forward pass; give it back with ``free_context``."""
        context = self._dll.aq_context_new()
        if not context:
            raise MemoryError("aq_context_new ran out of memory")
        return int(context)

    def free_context(self, context: int) -> None:
        """Give back what :meth:`new_context` made."""
        self._dll.aq_context_free(context)

    def stage_ms(self, context: int) -> list[float]:
        """Wall time of each of STAGES in the last passes of ``context``, milliseconds."""
        out = (ctypes.c_double * len(STAGES))()
        self._dll.aq_stage_ms(context, out)
        return list(out)

    def constants(self) -> list[float]:
        """The constants compiled in, in the order of ``aq_constants``."""
        out = (ctypes.c_double * 10)()
        self._dll.aq_constants(out)
        return list(out)


@lru_cache(maxsize=8)
def load_library(isa: str | None = None, directory: Path = native.NATIVE_DIR) -> Library:
    """The fastest library this processor runs, or the variant ``isa``; built first if out of date.

    Where the fastest cannot be had, the next one is taken. Raises NativeUnavailableError when none
    is there and none can be built.
    """
    supported = native.supported_isas()
    if not supported or (isa is not None and isa not in supported):
        raise NativeUnavailableError(
            f"This processor does not run the {isa or 'compiled'} kernels; "
            f"choose one of {', '.join(supported) or 'the torch renderers'}."
        )
    failures: list[NativeUnavailableError] = []
    for variant in supported if isa is None else (isa,):
        try:
            return _load_variant(variant, native.library_path(variant, directory))
        except NativeUnavailableError as error:
            failures.append(error)
    raise failures[0]


def _load_variant(isa: str, path: Path) -> Library:
    with _BUILD_LOCK:
        if not native.is_current(path):
            try:
                native.build(isa, path.parent)
            except native.BuildError as error:
                raise NativeUnavailableError(
                    f"The compiled CPU renderer ({path.name}) is missing or out of date and was "
                    f"not built: {error}."
                ) from error
    try:
        return Library(path, isa)
    except OSError as error:
        raise NativeUnavailableError(
            f"The compiled CPU renderer {path} does not load: {error}; "
            "delete it to have it built again."
        ) from error


@lru_cache(maxsize=1)
def library_or_none() -> Library | None:
    """The fastest library, or None where ``select_renderer`` announces the torch fallback.

    Looked for once in a process: a compiler that fails is not asked again at every step.
    """
    try:
        return load_library()
    except NativeUnavailableError:
        return None
