"""Work on the maps of a dive, which live on one device until that fails.

Nothing else knows of that: work on a map is asked for by :meth:`DeviceWork.do` or
:meth:`DeviceWork.change`. Where the device's memory is full, work that may be left out is, and the
maps stay where they are. Other work, such as a correction, and all work that fails because the
device is gone, is done again on the CPU, where all maps go on.
"""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from functools import partial
from typing import Concatenate, ParamSpec

from aquaflow.base.errors import first_line, is_device_failure, is_device_full
from aquaflow.base.errors.failures import Failures
from aquaflow.config import Config
from aquaflow.geometry.arrays import Arrays
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import Facts, deserialise, serialise
from aquaflow.mapping.tiles import TileFiles
from aquaflow.render.contract import Renderer
from aquaflow.render.cpu import cpu_renderer
from aquaflow.render.gsplat import give_back_after

# --------------------------------------------------------------------------------------------------
# A map whose device failed goes on on the CPU.
#
# A device that is out of memory can still be read, and the map goes on as it is. One that is gone
# cannot, nor can a map that the failure left half changed: then it goes on from its last copy on
# the host. Views, poses and pictures live on the host anyway and are the newest ones in both cases;
# what is lost is the optimisation since the copy, and the Gaussians inserted since. Corrections of
# keyframes that came after the copy are made in it too.

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


log = logging.getLogger(__name__)


# --------------------------------------------------------------------------------------------------
# Work on the maps, on the device as long as it goes.

P = ParamSpec("P")

MOST_LEFT_OUT = 10
"""Times in a row that a full device may cost a kind of work: the map is too large for it then."""

MAY_BE_LEFT_OUT = {"copy of the map", "insertion", "optimisation", "voxels in metres"}
"""Work without which a map goes on: it leaves a whole map, whatever it raises."""


class DeviceWork:
    """The maps by sub-map, and the device they are on."""

    def __init__(
        self,
        config: Config,
        renderer: Renderer,
        failures: Failures,
        tiles: TileFiles | None = None,
    ) -> None:
        self.renderer, self._tiles = renderer, tiles
        self.mappers: dict[int, Mapper] = {}
        self._copies = HostCopies()
        self._config, self._failures = config, failures
        self._left_out: Counter[str] = Counter()
        """By stage, how often in a row."""

    def mapper(self, number: int) -> Mapper:
        """The map of a sub-map, made when first asked for."""
        if number not in self.mappers:
            seed = self._config.seed + number
            self.mappers[number] = Mapper(
                self._config.mapping, self.renderer, seed, self._failures, self._tiles
            )
        return self.mappers[number]

    def do(
        self,
        stage: str,
        number: int,
        frame: int | None,
        work: Callable[Concatenate[Mapper, P], object],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> bool:
        """Do ``work`` on map ``number``, with these arguments after the map, which is another one
        once its device is lost; what it raises is counted, for ``frame``, and False returned."""
        may_be_left_out = stage in MAY_BE_LEFT_OUT
        attempt = partial(self._attempt, stage, number, frame, work, *args, **kwargs)
        error = attempt()
        if error is not None and self._is_of_device(error):
            full = is_device_full(error)
            if full:
                give_back_after(error, self.renderer.device)
            if full and may_be_left_out and self._left_out[stage] < MOST_LEFT_OUT:
                self._left_out[stage] += 1
            else:
                self.leave_device(first_line(error))
                error = attempt()
        if error is None:
            self._left_out[stage] = 0
        elif may_be_left_out:
            self.mend(number)
        return error is None

    def change(
        self,
        stage: str,
        number: int,
        work: Callable[Concatenate[Mapper, P], object],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> bool:
        """A change that is made wholly, and once: a map that a failing device left half changed
        goes on from its copy, which is of before."""
        attempt = partial(self._attempt, stage, number, None, work, *args, **kwargs)
        error = attempt()
        if error is not None and self._is_of_device(error):
            self.leave_device(first_line(error), half_changed=number)
            error = attempt()
        if error is not None:
            self.mend(number)
        return error is None

    def move(self, number: int, moves: Mapping[int, Sim3]) -> None:
        """Map ``number`` follows its keyframes, and so does its copy."""
        if self.change("correction of the map", number, Mapper.move, moves):
            self._copies.follow_moves(number, moves)

    def copy_grown(self, number: int) -> None:
        """Map ``number`` has grown by a view; now and then it is copied."""
        self.do("copy of the map", number, None, lambda mapper: self._copies.grow(number, mapper))

    def copy(self, number: int) -> None:
        """Copy map ``number``, as it would go on without its device."""
        self.do("copy of the map", number, None, lambda mapper: self._copies.take(number, mapper))

    def leave_device(self, why: str, half_changed: int | None = None) -> None:
        """From here on all maps are drawn and optimised on the CPU."""
        log.warning(
            "%s failed (%s); the map goes on on the CPU, more slowly", self.renderer.device, why
        )
        self.renderer = cpu_renderer(self._config.threads)
        for number, mapper in self.mappers.items():
            half = number == half_changed
            self.mappers[number] = self._copies.on_cpu(number, mapper, self.renderer, half)
        self._copies = HostCopies()

    def mend(self, number: int) -> None:
        """After a failure: the map is whole, wherever it is."""
        try:
            self.mapper(number).make_whole()
        except Exception as error:
            if not self._is_of_device(error):
                raise
            self.leave_device(first_line(error))  # where every map is made whole

    def _attempt(
        self,
        stage: str,
        number: int,
        frame: int | None,
        work: Callable[Concatenate[Mapper, P], object],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Exception | None:
        """What ``work`` raised, if it was contained or the device's."""
        try:
            with self._failures.contain(stage, frame) as run:
                work(self.mapper(number), *args, **kwargs)
        except Exception as error:
            if not self._is_of_device(error):
                raise
            self._failures.record(stage, error, frame)
            return error
        return run.error

    def _is_of_device(self, error: Exception) -> bool:
        return self.renderer.device.type != "cpu" and is_device_failure(error)
