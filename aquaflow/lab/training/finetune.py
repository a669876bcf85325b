"""Fine-tuning of the paper's network on pairs of the data sets (paper, Sec. 3.1 and 4).

Points stay metric: no scale is normalised away. The learning rate rises over 4 of 30 epochs and
falls along a cosine; every step has 128 pairs, in batches that memory allows, shared out among any
number of processes. An epoch takes from each data set as the paper does.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.lab.networks.mast3r.network import Mast3r
from aquaflow.lab.training.datasets.chaining import chain
from aquaflow.lab.training.datasets.colmap import colmap
from aquaflow.lab.training.datasets.posed import Frames, Posed, nothing_in, read_image
from aquaflow.lab.training.datasets.simulated import mimir, tartanair
from aquaflow.lab.training.datasets.uwstereo import uwstereo
from aquaflow.lab.training.losses import Losses, LossWeights, pair_loss
from aquaflow.lab.training.mining import MinedPairs, PairIndex, load_index, mine, save_index
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.scene import rotation
from aquaflow.lab.training.pair_generator.stored_pairs import STRIDE
from aquaflow.lab.training.pairs import Pair, ViewBatch
from aquaflow.lab.training.trainer import Progress, Schedule, TrainingPlan, TrainingProcess, train

# --------------------------------------------------------------------------------------------------
# FLSea-stereo (Randall and Treibitz, 2023): real dives with depth from photogrammetry.
#
# ``rock_garden1/{imgs/LFT/*, imgs/RGT/*, depth/LFT/*.tif}``: the left camera's pictures and its
# depth in metres, whose names begin alike; 0 or NaN where unknown. The left camera goes into
# ``camera.yaml`` at the root, in AquaFlow's format, once converted from the set's MATLAB files.
# Poses do not come with it: they follow from keypoints and depth (chaining.py).

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Suffixes of pictures."""


def flsea(root: Path) -> list[Frames]:
    """Stretches of every dive in which each picture's pose follows from the one before.

    Raises:
        InputError: there is none, or no calibration.
    """
    folders = sorted(path.parents[1] for path in root.rglob("depth/LFT"))
    if not folders:
        raise nothing_in(root, "FLSea-stereo dive (depth/LFT)")
    camera = load_camera(root / "camera.yaml")
    stretches = []
    for folder in folders:
        frames = _dive(folder, root, camera)
        stretches += chain(frames)
    return stretches


def _dive(folder: Path, root: Path, camera: CameraModel) -> Frames:
    depths = sorted((folder / "depth" / "LFT").glob("*.tif*"))
    names = [path.stem for path in depths]
    readers = []
    for image in sorted((folder / "imgs" / "LFT").iterdir()):
        at = bisect_left(names, image.stem)
        if image.suffix.lower() not in PICTURES or at == len(names):
            continue
        if names[at].startswith(image.stem):
            readers.append(partial(_frame, image, depths[at], camera))
    return Frames(str(folder.relative_to(root)), tuple(readers))


def _frame(image: Path, depth: Path, camera: CameraModel) -> Posed:
    """Undistorted; its pose is not known yet."""
    picture, metres = read_image(image), cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    if metres is None or metres.shape != picture.shape[:2]:
        raise InputError(f"{depth} does not fit its picture; unpack the data set again")
    height, width = picture.shape[:2]
    sized = camera.resize(width, height)
    depth_m = np.nan_to_num(np.asarray(metres, dtype=np.float32), posinf=0.0, neginf=0.0)
    if sized.is_distorted:
        maps = _undistorting(sized)
        picture = np.asarray(cv2.remap(picture, *maps, cv2.INTER_CUBIC), dtype=np.uint8)
        depth_m = np.asarray(cv2.remap(depth_m, *maps, cv2.INTER_NEAREST), dtype=np.float32)
    return Posed(picture, depth_m, sized.K, np.eye(4))


def _undistorting(camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """Maps to a pinhole camera of the same K."""
    K, D, size = camera.K, np.array(camera.distortion), (camera.width, camera.height)
    K[:2, 2] -= 0.5
    undistorting = (
        cv2.fisheye.initUndistortRectifyMap
        if camera.distortion_model == "fisheye"
        else cv2.initUndistortRectifyMap
    )
    u, v = undistorting(K, D, np.eye(3), K, size, cv2.CV_32FC1)
    return u, v


READERS: dict[str, Callable[[Path], list[Frames]]] = {
    "tartanair": tartanair,
    "mimir": mimir,
    "uwstereo": uwstereo,
    "flsea": flsea,
    "colmap": colmap,
}
"""Data sets that can be named, and what reads them."""

INDEX, WEIGHTS = "pairs.jsonl", "mast3r.pth"
"""Files of a run: the pairs that were found, the weights of the network."""
STRETCH, HELD_OUT_EVERY = 60, 50
"""Of so many stretches of so many pictures, one is never trained on. It is longer than the gap
between a pair's pictures: neighbouring pairs show the same."""
HELD_OUT = 64
"""Of its pairs at most are looked at; more only take longer."""


@dataclass(frozen=True)
class FineTuningSettings:
    """Defaults are the paper's."""

    width: int = 512
    """px, a multiple of 16"""
    height: int = 384
    """px, a multiple of 16"""
    epochs: int = 30
    warm_up_epochs: int = 4
    batch: int = 2
    """Pairs that a process computes at once."""
    effective_batch: int = 128
    """Pairs of a step, on all processes together: the paper's 16 GPUs, 4 batches of 2 on each."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises ArgumentError where a step's batches do not come out even."""
        if self.effective_batch % self.batch:
            raise ArgumentError(
                f"{self.effective_batch} pairs of a step cannot be cut into batches of "
                f"{self.batch}; give a --batch that divides --effective-batch"
            )

    @property
    def batches(self) -> int:
        """Of a step, on all processes together."""
        return self.effective_batch // self.batch


class PairSource(Protocol):
    """Pairs by number."""

    @property
    def index(self) -> Sequence[PairIndex]:
        """Which pictures make each pair."""
        ...

    @property
    def kinds(self) -> Sequence[str]:
        """Data set of each pair."""
        ...

    def pair(
        self,
        numbers: Sequence[int],
        zooms: Tensor | None = None,  # [B, 2] of either view, at least 1; None: 1
    ) -> Pair:
        """A batch."""
        ...


class FineTuning:
    """The task for the trainer: batches of pairs, the paper's loss, held-out pairs."""

    def __init__(
        self,
        network: Mast3r,
        pairs: PairSource,
        settings: FineTuningSettings,
        process: TrainingProcess,
    ) -> None:
        """Raises InputError where there are too few pairs for one batch."""
        self.network = network.to(process.device)
        self._pairs, self._settings, self._process = pairs, settings, process
        held_out: list[int] = []
        by_kind: dict[str, list[int]] = {}
        for number, (pair, kind) in enumerate(zip(pairs.index, pairs.kinds, strict=True)):
            unseen = [is_held_out(pair.sequence, picture) for picture in (pair.a, pair.b)]
            if all(unseen):
                held_out.append(number)
            elif not any(unseen):
                by_kind.setdefault(kind, []).append(number)
        self._held_out = held_out[:: len(held_out) // HELD_OUT + 1]
        self._order = BalancedOrder(by_kind, settings.seed)
        if self._order.length < settings.batch:
            raise InputError(
                f"{self._order.length} pairs are too few for a batch of {settings.batch}; "
                "give more --data"
            )
        self._weights = LossWeights()

    @property
    def batches_per_epoch(self) -> int:
        """Of all processes together; the rest of an epoch is left out, another one each time."""
        return self._order.length // self._settings.batch

    def loss(self, batch: int) -> tuple[Tensor, dict[str, float]]:
        """Loss of batch number ``batch``, whose pairs are varied."""
        numbers, draw = self.numbers(batch), Draw(self._settings.seed * STRIDE + batch)
        zooms = draw.uniform(len(numbers), 2, low=1.0, high=ZOOM)
        losses = self._losses(vary(draw, self._pairs.pair(numbers, zooms)), draw)
        return losses.total, _terms(losses)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Means over the held-out pairs; nothing where there are too few pairs to hold any out."""
        self.network.eval()
        draws = ((n, Draw(self._settings.seed)) for n in self._held_out)
        rows = [_terms(self._losses(self._pairs.pair([n]), draw)) for n, draw in draws]
        return {
            f"held_out_{name}": sum(row[name] for row in rows) / len(rows)
            for name in (rows[0] if rows else ())
        }

    def _losses(self, pair: Pair, draw: Draw) -> Losses:
        device = self._process.device
        pair = pair.to(device)
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            a, b = self.network(pair.a.image, pair.b.image)
        return pair_loss(pair, a, b, self._weights, draw.generator)

    def numbers(self, batch: int) -> list[int]:
        """The pairs of batch number ``batch``."""
        epoch, place = divmod(batch, self.batches_per_epoch)
        first = place * self._settings.batch
        return self._order.epoch(epoch)[first : first + self._settings.batch]


def is_held_out(scene: int, picture: int) -> bool:
    """Whether the picture of that number in that scene is never trained on."""
    return (scene + picture // STRETCH) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1


def fine_tune(
    network: Mast3r,
    pairs: PairSource,
    out: Path,
    settings: FineTuningSettings,
    process: TrainingProcess,
    progress: Progress,
) -> list[dict[str, float]]:
    """Train, and write ``mast3r.pth``, which `aquaflow lab prior export mast3r` reads.

    Raises:
        InputError: too few pairs, or ``out`` holds the checkpoint of another network.
    """
    task = FineTuning(network, pairs, settings, process)
    history = train(task, plan_of(task.batches_per_epoch, settings), out, progress, process)
    if process.leads:
        torch.save({"model": network.state_dict()}, out / WEIGHTS)
    return history


def plan_of(batches_per_epoch: int, settings: FineTuningSettings) -> TrainingPlan:
    """The paper's learning rate over as many steps as the pairs make."""
    steps_per_epoch = max(1, batches_per_epoch // settings.batches)
    schedule = Schedule(
        steps=settings.epochs * steps_per_epoch, warm_up=settings.warm_up_epochs * steps_per_epoch
    )
    return TrainingPlan(schedule, batches=settings.batches)


# --------------------------------------------------------------------------------------------------
# Which pairs an epoch shows: from each data set as many as in the paper.

PAPER_PAIRS = {
    "tartanair": 76_387,
    "mimir": 44_721,
    "uwstereo": 26_611,
    "flsea": 6_576,
    "colmap": 69_978,
}
"""Of an epoch (paper, table of the training pairs); ``colmap`` stands for sweet-corals."""


def epoch_counts(available: Mapping[str, int]) -> dict[str, int]:
    """Pairs of an epoch from each data set.

    They are in the paper's proportions, and in all as many as there are, at most as in the paper. A
    set that has fewer than its share shows some twice, one that has more shows others next time.
    """
    wanted = {kind: PAPER_PAIRS.get(kind, count) for kind, count in available.items()}
    scale = min(1.0, sum(available.values()) / max(sum(wanted.values()), 1))
    return {kind: max(1, round(scale * count)) for kind, count in wanted.items()}


class BalancedOrder:
    """The pairs of every epoch in an order of its own; each of a set is as often shown."""

    def __init__(self, by_kind: Mapping[str, Sequence[int]], seed: int) -> None:
        """``by_kind``: numbers of the pairs of each data set."""
        self._by_kind, self._seed = by_kind, seed
        self._counts = epoch_counts({kind: len(pairs) for kind, pairs in by_kind.items()})
        self.length = sum(self._counts.values())
        self._last: tuple[int, list[int]] = (-1, [])

    def epoch(self, number: int) -> list[int]:
        """The pairs of an epoch, in order."""
        if self._last[0] != number:
            shown: list[int] = []
            for kind, count in self._counts.items():
                shown += self._stretch(kind, number * count, count)
            self._last = (number, [shown[i] for i in self._shuffle(len(shown), number)])
        return self._last[1]

    def _stretch(self, kind: str, first: int, count: int) -> list[int]:
        """``count`` of a set's pairs from place ``first`` of its shuffles, put end to end."""
        pairs = self._by_kind[kind]
        found: list[int] = []
        while len(found) < count:
            shuffle, place = divmod(first + len(found), len(pairs))
            order = self._shuffle(len(pairs), shuffle)[place:]
            found += [pairs[i] for i in order[: count - len(found)]]
        return found

    def _shuffle(self, count: int, number: int) -> list[int]:
        generator = torch.Generator().manual_seed(self._seed * STRIDE + number)
        return torch.randperm(count, generator=generator).tolist()


# --------------------------------------------------------------------------------------------------
# How a pair varies each time that it is shown: zoom, order, mirror image and colours.
#
# The paper says nothing of it; of colours, these are the ranges that MASt3R's authors publish for
# their training. Points stay metric: a zoom changes the focal length, a mirror image the scene.

ZOOM = 1.25
"""Most of a view: beyond 1.4, two views that share 30 % could share nothing."""
BRIGHTNESS = CONTRAST = SATURATION = 0.5
"""Most that their factors differ from 1."""
HUE = 0.1
"""Most of a full turn about the grey axis."""
LUMA = (0.299, 0.587, 0.114)
"""Of red, green and blue (ITU-R BT.601)."""


def vary(draw: Draw, pair: Pair) -> Pair:
    """The pair, in either order, it or its mirror image, each view with colours of its own."""
    if bool(draw.chance(0.5)):
        pair = pair.swap()
    if bool(draw.chance(0.5)):
        pair = Pair(mirror(pair.a), mirror(pair.b))
    a, b = (replace(view, image=recolour(draw, view.image)) for view in (pair.a, pair.b))
    return Pair(a, b)


def mirror(view: ViewBatch) -> ViewBatch:
    """The view of the scene's mirror image, left and right exchanged."""
    K, flip = view.K.clone(), torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0])).to(view.T_wc)
    K[:, 0, 2] = view.image.shape[-1] - K[:, 0, 2]
    T_wc = flip @ view.T_wc @ flip
    return ViewBatch(view.image.flip(-1), view.depth.flip(-1), K, T_wc, view.valid.flip(-1))


def recolour(
    draw: Draw,
    image: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 3, H, W] another brightness, contrast, saturation and hue for each picture."""

    def factor(most: float) -> Tensor:
        return draw.uniform(len(image), 1, 1, 1, low=1.0 - most, high=1.0 + most)

    image = (image * factor(BRIGHTNESS)).clamp(0.0, 1.0)
    mean = _grey(image).mean(dim=(2, 3), keepdim=True)
    image = torch.lerp(mean, image, factor(CONTRAST)).clamp(0.0, 1.0)
    image = torch.lerp(_grey(image), image, factor(SATURATION))
    turn = 2.0 * math.pi * draw.uniform(len(image), 1, low=-HUE, high=HUE)
    R = rotation(turn.expand(-1, 3) / math.sqrt(3.0))
    return torch.einsum("bij,bjhw->bihw", R, image).clamp(0.0, 1.0)


def _grey(
    image: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 1, H, W]"""
    return (image * image.new_tensor(LUMA)[:, None, None]).sum(1, keepdim=True)


# --------------------------------------------------------------------------------------------------
# From folders to pairs.


def read_data(specs: Sequence[str]) -> list[Frames]:
    """Every sequence of data sets given as KIND=FOLDER.

    Raises:
        ArgumentError: a kind is unknown.
        InputError: a folder does not hold that data set.
    """
    sequences = []
    for spec in specs:
        kind, _, folder = spec.partition("=")
        if kind not in READERS or not folder:
            raise ArgumentError(
                f"'{spec}' is no data set; give KIND=FOLDER, KIND one of {', '.join(READERS)}"
            )
        sequences += [replace(frames, kind=kind) for frames in READERS[kind](Path(folder))]
    return sequences


def mine_pairs(
    sequences: Sequence[Frames],
    out: Path,
    settings: FineTuningSettings,
    process: TrainingProcess,
    progress: Progress,
) -> MinedPairs:
    """The pairs of ``out``'s list, which the process that leads makes if it is not there.

    Raises:
        InputError: no pair overlaps enough, or the list is damaged.
    """
    path = out / INDEX
    if process.leads and not path.is_file():
        out.mkdir(parents=True, exist_ok=True)
        save_index(mine(sequences, progress), path)
    process.wait()
    index = load_index(path)
    if not index:
        raise InputError("no two pictures of --data overlap by 30 %; are depths and poses right?")
    return MinedPairs(sequences, index, settings.width, settings.height)


def _terms(losses: Losses) -> dict[str, float]:
    return {"points": float(losses.points.detach()), "match": float(losses.match.detach())}
