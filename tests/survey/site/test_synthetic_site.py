"""Two dives of one synthetic scene, under other water and light, are merged as the truth says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.config import Config, SourceConfig
from aquaflow.dive.replay import map_recording
from aquaflow.dive.tum import read_tum
from aquaflow.geometry.alignment import align
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.sources import open_recording
from aquaflow.survey.site.merged_file import MergedSite
from aquaflow.survey.site.merging import add_to_site, merge
from tests.made_once import made_once
from tests.small_recording import FRAMES, HEIGHT, WIDTH

OTHER = SyntheticConfig(
    frames=FRAMES, width=WIDTH, height=HEIGHT, water="coastal_3C", snow_per_m3=10.0,
    noise_sigma=0.008, vignette=0.35,
)  # fmt: skip
"""The same scene and way as the small recording's, in water that takes more light."""
PARTS = {"clear": SourceConfig(stop=18), "green": SourceConfig(start=6)}
"""What of the way each dive sees."""


def config_of(name: str) -> Config:
    return Config.model_validate({"mapping": {"enabled": False}, "source": PARTS[name]})


@pytest.fixture(scope="module")
def recordings(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    other = made_once(tmp_path_factory, "other_water", lambda folder: write_dive(folder, OTHER))
    return [small_recording, other]


@pytest.fixture(scope="module")
def site(recordings: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic_site")
    dives = []
    for name, recording in zip(("clear", "green"), recordings, strict=True):
        finished = map_recording(open_recording(recording), name, folder / name, config_of(name))
        dives.append(finished.dive)
    add_to_site(folder / "site", dives)
    return folder / "site"


@pytest.fixture(scope="module")
def merged(site: Path) -> MergedSite:
    return merge(site)


@pytest.mark.ci
def test_both_paths_fit_the_truth_by_one_similarity(
    site: Path, merged: MergedSite, recordings: list[Path]
) -> None:
    assert len(merged.components) == 1
    found, true = [], []
    for name, recording in zip(("clear", "green"), recordings, strict=True):
        path, truth = read_tum(site / "paths" / f"{name}_0.tum"), read_tum(recording / "poses.tum")
        at = np.abs(truth.t_s[None] - path.t_s[:, None]).argmin(axis=1)
        found.append(path.positions)
        true.append(truth.positions[at])
    estimate, truth_m = np.concatenate(found), np.concatenate(true)
    T = align(estimate, truth_m, with_scale=True).T_target_source
    off = T.apply(estimate) - truth_m
    length = sum(np.linalg.norm(np.diff(each, axis=0), axis=1).sum() for each in true)
    rmse = float(np.sqrt((off**2).sum(axis=1).mean()))
    assert rmse < 0.003 * length
