"""``python -m aquaflow.lab.batch.examining_process``: looks at recordings, which may crash it.

Reads a path from each line of stdin, as JSON, and answers with a line: frames, width and height,
each null where it is not known. What libraries print goes to stderr.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from aquaflow.sources import open_recording
from aquaflow.types import Frame

MOST_LOOKED_AT = 30
"""Frames, at the start of a recording, of which one should be readable."""


def look(path: Path) -> dict[str, Any]:
    """Frames, width and height of the recording at ``path``.

    Raises:
        InputError: it cannot be opened.
    """
    recording = open_recording(path)
    try:
        size: dict[str, Any] = {"width": None, "height": None}
        for frame in recording.frames(stop=MOST_LOOKED_AT):
            if isinstance(frame, Frame):
                height, width = frame.image.shape[:2]
                size = {"width": int(width), "height": int(height)}
                break
        return {"frames": recording.frame_count, **size}
    finally:
        recording.close()


def main() -> None:
    """Entry point of the process."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        try:
            found = look(Path(json.loads(line)))
        except Exception:  # its job will say what is wrong with it
            found = {}
        print(json.dumps(found), file=answers, flush=True)


if __name__ == "__main__":
    main()
