"""Presets are overrides of the config; options on the command line go on top of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.cli.console import PRESETS as PRESETS_IN_HELP
from aquaflow.config import Config, parse_config
from aquaflow.config.presets import (
    BY_EFFORT,
    PRESETS,
    load_configured,
    merge,
    preset,
)
from aquaflow.config.vehicle import load_vehicle

ON_A_GPU = ("onboard-gpu", "paper", "paper-strict")


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_is_a_valid_config(name: str) -> None:
    parse_config(merge(Config().model_dump(), preset(name)), name)


def test_balanced_is_the_default() -> None:
    assert preset("balanced") == {}


def test_presets_are_ordered_by_effort() -> None:
    steps = [
        parse_config(merge(Config().model_dump(), preset(name)), name).mapping.optimiser
        for name in BY_EFFORT
    ]
    assert steps[0].refine_steps < steps[1].refine_steps < steps[2].refine_steps


def test_every_preset_is_in_the_help_and_those_never_measured_say_so() -> None:
    assert set(PRESETS) == {*BY_EFFORT, "small", *ON_A_GPU}
    listed, _, said = PRESETS_IN_HELP.partition(";")
    assert listed.split(" | ") == list(PRESETS)
    assert "never measured on a GPU" in said


def test_a_learned_prior_of_ones_own_stays_under_a_preset_for_a_gpu(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(f"prior: {{kind: folder, folder: {tmp_path}}}\n")
    for name in ON_A_GPU:
        assert load_configured(file, name, {}, "test").prior.folder == tmp_path


def test_a_vehicle_runs_with_a_preset_on_top_of_its_file(tmp_path: Path) -> None:
    file = tmp_path / "vehicle.yaml"
    file.write_text("seed: 5\nmapping: {max_gaussians: 1000}\n")
    assert load_vehicle(file).mapping.max_gaussians == 1000
    found = load_vehicle(file, "onboard-gpu")
    assert (found.seed, found.mapping.max_gaussians) == (5, 600_000)
    with pytest.raises(ConfigError, match="no preset 'gpu'"):
        load_vehicle(None, "gpu")


def test_an_unknown_preset_names_those_there_are() -> None:
    with pytest.raises(ConfigError, match="no preset 'slow'; choose fast, balanced, accurate"):
        preset("slow")


def test_merging_changes_neither_side_and_none_overrides_nothing() -> None:
    base, top = {"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 5}, "d": None}
    assert merge(base, top) == {"a": {"b": 5, "c": 2}, "d": 3}
    assert base == {"a": {"b": 1, "c": 2}, "d": 3}
    preset("fast")["mapping"]["max_gaussians"] = 0
    assert preset("fast")["mapping"]["max_gaussians"] > 0


def test_the_command_line_goes_over_the_preset_and_the_preset_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("seed: 5\nmapping: {optimiser: {refine_steps: 7, steps_common: 9}}\n")
    found = load_configured(
        file, "fast", {"mapping": {"optimiser": {"refine_steps": 11}}}, "command line"
    )
    assert found.seed == 5
    assert found.mapping.optimiser.refine_steps == 11
    assert found.mapping.optimiser.steps_common == 2
