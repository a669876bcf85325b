"""A supervised link comes back from everything, and always lets itself be stopped."""

from __future__ import annotations

import logging
import threading
from contextlib import contextmanager

import pytest

from aquaflow.config.telemetry import NmeaConfig
from aquaflow.drivers import supervisor
from aquaflow.drivers.link import LinkLostError
from aquaflow.drivers.protocol.nmea import NmeaDecoder
from aquaflow.drivers.supervisor import Supervisor
from aquaflow.sim_drivers.devices.nmea_talker import sentence
from tests.drivers.simulated_links import until

DEPTH = sentence("SDDPT,4.25,0.5")


class ScriptedLink:
    """Gives what the script says, one entry per read; then silence."""

    def __init__(self, *script: bytes | Exception):
        self.name = "box"
        self.script = list(script)
        self.closed = 0
        self.written = b""

    def read(self, timeout_s: float) -> bytes:
        if not self.script:
            threading.Event().wait(0.002)
            return b""
        entry = self.script.pop(0)
        if isinstance(entry, Exception):
            raise entry
        return entry

    def write(self, data: bytes) -> None:
        self.written += data

    def close(self) -> None:
        self.closed += 1


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch):
    monkeypatch.setattr(supervisor, "FIRST_PAUSE_S", 0.002)
    monkeypatch.setattr(supervisor, "LONGEST_PAUSE_S", 0.01)


def decoder() -> NmeaDecoder:
    config = NmeaConfig.model_validate({"link": {"kind": "serial", "port": "/dev/null"}})
    return NmeaDecoder("box", config)


@contextmanager
def supervised(*attempts: ScriptedLink | Exception, **settings):
    """Runs a supervisor whose attempts to open go as told; the last one is repeated."""
    todo, heard = list(attempts), []

    def open_link():
        attempt = todo.pop(0) if len(todo) > 1 else todo[0]
        if isinstance(attempt, Exception):
            raise attempt
        return attempt

    box = settings.pop("decoder", None) or decoder()
    link = Supervisor("box", open_link, box, heard.extend, **settings)
    thread = threading.Thread(target=link.run, daemon=True)
    thread.start()
    try:
        yield link, heard
    finally:
        link.stop()
        thread.join(10)
        assert not thread.is_alive()


def test_a_lost_link_is_opened_anew_and_its_half_sentence_forgotten():
    first = ScriptedLink(DEPTH, DEPTH[:9], LinkLostError("unplugged"))
    second = ScriptedLink(DEPTH)

    with supervised(first, second) as (link, heard):
        until(lambda: len(heard) == 2)
        assert link.state == "connected"
        assert link.counters.reconnects == 1
        assert (link.counters.garbage_bytes, link.counters.bad_checksums) == (9, 0)
    assert first.closed == 1
    assert second.closed == 1
    assert link.state == "closed"


def test_a_device_that_is_not_there_is_tried_again_and_said_once(caplog):
    gone = LinkLostError("cannot open /dev/ttyUSB0")
    with (
        caplog.at_level(logging.INFO),
        supervised(gone, gone, gone, ScriptedLink(DEPTH)) as running,
    ):
        until(lambda: len(running[1]) == 1)

    said = [record.getMessage() for record in caplog.records]
    assert said.count("box: cannot open /dev/ttyUSB0") == 1
    assert running[0].counters.reconnects == 0


def test_pauses_grow_while_nothing_is_heard_and_start_small_after(monkeypatch):
    pauses = []
    monkeypatch.setattr(
        threading.Event, "wait", lambda self, s=None: pauses.append(s) or self.is_set()
    )
    gone = LinkLostError("gone")
    seen = {}

    def open_link():
        seen["n"] = seen.get("n", 0) + 1
        if seen["n"] == 6:
            return ScriptedLink(DEPTH, LinkLostError("again"))
        if seen["n"] == 7:
            link.stop()
        raise gone

    link = Supervisor("box", open_link, decoder(), lambda samples: None)
    link.run()

    assert pauses[:5] == [0.002, 0.004, 0.008, 0.01, 0.01]
    assert pauses[5] == 0.002


class SimulatedTime:
    """The supervisor's module ``time``; it passes while a silent link is read."""

    def __init__(self):
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(self.now_s * 1e9)


class SilentLink(ScriptedLink):
    """Every read of it takes a second."""

    def __init__(self, time: SimulatedTime):
        super().__init__()
        self._time = time

    def read(self, timeout_s: float) -> bytes:
        self._time.now_s += 1.0
        return super().read(timeout_s)


def test_a_silent_link_is_opened_anew_and_said_once(caplog, monkeypatch):
    time = SimulatedTime()
    monkeypatch.setattr(supervisor, "time", time)
    silent = SilentLink(time), SilentLink(time), SilentLink(time)
    with (
        caplog.at_level(logging.INFO),
        supervised(*silent, ScriptedLink(DEPTH), silence_s=10.0) as (link, heard),
    ):
        until(lambda: len(heard) == 1)
        assert link.counters.reconnects == 0

    said = [record.getMessage() for record in caplog.records]
    assert said == ["box: no byte for 10 s", "box: connected"]


def test_a_link_may_be_silent_where_the_config_says_so():
    with supervised(ScriptedLink(b"", b"", DEPTH), silence_s=None) as (link, heard):
        until(lambda: len(heard) == 1)
        assert link.counters.reconnects == 0


def test_the_tap_gets_every_read_as_it_came():
    taps = []
    link = ScriptedLink(DEPTH[:4], b"\xff\xff", DEPTH)
    with supervised(link, tap=lambda *read: taps.append(read)) as (_, heard):
        until(lambda: len(heard) == 1)

    assert [(name, data) for name, _, data in taps] == [
        ("box", DEPTH[:4]),
        ("box", b"\xff\xff"),
        ("box", DEPTH),
    ]
    assert heard[0].arrival_ns == taps[2][1]


@pytest.mark.parametrize("error", [RuntimeError("disk is full"), ValueError("?")])
def test_a_tap_or_driver_that_fails_costs_a_reconnect_and_is_logged(error, caplog):
    calls = []

    def tap(*read):
        calls.append(read)
        if len(calls) == 1:
            raise error

    with supervised(ScriptedLink(DEPTH, DEPTH), tap=tap) as (link, heard):
        until(lambda: len(heard) == 1)
        assert link.counters.reconnects == 1
    assert "the driver failed" in caplog.text


def test_what_the_decoder_wants_said_is_written():
    class Talking(NmeaDecoder):
        said = 0

        def outgoing(self, now_ns: int) -> bytes:
            self.said += 1
            return b"ping" if self.said == 1 else b""

    link = ScriptedLink(DEPTH)
    config = NmeaConfig.model_validate({"link": {"kind": "serial", "port": "/dev/null"}})
    with supervised(link, decoder=Talking("box", config)) as (_, heard):
        until(lambda: len(heard) == 1)

    assert link.written == b"ping"


def test_what_was_to_be_said_before_the_end_is_still_written():
    class Last(ScriptedLink):
        def read(self, timeout_s: float) -> bytes:
            link.stop()
            talking.words = b"goodbye"
            return b""

    class Talking(NmeaDecoder):
        words = b""

        def outgoing(self, now_ns: int) -> bytes:
            words, self.words = self.words, b""
            return words

    wire = Last()
    config = NmeaConfig.model_validate({"link": {"kind": "serial", "port": "/dev/null"}})
    talking = Talking("box", config)
    link = Supervisor("box", lambda: wire, talking, lambda samples: None)
    link.run()

    assert wire.written == b"goodbye"
    assert wire.closed == 1
