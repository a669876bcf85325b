"""Many small dives over one synthetic reef: other ways, headings, heights, waters and lights.

``python -m tests.survey.site.visits COUNT FOLDER`` maps them, tracking only.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.config import Config
from aquaflow.dive.replay import map_recording
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.lab.synthetic.config import WaterType
from aquaflow.lab.synthetic.survey import FPS, SurveyPictures
from aquaflow.types import CameraModel, Frame

WIDTH, PICTURES, EVERY = 160, 14, 3
"""Every third picture of a survey: 15 cm from one to the next, 2 m in all."""
SIDE_M = 4.0
"""Of the square in which the dives begin."""
WATERS: tuple[WaterType, ...] = ("coastal_1C", "oceanic_II", "coastal_3C")


class Visit(SurveyPictures):
    """One dive of many over the survey's seabed."""

    def __init__(self, number: int, side_m: float = SIDE_M) -> None:
        super().__init__(WIDTH, water=WATERS[number % len(WATERS)])
        self._rng = np.random.default_rng([7, number])
        x, y = self._rng.uniform(0.0, side_m, 2)
        turn, up = self._rng.uniform(-np.pi, np.pi), self._rng.uniform(-0.2, 0.3)
        self._T_visit = Sim3(so3_exp(np.array([0.0, 0.0, turn])), np.array([x, y, -up]))
        self._light = self._rng.uniform(0.75, 1.25, 3)

    def T_wc(self, index: int) -> Sim3:
        return self._T_visit @ super().T_wc(index)

    def frame(self, index: int) -> Frame:
        plain = super().frame(index)
        noisy = plain.image * self._light + self._rng.normal(0.0, 1.0, plain.image.shape)
        return replace(plain, image=np.clip(np.rint(noisy), 0, 255).astype(np.uint8))

    def true_positions(
        self,
        t_s: npt.NDArray[np.float64],  # [N]
    ) -> npt.NDArray[np.float64]:
        """[N, 3] m of the camera."""
        return np.array([self.T_wc(round(FPS * t)).t for t in t_s])


class VisitRecording:
    """A dive's pictures as a recording."""

    specificity = 0

    def __init__(self, visit: Visit) -> None:
        self._visit = visit
        self.camera: CameraModel | None = visit.camera
        self.frame_count: int | None = PICTURES
        self.notes: list[str] = []

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return False

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> VisitRecording:
        raise InputError(f"{path} is no visit: one is drawn by its number, not read from files")

    def name_of(self, index: int) -> str:
        return self._visit.name_of(index)

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        return (self._visit.frame(EVERY * index) for index in range(PICTURES))

    def close(self) -> None:
        pass


def map_visit(number: int, folder: Path, side_m: float = SIDE_M) -> Path:
    """The finished dive folder of dive ``number``."""
    config = Config.model_validate({"threads": 1, "mapping": {"enabled": False}})
    map_recording(VisitRecording(Visit(number, side_m)), folder.name, folder, config)
    return folder


if __name__ == "__main__":
    for each in range(int(sys.argv[1])):
        place = Path(sys.argv[2]) / f"dive_{each:03d}"
        if not place.exists():
            print(map_visit(each, place), flush=True)
