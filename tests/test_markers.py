"""``make markers``, a part of ``make check``: no marker of an unfinished merge is committed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.skipif(
    shutil.which("git") is None or shutil.which("make") is None, reason="no git or no make here"
)


def run(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("marker", ["<" * 7 + " HEAD", "=" * 7, ">" * 7 + " other"])
def test_a_marker_of_a_merge_fails_the_check_and_nothing_else_does(
    tmp_path: Path, marker: str
) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    page = tmp_path / "page.md"
    page.write_text("trailing  \n \t spaces\n\n")
    run(tmp_path, "git", "init", "--quiet")
    run(tmp_path, "git", "add", "page.md")
    sound = run(tmp_path, "make", "markers")
    assert sound.returncode == 0, sound.stdout + sound.stderr
    page.write_text(f"text\n{marker}\n")
    found = run(tmp_path, "make", "markers")
    assert found.returncode != 0
    assert "page.md:2: leftover conflict marker" in found.stdout


def test_the_check_of_the_project_asks_for_it() -> None:
    [check] = [line for line in (ROOT / "Makefile").read_text().splitlines() if "check: " in line]
    assert "markers" in check.split("##")[0].split()
