"""How many threads may work: one for each core, however many are asked for.

More only wait for each other, and thousands of them stop the machine.
"""

from __future__ import annotations

import logging
import os

log = logging.getLogger(__name__)


def core_count() -> int:
    """Cores of this machine."""
    return os.cpu_count() or 1


def usable_threads(asked: int | None) -> int:
    """``asked``, or every core if None, and never more than there are; warns where it is less."""
    cores = core_count()
    if asked is None or asked <= cores:
        return asked or cores
    log.warning("note: %d threads were asked for; one for each of %d cores is used", asked, cores)
    return cores
