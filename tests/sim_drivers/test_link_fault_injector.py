"""The fault injector does what it says, as often as it says, the same for the same seed."""

from __future__ import annotations

import random
import time

import pytest

from aquaflow.drivers.link import MAX_READ_BYTES, LinkLostError
from aquaflow.sim_drivers.faults import Faults, corrupt, faulty, jumping_clock

CHUNKS = [bytes([k]) * 10 for k in range(200)]


class Chunks:
    """A link that brings one chunk per read."""

    name = "chunks"

    def __init__(self) -> None:
        self.left = list(CHUNKS)
        self.closed = False
        self.written = b""

    def read(self, timeout_s: float) -> bytes:
        if not self.left:
            time.sleep(min(timeout_s, 0.001))
            return b""
        return self.left.pop(0)

    def write(self, data: bytes) -> None:
        self.written += data

    def close(self) -> None:
        self.closed = True


def through(faults: Faults) -> tuple[list[bytes], dict[str, int]]:
    """What comes through, read by read, until nothing more does."""
    link = Chunks()
    opened, injected = faulty(lambda: link, faults)
    disturbed, heard, silent = opened(), [], 0
    while silent < 100:
        data = disturbed.read(0.1)
        heard += [data] if data else []
        silent = 0 if data or link.left else silent + 1
    return heard, injected


def test_without_faults_nothing_changes():
    heard, injected = through(Faults())

    assert heard == CHUNKS
    assert sum(injected.values()) == 0


def test_dropped_reads_are_missing():
    heard, injected = through(Faults(drop=0.3))

    assert 30 < injected["drop"] < 90
    assert len(heard) == len(CHUNKS) - injected["drop"]
    assert [chunk for chunk in CHUNKS if chunk in heard] == heard


def test_duplicated_reads_come_twice():
    heard, injected = through(Faults(duplicate=0.3))

    assert injected["duplicate"] > 30
    assert len(b"".join(heard)) == 10 * (len(CHUNKS) + injected["duplicate"])


def test_corrupted_reads_differ_in_a_byte():
    heard, injected = through(Faults(corrupt=0.3))
    changed = [
        sum(a != b for a, b in zip(told, true, strict=True))
        for told, true in zip(heard, CHUNKS, strict=True)
    ]

    assert changed.count(1) == injected["corrupt"] > 30
    assert changed.count(0) == len(CHUNKS) - injected["corrupt"]


@pytest.mark.parametrize("faults", [Faults(reorder=0.3), Faults(delay_s=0.01)])
def test_late_reads_come_whole_and_in_another_order(faults):
    heard, _ = through(faults)
    data = b"".join(heard)

    assert data != b"".join(CHUNKS)
    assert sorted(data) == sorted(b"".join(CHUNKS))


def test_a_flood_comes_in_reads_of_bounded_size():
    heard, injected = through(Faults(flood=0.1))

    assert injected["flood"] > 5
    assert max(map(len, heard)) <= MAX_READ_BYTES
    assert len(b"".join(heard)) == 10 * len(CHUNKS) + injected["flood"] * MAX_READ_BYTES


def test_a_disconnection_closes_the_link_and_it_can_be_opened_again():
    links: list[Chunks] = []

    def open_link() -> Chunks:
        links.append(Chunks())
        return links[-1]

    opened, injected = faulty(open_link, Faults(disconnect_after=3))
    for attempt in (1, 2):
        link = opened()
        assert [link.read(0.1) for _ in range(3)] == CHUNKS[:3]
        with pytest.raises(LinkLostError, match="injector"):
            link.read(0.1)
        assert links[-1].closed
        assert injected["disconnect"] == attempt


def test_the_same_seed_does_the_same():
    every = {"drop": 0.1, "duplicate": 0.1, "corrupt": 0.1}

    assert through(Faults(seed=3, **every)) == through(Faults(seed=3, **every))
    assert through(Faults(seed=3, **every)) != through(Faults(seed=4, **every))


def test_what_is_written_goes_through():
    link = Chunks()
    opened, _ = faulty(lambda: link, Faults())
    disturbed = opened()

    disturbed.write(b"hello")
    disturbed.close()

    assert (link.written, link.closed) == (b"hello", True)


def test_a_share_of_the_bytes_is_corrupted():
    data = bytes(10_000)
    changed = corrupt(data, random.Random(1), 0.01)

    assert len(changed) == len(data)
    assert 90 <= sum(map(bool, changed)) <= 100
    assert corrupt(b"a", random.Random(1)) != b"a"


def test_a_clock_jumps_at_its_moment():
    clock = jumping_clock(lambda elapsed_ns: elapsed_ns, 100, 7)

    assert [clock(t) for t in (0, 99, 100, 200)] == [0, 99, 107, 207]
