"""What nobody foresaw: one sentence that says whose fault it is, and a file with the traceback."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from aquaflow.base.errors import crash_report
from aquaflow.config import vehicle
from tests.command_line import Cli, refused

OUR_MISTAKE = 70


def broken(error: BaseException) -> object:
    def load(path: Path) -> None:
        raise error

    return load


@pytest.fixture
def failing(command: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Cli:
    """``failing(error)``: a command in whose middle ``error`` is raised."""

    def run(*arguments: object) -> object:
        (error,) = arguments
        assert isinstance(error, BaseException)
        monkeypatch.setattr(vehicle, "load_any", broken(error))
        return command("config", tmp_path / "any.yaml")

    return run  # type: ignore[return-value]


def test_a_mistake_of_ours_is_called_that_and_kept(failing: Cli, tmp_path: Path) -> None:
    ran = failing(AssertionError("a secret of the input"))
    assert ran.code == OUR_MISTAKE
    (line,) = ran.err.splitlines()
    assert "mistake in AquaFlow itself (AssertionError in test_mistakes.py" in line
    assert "secret" not in line
    (kept,) = (tmp_path / "state" / "aquaflow").iterdir()
    assert str(kept) in line
    assert kept.stat().st_mode & 0o077 == 0
    assert "Traceback" in kept.read_text()


def test_only_the_last_mistake_is_kept(failing: Cli, tmp_path: Path) -> None:
    for kind in (ZeroDivisionError, KeyError):
        failing(kind("x"))
    (kept,) = (tmp_path / "state" / "aquaflow").iterdir()
    assert "KeyError" in kept.read_text()
    assert "ZeroDivisionError" not in kept.read_text()


def test_for_debugging_the_traceback_is_printed(
    failing: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(crash_report.DEBUG, "1")
    ran = failing(IndexError("x"))
    assert ran.code == OUR_MISTAKE
    assert "Traceback" in ran.err


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(28, "No space left on device"), "No space left on device"),
        (PermissionError(13, "Permission denied", "/dives"), "/dives: Permission denied"),
        (MemoryError(), "out of memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), "out of memory"),
    ],
)
def test_the_machines_limits_are_not_called_mistakes(
    failing: Cli, error: Exception, words: str
) -> None:
    refused(failing(error), words)


def test_an_interrupt_keeps_its_exit_code_and_says_what_stays(failing: Cli) -> None:
    ran = failing(KeyboardInterrupt())
    assert ran.code == 130
    assert ran.err == (
        "aquaflow: stopped; what was written so far stays where it is, and the same command begins "
        "anew\n"
    )


@pytest.mark.parametrize("module", ["importlib.metadata", "typer", "aquaflow.cli.export"])
def test_an_interrupt_while_the_command_is_loaded_says_nothing(module: str) -> None:
    pressed = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in a background
        "class Press:\n"
        "    def find_spec(self, name, *_):\n"
        f"        if name == '{module}': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Press())\n"
        "from aquaflow.__main__ import main\n"
        "main()\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", pressed], capture_output=True, check=False, timeout=60
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (-signal.SIGINT, b"", b"")
