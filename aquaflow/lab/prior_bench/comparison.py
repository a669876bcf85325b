"""``aquaflow lab prior compare``: every method on the same pairs, in turn, with what each costs."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.config import Config, PriorConfig, parse_config
from aquaflow.config.presets import merge
from aquaflow.config.stage import COMMAND_LINE, validate
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.bench import machine
from aquaflow.lab.bench.peers.dive import prepared_frames
from aquaflow.lab.bench.scene import scene_of_clip
from aquaflow.lab.evaluation.matching import HEIGHT, LEVELS, WIDTH, homography_pair
from aquaflow.lab.evaluation.trajectory_error import ASSOCIATION_TOLERANCE_S, associate, read_tum
from aquaflow.lab.prior_bench.pair import FoundMatches, KnownPair, Picture
from aquaflow.lab.prior_bench.table import PairFigures, figures_of
from aquaflow.lab.training.held_out import LEAST_OVERLAP, SEED
from aquaflow.lab.training.pair_generator.cameras import WIDE, WIDER, PairMotion
from aquaflow.lab.training.pair_generator.drawing import through_water
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, Pool
from aquaflow.lab.training.pairs import Pair, ViewBatch, correspondences, overlap
from aquaflow.prior.contract import Keypoints, Prior
from aquaflow.prior.factory import NetworkKind, keypoint_network, make_prior
from aquaflow.prior.flow import pixel_grid
from aquaflow.prior.hybrid import HybridEncoding
from aquaflow.prior.keypoint_networks.keypoint_prior import (
    KeypointEncoding,
    KeypointNetwork,
    KeypointPrior,
    Size,
    warm_up,
)
from aquaflow.types import Frame

Progress = Callable[[str, int, int], None]

NETWORKS: dict[NetworkKind, str] = {"xfeat": "XFeat", "aliked": "ALIKED + LightGlue"}
"""Networks of others, and their names in the table."""


@dataclass
class _Record:
    """All that one method did on the pairs of one group."""

    judged_by: str
    figures: list[PairFigures] = field(default_factory=list)
    picture_ms: list[float] = field(default_factory=list)
    pair_ms: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Methods:
    """What can run here, and why the rest cannot."""

    usable: list[Method]
    missing: list[str]


def methods_here(device: str) -> Methods:
    """The classical and the compact prior, and either keypoint network, alone and with flow.

    Raises:
        ConfigError: there is no device of that name.
        AquaFlowError: the device is not there.
    """
    usable: list[Method] = [DenseMethod("classical", make_prior(PriorConfig(kind="classical")))]
    missing = []
    settings = {"kind": "compact", "device": device}
    compact = make_prior(validate(PriorConfig, settings, COMMAND_LINE))
    if compact.name == "compact":
        usable.append(DenseMethod("compact", compact))
    else:
        missing.append("compact: it has no weights or no onnxruntime here")
    for kind, title in NETWORKS.items():
        try:
            network = keypoint_network(kind, device)
        except AquaFlowError as error:
            missing.append(f"{title}: {error}")
            continue
        usable.append(SparseMethod(title, network))
        usable.append(DenseMethod(f"{title}, then flow", KeypointPrior(network)))
    return Methods(usable, missing)


def pairs_of(
    pictures: Sequence[Picture],  # [H, W, 3] RGB each
    clips: Sequence[Path],
    count: int,
    pool: Path | None,
) -> list[KnownPair]:
    """``count`` pairs of each kind; generated ones are kept in ``pool`` if it is given.

    Raises:
        InputError: a clip's folder lacks something.
    """
    real = [pair for clip in clips for pair in clip_pairs(clip, count)]
    with tempfile.TemporaryDirectory(prefix="aquaflow_pairs_") as scratch:
        generated = generated_pairs(pool or Path(scratch), count)
    return [*generated, *(warped_pairs(pictures, count) if pictures else []), *real]


def compare(
    methods: Methods,
    pairs: Sequence[KnownPair],
    progress: Progress,
) -> dict[str, Any]:
    """Means, medians and processor times by group of pairs and method."""
    records: dict[tuple[str, str], _Record] = {}
    for done, pair in enumerate(pairs):
        progress("pairs", done, len(pairs))
        for method in methods.usable:
            record = records.setdefault((pair.group, method.name), _Record(pair.judged_by))
            _run(method, pair, record)
    progress("pairs", len(pairs), len(pairs))
    return {
        "machine": machine.describe(),
        "missing": methods.missing,
        "rows": [_row(group, name, record) for (group, name), record in records.items()],
    }


def _run(method: Method, pair: KnownPair, record: _Record) -> None:
    described = []
    for picture, camera in ((pair.a, pair.camera_a), (pair.b, pair.camera_b)):
        began = time.process_time()
        described.append(method.describe(picture, camera))
        record.picture_ms.append(1e3 * (time.process_time() - began))
    began = time.process_time()
    found = method.match(*described)
    record.pair_ms.append(1e3 * (time.process_time() - began))
    record.figures.append(figures_of(pair, found))


def _row(group: str, name: str, record: _Record) -> dict[str, Any]:
    """Means of shares, medians of all else; null where there is no such thing."""
    found = record.figures
    recalls = [f.recall for f in found if f.recall is not None]
    return {
        "pairs": group,
        "count": len(found),
        "method": name,
        "judged_by": record.judged_by,
        "matches": int(np.median([f.matches for f in found])),
        "recall": round(float(np.mean(recalls)), 4) if recalls else None,
        "precision": round(float(np.mean([f.precision for f in found])), 4),
        "median_px": _median([f.median_px for f in found]),
        "rotation_deg": _median([f.rotation_deg for f in found]),
        "direction_deg": _median([f.direction_deg for f in found]),
        "picture_cpu_ms": round(float(np.median(record.picture_ms)), 1),
        "pair_cpu_ms": round(float(np.median(record.pair_ms)), 1),
    }


def _median(values: Sequence[float | None]) -> float | None:
    """None where nothing is known, or where more than half is infinite."""
    known = [value for value in values if value is not None and not math.isnan(value)]
    middle = float(np.median(known)) if known else math.inf
    return round(middle, 3) if math.isfinite(middle) else None


# --------------------------------------------------------------------------------------------------
# Pairs of a real clip whose poses are known, at several distances in time.
#
# Of such a pair only the epipolar line of a match is known, not the place on it.

TRUTH, CALIBRATION = "poses_sfm.tum", "camera.yaml"
"""Files of a clip's folder that are needed."""
SPACINGS = (1, 4, 8, 16)
"""Between the two pictures, in poses of the truth."""


def clip_pairs(folder: Path, count: int) -> list[KnownPair]:
    """Up to ``count`` pairs of each spacing, evenly over the clip.

    Raises:
        InputError: the folder holds no clip, no calibration or no poses.
    """
    scene = scene_of_clip(folder) if folder.is_dir() else None
    missing = [name for name in (TRUTH, CALIBRATION) if not (folder / name).is_file()]
    if scene is None or missing:
        lacking = " and ".join(missing) or "video or pictures"
        raise InputError(f"{folder} has no {lacking}; give the folder of a clip with its poses")
    config = parse_config(merge(Config().model_dump(), scene.overrides), str(folder))
    frames, truth = prepared_frames(scene, config).frames, read_tum(folder / TRUTH)
    ours, theirs = associate(
        np.array([frame.t_ns * 1e-9 for frame in frames]), truth.t_s, ASSOCIATION_TOLERANCE_S
    )
    known = [
        (frames[i], Sim3(truth.R_wc[j], truth.positions[j]))
        for i, j in zip(ours, theirs, strict=True)
    ]
    return [pair for n in SPACINGS for pair in _space(folder.name, known, n, count)]


def _space(
    name: str, known: Sequence[tuple[Frame, Sim3]], spacing: int, count: int
) -> list[KnownPair]:
    both = list(zip(known, known[spacing:], strict=False))
    if not both:
        return []
    apart_s = float(np.median([b.t_ns - a.t_ns for (a, _), (b, _) in both])) * 1e-9
    chosen = np.unique(np.linspace(0, len(both) - 1, min(count, len(both))).round().astype(int))
    return [
        KnownPair(
            f"{name}, {apart_s:.2f} s", a.image, b.image, a.camera, b.camera,
            T_ba=T_wb.inverse() @ T_wa,
        )
        for (a, T_wa), (b, T_wb) in (both[i] for i in chosen)
    ]  # fmt: skip


# --------------------------------------------------------------------------------------------------
# The methods that are compared: priors, dense, and keypoint networks alone, sparse.


class Method(Protocol):
    """What is done once for a picture, and what for a pair."""

    name: str

    def describe(
        self,
        picture: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
    ) -> Any:
        """What :meth:`match` needs of a picture."""
        ...

    def match(self, a: Any, b: Any) -> FoundMatches:
        """Nothing about the motion is expected."""
        ...


class DenseMethod:
    """A prior's flow: a match for every pixel that survives its own check."""

    def __init__(self, name: str, prior: Prior) -> None:
        self.name, self._prior = name, prior
        prior.warm_up()

    def describe(
        self,
        picture: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
    ) -> Any:
        """The encoding; a network's features, which may wait until they are needed, are in it."""
        encoding = self._prior.encode(picture, camera)
        if isinstance(encoding, (HybridEncoding, KeypointEncoding)):
            _ = encoding.features
        return encoding

    def match(self, a: Any, b: Any) -> FoundMatches:
        """Valid matches, and where texture is."""
        pair = self._prior.decode(a, b)
        valid = pair.valid
        here = pixel_grid(*valid.shape)[valid]
        return FoundMatches(here, pair.matches[valid], a.interesting)


class SparseMethod:
    """A keypoint network's own matches; there is no flow."""

    def __init__(self, name: str, network: KeypointNetwork) -> None:
        self.name, self._network = name, network
        warm_up(network)

    def describe(
        self,
        picture: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
    ) -> tuple[Keypoints, Size]:
        """Keypoints, and the picture's height and width."""
        del camera  # a network's keypoints need none
        return self._network.detect(picture), (picture.shape[0], picture.shape[1])

    def match(self, a: Any, b: Any) -> FoundMatches:
        """Keypoints that show the same thing."""
        (keypoints_a, size_a), (keypoints_b, size_b) = a, b
        in_a, in_b = self._network.match(keypoints_a, keypoints_b, size_a, size_b)
        return FoundMatches(keypoints_a.pixels[in_a], keypoints_b.pixels[in_b])


# --------------------------------------------------------------------------------------------------
# Pairs whose matches are known exactly: held-out generated scenes, and pictures warped by us.

GENERATED: dict[str, PairMotion] = {"generated, wide": WIDE, "generated, wider": WIDER}
"""The held-out motions, by the name of their group."""
SIDES = (320, 240)
"""Width and height of generated pictures. Training looks at windows of 128 x 96: networks of others
were trained on larger pictures."""
FOCAL_WIDTHS = 0.75
"""Focal length of a warped picture's camera over its width; no figure depends on it."""


def generated_pairs(folder: Path, count: int) -> list[KnownPair]:
    """``count`` pairs of either motion, of scenes that nothing is trained on; rendered where
    ``folder`` lacks them."""
    found: list[KnownPair] = []
    for group, motion in GENERATED.items():
        pool = Pool(folder / group.rpartition(" ")[2], SEED, *SIDES, motion=motion)
        draw, number, before = Draw(SEED), 0, len(found)
        while len(found) - before < count:
            clear = pool.pairs(torch.arange(number, number + SHARD))
            wet, enough = through_water(draw, clear), overlap(clear) >= LEAST_OVERLAP
            rows = torch.nonzero(enough)[:, 0].tolist()[: count - (len(found) - before)]
            found += _known_pairs_of(wet, group, rows)
            number += SHARD
    return found


def warped_pairs(
    pictures: Sequence[Picture],  # [H, W, 3] RGB each
    count: int,
) -> list[KnownPair]:
    """``count`` pairs of each level of distortion: pictures against themselves, turned, moved and
    relit."""
    camera = CameraModel(
        WIDTH, HEIGHT, FOCAL_WIDTHS * WIDTH, FOCAL_WIDTHS * WIDTH, WIDTH / 2, HEIGHT / 2
    )
    rng = np.random.default_rng(0)
    found = []
    for level in LEVELS:
        for number in range(count):
            pair = homography_pair(pictures[number % len(pictures)], level, rng)
            found.append(
                KnownPair(
                    f"warped, {level.name}", pair.a, pair.b, camera, camera, pair.truth, pair.inside
                )
            )
    return found


def _known_pairs_of(pair: Pair, group: str, rows: list[int]) -> list[KnownPair]:
    matches = correspondences(pair)
    T_ba = torch.linalg.solve(pair.b.T_wc, pair.a.T_wc).numpy().astype(np.float64)
    return [
        KnownPair(
            group,
            _picture(pair.a.image[row]),
            _picture(pair.b.image[row]),
            _camera(pair.a, row),
            _camera(pair.b, row),
            matches.pixels[row].numpy(),
            matches.visible[row].numpy(),
            Sim3(T_ba[row, :3, :3], T_ba[row, :3, 3]),
        )
        for row in rows
    ]


def _picture(
    image: Tensor,  # [3, H, W] in [0, 1]
) -> Picture:
    return np.ascontiguousarray((255.0 * image).round().byte().permute(1, 2, 0).numpy())


def _camera(view: ViewBatch, row: int) -> CameraModel:
    height, width = view.depth.shape[-2:]
    (fx, _, cx), (_, fy, cy), _ = view.K[row].double().tolist()
    return CameraModel(width, height, fx, fy, cx, cy)
