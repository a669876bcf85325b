"""What devices lost or sent in vain is summed up; every counter of a driver is known."""

from __future__ import annotations

import logging
from dataclasses import fields

import pytest

from aquaflow.drivers.link import LinkCounters
from aquaflow.drivers.live import CameraCounters
from aquaflow.live.dive_parts import EVERY_S, DeviceErrors
from aquaflow.live.health import exposition as tables


def test_every_counter_of_a_driver_is_in_one_table() -> None:
    known = [
        *tables.RECEIVED, *tables.NOT_ASKED_FOR, *tables.DROPPED, *tables.ERRORS,
        tables.RECONNECTS,
    ]  # fmt: skip
    counted = {field.name for kind in (CameraCounters, LinkCounters) for field in fields(kind)}
    assert sorted(known) == sorted(counted)


def test_what_grew_within_a_minute_is_one_line_for_each_device(
    caplog: pytest.LogCaptureFixture,
) -> None:
    now = [0.0]
    devices: dict[str, dict[str, object]] = {
        "front": {"kind": "camera", "lost": 0, "overtaken": 0},
        "dvl": {"kind": "link", "bad_checksums": 3},
    }
    errors = DeviceErrors(lambda: devices, lambda: now[0])
    devices["front"] |= {"lost": 2, "overtaken": 500}
    errors.update()
    assert caplog.messages == []
    now[0] = EVERY_S
    errors.update()
    assert caplog.messages == ["front: in 60 s 2 lost", "dvl: in 60 s 3 bad checksums"]
    now[0] = 2 * EVERY_S
    devices["dvl"]["bad_checksums"] = 4
    with caplog.at_level(logging.WARNING):
        errors.update()
    told = caplog.records[-1].fields  # type: ignore[attr-defined]
    assert told == {"event": "errors", "source": "dvl", "counts": {"bad_checksums": 1}}
    assert len(caplog.messages) == 3
