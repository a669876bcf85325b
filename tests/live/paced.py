"""``aquaflow run`` on a recording of which every picture waits until the loop asks for it.

A live dive takes the newest picture, so that what it maps depends on how fast the machine is; with
this one every picture is taken, at the machine's own pace. As a program:
``paced.py [--full-disk-at INDEX | --killed-at INDEX] run ...``: at that picture of the recording,
once a checkpoint that is newer than it was written, files cannot grow any more, or the process is
killed; with ``--killed-with-a-report-at``, once a report was written, too, and with
``--little-room-with-a-report-at`` files can only stay small from there on.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from aquaflow.live.checkpoint.generations import state_file
from aquaflow.sources.newest import Newest
from aquaflow.types import Dropped, Frame

ROOM_BYTES = 64
"""No file can become larger: nothing new can be written, what is there stays."""
LITTLE_BYTES = 16_384
FAST = "1000"
"""Times as fast as the recording: pictures are always there when they are asked for."""
LOOK_S = 0.02


def fill_the_disk() -> None:
    """The operating system says no, not a mock."""
    sys.dont_write_bytecode = True  # Python cuts a compiled module short without a word
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM_BYTES, resource.RLIM_INFINITY))


def leave_little_room() -> None:
    """A path finds room, a map does not."""
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (LITTLE_BYTES, resource.RLIM_INFINITY))


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


HAPPENINGS: dict[str, Callable[[], None]] = {
    "--little-room-with-a-report-at": leave_little_room,
    "--full-disk-at": fill_the_disk, "--killed-at": kill, "--killed-with-a-report-at": kill,
}  # fmt: skip


def every_picture(at: int | None, happen: Callable[[], None], files: list[Path]) -> None:
    """From now on pictures wait until they are asked for; at picture ``at``, and once the ``files``
    are newer, ``happen``."""
    put = Newest.put

    def put_when_asked(self: Newest[Frame | Dropped], frame: Frame | Dropped) -> None:
        if frame.index == at:
            for file in [*files, *files]:  # what is written at first may be of long before
                wait_for_newer(file, time.time())
            happen()
        while not self.wait_for_consumer(1.0):
            pass
        put(self, frame)

    Newest.put = put_when_asked  # type: ignore[assignment,method-assign]


def wait_for_newer(file: Path, than: float) -> None:
    """Until ``file`` was written after ``than``, in seconds since 1970."""
    while not (file.is_file() and file.stat().st_mtime > than):
        threading.Event().wait(LOOK_S)


def paced_run(
    source: Path, config: Path, dive: Path, *happening: str
) -> subprocess.CompletedProcess[str]:
    """The dive of ``source`` in a process of its own, with one of HAPPENINGS and its picture."""
    command = [sys.executable, __file__, *happening, "run", "--speed", FAST]
    command += ["--config", str(config), "--source", str(source), "--out", str(dive)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    index, happens, dive = None, kill, Path(sys.argv[sys.argv.index("--out") + 1])
    awaited = [state_file(dive), *([dive / "report.html"] if "report" in sys.argv[1] else [])]
    if sys.argv[1] in HAPPENINGS:
        happens, index = HAPPENINGS[sys.argv[1]], int(sys.argv[2])
        del sys.argv[1:3]
    every_picture(index, happens, awaited)
    from aquaflow.cli import main

    main()
