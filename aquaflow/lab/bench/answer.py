"""How a process of a benchmark answers: a job comes in on stdin, its row goes out on stdout."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable
from typing import Any, TypeVar

from aquaflow.base.errors import AquaFlowError

AnyJob = TypeVar("AnyJob")


def answer(from_text: Callable[[str], AnyJob], perform: Callable[[AnyJob], dict[str, Any]]) -> None:
    """Print the row of one job as JSON; of one that failed, the sentence that says why."""
    logging.captureWarnings(True)
    job = from_text(sys.stdin.read())
    try:
        row = perform(job)
    except AquaFlowError as error:
        row = {"failed": str(error)}
    print(json.dumps(row))
