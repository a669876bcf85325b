"""A camera driver of your own, here for pictures in one numpy file.

python examples/6_read_your_own_recording.py PICTURES.npz DIVE

`aquaflow map PICTURES.npz` finds the class once its own package registers it in pyproject.toml:

    [project.entry-points."aquaflow.cameras"]
    numpy = "my_package.camera:NumpyRecording"
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import aquaflow


class NumpyRecording:
    """Pictures [N, H, W, 3] uint8 RGB and their times [N] in s; see aquaflow.sources."""

    specificity = 10  # where several drivers recognise a path, the highest opens it

    def __init__(self, path: Path) -> None:
        with np.load(path) as arrays:
            self.images, self.t_s = arrays["images"], arrays["t_s"]
        self.notes: list[str] = []  # sentences for the user on what was left out
        self.camera: aquaflow.CameraModel | None = None  # this file holds no calibration
        self.frame_count: int | None = len(self.images)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.suffix == ".npz"

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> NumpyRecording:
        return cls(path)

    def name_of(self, index: int) -> str:
        return f"picture {index}"

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[aquaflow.Frame]:
        camera = aquaflow.guess_camera(self.images.shape[2], self.images.shape[1])
        for index in range(len(self.images))[start:stop:every]:
            t_ns = round(1e9 * float(self.t_s[index] - self.t_s[0]))
            yield aquaflow.Frame(index, t_ns, t_ns, self.images[index], camera)

    def close(self) -> None: ...


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    recording, without_map = NumpyRecording(Path(sys.argv[1])), {"mapping": {"enabled": False}}
    found = aquaflow.map_recording(recording, sys.argv[2], settings=without_map)
    print(f"{len(found.trajectory)} of {len(found)} frames have a pose")
