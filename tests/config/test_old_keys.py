"""What users decide is public; switches of the lab and keys of before are understood, and said."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from aquaflow.base.errors import ConfigError
from aquaflow.config import Config, MappingConfig, load_config
from aquaflow.config.presets import PRESETS, load_configured
from aquaflow.config.service import ServiceConfig
from aquaflow.config.stage import (
    CONSTANTS,
    GONE,
    StageConfig,
    stages_of,
    validate,
    without_old_keys,
)
from aquaflow.config.vehicle import VehicleConfig, load_any, load_vehicle
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import deserialise, serialise
from aquaflow.render.reference import ReferenceRenderer
from tests.command_line import Cli

MOST_PUBLIC = 90
"""Keys that a user decides about a dive and its service; equipment is described apart."""


def public_keys(model: type[StageConfig], prefix: str = "") -> Iterator[str]:
    for name, _, below, is_lab in stages_of(model):
        if not is_lab:
            yield from [prefix + name] if below is None else public_keys(below, f"{prefix}{name}.")


def written(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "dive.yaml"
    file.write_text(text)
    return file


def nested(path: str, value: object) -> dict[str, Any]:
    data: Any = value
    for key in reversed(path.split(".")):
        data = {key: data}
    assert isinstance(data, dict)
    return data


def test_a_user_decides_no_more_than_ninety_keys() -> None:
    keys = [*public_keys(Config), *public_keys(ServiceConfig, "service.")]
    assert len(set(keys)) == len(keys)
    assert len(keys) <= MOST_PUBLIC


def test_config_shows_what_a_user_decides_and_with_all_the_labs_too(
    aquaflow: Cli, tmp_path: Path
) -> None:
    shown = yaml.safe_load(aquaflow("config").out)
    assert list(shown["mapping"]["medium"]) == ["enabled", "open_water", "white_balance"]
    assert "decoder" not in shown["mapping"]
    everything = aquaflow("config", "--all").out
    assert yaml.safe_load(everything)["mapping"]["decoder"]["enabled"] is False
    ran = aquaflow("config", "--all", written(tmp_path, everything))
    assert (ran.code, ran.err) == (0, "")


@pytest.mark.parametrize("load", [load_config, load_any, load_vehicle])
def test_a_switch_of_the_lab_in_a_users_file_is_used_and_one_sentence_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, load: Any
) -> None:
    file = written(tmp_path, "mapping: {decoder: {enabled: true}, insertion: {density: 0.5}}")
    assert load(file).mapping.decoder.enabled
    assert [record.message for record in caplog.records] == [
        f"{file}: 'mapping.decoder.enabled' is a switch of the lab now, no setting of a dive; it "
        "is used: set `lab: true` in the file to keep it from the next release on"
    ]


@pytest.mark.parametrize(
    "text",
    [
        "lab: true\nmapping: {decoder: {enabled: true}}",
        "mapping: {decoder: {enabled: false}}",
        "mapping: {optimiser: {betas: [0.9, 0.95]}}",
    ],
)
def test_what_asks_for_the_lab_or_changes_nothing_is_not_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str
) -> None:
    load_config(written(tmp_path, text))
    assert caplog.records == []


def test_presets_python_and_a_dives_own_config_set_the_lab_without_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings = load_configured(None, "paper", {"tracking": {"residual": "point"}}, "here")
    assert (settings.mapping.decoder.enabled, settings.tracking.residual) == (True, "point")
    file = written(tmp_path, yaml.safe_dump(settings.model_dump(mode="json")))
    assert load_config(file, inside=True) == settings
    assert caplog.records == []


def test_a_key_of_the_lab_that_is_misspelt_is_still_refused_with_its_path(tmp_path: Path) -> None:
    file = written(tmp_path, "mapping: {decoder: {enabeld: true}}")
    with pytest.raises(ConfigError, match=r"'mapping\.decoder\.enabeld' is not a known key"):
        load_config(file)


@pytest.mark.parametrize("path", CONSTANTS)
def test_a_setting_that_is_a_constant_now_is_taken_out_and_its_value_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, path: str
) -> None:
    caplog.set_level(logging.WARNING)
    same = without_old_keys(nested(path, CONSTANTS[path]), "here")
    assert validate(VehicleConfig, same, "here") == VehicleConfig()
    assert caplog.records == []
    load_any(written(tmp_path, yaml.safe_dump(nested(path, -7))))
    (record,) = caplog.records
    assert f"'{path}' is a constant now, {CONSTANTS[path]}; the file's -7 is" in record.message


@pytest.mark.parametrize("path", GONE)
def test_a_key_whose_code_went_is_taken_out_and_the_reason_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, path: str
) -> None:
    load_any(written(tmp_path, yaml.safe_dump(nested(path, True))))
    (record,) = caplog.records
    assert f"'{path}' is no key any more and not used: {GONE[path]}" in record.message


def test_a_map_written_with_keys_of_before_is_read(caplog: pytest.LogCaptureFixture) -> None:
    facts, arrays = serialise(Mapper(MappingConfig(), ReferenceRenderer(), 0))
    old = {path: value for path, value in CONSTANTS.items() if path.startswith("mapping.")}
    old |= dict.fromkeys(GONE, False)
    for path, value in old.items():
        *stages, key = path.split(".")[1:]
        below = facts["config"]
        for stage in stages:
            below = below[stage]
        below[key] = value
    assert deserialise(facts, arrays, ReferenceRenderer()).config == MappingConfig()
    assert caplog.records == []


def test_no_key_of_before_is_a_key_of_today_and_no_preset_sets_one() -> None:
    def paths(data: dict[str, Any], prefix: str = "") -> Iterator[str]:
        for name, value in data.items():
            inner = isinstance(value, dict)
            yield from paths(value, f"{prefix}{name}.") if inner else [prefix + name]

    old = {*CONSTANTS, *GONE}
    assert not old & set(paths(VehicleConfig().model_dump()))
    assert not old & {path for each in PRESETS.values() for path in paths(each)}
