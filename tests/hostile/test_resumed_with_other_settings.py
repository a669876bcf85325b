"""A dive is not resumed with pictures of another size than its keyframes have."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.config import Config, SourceConfig, dump_config
from aquaflow.errors import InputError
from aquaflow.service.same_pictures import check_same_pictures


def settings(**source: object) -> Config:
    return Config(source=SourceConfig.model_validate(source))


@pytest.mark.parametrize(
    ("before", "asked"),
    [({"width": 160}, {"width": 240}), ({}, {"width": 240}), ({"crop": "left"}, {})],
)
def test_another_width_or_crop_is_refused_with_both_values(
    tmp_path: Path, before: dict[str, object], asked: dict[str, object]
) -> None:
    dump_config(settings(**before), tmp_path / "config.yaml")
    with pytest.raises(InputError, match=r"begun with source\.(width|crop).*--new"):
        check_same_pictures(tmp_path, settings(**asked))


def test_the_same_pictures_and_other_settings_are_resumed(tmp_path: Path) -> None:
    dump_config(settings(width=160, every=2), tmp_path / "config.yaml")
    check_same_pictures(tmp_path, settings(width=160, every=1))


def test_a_lost_config_leaves_it_to_the_checkpoint(tmp_path: Path) -> None:
    check_same_pictures(tmp_path, settings(width=160))
