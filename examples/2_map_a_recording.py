"""Map a recording and read the result: python examples/2_map_a_recording.py SOURCE DIVE

SOURCE is a video, a folder of pictures, or what `aquaflow lab synth SOURCE` wrote.
"""

from __future__ import annotations

import sys

import aquaflow


def main(source: str, out: str) -> None:
    """Map ``source`` into ``out`` and print what came of it."""
    dive = aquaflow.map_recording(
        source,
        out,
        preset="fast",
        settings={"source": {"stop": 12}},  # the first twelve pictures; leave it out for all
        overwrite=True,
    )
    posed = len(dive.trajectory)
    print(f"{posed} of {len(dive)} frames have a pose; see {dive.path / 'report.html'}")
    for row in dive.frames:
        if row.reason:
            print(f"frame {row.index} at {row.t_s:.2f} s has none: {row.reason}")
    if dive.metrics["psnr"] is not None:
        print(f"held-out frames are rendered with a PSNR of {dive.metrics['psnr']:.1f} dB")

    scene = aquaflow.load_map(dive.path)
    gaussians = scene.gaussians
    low, high = gaussians.means.min(axis=0), gaussians.means.max(axis=0)
    print(f"{len(scene)} Gaussians between {low.round(2)} and {high.round(2)} {scene.unit}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
