"""The keyframe store: the same keyframes in memory and in files, and memory that stays flat."""

from __future__ import annotations

import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.lab.stress.soak import TINY
from aquaflow.lab.stress.swim import Floor, film, pose
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.flow_pair import FlowEncoding
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame

CAMERA = CameraModel(96, 72, 80.0, 80.0, 48.0, 36.0)
GUESS = CameraModel(96, 72, 70.0, 70.0, 48.0, 36.0, calibrated=False)
PRIOR = ClassicalPrior()
WORK = [pytest.param(False, id="memory"), pytest.param(True, id="files")]


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (72, 96, 3), dtype=np.uint8)


def pointmap_of(number: int) -> Pointmap:
    rng = np.random.default_rng(number)
    return Pointmap(CAMERA, rng.random((72, 96)), 1e-4 * rng.random((72, 96)))


def add(store: KeyframeStore, number: int, keypoints: bool = False) -> Keyframe:
    encoding = PRIOR.encode(picture(number), GUESS)
    if keypoints:
        _ = encoding.keypoints
    return store.add(10 * number, number, encoding, Sim3.identity(), pointmap_of(number), 0)


def filled(work: Path | None, count: int = 6, resident: int = 1) -> KeyframeStore:
    store = KeyframeStore(work, PRIOR, resident)
    for number in range(count):
        add(store, number, keypoints=number % 2 == 0)
    return store


def test_encoding_and_pointmap_come_back_bit_for_bit(tmp_path: Path) -> None:
    store = filled(tmp_path)
    assert len(list((tmp_path / "keyframes").iterdir())) == 4  # one used last, one held
    for number, keyframe in enumerate(store.keyframes):
        wanted, got = PRIOR.encode(picture(number), GUESS), keyframe.encoding
        assert isinstance(got, FlowEncoding)
        np.testing.assert_array_equal(got.grey, wanted.grey)
        np.testing.assert_array_equal(got.texture, wanted.texture)
        np.testing.assert_array_equal(got.interesting, wanted.interesting)
        np.testing.assert_array_equal(got.keypoints.pixels, wanted.keypoints.pixels)
        np.testing.assert_array_equal(got.keypoints.descriptors, wanted.keypoints.descriptors)
        np.testing.assert_array_equal(keyframe.pointmap.rho, pointmap_of(number).rho)
        np.testing.assert_array_equal(keyframe.pointmap.variance, pointmap_of(number).variance)
        assert (got.camera, keyframe.pointmap.camera) == (GUESS, CAMERA)


def test_keypoints_that_were_detected_are_not_detected_again(tmp_path: Path) -> None:
    store = filled(tmp_path)
    assert "keypoints" in vars(store[0].encoding)
    assert "keypoints" not in vars(store[1].encoding)


def test_pose_and_sub_map_stay_as_they_are_set(tmp_path: Path) -> None:
    store, moved = filled(tmp_path), pose((1.0, 2.0, 3.0))
    store[0].T_wc, store[0].sub_map = moved, 4
    _ = store[3].pointmap
    assert (store[0].T_wc, store[0].sub_map, store[0].frame_index) == (moved, 4, 0)
    assert len(store) == 6


@pytest.mark.parametrize("in_files", WORK)
def test_only_the_keyframe_added_last_may_be_changed_in_place(
    tmp_path: Path, in_files: bool
) -> None:
    store = filled(tmp_path if in_files else None)
    store[5].pointmap.rho[0, 0] = 9.0
    for number in range(5):
        for array in (store[number].pointmap.rho, store[number].pointmap.variance):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = 9.0
    assert store[5].pointmap.rho[0, 0] == 9.0


@pytest.mark.parametrize("in_files", WORK)
def test_an_earlier_keyframe_may_be_changed_once_it_is_held(tmp_path: Path, in_files: bool) -> None:
    store = filled(tmp_path if in_files else None)
    keyframe = store.load(2)
    assert keyframe is store[2]
    held = keyframe.pointmap
    for number in range(6):  # whatever else is looked at meanwhile
        _ = store[number].encoding
    held.rho[0, 0] = 9.0
    store.load(4)
    for number in range(6):
        _ = store[number].encoding
    assert store[2].pointmap.rho[0, 0] == 9.0
    with pytest.raises(ValueError, match="read-only"):
        store[2].pointmap.rho[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        held.rho[0, 0] = 1.0


@pytest.mark.parametrize("in_files", WORK)
def test_a_better_pointmap_takes_the_place_of_any(tmp_path: Path, in_files: bool) -> None:
    store = filled(tmp_path if in_files else None)
    store[1].pointmap = pointmap_of(77)
    store[5].pointmap = pointmap_of(78)
    store[5].pointmap.rho[0, 0] = 9.0
    for number in range(6):
        _ = store[number].encoding
    np.testing.assert_array_equal(store[1].pointmap.rho, pointmap_of(77).rho)
    assert store[5].pointmap.rho[0, 0] == 9.0
    with pytest.raises(ValueError, match="read-only"):
        store[1].pointmap.rho[0, 0] = 1.0


def swum(frames: list[Frame], store: KeyframeStore, prior: ClassicalPrior) -> np.ndarray:
    tracker = Tracker(prior, store, TrackingConfig())
    decided = [tracked for frame in frames for tracked in tracker.track(frame).frames]
    posed = [tracked.T_wc for tracked in [*decided, *tracker.finish().frames]]
    return np.array([T.matrix for T in posed if T is not None])


def test_a_dive_is_tracked_the_same_bit_for_bit(tmp_path: Path) -> None:
    floor = Floor(0)
    frames = [film(floor, [pose((0.1 * i, 0.0, 0.0))], TINY, first=i)[0] for i in range(20)]
    prior = ClassicalPrior()
    memory, files = KeyframeStore(), KeyframeStore(tmp_path, prior, resident=1)
    with threadpool_limits(1, user_api="blas"):
        wanted, got = swum(frames, memory, ClassicalPrior()), swum(frames, files, prior)
    np.testing.assert_array_equal(got, wanted)
    assert len(wanted) > 15
    assert len(memory) == len(files) > 4
    for a, b in zip(memory.keyframes, files.keyframes, strict=True):
        np.testing.assert_array_equal(a.pointmap.rho, b.pointmap.rho)
        np.testing.assert_array_equal(a.pointmap.variance, b.pointmap.variance)


def bytes_of_arrays() -> int:
    """Of all arrays that live, whoever holds them; what else Python holds is not this store's."""
    arrays = tracemalloc.DomainFilter(True, np.lib.tracemalloc_domain)
    return sum(trace.size for trace in tracemalloc.take_snapshot().filter_traces([arrays]).traces)


def test_memory_after_800_keyframes_is_that_after_200(tmp_path: Path) -> None:
    store, sizes, traced = KeyframeStore(tmp_path, PRIOR, resident=64), [], []
    encoding = PRIOR.encode(picture(0), CAMERA)
    tracemalloc.start()
    for number in range(800):
        copied = FlowEncoding(CAMERA, encoding.grey.copy(), encoding.texture.copy())
        store.add(number, number, copied, Sim3.identity(), Pointmap.unknown(CAMERA), 0)
        _ = store[max(number - 100, 0)].pointmap
        if number + 1 in (200, 800):
            sizes.append(store.resident_bytes)
            traced.append(bytes_of_arrays())
    tracemalloc.stop()
    assert sizes[1] == sizes[0] == 65 * (72 * 96 * (1 + 4 + 8 + 8) + 8)
    assert traced[1] < 1.2 * traced[0]


def test_closing_removes_the_files_unless_they_are_to_be_kept(tmp_path: Path) -> None:
    filled(tmp_path / "gone").close()
    assert list((tmp_path / "gone").iterdir()) == []
    filled(tmp_path / "kept").close(keep=True)
    assert len(list((tmp_path / "kept" / "keyframes").iterdir())) == 6


def test_files_without_the_prior_that_packs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="prior"):
        KeyframeStore(tmp_path)


def test_a_keyframe_needs_a_pose_that_is_finite() -> None:
    store = KeyframeStore()
    nowhere = Sim3(np.eye(3), np.full(3, np.nan))
    with pytest.raises(ArithmeticError):
        store.add(0, 0, PRIOR.encode(picture(0), GUESS), nowhere, pointmap_of(0), 0)
    assert len(store) == 0


def test_another_thread_reads_while_keyframes_come_and_go(tmp_path: Path) -> None:
    store, read = filled(tmp_path), list[int]()

    def look() -> None:
        for turn in range(60):
            number = turn % 6
            known = store[number].pointmap.is_known(1.0)
            assert known.shape == (72, 96)
            read.append(number)

    with ThreadPoolExecutor(1) as threads:
        looking = threads.submit(look)
        for number in range(6, 24):
            add(store, number)
            store.load(number // 2)
            store.save()
        looking.result()
    assert len(read) == 60
