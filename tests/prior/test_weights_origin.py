"""What the shipped weights were trained on: manifest, README, CITATION, docs and notes agree."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

import aquaflow
from aquaflow.prior.folder import read_card

ROOT = Path(__file__).parents[2]
WEIGHTS = Path(aquaflow.__file__).parent / "prior" / "weights" / "compact"
PAGES = sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "notes").glob("*.md"), ROOT / "README.md"])

COMPACT = re.compile(r"\bcompact\b")
CLIPS = re.compile(r"Curasao|curasao|reef.clip|\breef, every")
TOLD = re.compile(r"†|not held out|\(?version 1\b")
"""Version 1 of the weights learned from generated pictures alone."""


@pytest.fixture(scope="module")
def training() -> dict[str, Any]:
    training = read_card(WEIGHTS).training
    assert training is not None
    return training


def test_the_manifest_has_source_and_licence_of_every_clip(training: dict[str, Any]) -> None:
    sources = training["sources"]
    assert set(sources) == set(training["pictures"])
    for source in sources.values():
        assert source["from"].startswith("https://")
        assert source["licence"] in read_card(WEIGHTS).licence
    of_maps = {name.removeprefix("map_") for name in training["maps"]}
    assert all(any(name.startswith(of) for name in sources) for of in of_maps)


@pytest.mark.parametrize("page", ["README.md", "docs/prior.md"])
def test_a_page_that_says_what_weights_learned_from_names_every_clip(
    page: str, training: dict[str, Any]
) -> None:
    text = " ".join((ROOT / page).read_text().split())
    for source in training["sources"].values():
        place = text.index(source["from"])
        assert source["licence"] in text[place : place + 100]


def test_citation_refers_to_every_clip(training: dict[str, Any]) -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    referred = {ref["repository-code"]: ref["license"] for ref in citation["references"]}
    sources = training["sources"].values()
    assert referred == {source["from"]: source["licence"] for source in sources}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.name))
def test_figures_on_the_clips_that_weights_learned_from_say_so(page: Path) -> None:
    """A paragraph or table with the compact prior and one of these clips."""
    for paragraph in re.split(r"\n\s*\n", page.read_text()):
        if COMPACT.search(paragraph) and CLIPS.search(paragraph):
            assert TOLD.search(paragraph), f"{page.name}: {paragraph[:300]}"
