"""Presets are overrides of the config; options on the command line go on top of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.config import Config, parse_config
from aquaflow.config.presets import PRESETS, configured, merged, preset
from aquaflow.errors import ConfigError


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_is_a_valid_config(name: str) -> None:
    parse_config(merged(Config().model_dump(), preset(name)), name)


def test_balanced_is_the_default() -> None:
    assert preset("balanced") == {}


def test_presets_are_ordered_by_effort() -> None:
    steps = [
        parse_config(merged(Config().model_dump(), preset(name)), name).mapping.optimiser
        for name in ("fast", "balanced", "accurate")
    ]
    assert steps[0].refine_steps < steps[1].refine_steps < steps[2].refine_steps


def test_an_unknown_preset_names_those_there_are() -> None:
    with pytest.raises(ConfigError, match="no preset 'slow'; choose fast, balanced, accurate"):
        preset("slow")


def test_merging_changes_neither_side_and_none_overrides_nothing() -> None:
    base, top = {"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 5}, "d": None}
    assert merged(base, top) == {"a": {"b": 5, "c": 2}, "d": 3}
    assert base == {"a": {"b": 1, "c": 2}, "d": 3}
    preset("fast")["mapping"]["max_gaussians"] = 0
    assert preset("fast")["mapping"]["max_gaussians"] > 0


def test_the_command_line_goes_over_the_preset_and_the_preset_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("seed: 5\nmapping: {optimiser: {refine_steps: 7, steps_common: 9}}\n")
    found = configured(
        file, "fast", {"mapping": {"optimiser": {"refine_steps": 11}}}, "command line"
    )
    assert found.seed == 5
    assert found.mapping.optimiser.refine_steps == 11
    assert found.mapping.optimiser.steps_common == 2
