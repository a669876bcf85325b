"""docs/paper.md states what the paper's presets set, and they set nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from aquaflow.config import Config
from aquaflow.config.presets import PRESETS, load_configured, preset

PAGE = Path(__file__).resolve().parents[2] / "docs" / "paper.md"
TABLE = re.compile(r"^## .*{#paper-strict}$.*?^\| the paper [^\n]*\n[^\n]*\n(.*?)\n\n", re.M | re.S)
KEY = re.compile(r"`([a-z_.]+)`")


def leaves(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted path and value of every key below ``values``."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def settings(name: str) -> dict[str, Any]:
    """Every key of the config under a preset."""
    return dict(leaves(load_configured(None, name, {}, "test").model_dump()))


@cache
def rows() -> dict[str, tuple[str, str]]:
    """What the table says of each key: under paper-strict, bold if under paper too, and by default.

    A row with several keys has a value for each, or one for all.
    """
    (body,) = TABLE.findall(PAGE.read_text(encoding="utf-8"))
    found: dict[str, tuple[str, str]] = {}
    for line in body.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        keys = KEY.findall(cells[1])
        assert keys, f"no key in {line}"
        values = [cell.split(", ") for cell in cells[2:4]]
        spread = [each * len(keys) if len(each) == 1 else each for each in values]
        for key, strict, default in zip(keys, *spread, strict=True):
            assert key not in found, f"{key} stands there twice"
            found[key] = (strict, default)
    return found


def test_the_table_has_each_key_that_a_preset_of_the_paper_sets_and_no_other() -> None:
    set_by = {path for name in ("paper", "paper-strict") for path, _ in leaves(preset(name))}
    assert set(rows()) == set_by


def test_the_table_has_the_values_of_paper_strict_and_of_the_defaults() -> None:
    stated = {key: (strict.strip("*"), default) for key, (strict, default) in rows().items()}
    strict, default = settings("paper-strict"), settings("balanced")
    assert stated == {key: (_as_stated(strict[key]), _as_stated(default[key])) for key in stated}


def test_what_is_bold_in_the_table_and_nothing_else_is_set_by_paper() -> None:
    bold = {key for key, (strict, _) in rows().items() if strict.startswith("**")}
    strict, paper = settings("paper-strict"), settings("paper")
    assert {key for key in rows() if paper[key] == strict[key]} == bold
    assert bold == {path for path, _ in leaves(preset("paper"))}


@pytest.mark.parametrize("name", [name for name in PRESETS if name.startswith("paper")])
def test_no_key_of_the_papers_presets_is_the_default_anyway(name: str) -> None:
    default = dict(leaves(Config().model_dump()))
    assert not {key for key, value in leaves(preset(name)) if value == default[key]}


def _as_stated(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else format(value, "," if isinstance(value, int) else "")
