"""Runs each ``aquaflow`` command in a fork of one process that has imported what commands need.

A line of JSON on the standard input is a command: its words, environment, working folder, and the
files that take its output. The answer is two lines: its process id, and its exit status.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import signal
import sys
import threading
import traceback
from typing import TypedDict

IMPORTED = (
    *("torch", "cv2", "scipy.ndimage", "scipy.optimize", "scipy.spatial", "matplotlib.pyplot"),
    *("aquaflow.cli", "aquaflow.dive.replay", "aquaflow.lab.evaluation.summary"),
    *("aquaflow.survey.report.page", "aquaflow.live.onboard", "aquaflow.lab.synthetic.dive"),
)
"""Slow to import; none of them starts a thread when it is imported, so a fork is whole."""


LINE_S = 3600.0
"""Without a line of progress: what a test maps takes more than a minute on a busy machine."""


class Command(TypedDict):
    """What a shell would set before it starts a program."""

    words: list[str]
    environment: dict[str, str]
    folder: str
    out: str
    err: str


def serve() -> Command | None:
    """Answer until the input ends. Returns the command in each fork, and None in the server."""
    for line in sys.stdin:
        process_id = os.fork()
        if process_id == 0:
            command: Command = json.loads(line)
            return command
        print(process_id, flush=True)
        _, status = os.waitpid(process_id, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)
    return None


def become(command: Command) -> None:
    """Take over files, folder, environment and arguments as a new process has them."""
    create = os.O_WRONLY | os.O_CREAT | os.O_APPEND
    files = ((os.devnull, os.O_RDONLY), (command["out"], create), (command["err"], create))
    for descriptor, (name, flags) in enumerate(files):
        opened = os.open(name, flags)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.chdir(command["folder"])
    os.environ.clear()
    os.environ.update(command["environment"])
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run behind a "&"
    sys.argv = command["words"]


def run() -> int:
    """The exit status, after all that a process does at its end but taking the interpreter apart:
    that would touch, and so copy, all of the server's memory."""
    from aquaflow.cli import console, main

    console.LINE_S = LINE_S
    status = 0
    try:
        main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    threading._shutdown()  # as in multiprocessing's forks: waits for threads that are no daemons
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    return status


if __name__ == "__main__":
    for module in IMPORTED:
        importlib.import_module(module)
    gc.freeze()  # what is here already is not looked through again in every fork
    asked = serve()
    if asked is not None:
        become(asked)
        os._exit(run())
