"""Any CAN bus that a DBC file describes; the config says which signals make which sample.

CAN carries no time of measurement, so ``t_ns`` is the arrival.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from aquaflow.base.errors import ConfigError, load, reason_of
from aquaflow.config.instruments import DbcConfig, DbcSignal
from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing, PacketDecoder
from aquaflow.drivers.samples import Fixes, Vector, from_euler, normalise, sigma_of
from aquaflow.drivers.transport.can import EXTENDED, RECORD
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    TelemetrySample,
    Velocity,
)

SCALARS: dict[str, Callable[[int, int, str, float], TelemetrySample]] = {
    "depth": Depth,
    "altitude": Altitude,
    "lights": Lights,
}
"""Kinds of samples with one value, by their name in the config."""
VECTORS: dict[str, Callable[[int, int, str, Vector], TelemetrySample]] = {
    "angular_rate": AngularRate,
    "acceleration": Acceleration,
}
"""Kinds of samples with three values, in body axes."""


class DbcDecoder(PacketDecoder):
    """Samples of the mapped messages; other frames are counted.

    Raises:
        InputError: cantools is not installed.
        ConfigError: the DBC file cannot be read, or has no such message or signal.
    """

    def __init__(self, name: str, config: DbcConfig) -> None:
        super().__init__(name, CanFraming())
        self._cantools = load("cantools", f"the CAN device '{name}'")
        database = self._open_file(config.database)
        self._fixes = Fixes(config)
        self._mapped: dict[tuple[int, bool], tuple[Any, list[DbcSignal]]] = {}
        for mapping in config.samples:
            message = _message(database, mapping, config.database)
            key = (message.frame_id, message.is_extended_frame)
            self._mapped.setdefault(key, (message, []))[1].append(mapping)

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        frame = frame_of(packet)
        if (frame.identifier, frame.extended) not in self._mapped:
            return []
        message, mappings = self._mapped[frame.identifier, frame.extended]
        try:
            values = message.decode(frame.data, decode_choices=False)
        except self._cantools.database.DecodeError as error:
            raise ValueError(str(error)) from error
        source = self.source(message.name)
        # A multiplexed message holds only some of its signals.
        known = [mapping for mapping in mappings if all(name in values for name in mapping.signals)]
        return [s for mapping in known for s in self._samples(mapping, values, arrival_ns, source)]

    def _samples(
        self, mapping: DbcSignal, values: dict[str, float], t_ns: int, source: str
    ) -> list[TelemetrySample]:
        scale = mapping.scale * (len(mapping.signals) // len(mapping.scale))
        scaled = [
            factor * values[name] for factor, name in zip(scale, mapping.signals, strict=True)
        ]
        if mapping.sample == "position":
            return self._fixes.fix(t_ns, t_ns, source, scaled[0], scaled[1], sigma_of(None))
        return [_in_body(mapping, scaled, t_ns, source)]

    def _open_file(self, path: str) -> Any:
        try:
            return self._cantools.database.load_file(path, database_format="dbc")
        except (OSError, ValueError, self._cantools.Error) as error:
            raise ConfigError(
                f"cannot read the DBC file {path}: {reason_of(error)}; give the bus's .dbc"
            ) from error


def _message(database: Any, mapping: DbcSignal, path: str) -> Any:
    try:
        message = database.get_message_by_name(mapping.message)
    except KeyError:
        known = ", ".join(sorted(message.name for message in database.messages))
        raise ConfigError(
            f"{path} has no message '{mapping.message}'; its messages are {known}"
        ) from None
    known_signals = [signal.name for signal in message.signals]
    for signal in mapping.signals:
        if signal not in known_signals:
            raise ConfigError(
                f"{path}: message '{mapping.message}' has no signal '{signal}'; its signals are "
                f"{', '.join(known_signals)}"
            )
    return message


def _in_body(mapping: DbcSignal, scaled: list[float], t_ns: int, source: str) -> TelemetrySample:
    if mapping.sample == "velocity":
        return Velocity(t_ns, t_ns, source, (scaled[0], scaled[1], scaled[2]), mapping.sigma_m_s)
    if mapping.sample == "euler":
        return Attitude(t_ns, t_ns, source, from_euler(*scaled))
    if mapping.sample == "attitude":
        return Attitude(t_ns, t_ns, source, normalise((scaled[0], scaled[1], scaled[2], scaled[3])))
    if mapping.sample in VECTORS:
        return VECTORS[mapping.sample](t_ns, t_ns, source, (scaled[0], scaled[1], scaled[2]))
    return SCALARS[mapping.sample](t_ns, t_ns, source, scaled[0])


# --------------------------------------------------------------------------------------------------
# CAN frames in a stream of bytes: the records that :mod:`aquaflow.drivers.transport.can` makes.
#
# A bus loses whole frames only. The checks are for recordings and for whatever else feeds a
# decoder.

MAX_STANDARD, MAX_EXTENDED = 0x7FF, 0x1FFF_FFFF
"""The largest identifiers of 11 and of 29 bits."""


class CanFrame(NamedTuple):
    """One frame of a CAN bus."""

    identifier: int
    extended: bool
    data: bytes


class CanFraming(Framing):
    """Records of 16 bytes, recognised by the bytes that must be zero."""

    longest = RECORD.size

    def find(self, buffer: bytes, at: int) -> int:
        return at

    def length(self, buffer: bytes, at: int) -> int:
        if len(buffer) - at < RECORD.size:
            return INCOMPLETE
        identifier, length, payload = RECORD.unpack_from(buffer, at)
        allowed = EXTENDED | MAX_EXTENDED if identifier & EXTENDED else MAX_STANDARD
        padding = buffer[at + 5 : at + 8] + payload[length:]
        if identifier & ~allowed or length > len(payload) or any(padding):
            return NO_PACKET
        return RECORD.size

    def intact(self, packet: bytes) -> bool:
        return True  # the bus has tested its own checksum


def frame_of(record: bytes) -> CanFrame:
    """The frame in a record of :class:`CanFraming`."""
    identifier, length, payload = RECORD.unpack(record)
    return CanFrame(identifier & ~EXTENDED, bool(identifier & EXTENDED), payload[:length])
