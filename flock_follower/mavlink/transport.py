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
Bytes to and from an autopilot: UDP, TCP and serial, opened from a pymavlink URL.

``udpin:HOST:PORT`` listens, ``udpout:HOST:PORT`` sends first, ``tcp:HOST:PORT`` connects,
``/dev/DEVICE[,BAUD]`` is a serial port. Everything is non-blocking, nothing here reads a clock.
What is lost or not there yet (an unplugged device, a closed connection) is opened by ``reopen``.
"""

from __future__ import annotations

from collections.abc import Iterator
import re
import socket
from typing import Any, Final, Protocol

from flock_follower.mavlink.serial_tcp import BAUD_RATES, NOT_NOW, SerialTransport, TcpTransport
from flock_follower.ranges import Range

DEFAULT_BAUD: Final[int] = 115200
_URL_FORMS: Final[str] = 'udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/DEVICE[,BAUD]'


class Transport(Protocol):
    """A non-blocking pipe; ``peer`` is where ``write`` sends to, None while unknown."""

    url: str
    peer: Any
    fault: str
    """Why nothing can pass now (unplugged, refused), for people; '' where all is well."""
    capacity: float
    """What the line carries each way, bytes per second; 0 where that is no matter."""
    delivers_late: bool
    """Whether what cannot arrive now is kept, and arrives later."""

    def fileno(self) -> int:
        """Return the descriptor to select on, -1 while there is none."""

    def reopen(self, now: float) -> None:
        """Try to open again what was lost, at most every half second; ``now`` is in s."""

    def read(self) -> Iterator[tuple[bytes, Any]]:
        """Yield what has arrived, with where it came from."""

    def write(self, data: bytes) -> bool:
        """Send to the peer; return whether it went out, or will, whole."""

    def congested(self) -> bool:
        """Return whether what waits to be sent would hold up a setpoint."""

    def close(self) -> None:
        """Release the port."""


class UdpTransport:
    """
    A UDP socket.

    A listening one answers only the ``peer`` its owner sets, not everyone who ever sent to it:
    a setpoint must not reach a second vehicle by accident.
    """

    fault = ''
    capacity = 0.0
    delivers_late = False

    def __init__(self, url: str, *, bind: tuple[str, int] | None = None,
                 peer: tuple[str, int] | None = None) -> None:
        self.url = url
        self.peer: Any = peer
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            if bind is not None:
                self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            raise OSError(f'connection = {url!r}: cannot listen there: {error.strerror}') from None

    @property
    def address(self) -> tuple[str, int]:
        """Return the local address."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def fileno(self) -> int:
        """Return the descriptor to select on."""
        return self._socket.fileno()

    def reopen(self, now: float) -> None:
        """Do nothing: a UDP socket is never lost."""

    def read(self) -> Iterator[tuple[bytes, Any]]:
        """Yield the datagrams that have arrived, with their senders."""
        # Bounded, so that a flood cannot keep the caller from its other work.
        for _ in range(256):
            try:
                yield self._socket.recvfrom(65535)
            except OSError as error:
                if error.errno in NOT_NOW:
                    return
                raise

    def write(self, data: bytes) -> bool:
        """Send one datagram to the peer; return whether it went out."""
        if self.peer is None:
            return False
        try:
            self._socket.sendto(data, self.peer)
        except OSError:
            # Unreachable for the moment: the link's watchdog says so, no exception.
            return False
        return True

    def congested(self) -> bool:
        """Return False: datagrams do not wait for one another here."""
        return False

    def close(self) -> None:
        """Release the port."""
        self._socket.close()


def open_transport(url: str) -> UdpTransport | SerialTransport | TcpTransport:
    """
    Open a connection URL.

    A serial device that is not there, and a TCP port where nobody listens, are waited for.

    :raises ValueError: where the URL is not one of the known forms.
    :raises OSError: where a UDP port cannot be opened; the message names the URL.
    """
    network = re.fullmatch(r'(udpin|udpout|tcp):([^:\s]+):(\d{1,5})', url)
    if network:
        kind, host, port = network[1], network[2], int(network[3])
        lowest = 0 if kind == 'udpin' else 1
        Range(lowest, 65535, whole=True).check(f'connection = {url!r}: port', port)
        try:
            address = (socket.gethostbyname(host), port)
        except OSError:
            raise ValueError(f'connection = {url!r}: unknown host {host}') from None
        if kind == 'udpin':
            return UdpTransport(url, bind=address)
        if kind == 'tcp':
            return TcpTransport(url, address)
        return UdpTransport(url, peer=address)
    serial = re.fullmatch(r'(/dev/[^,\s]+)(?:,(\d+))?', url)
    if serial:
        baud = int(serial[2] or DEFAULT_BAUD)
        if baud not in BAUD_RATES or baud == 0:
            rates = ', '.join(str(b) for b in sorted(BAUD_RATES) if b >= 9600)
            raise ValueError(f'connection = {url!r}: baud rate must be one of {rates}')
        return SerialTransport(url, serial[1], baud)
    raise ValueError(f'connection = {url!r}: must be {_URL_FORMS}')
