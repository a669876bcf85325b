"""A map whose device failed goes on on the CPU.

A device that is out of memory can still be read, and the map goes on as it is. One that is gone
cannot, nor can a map that the failure left half changed: then it goes on from its last copy on the
host. Views, poses and pictures live on the host anyway and are the newest ones in both cases; what
is lost is the optimisation since the copy, and the Gaussians inserted since. Corrections of
keyframes that came after the copy are made in it too.
"""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Mapping

from aquaflow.geometry.arrays import Arrays
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import Facts, deserialise, serialise
from aquaflow.render.contract import Renderer

log = logging.getLogger(__name__)

COPY_EVERY = 16
"""Views with which a map grows from one copy to the next. A copy of 150 000 Gaussians and their
optimiser is 25 MB; 16 views are one or two keyframes' worth of optimisation."""


class HostCopies:
    """The last copy of every map that is on a device; of a map on the CPU there is none."""

    def __init__(self) -> None:
        self._copies: dict[int, tuple[Facts, Arrays]] = {}
        self._moves: defaultdict[int, list[Mapping[int, Sim3]]] = defaultdict(list)
        """By map, the corrections since its copy."""
        self._grown: Counter[int] = Counter()

    def grow(self, number: int, mapper: Mapper) -> None:
        """Map ``number`` has grown by a view; now and then that is worth a copy."""
        if self._grown[number] % COPY_EVERY == 0:
            self.take(number, mapper)
        self._grown[number] += 1

    def take(self, number: int, mapper: Mapper) -> None:
        """Copy map ``number``."""
        if mapper.device.type != "cpu":
            self._copies[number] = serialise(mapper, optimiser=True)
            self._moves[number] = []

    def follow_moves(self, number: int, moves: Mapping[int, Sim3]) -> None:
        """Map ``number`` has followed its keyframes, and its copy is to follow too."""
        if number in self._copies and moves:
            self._moves[number].append(moves)

    def on_cpu(self, number: int, mapper: Mapper, renderer: Renderer, half_changed: bool) -> Mapper:
        """Map ``number`` on the CPU, with its optimiser: as it is, or as its last copy has it.

        ``half_changed``: the device failed while it moved the map, which is not to be read.
        """
        moved = self._from_copy(number, mapper, renderer) if half_changed else None
        if moved is None:
            try:
                state = serialise(mapper, optimiser=True)
                moved = deserialise(*state, renderer, mapper.failures)
            except Exception as error:  # the device is gone, or the map does not fit together
                log.warning("map %d cannot be read from its device: %s", number, error)
                moved = self._from_copy(number, mapper, renderer)
        moved = moved or Mapper(mapper.config, renderer, number, mapper.failures)
        _take_over(moved, mapper)
        moved.make_whole()
        return moved

    def _from_copy(self, number: int, mapper: Mapper, renderer: Renderer) -> Mapper | None:
        if number not in self._copies:
            return None
        copy = deserialise(*self._copies[number], renderer, mapper.failures)
        for moves in self._moves[number]:
            copy.move(moves)
        return copy


def _take_over(moved: Mapper, mapper: Mapper) -> None:
    """The views themselves, which tracking knows too, with what the copy knows of their light."""
    learned = {view.frame_index: view for view in moved.views}
    for view in mapper.views:
        view.begin_on(moved.device)
        known = learned.get(view.frame_index)
        if known is not None:
            view.log_gain, view.light, view.explained = known.log_gain, known.light, known.explained
    moved.views = mapper.views
    moved.scene.seen_nearest = mapper.scene.seen_nearest
