"""Hints on a real MAVLink link: as a simulated ArduSub hears them, where they are wanted."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from aquaflow.config.service import VehicleReportConfig
from aquaflow.live.vehicle.arming import REPEAT_S, PilotMessages
from aquaflow.survey.coverage.live_coverage import SENTENCES, Hint
from tests.drivers.simulated_links import Running, mavlink_udp, motion, running, until
from tests.live.live_scenes import Told
from tests.survey.coverage.covered_dives import CoveredDive

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

TOO_FAST, TOO_HIGH = SENTENCES[Hint.TOO_FAST], SENTENCES[Hint.TOO_HIGH]
WANTED = VehicleReportConfig(hints=True, values=False)


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    told = Told(tmp_path / "dive")
    told.frames("pp")
    yield told
    told.close()


@pytest.fixture
def dive() -> Iterator[CoveredDive]:
    dive = CoveredDive(attenuation=0.5)
    yield dive
    dive.close()


def introduced(session: Running) -> None:
    session.play()
    until(lambda: session.telemetry.clocks()["device"].round_trips)


def test_an_ardusub_hears_each_hint_once_when_it_begins(
    told: Told, dive: CoveredDive, tmp_path: Path
) -> None:
    rig = mavlink_udp(tmp_path)
    messages = PilotMessages(WANTED, told.feed, dive.live.sentences)  # type: ignore[arg-type]
    with running(rig, motion(), speed=1.0) as session:
        introduced(session)
        told.feed.send = session.telemetry.send  # type: ignore[method-assign]
        now_s = 0.0
        for phase, step in enumerate((0.2, 1.0, 0.2, 1.0)):
            for i in range(14):
                now_s += 1.0
                dive.swim(20.0 * phase, step * i)
                dive.live.turn()
                messages.update(told.loop, now_s)
        until(lambda: rig.protocol.texts.count(TOO_FAST) == 2)
    hints = [text for text in rig.protocol.texts if text in SENTENCES.values()]
    assert hints == [TOO_FAST, TOO_FAST]
    assert rig.protocol.texts[0] == "AquaFlow is tracking."


def test_who_did_not_ask_for_hints_hears_none(told: Told) -> None:
    messages = PilotMessages(VehicleReportConfig(), told.feed, lambda: (TOO_FAST,))  # type: ignore[arg-type]
    for second in range(20):
        messages.update(told.loop, float(second))
    assert all(getattr(word, "text", "") != TOO_FAST for word in told.feed.told)


def test_a_hint_that_flickers_is_not_repeated_within_a_while(told: Told) -> None:
    holds: list[str] = []
    messages = PilotMessages(WANTED, told.feed, lambda: tuple(holds))  # type: ignore[arg-type]
    for second in range(40):
        holds[:] = [TOO_HIGH] if second % 4 < 2 else []
        messages.update(told.loop, float(second))
    said = [word for word in told.feed.told if getattr(word, "text", "") == TOO_HIGH]
    assert 2 <= len(said) <= 1 + 40 / REPEAT_S


def test_a_pilot_who_is_lost_hears_no_hints(told: Told) -> None:
    messages = PilotMessages(WANTED, told.feed, lambda: (TOO_FAST,))  # type: ignore[arg-type]
    told.frames("lllll", first=2)
    for second in range(20):
        messages.update(told.loop, float(second))
    assert all(getattr(word, "text", "") != TOO_FAST for word in told.feed.told)
