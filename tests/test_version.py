"""The version is the newest git tag; without tags or git there is a fallback."""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.skipif(
    find_spec("setuptools_scm") is None or shutil.which("git") is None,
    reason="no setuptools-scm or no git here",
)


def run(*command: str, cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


@pytest.fixture
def clone(archive: Path) -> Path:
    """A repository with one commit and no tag."""
    me = ("-c", "user.name=test", "-c", "user.email=test@localhost")
    run("git", "init", "--quiet", cwd=archive)
    run("git", "add", ".", cwd=archive)
    run("git", *me, "commit", "--quiet", "--no-gpg-sign", "-m", "one", cwd=archive)
    return archive


def version_of(folder: Path) -> str:
    return run(sys.executable, "-m", "setuptools_scm", cwd=folder)


def test_an_archive_without_git_has_the_fallback_version(archive: Path) -> None:
    assert version_of(archive) == "0.1.0"


def test_a_clone_without_tags_names_its_commit(clone: Path) -> None:
    commit = run("git", "rev-parse", "--short=7", "HEAD", cwd=clone)
    assert version_of(clone).startswith(f"0.1.1.dev1+g{commit}")


@pytest.mark.parametrize(
    ("tag", "version"), [("v0.2.0", "0.2.0"), ("recorded-2026", "0.1.1.dev1+g")]
)
def test_only_a_tag_that_is_a_version_counts(clone: Path, tag: str, version: str) -> None:
    run("git", "tag", tag, cwd=clone)
    assert version_of(clone).startswith(version)
