"""What devices lost or sent in vain, summed up in log.jsonl once a minute."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping

from aquaflow.live.health.device_counters import DROPPED, ERRORS

log = logging.getLogger(__name__)

EVERY_S = 60.0
"""Period of the summaries: a device that fails for an hour takes 60 lines."""

Devices = Mapping[str, Mapping[str, object]]


class DeviceErrors:
    """Compares the counters of the devices with those of the summary before."""

    def __init__(
        self, describe: Callable[[], Devices], now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._describe, self._now_s = describe, now_s
        self._before: dict[str, dict[str, int]] = {}
        self._since_s = now_s()

    def update(self) -> None:
        """To be called often; tells what went wrong once a minute."""
        if self._now_s() - self._since_s >= EVERY_S:
            self.tell()

    def tell(self) -> None:
        """A line for each device that counted something since the last."""
        took_s, self._since_s = self._now_s() - self._since_s, self._now_s()
        for name, device in self._describe().items():
            counts = {
                key: value
                for key in (*DROPPED, *ERRORS)
                if isinstance(value := device.get(key), int)
            }
            before, self._before[name] = self._before.get(name, {}), counts
            grown = {key: counts[key] - before.get(key, 0) for key in counts}
            grown = {key: count for key, count in grown.items() if count > 0}
            if grown:
                self._log(name, grown, took_s)

    @staticmethod
    def _log(name: str, grown: dict[str, int], took_s: float) -> None:
        words = ", ".join(f"{count} {key.replace('_', ' ')}" for key, count in grown.items())
        fields = {"event": "errors", "source": name, "counts": grown}
        log.warning("%s: in %.0f s %s", name, took_s, words, extra={"fields": fields})
