"""Far parts of a map wait in files, so that a map may grow with the ground that a dive covers.

A tile is what one keyframe inserted: its Gaussians, with their rows of the optimiser. Where a map
has no room left for what is seen now, the tiles that are farthest from there leave memory; they
come back, bit for bit, when a keyframe looks at their ground again. Corrections of keyframes that
wait are kept with them, and made when they come back.

Ground is told apart by spheres: that of a keyframe around what it saw, and that of a tile around
its Gaussians. A view may be learned from while no waiting tile lies in its keyframe's sphere: what
is missing would be taken for bare ground.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree

from aquaflow.base.storage.spill import SUFFIX, Spill
from aquaflow.geometry.arrays import Arrays, of_sim3, to_sim3
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians import GaussianMap, move_gaussians
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.views import View

Array: TypeAlias = npt.NDArray[np.float64]

KEPT_SHARE = 0.7
"""Of the room in memory that stays in use when tiles leave: they leave some thirty at a time."""
REACH = 2.0
"""Radius of a tile over the RMS distance of its Gaussians from their mean: 1.7 reaches the corners
of a square."""


@dataclass(frozen=True)
class Sphere:
    """Where ground lies, in the map's world."""

    centre: Array
    """[3]"""
    radius: float

    def moved(self, move: Sim3) -> Sphere:
        """The same after a correction."""
        return Sphere(move.apply(self.centre), self.radius * move.scale)


@dataclass(frozen=True)
class WaitingTile:
    """What is known of a tile while its Gaussians are in a file."""

    number: int
    """Of its file."""
    count: int
    """Gaussians."""
    sphere: Sphere
    move: Sim3 | None = None
    """The corrections since it left; None: none."""


class TileFiles:
    """The files of all waiting tiles of a dive: each is written once, under a number of its own.

    A checkpoint names the tiles that waited when it was taken. Once there is one, files are removed
    only when two later ones no longer name them.
    """

    def __init__(self, work: Path | None) -> None:
        self._folder = None if work is None else work / "tiles"
        self._spill = Spill[Arrays](self._folder, 0, dict, lambda number, arrays: arrays)
        self._next = 0
        self._fresh: list[int] = []
        """Numbers of files since they were last saved."""
        self._returned: list[int] = []
        """Numbers since the last checkpoint."""
        self._named: list[list[int]] | None = None
        """Numbers returned before it, that the last two may name; None: no checkpoint was taken."""

    @property
    def usable(self) -> bool:
        """False without a folder: nothing can leave memory."""
        return self._folder is not None

    def write(
        self,
        arrays: Arrays,  # by name, of any shape
    ) -> int:
        """The number of a new file; where there is no room on the disk it stays in memory."""
        number, self._next = self._next, self._next + 1
        self._spill[number] = arrays
        self._fresh.append(number)
        return number

    def read(self, number: int) -> Arrays:
        """What was written.

        Raises:
            InputError: the file is gone or damaged.
        """
        return self._spill[number]

    def take_back(self, number: int) -> None:
        """Its content is in memory again."""
        self._returned.append(number)
        if self._named is None:
            for each in self._returned:
                del self._spill[each]
            self._returned = []

    def checkpoint(self) -> None:
        """One is being taken."""
        self._named = [*(self._named or []), self._returned]
        self._returned = []
        while len(self._named) > 2:
            for number in self._named.pop(0):
                del self._spill[number]

    def restore(self, number: int) -> bool:
        """Make a file of an earlier run available; False if it was lost."""
        if self._named is None and self._folder is not None:
            there = [
                int(path.stem) for path in self._folder.glob("*.arrays") if path.stem.isdigit()
            ]
            self._next = max([self._next, *(number + 1 for number in there)])
            self._named = []
        return self._spill.restore(number)

    def save(self) -> list[Path]:
        """Write what the disk had no room for; the files that are new since the last call.

        Raises:
            OSError: something could not be written.
        """
        if self._folder is None:
            return []
        self._spill.save()
        fresh, self._fresh = self._fresh, []
        return [self._folder / f"{number:06d}{SUFFIX}" for number in fresh]

    def close(self, keep: bool = False) -> None:
        """Remove the files, or keep them."""
        self._spill.close(keep)


class Tiles:
    """The tiles of one map: which wait, and on what ground each keyframe has looked."""

    def __init__(self, files: TileFiles | None = None) -> None:
        self.files = files or TileFiles(None)
        self.waiting: dict[int, WaitingTile] = {}
        """By keyframe."""
        self.seen: dict[int, Sphere] = {}
        """What each keyframe saw, by its number."""

    def __len__(self) -> int:
        """Gaussians that wait."""
        return sum(tile.count for tile in self.waiting.values())

    def look(self, view: View, range_: float) -> Sphere:
        """Note that a keyframe's ``view`` saw ground at this range, map units; where that is."""
        camera = view.camera
        aside = np.hypot(camera.width / camera.fx, camera.height / camera.fy) / 2.0
        ahead = view.T_wc.R @ np.array([0.0, 0.0, range_])
        self.seen[view.keyframe] = Sphere(view.T_wc.t + ahead, float(range_ * aside))
        return self.seen[view.keyframe]

    def near(self, sphere: Sphere) -> list[int]:
        """Keyframes whose waiting tile reaches into ``sphere``, in their order."""
        if not self.waiting:
            return []
        keyframes = sorted(self.waiting)
        apart = _distances([self.waiting[number].sphere for number in keyframes], sphere)
        return [keyframe for keyframe, gap in zip(keyframes, apart, strict=True) if gap < 0.0]

    def far(self, gaussians: GaussianMap, sphere: Sphere, least: int) -> list[int]:
        """Keyframes whose Gaussians may leave so that ``least`` of them do, the farthest from
        ``sphere`` first, none that reaches into it; fewer where there are not so many."""
        owners, spheres, counts = _spheres(gaussians)
        apart = _distances(spheres, sphere)
        chosen, left = list[int](), 0
        for i in np.argsort(-apart, kind="stable").tolist():
            if left >= least or apart[i] <= 0.0:
                break
            if owners[i] not in self.waiting:  # a keyframe has one file
                chosen.append(int(owners[i]))
                left += int(counts[i])
        return chosen

    def around(
        self, gaussians: GaussianMap, sphere: Sphere, room: int
    ) -> tuple[list[int], list[int]]:
        """Keyframes whose Gaussians have to leave and to come, so that those nearest to ``sphere``
        are in memory: all that reach into it, and as many more as there is ``room`` for."""
        owners, spheres, counts = _spheres(gaussians)
        inside, out = owners.tolist(), sorted(self.waiting)
        apart = _distances([*spheres, *(self.waiting[n].sphere for n in out)], sphere)
        order = np.argsort(apart, kind="stable")
        sizes = np.concatenate([counts, [self.waiting[n].count for n in out]])[order]
        near = order[(np.cumsum(sizes) <= room) | (apart[order] < 0.0)]
        chosen = {[*inside, *out][i] for i in near.tolist()}
        leaving = [n for n in inside if n not in chosen and n not in self.waiting]
        return leaving, [n for n in out if n in chosen]

    def leave(
        self,
        gaussians: GaussianMap,
        adam: SelectiveAdam,
        keyframes: Sequence[int],
        seen: Mapping[str, torch.Tensor],  # [N, ...] each
    ) -> torch.Tensor:
        """Write the Gaussians of ``keyframes``, and how they are ``seen``, ``z`` the range; [N]
        bool, those that are to stay in memory."""
        owners, spheres, _ = _spheres(gaussians)
        found = dict(zip(owners.tolist(), spheres, strict=True))
        stay = torch.ones(len(gaussians), dtype=torch.bool)
        for keyframe in keyframes:
            mine = gaussians.keyframes == keyframe
            arrays = {"steps": adam.steps[mine].numpy()}
            arrays |= {name: each[mine].numpy() for name, each in seen.items()}
            for name, tensor in gaussians.parameters.items():
                arrays[name] = tensor[mine].numpy()
                arrays[f"first.{name}"] = adam.first_moments[name][mine].numpy()
                arrays[f"second.{name}"] = adam.second_moments[name][mine].numpy()
            number = self.files.write(arrays)
            self.waiting[keyframe] = WaitingTile(number, int(mine.sum()), found[keyframe])
            stay &= ~mine
        return stay

    def bring(self, keyframe: int) -> tuple[GaussianMap, Arrays]:
        """The tile's Gaussians, moved as their keyframe was meanwhile, and all its arrays; they no
        longer wait.

        Raises:
            InputError: its file is gone or damaged; it does not wait any more.
        """
        tile = self.waiting.pop(keyframe)
        arrays = self.files.read(tile.number)
        self.files.take_back(tile.number)
        gaussians = GaussianMap()
        new = {name: torch.from_numpy(arrays[name]) for name in gaussians.NAMES}
        gaussians.extend(new, keyframe)
        if tile.move is not None:
            move_gaussians(gaussians, {keyframe: tile.move})
            if "z" in arrays:  # not in files written before 2026-11-29
                arrays["z"] = arrays["z"] * np.float32(tile.move.scale)
        return gaussians, arrays

    def move(self, moves: Mapping[int, Sim3]) -> None:
        """Keyframes have moved, and what they saw with them."""
        for keyframe in self.seen.keys() & moves.keys():
            self.seen[keyframe] = self.seen[keyframe].moved(moves[keyframe])
        for keyframe in self.waiting.keys() & moves.keys():
            tile, move = self.waiting[keyframe], moves[keyframe]
            whole = move if tile.move is None else (move @ tile.move).if_finite()
            self.waiting[keyframe] = replace(tile, sphere=tile.sphere.moved(move), move=whole)

    def open_keyframes(self) -> set[int]:
        """Keyframes in whose ground no tile waits."""
        if not self.waiting:
            return set(self.seen)
        centres = np.stack([tile.sphere.centre for tile in self.waiting.values()])
        radii = np.array([tile.sphere.radius for tile in self.waiting.values()])
        seen = np.stack([sphere.centre for sphere in self.seen.values()])
        # Most are told by the nearest tile alone.
        apart, nearest = KDTree(centres).query(seen)
        perhaps = np.asarray(apart - radii[nearest])
        found = set[int]()
        for (number, sphere), gap in zip(self.seen.items(), perhaps.tolist(), strict=True):
            if gap >= sphere.radius and _gaps(centres, radii, sphere).min() >= 0.0:
                found.add(number)
        return found

    def absorb(self, other: Tiles) -> None:
        """Take over those of another map, already moved into this one's world."""
        self.waiting |= other.waiting
        self.seen |= other.seen

    # --- checkpoints --------------------------------------------------------------------------

    def serialise(self) -> Arrays:
        """What a checkpoint needs to know; the files stay where they are."""
        waiting = sorted(self.waiting)
        tiles = [self.waiting[number] for number in waiting]
        spheres = [*(tile.sphere for tile in tiles), *self.seen.values()]
        moves = [tile.move or Sim3.identity() for tile in tiles]
        return {
            "spheres": np.array([[*s.centre, s.radius] for s in spheres]).reshape(-1, 4),
            "waiting": np.array(
                [(n, t.number, t.count, t.move is not None) for n, t in zip(waiting, tiles)],  # noqa: B905
                np.int64,
            ).reshape(-1, 4),
            "moves": of_sim3(moves),
            "seen": np.array(list(self.seen), np.int64),
        }

    def restore(
        self,
        arrays: Arrays,  # as from serialise
    ) -> int:
        """Take up what a checkpoint has; the number of Gaussians whose file was lost."""
        spheres = [Sphere(row[:3].copy(), float(row[3])) for row in arrays["spheres"]]
        rows = zip(arrays["waiting"].tolist(), arrays["moves"], spheres, strict=False)
        lost = 0
        for (keyframe, number, count, moved), pose, sphere in rows:
            if self.files.restore(number):
                move = to_sim3(pose) if moved else None
                self.waiting[keyframe] = WaitingTile(number, count, sphere, move)
            else:
                lost += count
        seen = spheres[len(arrays["waiting"]) :]
        self.seen = dict(zip(arrays["seen"].tolist(), seen, strict=True))
        return lost


def _spheres(
    gaussians: GaussianMap,
) -> tuple[npt.NDArray[np.int64], list[Sphere], npt.NDArray[np.int64]]:
    """Of each keyframe's Gaussians: numbers [K], spheres, and how many [K]."""
    owners, rows, counts = np.unique(
        gaussians.keyframes.numpy(), return_inverse=True, return_counts=True
    )
    means = gaussians.means.detach().numpy().astype(np.float64)

    def mean_of(values: Array) -> Array:
        return np.bincount(rows, values, len(owners)) / counts

    centres = np.stack([mean_of(column) for column in means.T], axis=-1)
    squared = mean_of(((means - centres[rows]) ** 2).sum(axis=1))
    radii = REACH * np.sqrt(squared)
    spheres = [Sphere(c, r) for c, r in zip(centres, radii.tolist(), strict=True)]
    return owners, spheres, counts


def _distances(spheres: Sequence[Sphere], of: Sphere) -> Array:
    """[N] between the surfaces of ``spheres`` and that ``of`` one; negative where they overlap."""
    centres = np.array([sphere.centre for sphere in spheres]).reshape(-1, 3)
    radii = np.array([sphere.radius for sphere in spheres])
    return _gaps(centres, radii, of)


def _gaps(
    centres: Array,  # [N, 3]
    radii: Array,  # [N]
    of: Sphere,
) -> Array:
    """[N] as :func:`_distances`."""
    return np.asarray(np.linalg.norm(centres - of.centre, axis=1) - radii - of.radius)
