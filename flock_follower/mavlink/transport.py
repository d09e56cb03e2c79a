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
Bytes to and from an autopilot: UDP and serial, opened from a pymavlink URL.

``udpin:HOST:PORT`` listens, ``udpout:HOST:PORT`` sends first, ``/dev/DEVICE[,BAUD]`` is a serial
port. Everything is non-blocking, nothing here reads a clock.
"""

from __future__ import annotations

from collections.abc import Iterator
import errno
import os
import re
import socket
import termios
import tty
from typing import Any, Protocol

DEFAULT_BAUD = 115200
_BAUD_RATES = {
    int(name[1:]): getattr(termios, name) for name in dir(termios) if re.fullmatch(r'B\d+', name)}
_URL_FORMS = 'udpin:HOST:PORT, udpout:HOST:PORT or /dev/DEVICE[,BAUD]'
_GONE = (errno.EAGAIN, errno.EWOULDBLOCK, errno.ECONNREFUSED, errno.EINTR)


class Transport(Protocol):
    """A non-blocking pipe; ``peer`` is where ``write`` sends to, None while unknown."""

    url: str
    peer: Any

    def fileno(self) -> int:
        """Return the descriptor to select on."""

    def read(self) -> Iterator[tuple[bytes, Any]]:
        """Yield what has arrived, with where it came from."""

    def write(self, data: bytes) -> bool:
        """Send to the peer; return whether it went out."""

    def close(self) -> None:
        """Release the port."""


class UdpTransport:
    """
    A UDP socket.

    A listening one answers only the ``peer`` its owner sets, not everyone who ever sent to it:
    a setpoint must not reach a second vehicle by accident.
    """

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

    def read(self) -> Iterator[tuple[bytes, Any]]:
        """Yield the datagrams that have arrived, with their senders."""
        # Bounded, so that a flood cannot keep the caller from its other work.
        for _ in range(256):
            try:
                yield self._socket.recvfrom(65535)
            except OSError as error:
                if error.errno in _GONE:
                    return
                raise

    def write(self, data: bytes) -> bool:
        """Send one datagram to the peer; return whether it went out."""
        if self.peer is None:
            return False
        try:
            self._socket.sendto(data, self.peer)
        except OSError:
            # Unreachable for the moment: the link's watchdog, not an exception, tells.
            return False
        return True

    def close(self) -> None:
        """Release the port."""
        self._socket.close()


class SerialTransport:
    """A serial port in raw mode, reopened when an unplugged device comes back."""

    peer: Any = 'serial'

    def __init__(self, url: str, device: str, baud: int) -> None:
        self.url = url
        self._device = device
        self._baud = baud
        try:
            self._fd = self._open()
        except (OSError, termios.error) as error:
            reason = error.strerror if isinstance(error, OSError) else error.args[-1]
            raise OSError(f'connection = {url!r}: cannot open {device}: {reason}') from None

    def _open(self) -> int:
        fd = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            tty.setraw(fd)
            attributes = termios.tcgetattr(fd)
            attributes[2] |= termios.CLOCAL | termios.CREAD
            attributes[4] = attributes[5] = _BAUD_RATES[self._baud]
            termios.tcsetattr(fd, termios.TCSANOW, attributes)
        except BaseException:
            os.close(fd)
            raise
        return fd

    def _reopen(self) -> None:
        self.close()
        try:
            self._fd = self._open()
        except (OSError, termios.error):
            self._fd = -1

    def fileno(self) -> int:
        """Return the descriptor to select on, -1 while the device is away."""
        return self._fd

    def read(self) -> Iterator[tuple[bytes, Any]]:
        """Yield the bytes that have arrived."""
        if self._fd < 0:
            self._reopen()
        if self._fd < 0:
            return
        try:
            data = os.read(self._fd, 65535)
        except BlockingIOError:
            return
        except OSError:
            data = b''
        if data:
            yield data, self.peer
        else:
            self._reopen()

    def write(self, data: bytes) -> bool:
        """Send; return whether every byte was taken."""
        try:
            return self._fd >= 0 and os.write(self._fd, data) == len(data)
        except OSError:
            return False

    def close(self) -> None:
        """Release the port."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1


def open_transport(url: str) -> UdpTransport | SerialTransport:
    """
    Open a connection URL.

    :raises ValueError: where the URL is not one of the known forms.
    :raises OSError: where the port or device cannot be opened; the message names the URL.
    """
    udp = re.fullmatch(r'(udpin|udpout):([^:\s]+):(\d{1,5})', url)
    if udp:
        host, port = udp[2], int(udp[3])
        lowest = 0 if udp[1] == 'udpin' else 1
        if not lowest <= port <= 65535:
            raise ValueError(f'connection = {url!r}: port must be in [{lowest}, 65535]')
        try:
            address = (socket.gethostbyname(host), port)
        except OSError:
            raise ValueError(f'connection = {url!r}: unknown host {host}') from None
        if udp[1] == 'udpin':
            return UdpTransport(url, bind=address)
        return UdpTransport(url, peer=address)
    serial = re.fullmatch(r'(/dev/[^,\s]+)(?:,(\d+))?', url)
    if serial:
        baud = int(serial[2] or DEFAULT_BAUD)
        if baud not in _BAUD_RATES or baud == 0:
            rates = ', '.join(str(b) for b in sorted(_BAUD_RATES) if b >= 9600)
            raise ValueError(f'connection = {url!r}: baud rate must be one of {rates}')
        return SerialTransport(url, serial[1], baud)
    raise ValueError(f'connection = {url!r}: must be {_URL_FORMS}')
