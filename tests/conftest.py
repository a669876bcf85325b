"""What several tests share: the command line in a process of its own, and one small mapped dive."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import settings

# What a stage raises ends a test: a contained defect would stay hidden (aquaflow/failures.py).
os.environ["AQUAFLOW_STRICT"] = "1"

# A machine that does other work meanwhile is slow, not wrong.
settings.register_profile("aquaflow", deadline=None)
settings.load_profile("aquaflow")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

FRAMES = 24
WIDTH, HEIGHT = 160, 120
QUICK = ("--refine-steps", "60")
"""A map good enough to look at the files; its quality is the bars' business."""


@dataclass(frozen=True)
class Ran:
    """A finished command."""

    code: int
    out: str
    err: str


Cli = Callable[..., Ran]


def run_aquaflow(*arguments: object, timeout_s: float = 400.0) -> Ran:
    """Run ``aquaflow`` as a user does."""
    script = Path(sys.executable).with_name("aquaflow")
    done = subprocess.run(
        [str(script), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    return Ran(done.returncode, done.stdout, done.stderr)


def refused(ran: Ran, *named: object) -> None:
    """The command failed with one sentence that names the input."""
    assert ran.code == 1
    assert ran.out == ""
    assert "Traceback" not in ran.err
    (line,) = ran.err.splitlines()
    assert line.startswith("aquaflow: ")
    for name in named:
        assert str(name) in line


@pytest.fixture
def contained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Failures are contained, as in the field."""
    monkeypatch.setenv("AQUAFLOW_STRICT", "0")


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


@pytest.fixture(scope="session")
def small_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic dive of 24 small pictures, made once."""
    from aquaflow.synthetic import SyntheticConfig, write_dive

    folder = tmp_path_factory.mktemp("recording") / "small"
    write_dive(folder, SyntheticConfig(frames=FRAMES, width=WIDTH, height=HEIGHT))
    return folder


@pytest.fixture(scope="session")
def small_dive(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dive folder of the small recording, mapped once."""
    dive = tmp_path_factory.mktemp("dive") / "small"
    ran = run_aquaflow("map", small_recording, "--out", dive, *QUICK)
    assert ran.code == 0, ran.err
    return dive


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
