"""kill -9 at random moments of a replayed live dive: every start resumes, no file is corrupt."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.dive.frames_csv import read_rows
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from tests.live.killed_dives import kill_and_resume


def tracked_to_the_end(dive: Path, frames: int) -> None:
    """The trajectory covers the dive: posed frames near its beginning and its end."""
    posed = [row.index for row in read_rows(dive / "frames.csv") if row.keyframe is not None]
    assert posed[0] < 0.2 * frames
    assert posed[-1] > 0.8 * frames
    assert json.loads((dive / "metrics.json").read_text())["tracked"] == len(posed)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [4, 50])
def test_a_dive_that_is_killed_goes_on_each_time(tmp_path: Path, kills: int) -> None:
    source, frames = tmp_path / "recording", 40 * kills
    write_dive(source, SyntheticConfig(frames=frames, width=160, height=120))
    killed = kill_and_resume(source, tmp_path, kills, longest_s=4.0, speed=1.0)
    assert killed.kills == kills
    assert killed.resumed == kills
    assert killed.known == sorted(killed.known)
    tracked_to_the_end(tmp_path / "dive", frames)
