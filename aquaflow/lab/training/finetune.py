"""Fine-tuning of the paper's network on pairs of the data sets (paper, Sec. 3.1 and 4).

Points stay metric: no scale is normalised away. The learning rate rises over 4 of 30 epochs and
falls along a cosine; every step sums the gradients of 4 batches of 2 pairs on each GPU.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.lab.networks.mast3r.network import Mast3r, ViewGeometry
from aquaflow.lab.training.datasets.chaining import chain
from aquaflow.lab.training.datasets.colmap import colmap
from aquaflow.lab.training.datasets.posed import Frames, Posed, nothing_in, read_image
from aquaflow.lab.training.datasets.simulated import mimir, tartanair
from aquaflow.lab.training.datasets.uwstereo import uwstereo
from aquaflow.lab.training.losses import Losses, LossWeights, pair_loss
from aquaflow.lab.training.mining import MinedPairs, load_index, mine, save_index
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
HELD_OUT_EVERY = 50
"""Of so many pairs one is never trained on."""
HELD_OUT = 64
"""Of them at most are looked at; more only take longer."""


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
    """Pairs of a batch, on each GPU."""
    accumulate: int = 4
    """Batches of a step, on each GPU."""
    seed: int = 0


class FineTuning:
    """The task for the trainer: batches of pairs, the paper's loss, held-out pairs."""

    def __init__(
        self,
        network: Mast3r,
        pairs: MinedPairs,
        settings: FineTuningSettings,
        process: TrainingProcess,
    ) -> None:
        """Raises InputError where there are too few pairs for one batch of every process."""
        self.network = network.to(process.device)
        self._pairs, self._settings, self._process = pairs, settings, process
        numbers = range(len(pairs))
        held_out = [n for n in numbers if n % HELD_OUT_EVERY == HELD_OUT_EVERY - 1]
        self._held_out = held_out[:HELD_OUT]
        self._trained = [n for n in numbers if n % HELD_OUT_EVERY != HELD_OUT_EVERY - 1]
        if len(self._trained) < settings.batch * process.count:
            raise InputError(
                f"{len(self._trained)} pairs are too few for {process.count} processes with "
                f"batches of {settings.batch}; give more --data"
            )
        self._weights = LossWeights()

    @property
    def batches_per_epoch(self) -> int:
        """Number of batches of each process; the rest of an epoch is left out, another one each
        time."""
        return len(self._trained) // (self._settings.batch * self._process.count)

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss of this process's batch number ``step``."""
        losses = self._losses(self._numbers(step), self._settings.seed + step)
        return losses.total, _terms(losses)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Means over the held-out pairs; nothing where there are too few pairs to hold any out."""
        self.network.eval()
        rows = [_terms(self._losses([number], self._settings.seed)) for number in self._held_out]
        return {
            f"held_out_{name}": sum(row[name] for row in rows) / len(rows)
            for name in (rows[0] if rows else ())
        }

    def _losses(self, numbers: Sequence[int], seed: int) -> Losses:
        device = self._process.device
        pair = self._pairs.pair(numbers).to(device)
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            a, b = self.network(pair.a.image, pair.b.image)
        first, second = (ViewGeometry(*(x.float() for x in view)) for view in (a, b))
        generator = torch.Generator().manual_seed(seed)
        return pair_loss(pair, first, second, self._weights, generator)

    def _numbers(self, step: int) -> list[int]:
        """The pairs of a batch: every epoch in an order of its own, no pair in two processes."""
        epoch, batch = divmod(step, self.batches_per_epoch)
        generator = torch.Generator().manual_seed(self._settings.seed + epoch)
        order = torch.randperm(len(self._trained), generator=generator)
        first = (batch * self._process.count + self._process.rank) * self._settings.batch
        return [self._trained[int(n)] for n in order[first : first + self._settings.batch]]


def fine_tune(
    network: Mast3r,
    pairs: MinedPairs,
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
    steps_per_epoch = max(1, batches_per_epoch // settings.accumulate)
    schedule = Schedule(
        steps=settings.epochs * steps_per_epoch, warm_up=settings.warm_up_epochs * steps_per_epoch
    )
    return TrainingPlan(schedule, accumulate=settings.accumulate)


def read_data(specs: Sequence[str]) -> list[Frames]:
    """Every sequence of data sets given as KIND=FOLDER.

    Raises:
        InputError: a kind is unknown, or a folder does not hold that data set.
    """
    sequences = []
    for spec in specs:
        kind, _, folder = spec.partition("=")
        if kind not in READERS or not folder:
            raise InputError(
                f"'{spec}' is no data set; give KIND=FOLDER, KIND one of {', '.join(READERS)}"
            )
        sequences += READERS[kind](Path(folder))
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
