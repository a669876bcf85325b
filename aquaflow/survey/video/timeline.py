"""Pictures at their own times in a video of a constant rate."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.survey.video.encoder import VideoEncoder

Picture = npt.NDArray[np.uint8]


class Timeline:
    """Shows each picture from its time until the next one's, to half a picture's interval.

    Where two fall into one interval the later one is shown, so that times never drift.
    """

    def __init__(self, file: VideoEncoder, fps: float) -> None:
        self._file, self._fps = file, fps
        self._begun_s: float | None = None
        self._shown: tuple[int, Picture] | None = None

    def show(
        self,
        t_s: float,
        picture: Picture,  # [H, W, 3] RGB
    ) -> None:
        """The next picture; times are seconds and increase."""
        if self._begun_s is None:
            self._begun_s = t_s
        slot = round((t_s - self._begun_s) * self._fps)
        if self._shown is not None:
            before, last = self._shown
            for _ in range(slot - before):
                self._file.add(last)
        self._shown = slot, picture

    def end(self) -> None:
        """The last picture is shown for one interval."""
        if self._shown is not None:
            self._file.add(self._shown[1])


def usual_fps(
    t_s: npt.NDArray[np.float64],  # [N] increasing
    indices: npt.NDArray[np.intp],  # [N] increasing
) -> float:
    """Frames a second of a recording whose frames ``indices`` have the times ``t_s``: by the median
    interval, 1 for a single frame."""
    if len(t_s) < 2:
        return 1.0
    return float(1.0 / np.median(np.diff(t_s) / np.diff(indices)))
