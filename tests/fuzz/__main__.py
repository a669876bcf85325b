"""``python -m tests.fuzz``: see the package's docstring."""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
from pathlib import Path

from tests.command_server import IMPORTED

from .child import home_of, temporary_of
from .commands import all_commands
from .exemplars import make_exemplars
from .privileges import own_to_nobody
from .session import BATCH, Session
from .table import printed


def main() -> int:
    """Run for the asked time; 1 if there was a find."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz")
    parser.add_argument("--seconds", type=float, default=120.0, help="wall time, beside the start")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[""], help="commands whose names begin so")
    parser.add_argument(
        "--interrupt", type=float, default=12.0, help="s until long ones get Ctrl-C"
    )
    parser.add_argument("--batch", type=int, default=BATCH, help="runs of a command's turn")
    parser.add_argument("--keep", type=Path, help="folder for the folders of finds")
    asked = parser.parse_args()
    _import_all()
    commands = [each for each in all_commands() if each.name.startswith(tuple(asked.only))]
    with tempfile.TemporaryDirectory(prefix="aquaflow-fuzz-") as root:
        work, exemplars = Path(root), Path(root) / "exemplars"
        work.chmod(0o711)
        for folder in (exemplars, temporary_of(exemplars), home_of(exemplars)):
            folder.mkdir()
        own_to_nobody(work)
        make_exemplars(exemplars)
        session = Session(
            commands, exemplars, work, asked.seed, asked.interrupt, asked.keep, asked.batch
        )
        session.run(asked.seconds)
    print(printed(session))
    return 1 if session.found else 0


def _import_all() -> None:
    """What takes seconds to import, once; nothing here may start a thread."""
    for module in (*IMPORTED, "onnxruntime"):
        importlib.import_module(module)


if __name__ == "__main__":
    sys.exit(main())
