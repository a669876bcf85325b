"""Pictures that a device counted and never delivered."""

from __future__ import annotations

SEQUENCE_BITS = 32
"""Width of V4L2's counter, which then starts at 0; the OAK's is wider and never gets there."""

MAX_GAP = 9000
"""A larger gap (5 minutes at 30 pictures/s) is a counter that started anew, not a loss."""


class SequenceGaps:
    """Follows a device's counter while the device stays open."""

    def __init__(self) -> None:
        self._last: int | None = None

    def before(self, sequence: int | None) -> int | None:
        """How many were lost just before this picture; None if it is the last one again."""
        last, self._last = self._last, sequence
        if last is None or sequence is None:
            return 0
        step = (sequence - last) % (1 << SEQUENCE_BITS)
        if step == 0:
            return None
        return step - 1 if step <= MAX_GAP else 0
