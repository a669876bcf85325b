"""Coverage of a running dive: what is shown and hinted at, when, and over HTTP."""

from __future__ import annotations

import http.client
import io
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image

from aquaflow.config.service import ListenConfig
from aquaflow.live.health.http import HealthServer
from aquaflow.live.plan_view import PlanView
from aquaflow.survey.coverage.classes import CoverageClass
from aquaflow.survey.coverage.live_coverage import Hint
from aquaflow.survey.coverage.picture import HEIGHT, WIDTH
from tests.live.health.reports import REPORT
from tests.survey.coverage.covered_dives import CoveredDive
from tests.survey.coverage.surveys import lawnmower


@pytest.fixture
def dive() -> Iterator[CoveredDive]:
    dive = CoveredDive(attenuation=0.5)
    yield dive
    dive.close()


def swum(dive: CoveredDive, path: np.ndarray) -> None:
    for x, y in path:
        dive.swim(x, y)
        dive.live.turn()


def test_a_survey_is_shown_with_its_lines_areas_and_the_waters_range(dive: CoveredDive) -> None:
    swum(dive, lawnmower(2, 8.0, 1.0, 0.45))
    said = dive.live.to_json()[0]
    assert len(said["lines"]) == 2
    assert said["overlap"] == pytest.approx(1.0 - 1.0 / 2.4, abs=0.02)
    assert said["range_limit"] == pytest.approx(np.log(6.0) / 0.5, abs=1e-3)
    assert said["areas"]["well"] > 10.0
    assert said["next_line"]["new_share"] > 0.3
    plan = dive.live.plan(0)
    assert plan is not None
    assert plan.cells[CoverageClass.WELL] * (plan.frame.cell**2) > 0.0
    assert dive.live.plan(7) is None
    page = PlanView(lambda: dive.parts, coverage=dive.live).to_json()
    assert page["hints"] == []
    assert page["sub_maps"][0]["coverage"] == said


def test_swimming_fast_is_hinted_at_until_it_is_slow_again(dive: CoveredDive) -> None:
    for i in range(12):
        dive.swim(0.0, 1.0 * i)
    dive.live.turn()
    assert dive.live.hints == (Hint.TOO_FAST,)
    assert dive.live.in_words() == ["too fast for the wanted overlap: 44 %"]
    for i in range(14):
        dive.swim(0.0, 11.0 + 0.3 * i)
    dive.live.turn()
    assert dive.live.hints == ()


def test_swimming_above_the_waters_range_is_hinted_at(dive: CoveredDive) -> None:
    for i in range(8):
        dive.swim(0.0, 0.4 * i, z=4.5)
    dive.live.turn()
    assert Hint.TOO_HIGH in dive.live.hints


def test_without_a_fit_of_the_water_no_height_is_too_high() -> None:
    dive = CoveredDive()
    for i in range(8):
        dive.swim(0.0, 0.4 * i, z=20.0)
    dive.live.turn()
    assert dive.live.to_json()[0]["range_limit"] is None
    assert Hint.TOO_HIGH not in dive.live.hints
    dive.close()


def test_after_the_dive_nothing_of_it_is_shown(dive: CoveredDive) -> None:
    swum(dive, lawnmower(1, 4.0, 1.0, 0.45))
    dive.live.hide()
    dive.live.turn()
    assert dive.live.to_json() == {}
    assert (dive.live.png(), dive.live.cells(0)) == (None, None)
    assert dive.live.hints == ()


def get(port: int, path: str) -> tuple[int, str, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.getheader("Content-Type", ""), body


def test_the_pictures_are_at_their_addresses_and_decode(dive: CoveredDive) -> None:
    config = ListenConfig.model_construct(host="127.0.0.1", port=0, token_file=None)
    server = HealthServer(config, lambda: REPORT, coverage=dive.live)
    try:
        assert get(server.port, "/coverage.png")[0] == 404
        swum(dive, lawnmower(1, 4.0, 1.0, 0.45))
        for path in ("/coverage.png", "/coverage/0.png?frame=7"):
            status, kind, body = get(server.port, path)
            assert (status, kind) == (200, "image/png")
            image = Image.open(io.BytesIO(body))
            image.load()
            assert path != "/coverage.png" or image.size == (WIDTH, HEIGHT)
        for path in ("/coverage/1.png", "/coverage/x.png", "/coverage/..%2f0.png"):
            assert get(server.port, path)[0] == 404
    finally:
        server.close()
