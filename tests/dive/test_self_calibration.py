"""A dive without calibration: its camera is found first, or at its end, and stated with a sigma."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from aquaflow.config import Config
from aquaflow.dive import calibration_pass, replay, run
from aquaflow.dive.calibration_pass import FoundCamera, found_in, in_words, usable
from aquaflow.geometry.camera import guess_camera, load_camera
from aquaflow.sources import RecordedCamera, open_recording
from aquaflow.tracking.self_calibration import FoundLens
from aquaflow.types import Dropped, Frame
from tests.small_recording import WIDTH

STOP = 18
"""Pictures that show the lens to 2 %."""
TRACKING = Config.model_validate(
    {"threads": 1, "source": {"stop": STOP}, "mapping": {"enabled": False}}
)
FOCAL_PX = 0.85 * WIDTH
GUESS = guess_camera(480, 360)


def lens(log_focal: float, sigma: float) -> FoundLens:
    return FoundLens(np.array([log_focal, -0.01, 0, 0, 0]), np.array([sigma, 0.01]), 3e-4, 24, 9000)


def found(sigma: float, used: bool) -> FoundCamera:
    of_lens = lens(0.25, sigma)
    return FoundCamera(of_lens.camera(GUESS), of_lens, used)


@pytest.fixture(scope="module")
def uncalibrated(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small recording mapped without its camera.yaml."""
    out = tmp_path_factory.mktemp("uncalibrated") / "dive"
    replay.map_recording(open_recording(small_recording / "images"), "small", out, TRACKING)
    return out


def test_the_camera_is_found_and_its_sigma_covers_the_truth(uncalibrated: Path) -> None:
    numbers = json.loads((uncalibrated / "metrics.json").read_text())
    stated = numbers["self_calibration"]

    assert stated["verdict"] == "found"
    assert stated["used"]
    assert stated["focal_px"] == pytest.approx(FOCAL_PX, rel=0.03)
    assert abs(stated["focal_px"] - FOCAL_PX) < 3.0 * stated["focal_sigma_px"]
    assert abs(stated["k1"]) < 3.0 * stated["k1_sigma"]
    assert numbers["calibration_check"] is None
    assert numbers["tracked"] == STOP


def test_the_calibration_used_is_written_and_can_be_given_again(uncalibrated: Path) -> None:
    numbers = json.loads((uncalibrated / "metrics.json").read_text())["self_calibration"]
    written = load_camera(uncalibrated / "calibration.yaml")

    assert written.fx == pytest.approx(numbers["focal_px"], abs=0.01)
    assert written.distortion[0] == pytest.approx(numbers["k1"], abs=1e-4)
    head = (uncalibrated / "calibration.yaml").read_text().splitlines()[0]
    assert head.startswith("# found from the dive itself: focal length")
    assert yaml.safe_load((uncalibrated / "calibration.yaml").read_text())["width"] == WIDTH
    assert not (uncalibrated / "found_camera.yaml").exists()


def test_a_dive_that_finds_its_camera_at_the_end_keeps_it_for_the_next(
    small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = found(0.01, used=False)
    monkeypatch.setattr(replay, "found_in", lambda *_: None)
    monkeypatch.setattr(run, "from_keyframes", lambda _: late)

    finished = replay.map_recording(
        open_recording(small_recording / "images"), "late", tmp_path / "dive", TRACKING
    )

    assert load_camera(tmp_path / "dive" / "found_camera.yaml").fx == pytest.approx(late.camera.fx)
    assert not (tmp_path / "dive" / "calibration.yaml").exists()
    assert any("give found_camera.yaml to the next dive" in note for note in finished.notes)
    assert finished.metrics["self_calibration"]["used"] is False


def test_what_is_known_is_said_and_what_is_not_known_is_a_guess() -> None:
    assert "524 ± 5 px (1.0 %)" in in_words(found(0.01, True), GUESS, "f.yaml")
    assert "does not determine" in in_words(found(0.2, True), GUESS, "f.yaml")
    assert "f.yaml" in in_words(found(0.01, False), GUESS, "f.yaml")
    assert "pictures do not show" in in_words(None, GUESS, "f.yaml")
    assert not found(0.2, False).suggested


def test_a_lens_that_folds_the_picture_is_not_used() -> None:
    folding = FoundLens(np.array([0.0, -1.5, 0, 0, 0]), np.array([0.01, 0.01]), 3e-4, 24, 9000)
    assert usable(folding.camera(GUESS)) is None
    assert usable(lens(0.25, 0.01).camera(GUESS)) is not None


@pytest.mark.parametrize("change", [-2.1, 2.1, 5.0])
def test_a_focal_length_that_no_camera_has_is_not_used(change: float) -> None:
    """Ten times off and more: the adjustment ran off, however sure it is of itself."""
    assert usable(lens(change, 0.01).camera(GUESS)) is None


def test_a_still_camera_shows_no_lens(small_recording: Path, tmp_path: Path) -> None:
    for i in range(4):
        shutil.copy(small_recording / "images" / "000000.png", tmp_path / f"{i}.png")
    assert found_in(open_recording(tmp_path), TRACKING, lambda done, of: None) is None


def test_a_recording_that_cannot_be_read_to_its_end_is_used_until_there(
    small_recording: Path,
) -> None:
    seen: list[int] = []
    found_in(
        Failing(open_recording(small_recording / "images")), TRACKING, lambda k, _: seen.append(k)
    )
    assert seen[:2] == [1, 2]
    assert max(seen) == 2  # also where other focal lengths are tried


def passes(monkeypatch: pytest.MonkeyPatch, *ends: tuple[FoundLens | None, float]) -> list[Any]:
    """The cameras that passes begin with; each ends as in ``ends``: what was found, and the share
    of frames outside of the largest sub-map."""
    began: list[Any] = []

    class Pass:
        guess = GUESS

        def __init__(self, *given: Any) -> None:
            began.append(given[3] if len(given) > 3 else None)
            self._lens, self._outside_share = ends[len(began) - 1]

        def run(self, most_frames: int = 0) -> calibration_pass._Found | None:
            of_lens = self._lens
            if of_lens is None:
                return None
            return calibration_pass._Found(of_lens.camera(GUESS), of_lens, self._outside_share)

    monkeypatch.setattr(calibration_pass, "_Pass", Pass)
    return began


def test_where_the_guess_broke_the_map_tracking_is_repeated_with_what_was_found(
    small_recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began = passes(monkeypatch, (lens(0.2, 0.02), 0.4), (lens(0.25, 0.01), 0.0))
    camera = found_in(open_recording(small_recording / "images"), TRACKING, lambda *_: None)
    assert camera is not None
    assert began[0] is None
    assert began[1].fx == pytest.approx(GUESS.fx * np.exp(0.2))
    assert len(began) == 2
    assert camera.camera.fx == pytest.approx(GUESS.fx * np.exp(0.25))


@pytest.mark.parametrize("first", [(None, 1.0), (lens(0.2, 0.02), 0.5)], ids=["none", "pieces"])
def test_where_the_guess_failed_each_focal_length_that_may_be_is_tried(
    small_recording: Path, monkeypatch: pytest.MonkeyPatch, first: tuple[FoundLens | None, float]
) -> None:
    repeated = [] if first[0] is None else [(lens(0.2, 0.02), 0.5)]
    ends = [first, *repeated, (lens(-0.3, 0.01), 0.3), (None, 1.0), (lens(0.25, 0.01), 0.0)]
    began = passes(monkeypatch, *ends)
    camera = found_in(open_recording(small_recording / "images"), TRACKING, lambda *_: None)
    assert camera is not None
    assert camera.camera.fx == pytest.approx(GUESS.fx * np.exp(0.25))
    tried = began[1 + len(repeated) :]
    assert [each.fx / GUESS.fx for each in tried] == pytest.approx([1.0, 1.4, 0.7])
    assert all(each.calibrated for each in tried)


@pytest.mark.slow
def test_a_survey_that_shows_its_focal_length_late_is_placed_without_calibration(
    shared_data: Path, tmp_path: Path
) -> None:
    recording = tmp_path / "survey"
    recording.mkdir()
    for picture in (shared_data / "auv_survey_6").glob("*.tif"):
        (recording / picture.name).symlink_to(picture)
    replay.map_recording(open_recording(recording), "survey 6", tmp_path / "dive", TRACKING)
    numbers = json.loads((tmp_path / "dive" / "metrics.json").read_text())
    assert numbers["tracked"] == numbers["frames"] == 8
    stated = numbers["self_calibration"]
    assert abs(stated["focal_px"] - 1442.4 * 480 / 1360) < 3.0 * stated["focal_sigma_px"]


def test_a_map_in_one_piece_is_not_repeated(
    small_recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began = passes(monkeypatch, (lens(0.2, 0.02), 0.05))
    assert found_in(open_recording(small_recording / "images"), TRACKING, lambda *_: None)
    assert len(began) == 1


def test_views_further_apart_replace_a_lens_only_where_they_know_it_better() -> None:
    sure, unsure = lens(0.25, 0.01), lens(0.9, 0.014)
    assert calibration_pass._surer(sure, unsure) is sure
    assert calibration_pass._surer(unsure, sure) is sure
    assert calibration_pass._surer(None, unsure) is unsure
    assert calibration_pass._surer(sure, None) is sure
    assert calibration_pass._surer(None, None) is None


class Failing:
    """A recording whose third picture raises."""

    def __init__(self, recording: RecordedCamera) -> None:
        self._recording = recording

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        yield from self._recording.frames(every, start, 2)
        raise OSError("planted")
