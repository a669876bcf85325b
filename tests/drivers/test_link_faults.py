"""Every fault of the injector against every telemetry driver: counted, bounded, and it goes on."""

from __future__ import annotations

import logging
import threading

import numpy as np
import pytest

from aquaflow.drivers.link import MAX_READ_BYTES
from aquaflow.sim_drivers.faults import Faults
from tests.drivers.simulated_links import RIGS, endless, motion, running, until, values
from tests.small_recording import GIVE_UP_S

CHECKED = ("mavlink_pty", "mavlink_udp", "nmea_pty", "waterlinked_pty", "pd0_pty")
"""Protocols with a checksum of their own."""

FAULTS = {
    "drop": Faults(drop=0.4),
    "duplicate": Faults(duplicate=0.4),
    "delay": Faults(delay_s=0.03),
    "reorder": Faults(reorder=0.4),
    "corrupt": Faults(corrupt=0.4),
    "flood": Faults(flood=0.2),
    "disconnect": Faults(disconnect_after=5),
}


@pytest.fixture(autouse=True)
def no_driver_failed(caplog):
    """What the link's catch-all caught would be a bug of a driver."""
    with caplog.at_level(logging.ERROR):
        yield
    assert [record.getMessage() for record in caplog.records] == []


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_driver_lives_through_a_fault(name, fault, tmp_path):
    log, enough = motion(), threading.Event()
    with running(RIGS[name](tmp_path), endless(log, enough), FAULTS[fault]) as session:
        session.wait_open()
        session.device.start()
        until(lambda: session.injected[fault] > 0 or fault == "delay")
        # What comes after the fault is heard again.
        before = session.counters.samples
        until(lambda: session.counters.samples > before)
        enough.set()
        assert session.device.finished.wait(GIVE_UP_S)
        heard = session.fetched()

    counters = session.counters
    assert len(heard) == counters.samples
    assert session.telemetry.decoders["device"].reader.pending < MAX_READ_BYTES
    assert session.injected["disconnect"] - counters.reconnects in (0, 1)
    assert (counters.reconnects > 0) == (fault == "disconnect")
    if fault == "flood":
        assert counters.garbage_bytes > MAX_READ_BYTES // 2
    if fault == "corrupt" and name in CHECKED:
        assert counters.bad_checksums + counters.garbage_bytes > 0
    if name in CHECKED:
        assert all(was_measured(sample, log) for sample in heard)


def was_measured(sample, log):
    """True if the log has it, in the components that the protocol tells."""
    truth = np.array([values(other) for other in log if type(other) is type(sample)])
    return bool(np.isclose(values(sample), truth, atol=0.01).any(1).any())


@pytest.mark.parametrize("fault", ["drop", "duplicate", "delay", "reorder", "corrupt", "flood"])
def test_on_udp_every_fault_costs_exactly_its_datagrams(fault, tmp_path):
    rig = RIGS["mavlink_udp"](tmp_path)
    with running(rig, motion(), FAULTS[fault]) as session:
        session.play()
        change = {"drop": -1, "corrupt": -1, "duplicate": 1}.get(fault, 0)

        def counted() -> bool:
            said = session.device.sent
            return session.counters.messages == said + change * session.injected[fault]

        # A damaged length may wait for bytes behind the last packet; the heartbeats bring them.
        until(counted)
        assert session.injected[fault] > 0 or fault == "delay"
