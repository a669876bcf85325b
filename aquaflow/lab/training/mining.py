"""Which pictures make pairs: those that share 30 % of their back-projected pixels (Sec. 3.1)."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.errors import InputError
from aquaflow.lab.training.correspondences import overlap
from aquaflow.lab.training.datasets.fitting import view_of
from aquaflow.lab.training.datasets.posed import Posed
from aquaflow.lab.training.datasets.posed import Sequence as Scene
from aquaflow.lab.training.datasets.validity import moved
from aquaflow.lab.training.pairs import Pair, ViewBatch

LEAST_OVERLAP = 0.3
"""Of the valid pixels, seen by both (paper, Sec. 3.1)."""
MOST_OVERLAP = 0.95
"""Beyond, both pictures show the same from the same place, and the pair teaches nothing."""
GAPS = (1, 2, 3, 5, 8, 13, 21, 34, 55)
"""Pictures between the two of a pair."""
LEAST_VALID = 0.1
"""Share of a picture's pixels that must be valid."""
MINING_PX = (128, 96)
"""Width and height at which overlap is measured: its error is a hundredth of the picture."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class PairIndex:
    """Where a pair is."""

    sequence: int
    a: int
    b: int
    overlap: float


def mine(scenes: Sequence[Scene], progress: Progress) -> list[PairIndex]:
    """Every pair of the gaps that overlaps enough; a pair that cannot be read is skipped.

    Along a sequence a gap is not widened beyond the first at which the overlap is lost.
    """
    found: list[PairIndex] = []
    for number, scene in enumerate(scenes):
        views = _Small(scene)
        for a in range(len(scene)):
            found += _pairs_from(number, a, views)
            views.forget(a)
        progress("pairs", number + 1, len(scenes))
    return found


def _pairs_from(number: int, a: int, views: _Small) -> list[PairIndex]:
    found = []
    for gap in GAPS:
        if a + gap >= len(views):
            break
        first, second = views[a], views[a + gap]
        if first is None or second is None:
            continue
        shared = float(overlap(Pair(first, second))[0])
        if shared < LEAST_OVERLAP:
            break
        if shared <= MOST_OVERLAP:
            found.append(PairIndex(number, a, a + gap, round(shared, 3)))
    return found


class _Small:
    """Small views of a sequence, each read once and kept while pairs may need it."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._views: dict[int, ViewBatch | None] = {}

    def __len__(self) -> int:
        return len(self._scene)

    def __getitem__(self, index: int) -> ViewBatch | None:
        """None where it cannot be read, or shows too little."""
        if index not in self._views:
            try:
                view = view_of(self._scene[index], *MINING_PX)
            except InputError:
                self._views[index] = None
            else:
                enough = float(view.valid.float().mean()) >= LEAST_VALID
                self._views[index] = view if enough else None
        return self._views[index]

    def forget(self, index: int) -> None:
        self._views.pop(index, None)


@dataclass(frozen=True)
class MinedPairs:
    """Pairs as batches, at the size that the network takes."""

    scenes: Sequence[Scene]
    index: Sequence[PairIndex]
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.index)

    def pair(self, numbers: Sequence[int]) -> Pair:
        """A batch; the first view of each pair is at the origin, and nothing that moved is valid.

        Poses go in as float64 and out as float32 only after the world's far origin was left.
        """
        pairs = [self._one(self.index[number]) for number in numbers]
        return Pair(_batch([pair.a for pair in pairs]), _batch([pair.b for pair in pairs]))

    def _one(self, index: PairIndex) -> Pair:
        scene = self.scenes[index.sequence]
        first, second = scene[index.a], scene[index.b]
        T_aw = np.linalg.inv(first.T_wc)
        a = self._view(first, T_aw)
        b = self._view(second, T_aw)
        return Pair(_without(a, moved(a, b)), _without(b, moved(b, a)))

    def _view(
        self,
        posed: Posed,
        T_rw: npt.NDArray[np.floating],  # [4, 4] world to reference
    ) -> ViewBatch:
        return view_of(posed, self.width, self.height, T_rw)


def save_index(pairs: Sequence[PairIndex], path: Path) -> None:
    """One line of JSON for each."""
    path.write_text("".join(json.dumps(asdict(pair)) + "\n" for pair in pairs))


def load_index(path: Path) -> list[PairIndex]:
    """What ``save_index`` wrote.

    Raises:
        InputError: it is something else.
    """
    try:
        return [PairIndex(**json.loads(line)) for line in path.read_text().splitlines()]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path} is no list of pairs; delete it, and they are found again") from (
            error
        )


def _without(
    view: ViewBatch,
    mask: torch.Tensor,  # [B, H, W] bool
) -> ViewBatch:
    return ViewBatch(view.image, view.depth, view.K, view.T_wc, view.valid & ~mask)


def _batch(views: Sequence[ViewBatch]) -> ViewBatch:
    names = ("image", "depth", "K", "T_wc", "valid")
    return ViewBatch(*(torch.cat([getattr(view, name) for view in views]) for name in names))
