"""The platform tag of a wheel that holds the compiled kernels: manylinux, of the compiler's target.

Standard library only, as ``build.py``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

GLIBC_OF_GLIBCXX = {19: 17, 22: 24, 24: 28, 28: 31, 29: 34, 30: 35, 32: 38, 33: 39}
"""n of a symbol's version GLIBCXX_3.4.n -> N of manylinux_2_N, the oldest that admits it (as
auditwheel knows them): a system with that glibc has that libstdc++ too."""
OLDEST_GLIBC = 17
"""manylinux_2_17, the oldest that both x86_64 and aarch64 have."""

NEEDED_GLIBC = re.compile(rb"\0GLIBC_2\.(\d+)(?:\.\d+)?(?=\0)")
NEEDED_GLIBCXX = re.compile(rb"\0GLIBCXX_3\.4(?:\.(\d+))?(?=\0)")
"""Versions of symbols, as they stand in the string table of a shared library."""


def needed_glibc(library: bytes) -> int | None:
    """Minor version of the oldest glibc 2.N that loads ``library``; None if it needs none.

    Raises ValueError if it needs a libstdc++ that no manylinux tag is known to admit.
    """
    found = [int(minor) for minor in NEEDED_GLIBC.findall(library)]
    if not found:
        return None
    newest = max((int(minor or 0) for minor in NEEDED_GLIBCXX.findall(library)), default=0)
    admitting = [glibc for glibcxx, glibc in GLIBC_OF_GLIBCXX.items() if glibcxx >= newest]
    if not admitting:
        raise ValueError(f"GLIBCXX_3.4.{newest} is in no manylinux tag that is known here")
    return max(OLDEST_GLIBC, *found, min(admitting))


def platform_tag(machine: str, libraries: Iterable[Path]) -> str:
    """manylinux_2_N_MACHINE for these libraries; linux_MACHINE where no such tag fits.

    That is before they are compiled, and with another C library than glibc.
    """
    try:
        needs = [needed_glibc(library.read_bytes()) for library in libraries]
    except ValueError:
        return f"linux_{machine}"
    versions = [glibc for glibc in needs if glibc is not None]
    if not versions or len(versions) < len(needs):
        return f"linux_{machine}"
    return f"manylinux_2_{max(versions)}_{machine}"
