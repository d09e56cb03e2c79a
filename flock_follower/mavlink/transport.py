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
Bytes to and from an autopilot: UDP, TCP and serial, opened from a URL (see ``connection``).

No call blocks or reads a clock. ``reopen`` opens a device or a connection that was lost, or that
did not exist yet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import errno
import fcntl
import math
import os
import socket
import struct
import termios
import tty
from typing import Any, Final, TypeVar

from flock_follower.mavlink.connection import BAUD_RATES, explain_error, parse_connection

T = TypeVar('T')
#: Time between two attempts to reopen a lost port, s.
RETRY_PERIOD: Final[float] = 0.5
#: A line is congested if sending the waiting bytes takes longer than this, s.
LONGEST_BACKLOG: Final[float] = 0.02
#: A TCP connection without traffic for this long, ms, is closed.
LONGEST_TCP_DELAY: Final[int] = 1000
#: Size of its buffer, bytes.
TCP_BUFFER: Final[int] = 16384
#: It is congested if more bytes than this are not acknowledged.
TCP_BACKLOG: Final[float] = 1000.0
#: Bytes read at once.
MOST_READ: Final[int] = 2048
#: Bits on a serial line for each byte, with its start and stop bit.
BITS_PER_BYTE: Final[int] = 10
#: A TCP connection is made within this time, s, or tried again.
CONNECT_TIMEOUT: Final[float] = 0.2
#: Errors of an address that a network interface may have later.
COMES_LATER: Final[tuple[int, ...]] = (errno.EADDRNOTAVAIL, errno.ENETDOWN, errno.ENODEV)
#: Errors of a serial port that another process uses: it is exclusive, or locked.
IN_USE: Final[tuple[int, ...]] = (errno.EBUSY, errno.EWOULDBLOCK)


class _Line:
    """A descriptor that may be lost, and the bytes that it has not accepted yet."""

    peer: Any = 'line'
    capacity = 0.0
    delivers_late = False
    _device = ''  # of a serial port
    _backlog = 0.0  # bytes that may wait in the kernel

    def __init__(self, url: str) -> None:
        self.url = url
        self.fault = ''
        self._fd = -1
        self._tried = -math.inf  # when it was opened, or tried to, s
        self._waiting = b''

    def fileno(self) -> int:
        """Return the descriptor to select on, -1 while there is none."""
        return self._fd

    def _open(self) -> int:
        """Return a new descriptor."""
        raise NotImplementedError

    def _call(self, call: Callable[[], T]) -> T | None:
        """Return the result of a system call; None if it would block, or the line is lost."""
        try:
            return call()
        except (BlockingIOError, InterruptedError):
            return None
        except OSError as error:
            self._lose(explain_error(error, self._device))
            return None

    def _lose(self, fault: str) -> None:
        self.close()
        self.fault = fault

    def reopen(self, now: float) -> None:
        """Try to reopen a lost port, at most every RETRY_PERIOD."""
        if self._fd >= 0 or now - self._tried < RETRY_PERIOD:
            return
        self._tried = now
        try:
            self._fd, self.fault = self._open(), ''
        except (OSError, termios.error) as error:
            self.fault = explain_error(error, self._device)

    def read(self) -> Iterator[tuple[bytes, Any]]:
        """Yield the bytes that have arrived."""
        if self._fd < 0:
            return
        # Limited to one call's share; the rest waits in the kernel.
        data = self._call(lambda: os.read(self._fd, MOST_READ))
        if data:
            yield data, self.peer
        elif data is not None:
            self._lose('closed by the other end')

    def write(self, data: bytes) -> bool:
        """Send; return whether it was accepted. A message that was begun is always completed."""
        if self._fd < 0 or self._waits():
            return False
        taken = self._call(lambda: os.write(self._fd, data))
        self._waiting = data[taken:] if taken else b''
        return bool(taken)

    def _waits(self) -> bool:
        """Send the rest of the last message; return whether a part is still unsent."""
        if self._waiting and self._fd >= 0:
            taken = self._call(lambda: os.write(self._fd, self._waiting))
            self._waiting = self._waiting[taken or 0:]
        return bool(self._waiting)

    def is_congested(self) -> bool:
        """Return whether waiting data would delay a setpoint."""
        return self._waits() or self._queued_bytes() > self._backlog

    def _queued_bytes(self) -> int:
        """Return how many bytes the kernel keeps: not sent yet, or over TCP not acknowledged."""
        try:
            return int(struct.unpack('i', fcntl.ioctl(self._fd, termios.TIOCOUTQ, b'\0' * 4))[0])
        except (OSError, ValueError):
            return 0

    def close(self) -> None:
        """Release the port."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd, self._waiting = -1, b''


class SerialTransport(_Line):
    """
    A serial port in raw mode, opened whenever the device is there and no other process has it.

    A second process would receive a part of the autopilot's bytes, and mix its bytes with ours.
    """

    def __init__(self, url: str, device: str, baud: int) -> None:
        super().__init__(url)
        self._device = device
        self._baud = baud
        self.capacity = baud / BITS_PER_BYTE
        self._backlog = LONGEST_BACKLOG * self.capacity
        # A missing device is no error: the autopilot may start later than this computer.
        self.reopen(-math.inf)

    def _open(self) -> int:
        fd = -1
        try:
            fd = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            # TIOCEXCL below refuses the port to any program, but not to root's, nor to one that
            # opened it earlier: flock() finds those that lock it, too.
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Not TCSAFLUSH: that waits for data that another program left in the driver.
            tty.setraw(fd, termios.TCSANOW)
            attributes = termios.tcgetattr(fd)
            # 8N1 without flow control, whatever another program has set; and without the flags
            # that setraw() leaves before Python 3.12: IGNCR would remove each byte 0x0D.
            attributes[0] = 0
            attributes[2] &= ~(termios.CSTOPB | termios.CRTSCTS)
            attributes[2] |= termios.CLOCAL | termios.CREAD
            attributes[4] = attributes[5] = BAUD_RATES[self._baud]
            termios.tcsetattr(fd, termios.TCSANOW, attributes)
            fcntl.ioctl(fd, termios.TIOCEXCL)
        except BaseException as error:
            if fd >= 0:
                os.close(fd)
            if isinstance(error, OSError) and error.errno in IN_USE:
                raise OSError(errno.EBUSY, f'another process uses {self._device}: end it, or have '
                              'a router share the port (docs/deploy.md)') from None
            raise
        return fd

    def close(self) -> None:
        """Release the port, and the lock that keeps other processes out."""
        if self._fd >= 0:
            # Otherwise it stays exclusive while another process has it open.
            with contextlib.suppress(OSError):  # unplugged
                fcntl.ioctl(self._fd, termios.TIOCNXCL)
        super().close()


class TcpTransport(_Line):
    """
    A TCP connection to a listening autopilot or simulator; a closed connection is opened again.

    ``reopen`` waits for at most CONNECT_TIMEOUT; meanwhile nothing can be sent anyway.
    """

    delivers_late = True
    _backlog = TCP_BACKLOG  # the rest is for setpoints

    def __init__(self, url: str, address: tuple[str, int]) -> None:
        super().__init__(url)
        self._address = address
        self.fault = 'not connected yet'

    def _open(self) -> int:
        with socket.create_connection(self._address, CONNECT_TIMEOUT) as connection:
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # Drop data that is not delivered by then: a late setpoint is worse than none.
            connection.setsockopt(
                socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, LONGEST_TCP_DELAY)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, TCP_BUFFER)
            return connection.detach()


class UdpTransport(_Line):
    """
    A UDP socket, which is never lost once it is open.

    A listening socket sends only to the ``peer`` that its owner sets, not to every sender, so that
    no setpoint reaches a second vehicle by accident.
    """

    _backlog = math.inf  # datagrams do not wait for each other here

    def __init__(self, url: str, *, bind: tuple[str, int] | None = None,
                 peer: tuple[str, int] | None = None) -> None:
        super().__init__(url)
        self.peer = peer
        self._bind = bind
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._fd = self._open()
        except OSError as error:
            self.fault = explain_error(error)
            if error.errno not in COMES_LATER:
                raise OSError(error.errno, f'connection = {url!r}: cannot listen there: '
                              f'{self.fault}') from None

    def _open(self) -> int:
        self._socket.close()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if self._bind is not None:
            self._socket.bind(self._bind)
        return self._socket.fileno()

    @property
    def address(self) -> tuple[str, int]:
        """Return the local address."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def read(self) -> Iterator[tuple[bytes, Any]]:
        """Yield the datagrams that have arrived, with their senders."""
        if self._fd < 0:
            return
        # Bounded, so that a flood cannot keep the caller from its other work.
        for _ in range(256):
            try:
                yield self._socket.recvfrom(65535)
            except (BlockingIOError, InterruptedError, ConnectionRefusedError):
                return

    def write(self, data: bytes) -> bool:
        """Send one datagram to the peer; return whether it was sent."""
        if self.peer is None or self._fd < 0:
            return False
        try:
            self._socket.sendto(data, self.peer)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError as error:  # unreachable now
            self.fault = explain_error(error, sending=True)
            return False
        self.fault = ''
        return True

    def close(self) -> None:
        """Release the port."""
        self._socket.close()
        self._fd = -1


#: A non-blocking pipe. ``peer`` is the receiver of ``write``, None while unknown. ``fault`` is the
#: reason why no data can pass now (unplugged, refused), or ''. ``capacity`` is in bytes per second
#: each way, 0 if it does not matter. ``delivers_late`` is whether data that cannot arrive now is
#: kept. ``fileno`` is -1 without a descriptor to select on. ``reopen`` tries to open a lost port,
#: at most every RETRY_PERIOD. ``is_congested`` is whether waiting data would delay a setpoint.
Transport = UdpTransport | SerialTransport | TcpTransport


def open_transport(url: str) -> Transport:
    """
    Open a connection URL.

    A missing serial device, an address that no network interface has yet, or a TCP port without a
    listener is opened as soon as it appears.

    :raises ValueError: if the URL is not one of the known forms.
    :raises OSError: if a UDP port cannot be opened; the message names the URL.
    """
    parsed = parse_connection(url)
    if parsed.device:
        return SerialTransport(url, parsed.device, parsed.baud)
    try:
        address = (socket.gethostbyname(parsed.host), parsed.port)
    except OSError:
        raise ValueError(f'connection = {url!r}: unknown host {parsed.host}') from None
    if parsed.kind == 'udpin':
        return UdpTransport(url, bind=address)
    if parsed.kind == 'tcp':
        return TcpTransport(url, address)
    return UdpTransport(url, peer=address)
