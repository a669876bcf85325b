"""The commits that `git blame` ignores."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def git(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


@pytest.mark.skipif(not (ROOT / ".git").exists() or shutil.which("git") is None, reason="no git")
def test_every_ignored_commit_is_an_ancestor_of_this_one() -> None:
    if git("rev-parse", "--is-shallow-repository").stdout.strip() != "false":
        pytest.skip("a shallow clone, or git does not trust this folder")
    listed = (ROOT / ".git-blame-ignore-revs").read_text().splitlines()
    commits = [line for line in listed if line and not line.startswith("#")]
    assert commits
    for commit in commits:
        assert re.fullmatch("[0-9a-f]{40}", commit), commit
        assert git("merge-base", "--is-ancestor", commit, "HEAD").returncode == 0, commit
