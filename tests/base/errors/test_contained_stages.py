"""A dive in which every stage fails once still ends with all its files, and says what failed."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.base.stages import Stages
from aquaflow.config import Config
from aquaflow.dive import replay
from aquaflow.dive.deliverables import DeliverablePhase, Deliverables, deliverables_of
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.metric_outputs import MetricOutputs
from aquaflow.dive.run import Finished
from aquaflow.mapping import scene_water as water_fitting
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.optimisation import MapOptimiser
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.slam import Slam
from aquaflow.sources import RecordedCamera, open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.current_keyframe import KeyframeTracker
from aquaflow.tracking.gate import FrameGate
from aquaflow.tracking.graph.keyframe_graph import KeyframeGraph
from aquaflow.tracking.initialisation.initialiser import Initialiser
from aquaflow.tracking.loops import Places
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Dropped, Frame
from aquaflow.water import estimation

pytestmark = pytest.mark.usefixtures("contained")

FEW_STEPS = {"refine_steps": 12, "steps_keyframe": 2, "steps_mapping": 2, "steps_common": 1}
SETTINGS = Config.model_validate(
    {
        "threads": 1,
        "source": {"width": 96},
        "tracking": {"keyframe_share": 0.9, "recent_keyframes": 0},
        "mapping": {
            "optimiser": FEW_STEPS | {"heldout_steps": 2},
            "medium": {"first_fit_views": 4},
        },
    }
)
TRACKING = SETTINGS.model_copy(
    update={"mapping": SETTINGS.mapping.model_copy(update={"enabled": False})}
)
"""Where nothing is said about the map."""
MAPPED = 10
"""Pictures that make a map."""

STAGES: list[tuple[type | ModuleType, str, int, str]] = [
    (Preparation, "__call__", 3, "preparation"),
    (FrameGate, "judge", 4, "frame gate"),
    (ClassicalPrior, "encode", 7, "encoding"),
    (Initialiser, "solve", 1, "initialisation"),
    (KeyframeTracker, "place", 17, "pose"),
    (Places, "of_frame", 1, "relocalisation"),
    (KeyframeGraph, "close_loops", 1, "loop search"),
    (Places, "add", 2, "place index"),
    (KeyframeGraph, "add", 3, "keyframe graph"),
    (Mapper, "add_view", 3, "view"),
    (Mapper, "insert", 2, "insertion"),
    (MapOptimiser, "step", 5, "optimisation"),
    (water_fitting, "adopt_water", 1, "water fit"),
    (Mapper, "register", 1, "held-out pose"),
]
"""Of each stage: what raises, at which call, and the stage's name."""


@pytest.fixture
def raise_once(monkeypatch: pytest.MonkeyPatch) -> Callable[[type | ModuleType, str, int], None]:
    """Let the n-th call of a method raise."""

    def patch(owner: type | ModuleType, name: str, nth: int) -> None:
        original, calls = getattr(owner, name), []

        def method(*args: Any, **keywords: Any) -> Any:
            calls.append(name)
            if len(calls) == nth:
                raise FloatingPointError(f"planted in {name}")
            return original(*args, **keywords)

        monkeypatch.setattr(owner, name, method)

    return patch


def mapped(
    recording: RecordedCamera, out: Path, settings: Config = SETTINGS, **keywords: Any
) -> Finished:
    return replay.map_recording(recording, "planted", out, settings, **keywords)


def stopped(settings: Config, stop: int) -> Config:
    """The same for the first ``stop`` pictures."""
    return settings.model_copy(update={"source": settings.source.model_copy(update={"stop": stop})})


def rows(dive: Path) -> list[dict[str, str]]:
    with (dive / "frames.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_every_stage_may_fail_once_in_one_dive(
    small_recording: Path, tmp_path: Path, raise_once: Callable[[type | ModuleType, str, int], None]
) -> None:
    for owner, name, nth, _ in STAGES:
        raise_once(owner, name, nth)
    finished = mapped(open_recording(small_recording), tmp_path / "dive")
    counts = {kind["stage"]: kind["count"] for kind in finished.metrics["failures"]}
    assert counts == {stage: 1 for *_, stage in STAGES}
    table = rows(finished.dive)
    assert [int(row["index"]) for row in table] == list(range(len(table)))
    assert sum(not row["sub_map"] for row in table) <= 3  # preparation, encoding, pose
    for name in ("trajectory.tum", "map.ply", "map.aqf", "medium.json", "report.html"):
        assert (finished.dive / name).stat().st_size > 0
    report = (finished.dive / "report.html").read_text()
    assert all(f"{stage} failed once" in report for *_, stage in STAGES)
    log = [json.loads(line) for line in (finished.dive / "log.jsonl").read_text().splitlines()]
    assert sum("planted in" in line.get("exception", "") for line in log) == len(STAGES)


def test_a_programming_error_in_a_stage_is_a_warning_with_its_traceback_and_fails_a_test(
    small_recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    contained_defects: list[str],
) -> None:
    scope: dict[str, Any] = {}
    statement = "def fit_likeliest(problems):\n    yield unknown\n"
    exec(compile(statement, estimation.__file__, "exec"), scope)
    monkeypatch.setattr(estimation, "fit_likeliest", scope["fit_likeliest"])
    finished = mapped(open_recording(small_recording), tmp_path / "dive", stopped(SETTINGS, MAPPED))
    (failure,) = finished.metrics["failures"]
    assert (failure["stage"], failure["error"], failure["defect"]) == (
        "water fit", "NameError", True,
    )  # fmt: skip
    (warning,) = [each for each in finished.metrics["warnings"] if "defect" in each]
    assert warning.startswith("water fit failed")
    assert "aquaflow/water/estimation.py: fit_likeliest); a defect in AquaFlow" in warning
    assert not any("water fit" in note for note in finished.notes)
    assert warning.split(" (")[0] in (finished.dive / "report.html").read_text()
    assert "name 'unknown' is not defined" in (finished.dive / "log.jsonl").read_text()
    assert contained_defects, "the guard of every test (conftest.py) has not seen it"
    contained_defects.clear()


def test_frames_that_a_failing_tracker_held_are_accounted_for(
    small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = Tracker._begin

    def lose_all(self: Tracker, *_: object) -> Any:
        monkeypatch.setattr(Tracker, "_begin", begin)
        self._start._initialiser = None
        raise FloatingPointError("planted")

    monkeypatch.setattr(Tracker, "_begin", lose_all)
    monkeypatch.setattr(Tracker, "_shown_somewhere", lambda *_: None)  # it finds them again
    finished = mapped(open_recording(small_recording), tmp_path / "dive", TRACKING)
    table = rows(finished.dive)
    assert [int(row["index"]) for row in table] == list(range(len(table)))
    assert sum(row["class"] == "lost" for row in table) == finished.metrics["lost"] > 0


class Unreliable:
    """A recording whose reader raises at some frames."""

    def __init__(self, recording: RecordedCamera, at: set[int]) -> None:
        self.recording, self.at = recording, at

    def __getattr__(self, name: str) -> Any:
        return getattr(self.recording, name)

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        for frame in self.recording.frames(every, start, stop):
            if frame.index in self.at:
                raise OSError(5, "planted")
            yield frame


def test_reading_goes_on_after_a_frame_that_cannot_be_read(
    small_recording: Path, tmp_path: Path
) -> None:
    recording: Any = Unreliable(open_recording(small_recording), {5, 6, 11})
    finished = mapped(recording, tmp_path / "dive", stopped(TRACKING, 14))
    classes = {int(row["index"]): row["class"] for row in rows(finished.dive)}
    assert [index for index, kind in classes.items() if kind == "dropped"] == [5, 6, 11]
    assert sorted(classes) == list(range(14))


def test_what_came_before_a_recordings_damaged_end_is_mapped(
    small_recording: Path, tmp_path: Path
) -> None:
    recording: Any = Unreliable(open_recording(small_recording), set(range(MAPPED, 1000)))
    finished = mapped(recording, tmp_path / "dive")
    assert finished.metrics["tracked"] == MAPPED
    assert finished.metrics["gaussians"] > 0
    assert any("could not be read after frame" in note for note in finished.notes)


def test_a_recording_that_fails_at_once_is_an_error(small_recording: Path, tmp_path: Path) -> None:
    recording: Any = Unreliable(open_recording(small_recording), {0})
    with pytest.raises(OSError, match="planted"):
        mapped(recording, tmp_path / "dive")


def test_a_progress_bar_that_breaks_does_not_matter(small_recording: Path, tmp_path: Path) -> None:
    def broken(stage: str, done: int, total: int | None) -> None:
        raise BrokenPipeError(32, "planted")

    finished = mapped(
        open_recording(small_recording),
        tmp_path / "dive",
        stopped(SETTINGS, MAPPED),
        progress=broken,
    )
    assert finished.metrics["tracked"] == finished.metrics["frames"] == MAPPED


WRITERS = {
    "write_trajectory": ("writing trajectory.tum", "trajectory.tum"),
    "write_path_table": ("writing trajectory.csv", "trajectory.csv"),
    "write_metric_frames": ("writing metric.json", "metric.json"),
    "write_cameras": ("writing camera.yaml", "camera.yaml"),
    "write_map": ("writing map.aqf", "map.aqf"),
    "write_splats": ("writing map.ply", "map.ply"),
    "write_held_out": ("writing held-out views", "heldout"),
    "write_medium": ("writing medium.json", "medium.json"),
    "coverage": ("writing the coverage", "coverage.npz"),
    "overview": ("drawing the overview", "overview.png"),
    "reef_numbers": ("reef numbers", "reef_numbers.json"),
    "report": ("report", "report.html"),
}


NAMES = tuple(WRITERS)
CORE = 8
"""The first of them make the dive's own files; the others read what is known of it."""
TOGETHER = {
    "every second": NAMES[::2], "the others": NAMES[1::2],
    "core": NAMES[:CORE], "what is made of it": NAMES[CORE:],
}  # fmt: skip
"""Neighbours are in different ones, so that one that takes the next with it is seen."""


@pytest.fixture(scope="module")
def finished_slam(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Slam:
    """A dive whose frames have all been mapped, before anything of it is written."""
    recording = open_recording(small_recording)
    prepare = Preparation(SETTINGS.source, recording.camera)
    slam = Slam(SETTINGS, Stages(failures=Failures(strict=False)))
    for frame in recording.frames(stop=MAPPED):
        assert isinstance(frame, Frame)
        slam.process(prepare(frame))
    slam.finish()
    return slam


@pytest.mark.parametrize(
    "broken",
    [
        *(pytest.param(names, id=kind) for kind, names in TOGETHER.items()),
        *(pytest.param((name,), id=name, marks=pytest.mark.slow) for name in NAMES),
    ],
)
def test_files_that_cannot_be_written_leave_the_others(
    broken: tuple[str, ...], finished_slam: Slam, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise InputError("planted") from OSError(5, "planted")

    slam, folder = finished_slam, DiveFolder(tmp_path / "dive", SETTINGS)
    monkeypatch.setattr(slam, "failures", Failures(strict=False))
    others = deliverables_of(slam)
    for name in broken:
        if name in others:
            monkeypatch.setattr(others[name], "make", fail)
        else:
            monkeypatch.setattr(folder, name, fail)
    known = MetricOutputs({0: replace(WorldFrame.unknown(), level=True)})  # else no overview
    made = Deliverables("planted", folder, slam, slam.results(), None, known, others=others)
    made.summarise()
    made.write()
    made.make(DeliverablePhase.WRITE)
    made.evaluate()
    made.make(DeliverablePhase.MEASURE)
    made.write_evaluation()
    made.make(DeliverablePhase.REPORT, metrics={"stage_ms": {}, "warnings": []})
    folder.close()
    failed = dict(WRITERS[name] for name in broken)
    assert {kind.stage for kind in slam.failures.kinds} == failed.keys()
    for _, name in WRITERS.values():
        assert (folder.path / name).exists() == (name not in failed.values()), name


def test_a_map_that_stays_empty_and_a_dive_of_few_poses_are_said_first(
    small_recording: Path, tmp_path: Path
) -> None:
    asked = SETTINGS.model_dump()
    asked["mapping"]["insertion"]["tau_a"] = 1.0
    asked["source"]["stop"] = MAPPED
    recording, settings = open_recording(small_recording), Config.model_validate(asked)
    finished = replay.map_recording(recording, "empty", tmp_path / "dive", settings)
    [warning] = finished.warnings
    assert warning.startswith("the map is empty")
    assert "mapping.insertion.tau_a is 1.0, by default" in warning
    assert finished.metrics["warnings"] == [warning]
    assert "the map is empty" in (finished.dive / "report.html").read_text()
