"""Track and map pictures one by one, as a program of your own does with its camera.

python examples/1_frame_by_frame.py VIDEO

VIDEO is what OpenCV opens, such as dive.mp4 or pictures/%06d.png. For a recording, `aquaflow map`
does all this and writes a dive folder; on a vehicle, `aquaflow run` does.
"""

from __future__ import annotations

import sys

import cv2

import aquaflow

FRAMES_PER_S = 10.0  # of this camera


def main(video: str) -> None:
    """Process the first twelve frames of ``video``."""
    capture = cv2.VideoCapture(video)
    slam = aquaflow.Slam(aquaflow.Config())
    for index in range(12):
        there, picture = capture.read()
        if not there:
            break
        image = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
        camera = aquaflow.guess_camera(image.shape[1], image.shape[0])  # or your calibration
        t_ns = round(1e9 * index / FRAMES_PER_S)
        # Frames wait until the camera has moved enough for a first map; then several are finished.
        for tracked in slam.process(aquaflow.Frame(index, t_ns, t_ns, image, camera)):
            print(f"frame {tracked.frame.index}: {tracked.frame_class.value} {tracked.reason}")
    slam.finish()  # frames that still wait, and the refinement of the map

    poses = [tracked.T_wc for tracked in slam.results() if tracked.T_wc is not None]
    print(f"{len(poses)} of {len(slam.frames)} frames have a pose")
    for number, mapper in slam.mappers.items():
        print(f"map {number} has {len(mapper.gaussians)} Gaussians from {len(mapper.views)} views")
    if poses:
        print(f"the camera ended at {poses[-1].t.round(3)} in units of the first keyframe's depth")
    slam.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(*sys.argv[1:])
