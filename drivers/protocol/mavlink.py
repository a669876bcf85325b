"""An autopilot that speaks MAVLink: samples, and a clock agreed on by TIMESYNC."""

from __future__ import annotations

import logging
from collections import deque
from typing import Any

from aquaflow.config.telemetry import MavlinkConfig
from aquaflow.drivers.link import DeviceClock, about
from aquaflow.drivers.mavlink_dialect import dialect
from aquaflow.drivers.protocol.mavlink_frames import Header, MavlinkFraming, header_of
from aquaflow.drivers.protocol.mavlink_outbound import Receiver, messages_of
from aquaflow.drivers.protocol.mavlink_samples import SINCE_1970_US, MavlinkSamples, MessageTime
from aquaflow.drivers.protocol.packets import PacketDecoder
from aquaflow.drivers.transport.mavlink2rest import Wanted
from aquaflow.sources.outbound import Obey, OutboundMessage, PilotRequest, StatusText
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
            self._answer(self._commands.acknowledge(header, self._unpack(packet)))
            return []
        if (header.system, header.component) == self._senders.autopilot:
            return self._of_autopilot(header, name, packet, arrival_ns)
        return self._of_another(header, name, packet, arrival_ns)

    def _of_autopilot(
        self, header: Header, name: str, packet: bytes, arrival_ns: int
    ) -> list[TelemetrySample]:
        message = self._unpack(packet)
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
        return samples.of(self._unpack(packet), MessageTime(arrival_ns, arrival_ns, source))

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
                data += self._pack(message)
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
        return data + self._pack(heartbeat) + self._pack(request)

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

    def _unpack(self, packet: bytes) -> Any:
        try:
            return self._wire.decode(bytearray(packet))
        except self._dialect.MAVError as error:
            raise ValueError(str(error)) from error

    def _pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self._wire))
        self._wire.seq = (self._wire.seq + 1) % 256
        return data

    def _answer(self, message: Any | None) -> None:
        if message is not None and len(self._outgoing) < MAX_OUTGOING_BYTES:
            self._outgoing += self._pack(message)

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


# --------------------------------------------------------------------------------------------------
# Commands of MAVLink to AquaFlow's component (mavlink.io/en/services/command.html).
#
# MAV_CMD_USER_1 to 4, which the standard leaves to each vehicle's maker, are the four requests of a
# dive. Each is acknowledged; a repetition, as senders make while no acknowledgement reached them,
# is acknowledged as before and not obeyed twice.

FIRST_COMMAND = 31010
"""MAV_CMD_USER_1."""
REQUESTS: dict[int, PilotRequest] = {
    FIRST_COMMAND: "start",
    FIRST_COMMAND + 1: "stop",
    FIRST_COMMAND + 2: "finish",
    FIRST_COMMAND + 3: "new",
}
"""By MAV_CMD."""
MESSAGES = frozenset({"COMMAND_LONG", "COMMAND_INT"})
ACCEPTED, REFUSED_NOW, UNSUPPORTED = 0, 1, 3
"""MAV_RESULT."""


class MavlinkCommands:
    """Of one link; without :attr:`asked` it is silent."""

    def __init__(self, dialect: Any, system_id: int, component_id: int) -> None:
        """The numbers are ours: commands to others are theirs."""
        self.asked: Obey | None = None
        self._dialect, self._us = dialect, (system_id, component_id)
        self._answered: tuple[Header, int, int] | None = None
        """Who sent the last command, which one, and its result."""

    def acknowledge(self, header: Header, message: Any) -> Any | None:
        """The COMMAND_ACK of a COMMAND_LONG or COMMAND_INT; None if it is none of ours."""
        if self.asked is None or (message.target_system, message.target_component) != self._us:
            return None
        result = self._result(header, message, self.asked)
        self._answered = header, message.command, result
        return self._dialect.MAVLink_command_ack_message(
            command=message.command,
            result=result,
            target_system=header.system,
            target_component=header.component,
        )

    def _result(self, header: Header, message: Any, asked: Obey) -> int:
        request = REQUESTS.get(message.command)
        if request is None:
            return UNSUPPORTED
        before = self._answered
        if getattr(message, "confirmation", 0) > 0 and before is not None:
            (_, system, component, _), command, result = before
            if (system, component, command) == (header.system, header.component, message.command):
                return result
        return ACCEPTED if asked(request) else REFUSED_NOW


# --------------------------------------------------------------------------------------------------
# Whose MAVLink messages are used: the autopilot's, and those that the config names as well.

log = logging.getLogger(__name__)

MOST_WARNINGS = 16
"""Senders and messages that a warning names; the others are counted only."""
OF_MANY = frozenset({"SYSTEM_TIME"})
"""Ground stations send it too; that is no loss."""


class MavlinkSenders:
    """The converters of each sender on one link."""

    def __init__(self, name: str, config: MavlinkConfig) -> None:
        asked = [str(message) for message in config.messages]
        asked += [] if config.external_pressure is None else [config.external_pressure]
        asked += [] if config.lights is None else [config.lights.message]
        self._name = name
        self.autopilot = (config.system_id, config.component_id)
        self._samples = {self.autopilot: MavlinkSamples(config, asked)}
        for other in config.also:
            sender = (other.system_id or config.system_id, other.component_id)
            self._samples[sender] = MavlinkSamples(config, other.messages)
        self._warned: set[tuple[int, int, str]] = set()

    @property
    def wanted(self) -> frozenset[str]:
        """Names of the messages that make samples, whoever sends them."""
        return frozenset().union(*(each.wanted for each in self._samples.values()))

    @property
    def asked(self) -> dict[tuple[int, int], frozenset[str]]:
        """The same by system and component of the sender."""
        return {sender: each.wanted for sender, each in self._samples.items()}

    def of(self, header: Header, message: str) -> MavlinkSamples | None:
        """What converts ``message`` of this sender; None if it is not asked for it."""
        samples = self._samples.get((header.system, header.component))
        return samples if samples is not None and message in samples.wanted else None

    def unheard(self, header: Header, message: str) -> bool:
        """Whether a message that is used of others is lost; a warning names its sender once."""
        if message in OF_MANY or message not in self.wanted:
            return False
        if (header.system, header.component) in self._samples:
            return False
        sender = (header.system, header.component, message)
        if sender not in self._warned and len(self._warned) < MOST_WARNINGS:
            self._warned.add(sender)
            log.warning(
                "%s: %s of system %d, component %d is not used; to use it, add "
                "{system_id: %d, component_id: %d, messages: [%s]} under 'also'",
                self._name, message, *sender[:2], *sender, extra=about(self._name, "unheard"),
            )  # fmt: skip
        return True
