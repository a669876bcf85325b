"""One frame's way through the code: which of our files and functions it calls.

    python -m tests.trace_a_frame RECORDING [--frame N]

Maps the recording (without refinement) up to frame N and lists what that frame's processing calls,
file by file, in the order of the first call; docs/frame.md tells the same way in words.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import FrameType
from typing import Any

from aquaflow.config import Config
from aquaflow.slam import Slam
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame

ROOT = Path(__file__).resolve().parents[1]
OWN = f"{ROOT}/aquaflow/"


def called_in_one_frame(recording: Path, number: int) -> dict[str, list[str]]:
    """By file, the functions that the ``number``-th frame of ``recording`` calls."""
    source = open_recording(recording)
    config = Config.model_validate({"threads": 1})
    prepare, slam = Preparation(config.source, source.camera), Slam(config)
    called: dict[str, dict[str, None]] = {}

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(OWN):
            file = str(Path(code.co_filename).relative_to(ROOT))
            called.setdefault(file, {})[getattr(code, "co_qualname", code.co_name)] = None

    try:
        for frame in source.frames(stop=number + 1):
            assert isinstance(frame, Frame)
            if frame.index == number:
                sys.setprofile(note)
            slam.process(prepare(frame))
    finally:
        sys.setprofile(None)
        slam.close()
        source.close()
    return {file: list(functions) for file, functions in called.items()}


def main() -> None:
    """Print the way of one frame, and how many files and functions it is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frame", type=int, default=20)
    asked = parser.parse_args()
    called = called_in_one_frame(asked.recording, asked.frame)
    for file, functions in called.items():
        print(file)
        for function in functions:
            print(f"    {function}")
    print(f"{len(called)} files, {sum(map(len, called.values()))} functions")


if __name__ == "__main__":
    main()
