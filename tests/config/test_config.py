"""The config: misspelt keys and bad values are named by their path; what is written reads back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel, ValidationError

from aquaflow.base.errors import ArgumentError, ConfigError, InputError
from aquaflow.base.storage.atomic import write_yaml
from aquaflow.config import Config, StageConfig, load_config, parse_config
from aquaflow.config.mapping import BYTES_PER_GAUSSIAN
from aquaflow.config.service import ViewerConfig
from aquaflow.config.stage import COMMAND_LINE, validate


def nested(path: str, value: object) -> dict[str, Any]:
    """{"a": {"b": value}} for ``a.b``."""
    data: Any = value
    for key in reversed(path.split(".")):
        data = {key: data}
    assert isinstance(data, dict)
    return data


def stages(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Dotted paths of every stage in the config, and their models."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield prefix + name, field.annotation
            yield from stages(field.annotation, f"{prefix}{name}.")


ALL_STAGES = [path for path, _ in stages(Config)]
MODELS = [Config, *dict.fromkeys(model for _, model in stages(Config))]


@pytest.mark.parametrize("stage", ["", *ALL_STAGES])
def test_an_unknown_key_is_named_with_its_path_at_any_depth(stage: str) -> None:
    path = f"{stage}.misspelt" if stage else "misspelt"
    with pytest.raises(ConfigError) as caught:
        parse_config(nested(path, 1), "dive.yaml")
    assert str(caught.value) == (f"dive.yaml: '{path}' is not a known key; see `aquaflow config`")


def test_the_config_has_the_stages_that_these_tests_walk() -> None:
    assert {"source", "tracking.initialisation", "mapping.optimiser"} <= set(ALL_STAGES)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("threads", 0),
        ("seed", "many"),
        ("prior.kind", "clairvoyant"),
        ("prior", {"kind": "folder"}),
        ("prior.threads", 0),
        ("source.every", 0),
        ("source.start", -1),
        ("source.width", 63),
        ("source.fps", 0.0),
        ("tracking.keyframe_share", 1.0),
        ("tracking.min_matches", 9),
        ("tracking.lost_after", 0),
        ("tracking.initialisation.min_share", 0.0),
        ("tracking.initialisation.max_waiting", 2),
        ("mapping.renderer", "pencil"),
        ("mapping.max_gaussians", 10),
        ("mapping.max_gaussians", "200 sheep"),
        ("mapping.max_gaussians", "0.1 MB"),
        ("mapping.resolution_mm", 0.0),
        ("mapping.hold_out_every", -1),
        ("mapping.insertion.tau_a", 1.1),
        ("mapping.loss.ssim", -0.1),
        ("mapping.optimiser.poses", -1e-9),
        ("mapping.optimiser.betas", [0.9]),
        ("mapping.medium.initial_B_inf", 1.0),
    ],
)
def test_a_value_out_of_range_is_named_with_its_path(path: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"here: '{path.replace('.', '[.]')}[.0-9]*' .+; see"):
        parse_config(nested(path, value), "here")


@pytest.mark.parametrize(
    ("given", "found"),
    [
        (2000, 2000),
        ("2000", 2000),
        ("100 MB", int(1e8 / BYTES_PER_GAUSSIAN)),
        ("1.5GB", int(1.5e9 / BYTES_PER_GAUSSIAN)),
    ],
)
def test_gaussians_are_given_as_a_number_or_as_memory(given: object, found: int) -> None:
    config = parse_config(nested("mapping.max_gaussians", given), "here")
    assert config.mapping.max_gaussians == found
    assert parse_config(config.model_dump(mode="json"), "again") == config


def test_keys_that_do_not_go_together_are_told_without_an_empty_name() -> None:
    with pytest.raises(ArgumentError, match=r"^command line: nowhere\.invalid can be reached"):
        validate(ViewerConfig, {"enabled": True, "host": "nowhere.invalid"}, COMMAND_LINE)


def test_a_stage_that_is_no_mapping_is_named() -> None:
    with pytest.raises(ConfigError, match="'tracking'"):
        parse_config({"tracking": 3}, "here")


@pytest.mark.parametrize("stage", MODELS)
def test_every_stage_refuses_unknown_keys_and_changes(stage: type[StageConfig]) -> None:
    with pytest.raises(ValidationError, match="Extra inputs"):
        stage.model_validate({"misspelt": 1})
    built = stage()
    name = next(iter(stage.model_fields))
    with pytest.raises(ValidationError, match="frozen"):
        setattr(built, name, getattr(built, name))


@pytest.mark.parametrize("stage", MODELS)
def test_every_default_passes_its_own_check(stage: type[StageConfig]) -> None:
    assert stage.model_validate(stage().model_dump()) == stage()


def test_what_was_dumped_loads_as_it_was(tmp_path: Path) -> None:
    config = parse_config(
        {
            "seed": 7,
            "source": {"crop": "left", "stop": 40},
            "tracking": {"initialisation": {"focal_factors": [0.9, 1.2]}},
            "mapping": {"optimiser": {"betas": [0.8, 0.95], "refine_seconds": 2.5}},
        },
        "here",
    )
    path = tmp_path / "config.yaml"
    write_yaml(path, config.model_dump(mode="json"))
    assert load_config(path) == config
    assert set(yaml.safe_load(path.read_text())) == set(Config.model_fields)


def test_keys_that_are_absent_keep_their_defaults(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("tracking:\n  matches: 300\n")
    config = load_config(path)
    assert config.tracking.matches == 300
    assert config.mapping == Config().mapping


@pytest.mark.parametrize("text", ["", "# nothing set\n", "{}\n"])
def test_an_empty_file_is_the_defaults(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    assert load_config(path) == Config()


def test_a_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read the config .*nowhere\.yaml"):
        load_config(tmp_path / "nowhere.yaml")


def test_bytes_that_are_no_text_are_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(InputError, match="cannot read the config"):
        load_config(path)


def test_a_file_that_is_not_yaml_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("tracking: [1, 2\nseed: }")
    with pytest.raises(InputError, match=r"config\.yaml is not YAML"):
        load_config(path)


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "just words\n", "3\n"])
def test_a_file_without_keys_is_a_config_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="holds no key: value pairs"):
        load_config(path)


def test_an_unknown_key_in_a_file_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("mapping:\n  loss:\n    sim: 0.2\n")
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(caught.value).startswith(f"{path}: 'mapping.loss.sim' is not a known key")
