"""What several tests share: the command line in a process of its own, and one small mapped dive.

What a new test has to respect, so that `make test` stays quick and passes on a busy machine:

- It runs in one of two processes, one thread each (below). A file's tests run in one process, one
  after the other: what several tests of a file need is a fixture of that module, made once.
- Start from `small_recording` (24 pictures) and `small_dive` (its map); both are made once for all
  processes and are only read: copy one before changing it. No test maps a whole dive of its own
  where a part shows it (`--stop 10`, `--tracking-only`, HASTY), or draws larger pictures than it
  needs.
- `aquaflow(...)` costs 0.1 s of CPU; a new interpreter that imports torch costs 3 s.
- Nothing may depend on how fast the machine is. Wait for a state or an event, never for a time;
  give code that looks at a clock a simulated one; a give-up limit is GIVE_UP_S, since it only ends
  a test that fails. A live dive takes every picture with `tests/live/paced.py`.
- Two CPU seconds are much. What needs minutes is marked `slow` and has a quick relative here.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests.command_line import Cli, Ran, refused, run_aquaflow
from tests.command_server import LINE_S
from tests.made_once import made_once
from tests.small_recording import FRAMES, HEIGHT, QUICK, WIDTH

__all__ = ["Cli", "Ran", "refused", "run_aquaflow"]

# What a stage raises ends a test: a contained defect would stay hidden
# (aquaflow/base/errors/failures.py).
os.environ["AQUAFLOW_STRICT"] = "1"

# Before torch, OpenCV and BLAS are loaded, here and in the processes that tests start: tests run
# side by side, and threads of several processes that share cores only wait for each other.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_variable, "1")

# A machine that does other work meanwhile is slow, not wrong.
settings.register_profile("aquaflow", deadline=None)
settings.load_profile("aquaflow")

# Modules and tests stay until the process ends. While they are loaded, and in every test after
# that, the collector would look through all of them again: a third of what collecting tests costs.
gc.disable()

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.fixture
def contained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Failures are contained, as in the field."""
    monkeypatch.setenv("AQUAFLOW_STRICT", "0")


@pytest.fixture(scope="session", autouse=True)
def defects_so_far() -> Iterator[list[str]]:
    """Programming errors of ours that a stage contained since this list was emptied."""
    from aquaflow.base.errors.failures import Failures

    found, record = list[str](), Failures.record

    def noted(self: Failures, stage: str, error: Exception, frame: int | None = None) -> None:
        record(self, stage, error, frame)
        found.extend(self.defects())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Failures, "record", noted)
        yield found


@pytest.fixture(autouse=True)
def contained_defects(defects_so_far: list[str]) -> Iterator[list[str]]:
    """No test passes by containing a programming error of ours. One that plants some empties this
    list of them at its end."""
    yield defects_so_far
    left = list(dict.fromkeys(defects_so_far))
    defects_so_far.clear()
    assert not left, left


@pytest.fixture(scope="session")
def aquaflow() -> Cli:
    """``aquaflow("map", source, "--out", dive)`` runs the command in a process of its own."""
    return run_aquaflow


@pytest.fixture
def command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Cli:
    """``command("map", source)`` calls the entry point of ``aquaflow`` in this process: the same
    options and the same net for errors, without the seconds that torch takes to start."""
    from aquaflow import cli
    from aquaflow.cli import console

    monkeypatch.setattr(console, "LINE_S", LINE_S)
    logger = logging.getLogger("aquaflow")  # a command's handler writes to what this test captures
    monkeypatch.setattr(logger, "handlers", [*logger.handlers])
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def run(*arguments: object) -> Ran:
        monkeypatch.setattr(sys, "argv", ["aquaflow", *map(str, arguments)])
        capsys.readouterr()
        code: object = 0
        try:
            cli.main()
        except SystemExit as end:
            code = end.code or 0
        said = capsys.readouterr()
        assert isinstance(code, int)
        return Ran(code, said.out, said.err)

    return run


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """A folder of three pictures of noise, 160 x 120 px: a recording that costs nothing."""
    import cv2
    import numpy as np

    folder = tmp_path / "pictures"
    folder.mkdir()
    random = np.random.default_rng(0)
    for i in range(3):
        picture = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    return folder


def unchanged(folder: Path) -> Iterator[Path]:
    """``folder``, for tests that only read it: others read it at the same time."""

    def files() -> dict[Path, tuple[int, int]]:
        found = ((path, path.stat()) for path in sorted(folder.rglob("*")) if path.is_file())
        return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in found}

    before = files()
    yield folder
    assert files() == before, f"a test changed {folder}, which others share: copy it first"


@pytest.fixture(scope="session")
def small_recording(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A synthetic dive of 24 small pictures, made once."""

    def make(folder: Path) -> None:
        from aquaflow.lab.synthetic.config import SyntheticConfig
        from aquaflow.lab.synthetic.dive import write_dive

        write_dive(folder, SyntheticConfig(frames=FRAMES, width=WIDTH, height=HEIGHT))

    yield from unchanged(made_once(tmp_path_factory, "small_recording", make))


@pytest.fixture(scope="session")
def small_dive(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The dive folder of the small recording, mapped once."""

    def make(folder: Path) -> None:
        ran = run_aquaflow("map", small_recording, "--out", folder, *QUICK)
        assert ran.code == 0, ran.err

    yield from unchanged(made_once(tmp_path_factory, "small_dive", make))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The real recordings; tests that need them are skipped where they are not."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real recordings are not at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """torch as the pipeline has it: barriers between threads cost more than small tensors."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module", autouse=True)
def no_watchdog_is_left() -> Iterator[None]:
    """No file of tests leaves a watchdog behind: that of a dive which was not closed ends this
    process, and the tests that follow, once its heartbeats are old (health/heartbeats.py)."""
    before = _watchdogs()
    yield
    assert _watchdogs() <= before, "a live dive or a service was not closed"


def _watchdogs() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "watchdog"}


@pytest.fixture(scope="session")
def onnxscript() -> None:
    """Its import takes seconds: only where a test runs, not where tests are collected."""
    pytest.importorskip("onnxscript", reason="pip install 'aquaflow[export]'")
