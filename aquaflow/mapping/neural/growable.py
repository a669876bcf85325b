"""Tensors whose rows come and go while the map grows."""

from __future__ import annotations

from torch import Tensor


class GrowingRows:
    """A tensor that takes rows at its end, at a cost that grows with the new rows alone."""

    def __init__(
        self,
        rows: Tensor,  # [N, ...]
    ) -> None:
        self._buffer, self._count = rows.clone(), len(rows)

    @property
    def rows(self) -> Tensor:
        """[N, ...] contiguous; the same memory until the next ``extend`` or ``keep``."""
        return self._buffer[: self._count]

    def extend(
        self,
        new: Tensor,  # [M, ...]
    ) -> None:
        """Append rows; the buffer doubles when it is full."""
        count = self._count + len(new)
        if count > len(self._buffer):
            larger = self._buffer.new_empty(2 * count, *self._buffer.shape[1:])
            larger[: self._count] = self.rows
            self._buffer = larger
        self._buffer[self._count : count] = new
        self._count = count

    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the rows where ``mask`` is False."""
        self._buffer = self.rows[mask]
        self._count = len(self._buffer)
