"""Heartbeats of each stage and the watchdog that checks them.

A Python thread cannot be killed. A stage that hangs therefore takes the process down, and
its supervisor (systemd, Docker) restarts it; the dive resumes from its checkpoint.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping

from aquaflow.config.service import ServiceConfig
from aquaflow.live.health.degradation import Degradation
from aquaflow.live.health.state import Health, ServiceState

log = logging.getLogger(__name__)

EXIT_HUNG = 70
"""Exit status of a process that gave up on one of its stages (EX_SOFTWARE of sysexits.h)."""


class Heartbeats:
    """Time of the last heartbeat of each stage."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._last_s: dict[str, float] = {}

    def beat(self, stage: str, ahead_s: float = 0.0) -> None:
        """The stage worked, or is idle; called by the stage itself only. One that may be silent for
        a known time says so with ``ahead_s``."""
        self._last_s[stage] = self._now_s() + ahead_s

    def retire(self, stage: str) -> None:
        """The stage has ended normally; stop checking it."""
        self._last_s.pop(stage, None)

    def ages_s(self) -> dict[str, float]:
        """Seconds since each stage's last heartbeat."""
        now = self._now_s()
        return {stage: now - last for stage, last in dict(self._last_s).items()}

    def find_hung_stage(self, longer_than_s: float) -> str | None:
        """The stage that was silent for longest, if longer than ``longer_than_s``."""
        ages = self.ages_s()
        stage = max(ages, key=lambda name: ages[name], default=None)
        return stage if stage is not None and ages[stage] > longer_than_s else None


def give_up(stage: str, silent_s: float) -> None:
    """Write the stack of every thread to stderr and end the process at once."""
    log.critical("%s sent no heartbeat for %.0f s: the process exits", stage, silent_s)
    faulthandler.dump_traceback(file=sys.stderr, all_threads=True)
    os._exit(EXIT_HUNG)


class Watchdog:
    """Checks the heartbeats in its own thread; ends the process when a stage hangs."""

    def __init__(
        self,
        heartbeats: Heartbeats,
        hang_s: float,
        hung: Callable[[str, float], None] = give_up,
        look_s: float = 1.0,
    ) -> None:
        self._heartbeats, self._hang_s, self._hung, self._look_s = heartbeats, hang_s, hung, look_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop checking."""
        self._closing.set()
        self._thread.join(self._look_s + 1.0)

    def _run(self) -> None:
        while not self._closing.wait(self._look_s):
            stage = self._heartbeats.find_hung_stage(self._hang_s)
            if stage is not None:
                self._hung(stage, self._heartbeats.ages_s().get(stage, self._hang_s))
                return


# --------------------------------------------------------------------------------------------------
# What lives as long as the service, whatever dive it maps: state, heartbeats, load shedding.


class ServiceHealth:
    """Close it after the last dive."""

    def __init__(self, config: ServiceConfig) -> None:
        self.hang_s = config.hang_s
        self.heartbeats, self.degradation = Heartbeats(), Degradation(config.limits)
        self.health, self.notifier = Health(), Notifier()
        self._watchdog = Watchdog(self.heartbeats, config.hang_s)

    def notify(self) -> None:
        """Tell systemd the state; READY once a sensor answered or its absence was declared. The
        watchdog is fed only here, and only while every stage is alive."""
        state = self.health.state
        if state not in (ServiceState.STARTING, ServiceState.STOPPING):
            self.notifier.ready()
        self.notifier.status(f"{state.value}: {self.health.reason}")
        if self.heartbeats.find_hung_stage(self.hang_s) is None:
            self.notifier.alive()

    def stop(self, reason: str, seconds: float) -> None:
        """The service ends within ``seconds``; from here on systemd's limit for stopping counts."""
        self.health.set(ServiceState.STOPPING, reason)
        self.notifier.stopping()
        self.notifier.more_time(seconds)
        self.notify()

    def close(self) -> None:
        """Stop watching."""
        self._watchdog.close()
        self.notifier.close()

    def __enter__(self) -> ServiceHealth:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# --------------------------------------------------------------------------------------------------
# Messages to systemd: READY, WATCHDOG, STATUS, STOPPING (sd_notify(3), in the standard library).
#
# The watchdog is fed by the loop itself, after a frame or a declared idle moment, while the other
# stages live too; never from a side thread, which would keep a hung loop alive.


class Notifier:
    """Writes to the socket in NOTIFY_SOCKET; does nothing where there is none."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        own = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        interval_us = int(environment.get("WATCHDOG_USEC", "0")) if own else 0
        self._every_s = interval_us * 1e-6 / 2.0
        self._fed_s = 0.0
        self._said = ""
        self._ready = False

    def ready(self) -> None:
        """The service works; sent once."""
        if not self._ready:
            self._ready = True
            self._send("READY=1")

    def stopping(self) -> None:
        """The service is being stopped."""
        self._send("STOPPING=1")

    def status(self, sentence: str) -> None:
        """What ``systemctl status`` shows."""
        if sentence != self._said:
            self._said = sentence
            self._send(f"STATUS={sentence}")

    def alive(self, now_s: float | None = None) -> None:
        """Feed the watchdog, twice as often as it asks for."""
        now = time.monotonic() if now_s is None else now_s
        if self._every_s and now - self._fed_s >= self._every_s:
            self._fed_s = now
            self._send("WATCHDOG=1")

    def more_time(self, seconds: float) -> None:
        """Request more time for starting or stopping."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _send(self, message: str) -> None:
        if self._socket is None:
            return
        # A name that starts with @ lives in Linux's abstract name space.
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            self._socket.sendto(message.encode(), address)
        except OSError:
            return  # a manager that went away is no reason to stop mapping
