"""The telemetry of a vehicle: every configured device on a link and a thread of its own."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import NamedTuple

from aquaflow.base.clocks.device import ClockReport, Learned
from aquaflow.config.telemetry import AnyDevice, TelemetryConfig
from aquaflow.drivers.link import LinkCounters
from aquaflow.drivers.mounting import BodyFrame, Mounting
from aquaflow.drivers.protocol.packets import PacketDecoder
from aquaflow.drivers.shared_ports import shared_ports
from aquaflow.drivers.supervisor import Deliver, Supervisor
from aquaflow.drivers.transport import OpenLink, opener
from aquaflow.sources import RawTap
from aquaflow.sources.newest import Newest
from aquaflow.sources.outbound import AcceptsMessages, HearsPilot, Obey, OutboundMessage
from aquaflow.types import TelemetrySample

log = logging.getLogger(__name__)

QUEUE_SAMPLES = 10_000
"""Kept until fetched, then the oldest go: a minute at 160 samples/s."""
CLOSE_TIMEOUT_S = 5.0
"""Longest wait for a thread at the end; one stuck in a system call is abandoned."""


class _QueuedSample(NamedTuple):
    """A sample on its way to the consumer, and the link it came by."""

    sample: TelemetrySample
    mounting: Mounting
    counters: LinkCounters


DECODERS = {
    "mavlink": "aquaflow.drivers.protocol.mavlink:MavlinkDecoder",
    "nmea0183": "aquaflow.drivers.protocol.nmea:NmeaDecoder",
    "waterlinked_serial": "aquaflow.drivers.protocol.waterlinked_serial:WaterLinkedSerialDecoder",
    "waterlinked_json": "aquaflow.drivers.protocol.waterlinked_json:WaterLinkedJsonDecoder",
    "pd0": "aquaflow.drivers.protocol.pd0:Pd0Decoder",
    "nucleus": "aquaflow.drivers.protocol.nucleus:NucleusDecoder",
    "ping": "aquaflow.drivers.protocol.ping:PingDecoder",
    "vectornav": "aquaflow.drivers.protocol.vectornav:VectorNavDecoder",
    "nmea2000": "aquaflow.drivers.protocol.nmea2000:Nmea2000Decoder",
    "dbc": "aquaflow.drivers.protocol.dbc:DbcDecoder",
}
"""By the device's ``kind``; imported when a device needs it."""


def decoder_of(name: str, config: AnyDevice) -> PacketDecoder:
    """The decoder of device ``name``.

    Raises:
        InputError: the library that it needs is not installed.
        ConfigError: the DBC file is not as the config says.
    """
    module, _, decoder = DECODERS[config.kind].partition(":")
    built = getattr(import_module(module), decoder)(name, config)
    assert isinstance(built, PacketDecoder)
    return built


class LinkTelemetry:
    """A TelemetrySource of real devices, or of simulated ones that speak the same protocols.

    Args:
        config: the devices.
        tap: gets the raw bytes of every link, for the recorder.
        links: how to open some of the links otherwise than ``config`` says, by device.

    Raises:
        InputError: a library that a device needs is not installed.
        ConfigError: a DBC file is not as the config says.
    """

    def __init__(
        self,
        config: TelemetryConfig,
        tap: RawTap | None = None,
        links: Mapping[str, OpenLink] | None = None,
    ) -> None:
        self._queue: Newest[_QueuedSample] = Newest(QUEUE_SAMPLES, _count_dropped)
        self._body = BodyFrame()
        self.decoders = {name: decoder_of(name, device) for name, device in config.devices.items()}
        self.links: dict[str, Supervisor] = {}
        shared = shared_ports(config.devices, self.decoders)
        for name, device in config.devices.items():
            decoder = self.decoders[name]
            replaced = (links or {}).get(name) or shared.get(name)
            open_link = replaced or opener(name, device.link, decoder)
            deliver = self._deliverer(Mounting(device.mounting), decoder.counters)
            self.links[name] = Supervisor(name, open_link, decoder, deliver, tap, device.silence_s)
        self._threads = [
            threading.Thread(target=link.run, name=f"telemetry {name}", daemon=True)
            for name, link in self.links.items()
        ]
        for thread in self._threads:
            thread.start()

    def samples(self) -> Iterator[TelemetrySample]:
        """Samples of all devices in the order of arrival, in the body frame, until closed."""
        while (waiting := self._queue.take()) is not None:
            yield self._body.refer(waiting.sample, waiting.mounting)

    def counters(self) -> dict[str, LinkCounters]:
        """The counters of each link."""
        return {name: link.counters for name, link in self.links.items()}

    def clocks(self) -> dict[str, ClockReport]:
        """Reports of the clocks of devices that have one and sent messages."""
        reports = {
            name: decoder.clock.mapping.report()
            for name, decoder in self.decoders.items()
            if decoder.clock is not None
        }
        return {name: report for name, report in reports.items() if report is not None}

    def learned_mappings(self) -> dict[str, Learned]:
        """What :meth:`resume` takes, by device."""
        clocks = {name: decoder.clock for name, decoder in self.decoders.items()}
        return {name: clock.mapping.learned_mapping() for name, clock in clocks.items() if clock}

    def resume(self, learned: Mapping[str, Learned]) -> None:
        """Continue with the devices' clocks as an earlier process since the same boot learned
        them."""
        for name, decoder in self.decoders.items():
            if decoder.clock is not None:
                decoder.clock.mapping.resume(learned.get(name, ()))

    def send(self, message: OutboundMessage) -> bool:
        """Queue ``message`` for every device that understands it; False if none does."""
        accepting = [
            decoder for decoder in self.decoders.values() if isinstance(decoder, AcceptsMessages)
        ]
        queued = [decoder.send(message) for decoder in accepting]
        return any(queued)

    @property
    def armed(self) -> bool | None:
        """Of the first autopilot that said so; None while none did."""
        said = (decoder.armed for decoder in self._autopilots())
        return next((each for each in said if each is not None), None)

    def obey(self, asked: Obey) -> None:
        """From now on pass the commands that come by any link to ``asked``."""
        for decoder in self._autopilots():
            decoder.obey(asked)

    def _autopilots(self) -> list[HearsPilot]:
        return [each for each in self.decoders.values() if isinstance(each, HearsPilot)]

    def close(self) -> None:
        """Stop all links; samples that wait can still be fetched. May be called again."""
        for link in self.links.values():
            link.stop()
        for thread in self._threads:
            thread.join(CLOSE_TIMEOUT_S)
            if thread.is_alive():
                log.warning("%s: still busy after %g s; left behind", thread.name, CLOSE_TIMEOUT_S)
        self._queue.end()

    def _deliverer(self, mounting: Mounting, counters: LinkCounters) -> Deliver:
        def deliver(samples: list[TelemetrySample]) -> None:
            self._queue.put_all([_QueuedSample(sample, mounting, counters) for sample in samples])

        return deliver


def _count_dropped(waiting: _QueuedSample) -> None:
    waiting.counters.dropped_samples += 1
