"""Start-up stays light: heavy libraries load where they are used, not where they might be."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("torch", "cv2", "depthai")

REPORT = f"""
import sys
print("loaded:", *[name for name in {HEAVY!r} if name in sys.modules])
"""

HELP = """
import sys
sys.argv = ["aquaflow", "--help"]
from aquaflow.cli import main
try:
    main()
except SystemExit as end:
    assert end.code in (0, None), end.code
"""


def loaded_by(code: str) -> tuple[list[str], str]:
    """Heavy modules that a fresh interpreter holds after ``code``, and all that it printed."""
    run = subprocess.run(
        [sys.executable, "-c", code + REPORT],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout.rsplit("loaded:", 1)[1].split(), run.stdout


def test_a_heavy_import_would_be_seen() -> None:
    assert loaded_by("import cv2")[0] == ["cv2"]


@pytest.mark.parametrize(
    "module",
    ["aquaflow", "aquaflow.config", "aquaflow.base.errors", "aquaflow.types", "aquaflow.sources"],
)
def test_importing_the_light_modules_loads_nothing_heavy(module: str) -> None:
    assert loaded_by(f"import {module}")[0] == []


@pytest.mark.skipif(
    not (ROOT / "aquaflow" / "cli").exists(), reason="aquaflow/cli is not written yet"
)
def test_the_help_loads_nothing_heavy() -> None:
    loaded, printed = loaded_by(HELP)
    assert "Usage" in printed
    assert loaded == []
