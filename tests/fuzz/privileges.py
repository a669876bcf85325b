"""A process of root becomes one of ``nobody`` that may still read, but write only what is its own.

Without this, ``--readme /dev/null`` or ``--out /`` would be tried out on the machine itself.
"""

from __future__ import annotations

import ctypes
import os
import struct
from pathlib import Path

NOBODY = 65534
CAP_DAC_READ_SEARCH = 2
"""Interpreters often lie below /root, which nobody may enter."""
CAPABILITY_VERSION_3 = 0x20080522
PR_SET_DUMPABLE, PR_SET_KEEPCAPS, PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE = 4, 8, 47, 2


def own_to_nobody(*folders: Path) -> None:
    """Where we are root, let ``nobody`` write in ``folders`` and below."""
    if os.geteuid() != 0:
        return
    for folder in folders:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, NOBODY, NOBODY, follow_symlinks=False)


def become_nobody() -> None:
    """Give up being root; nothing for other users."""
    if os.geteuid() != 0:
        return
    libc = ctypes.CDLL(None)
    libc.prctl(PR_SET_KEEPCAPS, 1, 0, 0, 0)
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)
    header = struct.pack("=Ii", CAPABILITY_VERSION_3, 0)
    reading = 1 << CAP_DAC_READ_SEARCH
    # Effective, permitted, inheritable, each in two halves. Where a container withholds the
    # capability, the call changes nothing, and what is kept ends with the next line.
    if libc.capset(header, struct.pack("=6I", reading, reading, reading, 0, 0, 0)) != 0:
        libc.capset(header, bytes(24))
    libc.prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, CAP_DAC_READ_SEARCH, 0, 0)
    # The kernel hides /proc/self of a process that changed its user.
    libc.prctl(PR_SET_DUMPABLE, 1, 0, 0, 0)
