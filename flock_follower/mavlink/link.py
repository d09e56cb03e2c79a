# Copyright 2026 The flock_follower developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
One MAVLink 2 link to one autopilot: framing, signing, addresses, message rates.

Only messages of the configured system id are used. Other messages are counted, so that the bridge
can explain why it receives no autopilot. The caller passes the time and calls from one thread.

``Framer`` finds messages in bytes that may contain garbage. pymavlink's parser accepts each start
byte, and discards up to 280 bytes of good messages if the byte does not begin a message.
``Framer`` consumes only messages whose checksum is right.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
import hashlib
import hmac
import math
import os
from pathlib import Path
import re
import stat
import struct
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import AUTO, describe, dialect_of
from flock_follower.mavlink.identity import device, Identity
from flock_follower.mavlink.link_questions import LinkQuestions
from flock_follower.mavlink.telemetry import Telemetry
from flock_follower.mavlink.transport import Transport
from flock_follower.ranges import Range

_MARKER: Final = re.compile(b'[%c%c]' % (mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2))
_SIGNED: Final[int] = mavlink.MAVLINK_IFLAG_SIGNED
#: After this many false starts, or unknown messages, in one piece the rest of it is dropped: a
#: flood of bytes that look like starts must not keep the caller from its other work.
MOST_FALSE_STARTS: Final[int] = 64
UNDECODABLE: Final[str] = 'undecodable'
UNKNOWN_MESSAGE: Final[str] = 'unknown message'
BAD_SIGNATURE: Final[str] = (
    'unsigned, signed with another key, older than the last, or over a minute ahead of our clock')


class Codec(mavlink.MAVLink):  # type: ignore[misc]
    """Decodes the messages of one sender; refuses messages that are forged or from the future."""

    latest = 0
    """The latest timestamp to accept."""

    def check_signature(self, msgbuf: bytearray, *source: int) -> bool:
        # pymavlink notes a packet's timestamp before it has checked its signature, so a forged one
        # from the future would lock the real vehicle out.
        digest = hashlib.sha256(bytes(self.signing.secret_key) + bytes(msgbuf[:-6])).digest()
        return (hmac.compare_digest(digest[:6], bytes(msgbuf[-6:]))
                and int.from_bytes(msgbuf[-12:-6], 'little') <= self.latest
                and bool(super().check_signature(msgbuf, *source)))


class Framer:
    """
    Decodes the bytes of one sender as they arrive.

    :param codec: decodes, and checks signatures.
    """

    def __init__(self, codec: Codec) -> None:
        self.codec = codec
        self._waiting = bytearray()
        self.looks = 0
        """Number of start bytes in the last data, true and false: the cost of parsing."""

    def feed(self, data: bytes, most: int = 10_000) -> tuple[list[Any], Counter[str]]:
        """
        Return the complete messages, and the numbers of unused pieces by reason.

        After ``most`` start bytes, true or false, the remaining bytes are dropped.
        """
        buffer = self._waiting + data
        messages: list[Any] = []
        unused: Counter[str] = Counter()
        behind, rest, whole, self.looks = 0, len(buffer), 0, 0
        for start in (match.start() for match in _MARKER.finditer(buffer)):
            if start < behind:
                continue  # a byte of the last message
            if self.looks >= most or self.looks - whole > MOST_FALSE_STARTS:
                rest = len(buffer)
                break
            self.looks += 1
            end = start + frame_length(buffer, start)
            if end > len(buffer):
                # Either the rest has not arrived yet, or this byte was no start. Look on: a whole
                # message behind it shows that it was none.
                rest = min(rest, start)
                continue
            message, fault = self._decode(buffer[start:end])
            if fault:
                unused[fault] += 1
            else:
                messages.append(message)
            if fault not in (UNDECODABLE, UNKNOWN_MESSAGE):
                behind, rest, whole = end, len(buffer), whole + 1
        self._waiting = buffer[rest:]
        if buffer and not messages and not unused and not self._waiting:
            unused[UNDECODABLE] += 1
        return messages, unused

    def _decode(self, data: bytearray) -> tuple[Any, str]:
        """Return a message, and why it cannot be used, or ''."""
        try:
            message = self.codec.decode(data)
        except (mavlink.MAVError, struct.error, ValueError, IndexError) as error:
            return None, BAD_SIGNATURE if 'signature' in str(error).lower() else UNDECODABLE
        # Another dialect's, or garbage: an unknown kind has no checksum.
        return message, UNKNOWN_MESSAGE if message.get_type().startswith('UNKNOWN') else ''


def frame_length(buffer: bytearray, start: int) -> int:
    """Return the length of the message that begins here; 3 if fewer than 3 bytes are known."""
    if len(buffer) < start + 3:
        return 3
    marker, payload, flags = buffer[start:start + 3]
    if marker == mavlink.PROTOCOL_MARKER_V1:
        return int(payload + 8)
    return int(payload + 12 + (mavlink.MAVLINK_SIGNATURE_BLOCK_LEN if flags & _SIGNED else 0))


#: Valid system and component ids of MAVLink; 0 means all.
ID_RANGE: Final[Range] = Range(1, 255, whole=True)
COMPONENT: Final[int] = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
AUTOPILOT_COMPONENT: Final[int] = mavlink.MAV_COMP_ID_AUTOPILOT1
SIGNING_KEY_SIZE: Final[int] = 32
#: Beginning of MAVLink's signing timestamps, 2015-01-01, s.
_SIGNING_EPOCH: Final[float] = 1420070400.0
#: Those timestamps in a second: they count 10 us.
_SIGNING_TICKS: Final[float] = 1e5
#: Most senders that are stored.
_MOST_PEERS: Final[int] = 16
#: Messages and pieces of garbage that one call takes; a flood beyond that is dropped.
MOST_PIECES: Final[int] = 300
#: How far ahead of our clock a signed message may be, s. MAVLink's rules send with the latest
#: timestamp that was accepted, and refuse a new stream (the autopilot, started again) that is more
#: than a minute behind that. With a minute at most no message accepted can have that effect.
MOST_AHEAD: Final[float] = 60.0
#: The autopilot has to be silent for this long, s, before its HEARTBEAT may come from elsewhere.
PEER_TIMEOUT: Final[float] = 2.0


class Signing:
    """A MAVLink 2 signing key and the time, s since 1970, to start its timestamps from."""

    def __init__(self, key: bytes, unix_time: float, link_id: int = 0) -> None:
        self.state = mavlink.MAVLinkSigning()
        self.state.secret_key = key
        self.state.sign_outgoing = True
        self.state.link_id = link_id
        self.state.timestamp = _timestamp(unix_time)
        self._reference = self.state.timestamp, math.nan  # a timestamp, and its time, s

    def latest(self, now: float) -> int:
        """Return the latest timestamp to accept; the first ``now``, s, is the start's."""
        timestamp, since = self._reference
        if math.isnan(since):
            self._reference = timestamp, now
            since = now
        return timestamp + int((now - since + MOST_AHEAD) * _SIGNING_TICKS)

    def set_clock(self, unix_time: float, now: float) -> None:
        """
        Follow the system clock forward if it is set after the start; never back.

        A timestamp must not decrease, and the autopilot has adopted our last timestamp.
        """
        timestamp = _timestamp(unix_time)
        if timestamp > self.latest(now) - int(MOST_AHEAD * _SIGNING_TICKS):
            self._reference = timestamp, now
        self.state.timestamp = max(self.state.timestamp, timestamp)

    @classmethod
    def from_file(cls, path: str, unix_time: float) -> Signing:
        """
        Read a key file of 32 bytes.

        :raises ValueError: if the file cannot be read, others have access to it, or it holds no
            key; never shows its content.
        """
        try:
            with Path(path).open('rb') as file:
                mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
                data = file.read()
        except OSError as error:
            raise ValueError(f'signing_key_file = {path!r}: {error.strerror}') from None
        if mode & 0o077:
            raise ValueError(f'signing_key_file = {path!r}: mode {mode:03o} gives others access: '
                             f'chmod 600 {path}')
        if len(data) != SIGNING_KEY_SIZE:
            raise ValueError(f'signing_key_file = {path!r}: must hold {SIGNING_KEY_SIZE} bytes')
        return cls(data, unix_time)


def _timestamp(unix_time: float) -> int:
    return max(0, int((unix_time - _SIGNING_EPOCH) * _SIGNING_TICKS))


class Link:
    """
    A link over a transport to the autopilot of ``target_system``.

    :param source_system: our own system id; 0: the vehicle's id, as MAVLink requires of a
        companion.
    :param autopilot: firmware of the autopilot, see ``dialects.dialect_of``.
    :param signing: if given, every message is signed and unsigned ones are dropped.
    :param announce_as_gcs: whether our HEARTBEAT is that of a ground station.
    """

    def __init__(self, transport: Transport, *, target_system: int = 1, source_system: int = 0,
                 source_component: int = COMPONENT, autopilot: str = AUTO,
                 signing: Signing | None = None, announce_as_gcs: bool = False) -> None:
        self.transport = transport
        self.target_system = target_system
        self.source_system = source_system or target_system
        self.source_component = source_component
        self.autopilot = autopilot
        self._own_type = (mavlink.MAV_TYPE_GCS if announce_as_gcs
                          else mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
        self.telemetry = Telemetry(autopilot)
        self.questions = LinkQuestions((self.source_system, source_component))
        self.identity = Identity()
        #: Number of messages that were received and not used, by reason.
        self.ignored: Counter[str] = Counter()
        #: How often another sender has taken the place of one that fell silent.
        self.peer_changes = 0
        self.bytes_received = 0
        self.bytes_sent = 0
        self.signing = signing
        #: Whether the autopilot's newest message was signed.
        self.autopilot_signs = False
        self._now = -math.inf  # of the last call of receive, s
        self._framers: dict[Any, Framer] = {}
        self._sender = self._codec()

    def _codec(self) -> Codec:
        codec = Codec(None, srcSystem=self.source_system, srcComponent=self.source_component)
        if self.signing is not None:
            codec.signing = self.signing.state
        return codec

    def receive(self, now: float) -> list[Any]:
        """Return the autopilot's messages that have arrived, and update the telemetry."""
        messages = []
        self._now = now
        self.transport.reopen(now)
        # Pieces of the vehicle, and of all other senders together.
        budgets = {True: MOST_PIECES, False: MOST_PIECES}
        for data, peer in self.transport.read():
            self.bytes_received += len(data)
            ours = peer == self.transport.peer
            if budgets[ours] <= 0:
                self.ignored['flood'] += 1
                continue
            framer = self._framer(peer, now)
            parsed, unused = framer.feed(data, budgets[ours])
            self.ignored.update(unused)
            budgets[ours] -= 1 + framer.looks
            for message in parsed:
                if unfit := self._unfit(message, peer, now):
                    self.ignored[unfit] += 1
                    continue
                self.autopilot_signs = bool(message.get_header().incompat_flags & _SIGNED)
                self.telemetry.update(message, now)
                self.questions.take(message, now)
                messages.append(message)
        return messages

    def _framer(self, peer: Any, now: float) -> Framer:
        # One for each sender, so that garbage of one does not damage messages of another.
        if peer not in self._framers:
            if len(self._framers) >= _MOST_PEERS:
                del self._framers[next(iter(self._framers))]
            self._framers[peer] = Framer(self._codec())
        if self.signing is not None:
            self._framers[peer].codec.latest = self.signing.latest(now)
        return self._framers[peer]

    def _unfit(self, message: Any, peer: Any, now: float) -> str:
        """Return why a message is not used, or '' if it is the autopilot's; then answer it."""
        kind, system = message.get_type(), message.get_srcSystem()
        component = message.get_srcComponent()
        if (system, component) == (self.source_system, self.source_component):
            self.identity.take_own(message, now)
        other = device(message)
        if other and (system, component) != (self.target_system, AUTOPILOT_COMPONENT):
            return f'of {other} (system id {system}, component {component})'
        if system != self.target_system:
            return f'of system id {system}, not target_system {self.target_system}'
        if component != AUTOPILOT_COMPONENT:
            return f'of component {component}, not of an autopilot'
        if other:
            return f'of {other} that sends as an autopilot (component {component})'
        if kind == 'HEARTBEAT' and dialect_of(message, self.autopilot) is None:
            return f'of {describe(message)}, which autopilot = {self.autopilot!r} does not send'
        self.identity.take(message, peer, peer == self.transport.peer, now)
        if peer == self.transport.peer:
            return ''
        # Answer one vehicle only: a second one with the same id must be silent first.
        if now - self.telemetry.message_time <= PEER_TIMEOUT:
            return 'second sender'
        if kind != 'HEARTBEAT':
            return 'before HEARTBEAT'
        if math.isfinite(self.telemetry.message_time) and (
                not self.identity.is_same(self.transport.peer, peer)):
            self.peer_changes += 1
            self.telemetry.forget()
        self.transport.peer = peer
        return ''

    def send(self, message: Any) -> bool:
        """Send a message; return whether it was sent (False until a message was received)."""
        if self.transport.peer is None:
            return False
        data = message.pack(self._sender)
        self._sender.seq = (self._sender.seq + 1) % 256
        self.questions.sent(message, self._now)
        sent = self.transport.write(bytes(data))
        self.bytes_sent += len(data) * sent
        return sent

    def send_heartbeat(self) -> bool:
        """Send the HEARTBEAT of an onboard computer, or of a ground station."""
        self.identity.sent_heartbeat(self._sender.seq)
        return self.send(mavlink.MAVLink_heartbeat_message(
            self._own_type, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3))

    def send_command(self, command: int, params: tuple[float, ...], confirmation: int = 0) -> bool:
        """Send COMMAND_LONG with up to seven parameters, the rest zero."""
        return self.send(mavlink.MAVLink_command_long_message(
            self.target_system, AUTOPILOT_COMPONENT, command, confirmation,
            *params, *(0.0,) * (7 - len(params))))

    def request_streams(self, rates: Mapping[int, float]) -> None:
        """Request messages by id, at rates in Hz (MAV_CMD_SET_MESSAGE_INTERVAL)."""
        for message_id, hertz in rates.items():
            self.send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (message_id, 1e6 / hertz))

    def request_parameter(self, name: str) -> bool:
        """Send PARAM_REQUEST_READ for a parameter by its name."""
        return self.send(mavlink.MAVLink_param_request_read_message(
            self.target_system, AUTOPILOT_COMPONENT, name.encode('ascii'), -1))

    def silence(self) -> str:
        """Return a text about the messages that arrive instead of the autopilot's messages."""
        # A copy: the setpoint thread adds to it.
        why = ', '.join(f'{count} {reason}' for reason, count in self.ignored.copy().items())
        return f'received, but not used: {why}' if why else 'nothing arrives'
