"""What lives as long as the service, whatever dive it maps: state, heartbeats, load shedding."""

from __future__ import annotations

from aquaflow.config.service import ServiceConfig
from aquaflow.live.health.degradation import Degradation
from aquaflow.live.health.heartbeats import Heartbeats, Watchdog
from aquaflow.live.health.state import Health, ServiceState
from aquaflow.live.health.systemd import Notifier


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
