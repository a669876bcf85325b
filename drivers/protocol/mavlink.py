"""An autopilot that speaks MAVLink: samples, and a clock agreed on by TIMESYNC."""

from __future__ import annotations

from collections import deque
from typing import Any

from aquaflow.config.telemetry import MavlinkConfig
from aquaflow.drivers.device_clock import DeviceClock
from aquaflow.drivers.mavlink_dialect import dialect
from aquaflow.drivers.protocol.mavlink_commands import MESSAGES, MavlinkCommands
from aquaflow.drivers.protocol.mavlink_frames import Header, MavlinkFraming, header_of
from aquaflow.drivers.protocol.mavlink_outbound import Receiver, messages_of
from aquaflow.drivers.protocol.mavlink_samples import SINCE_1970_US, MessageTime
from aquaflow.drivers.protocol.mavlink_senders import MavlinkSenders
from aquaflow.drivers.protocol.packets import PacketDecoder
from aquaflow.drivers.transport.mavlink2rest import Wanted
from aquaflow.sources.outbound import OutboundMessage, StatusText
from aquaflow.sources.pilot import Obey
from aquaflow.types import TelemetrySample

OUR_COMPONENT = 197
"""MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""
TALK_EVERY_NS = 1_000_000_000
"""Heartbeats at 1 Hz, as the standard has it; TIMESYNC requests go with them."""
OPEN_REQUESTS = 16
"""Most open TIMESYNC requests."""
MAX_OUTGOING_BYTES = 1024
"""Most bytes of answers between two writes."""
MOST_WAITING = 32
"""Messages that wait while a link is down; older ones are dropped."""
ALWAYS = frozenset({"HEARTBEAT", "TIMESYNC", "SYSTEM_TIME"})
"""Of the autopilot, for its kind and its clock."""
FIXES = ("GPS_RAW_INT", "GPS2_RAW")
"""Stamped with the time of the fix, which is sent again while there is no newer one."""


class MavlinkDecoder(PacketDecoder):
    """The autopilot that ``config`` names, and the other components that it asks for."""

    def __init__(self, name: str, config: MavlinkConfig) -> None:
        self._dialect = dialect(f"the MAVLink device '{name}'")
        super().__init__(name, MavlinkFraming(self._dialect))
        self.clock: DeviceClock = DeviceClock(name)
        self._config = config
        self._senders = MavlinkSenders(name, config)
        # Numbers, since most packets are of no interest and need not be unpacked.
        self._wanted = {
            number: message.msgname
            for number, message in self._dialect.mavlink_map.items()
            if message.msgname in self._senders.wanted | ALWAYS | MESSAGES
        }
        self._wire = self._dialect.MAVLink(None, config.system_id, OUR_COMPONENT)
        self._requests: deque[int] = deque(maxlen=OPEN_REQUESTS)
        self._outgoing = b""
        self._outbound: deque[OutboundMessage] = deque(maxlen=MOST_WAITING)
        self._sent = 0
        """Messages of :meth:`send` so far."""
        self._talk_at_ns: int | None = None
        self._autopilot: int | None = None
        self.armed: bool | None = None
        self._commands = MavlinkCommands(self._dialect, config.system_id, OUR_COMPONENT)

    def obey(self, asked: Obey) -> None:
        """From now on pass commands to us to ``asked``; unheard where we only listen."""
        self._commands.asked = asked if self._config.talk else None

    @property
    def wanted(self) -> Wanted:
        """What a link need bring at the least."""
        of = self._senders.asked
        autopilot = self._senders.autopilot
        names = frozenset(self._wanted.values())
        return Wanted(names, {**of, autopilot: of[autopilot] | ALWAYS})

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        header = header_of(packet)
        if header.message_id not in self._wanted:
            return []
        name = self._wanted[header.message_id]
        if name in MESSAGES:
            self._answer(self._commands.acknowledged(header, self._unpacked(packet)))
            return []
        if (header.system, header.component) == self._senders.autopilot:
            return self._of_autopilot(header, name, packet, arrival_ns)
        return self._of_another(header, name, packet, arrival_ns)

    def _of_autopilot(
        self, header: Header, name: str, packet: bytes, arrival_ns: int
    ) -> list[TelemetrySample]:
        message = self._unpacked(packet)
        if name == "HEARTBEAT":
            self._autopilot = message.autopilot
            self.armed = bool(message.base_mode & self._dialect.MAV_MODE_FLAG_SAFETY_ARMED)
            return []
        if name == "TIMESYNC":
            self._synchronise(message, arrival_ns)
            return []
        t_ns = self._moment(name, message, arrival_ns)
        samples = self._senders.of(header, name)
        if samples is None:
            return []  # SYSTEM_TIME, for its time since boot
        return samples.of(message, MessageTime(t_ns, arrival_ns, self.source(name)))

    def _of_another(
        self, header: Header, name: str, packet: bytes, arrival_ns: int
    ) -> list[TelemetrySample]:
        """Samples of a component that the config names; of others they are counted."""
        samples = self._senders.of(header, name)
        if samples is None:
            self.counters.unheard += self._senders.unheard(header, name)
            return []
        source = self.source(f"{header.system}.{header.component}/{name}")
        return samples.of(self._unpacked(packet), MessageTime(arrival_ns, arrival_ns, source))

    def outgoing(self, now_ns: int) -> bytes:
        """The bytes to write now: answers to TIMESYNC, and once a second our own request."""
        if not self._config.talk:
            return b""
        data, self._outgoing = self._outgoing, b""
        while self._outbound:
            outbound = self._outbound.popleft()
            self._sent += 1
            receiver = self._receiver(outbound)
            for message in messages_of(self._dialect, outbound, receiver, self._sent):
                data += self._packed(message)
        if self._talk_at_ns is not None and now_ns < self._talk_at_ns:
            return data
        self._talk_at_ns = now_ns + TALK_EVERY_NS
        self._requests.append(now_ns)
        heartbeat = self._dialect.MAVLink_heartbeat_message(
            type=self._dialect.MAV_TYPE_ONBOARD_CONTROLLER,
            autopilot=self._dialect.MAV_AUTOPILOT_INVALID,
            base_mode=0,
            custom_mode=0,
            system_status=self._dialect.MAV_STATE_ACTIVE,
            mavlink_version=3,
        )
        request = self._dialect.MAVLink_timesync_message(tc1=0, ts1=now_ns)
        return data + self._packed(heartbeat) + self._packed(request)

    def send(self, outbound: OutboundMessage) -> bool:
        """Queue ``outbound`` for the next write; False where we only listen. For any thread."""
        if self._config.talk:
            self._outbound.append(outbound)
        return self._config.talk

    def _receiver(self, outbound: OutboundMessage) -> Receiver:
        """The autopilot, and the message's moment on its clock."""
        report = self.clock.mapping.report()
        if report is None or isinstance(outbound, StatusText):
            return Receiver(None, self._autopilot)
        return Receiver(max(outbound.t_ns - report.offset_ns, 0), self._autopilot)

    def _unpacked(self, packet: bytes) -> Any:
        try:
            return self._wire.decode(bytearray(packet))
        except self._dialect.MAVError as error:
            raise ValueError(str(error)) from error

    def _packed(self, message: Any) -> bytes:
        data = bytes(message.pack(self._wire))
        self._wire.seq = (self._wire.seq + 1) % 256
        return data

    def _answer(self, message: Any | None) -> None:
        if message is not None and len(self._outgoing) < MAX_OUTGOING_BYTES:
            self._outgoing += self._packed(message)

    def _synchronise(self, message: Any, arrival_ns: int) -> None:
        """mavlink.io/en/services/timesync.html: tc1 is 0 in requests, ts1 is the asker's clock."""
        if message.tc1 == 0:
            self._answer(self._dialect.MAVLink_timesync_message(tc1=arrival_ns, ts1=message.ts1))
        elif message.ts1 in self._requests:
            self._requests.remove(message.ts1)
            self.clock.mapping.add(message.tc1, arrival_ns, arrival_ns - message.ts1)

    def _moment(self, name: str, message: Any, arrival_ns: int) -> int:
        boot_ns = getattr(message, "time_boot_ms", 0) * 1_000_000
        # SERVO_OUTPUT_RAW's 32 bits of microseconds start again every 71 minutes.
        if name in ("RAW_IMU", "HIGHRES_IMU") and message.time_usec < SINCE_1970_US:
            boot_ns = message.time_usec * 1000
        if name in FIXES:
            known = 0 < message.time_usec < SINCE_1970_US
            return self.clock.moment(message.time_usec * 1000, arrival_ns) if known else arrival_ns
        return self.clock.stamp(boot_ns, arrival_ns) if boot_ns > 0 else arrival_ns
