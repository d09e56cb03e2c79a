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

"""Lines that are lost and come back: a serial device, a TCP connection; and slow ones."""

import fcntl
import os
import select
import socket
import struct
import termios

import pytest

from flock_follower.mavlink.transport import (
    open_transport,
    RETRY_PERIOD,
)

TIOCGEXCL = 0x80045440  # of Linux; the termios module names it from Python 3.13 on


@pytest.fixture
def terminal(tmp_path, monkeypatch):
    """Give a function that plugs a pseudo terminal in, and one that opens it."""
    path, opened, real = tmp_path / 'ttyACM0', [], os.open
    # The URL wants /dev; the device itself may be anywhere.
    monkeypatch.setattr(os, 'open', lambda name, *rest: real(
        path if name == '/dev/ttyTEST' else name, *rest))

    def plug():
        path.unlink(missing_ok=True)
        ends = os.openpty()
        path.symlink_to(os.ttyname(ends[1]))
        return ends

    def make():
        opened.append(open_transport('/dev/ttyTEST,57600'))
        return opened[-1]
    yield plug, make, path.unlink
    for transport in opened:
        transport.close()


def wait(transport):
    assert select.select([transport], [], [], 2.0)[0]
    return b''.join(data for data, _ in transport.read())


def carries(transport, far_end):
    os.write(far_end, b'there')
    assert wait(transport) == b'there' and transport.fault == ''
    assert transport.write(b'back') and os.read(far_end, 10) == b'back'


def test_a_serial_device_that_is_away_is_reported_and_opened_when_it_comes(terminal):
    plug, make, unlink = terminal
    transport = make()
    for lost_at in (1.0, 10.0):
        assert (transport.fileno(), transport.fault) == (-1, 'No such file or directory')
        assert not transport.write(b'lost') and list(transport.read()) == []
        assert not transport.congested()
        transport.reopen(lost_at)
        main, replica = plug()
        transport.reopen(lost_at + 0.9 * RETRY_PERIOD)
        assert transport.fileno() == -1  # not too often
        transport.reopen(lost_at + RETRY_PERIOD)
        carries(transport, main)
        unlink()
        os.close(main)
        os.close(replica)
        assert wait(transport) == b'' and transport.fault
        transport.reopen(lost_at + 5.0)


def test_what_does_not_fit_is_refused_whole_and_what_begins_goes_out_whole(terminal):
    plug, make, _ = terminal
    main, _ = plug()
    transport, sent, message = make(), 0, bytes(range(256)) * 4
    while transport.write(message):
        sent += 1
        assert sent < 1000
    received = b''
    while len(received) < sent * len(message):
        received += os.read(main, 65536)
        transport.congested()  # which sends what waits
    assert received == sent * message
    assert not transport.congested() and transport.write(b'x')


def test_a_port_is_8n1_without_flow_control_however_it_was_left(terminal):
    plug, make, _ = terminal
    main, replica = plug()
    left = termios.tcgetattr(replica)
    left[0] |= termios.IXON | termios.IXOFF | termios.IGNCR | termios.INLCR | termios.PARMRK
    left[2] |= termios.CRTSCTS | termios.CSTOPB
    termios.tcsetattr(replica, termios.TCSANOW, left)
    transport = make()
    now = termios.tcgetattr(transport.fileno())
    assert not now[0] and now[2] & termios.CSIZE == termios.CS8
    assert not now[2] & (termios.CRTSCTS | termios.CSTOPB | termios.PARENB)
    os.write(main, bytes(range(256)))
    assert wait(transport) == bytes(range(256))


def test_a_serial_port_has_one_user_and_the_next_is_told_who_waits(terminal):
    plug, make, _ = terminal
    main, replica = plug()
    first, second = make(), make()
    assert first.capacity == 5760.0  # a tenth of its baud rate
    assert (first.fault, second.fault) == ('', 'another process uses /dev/ttyTEST')
    # Nor does another program open it.
    assert struct.unpack('i', fcntl.ioctl(replica, TIOCGEXCL, b'\0' * 4))[0] == 1
    carries(first, main)
    first.close()
    second.reopen(1.0)
    carries(second, main)


def test_tcp_connects_when_somebody_listens_again_after_a_close_and_holds_odometry_back():
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2304)
    server.bind(('127.0.0.1', 0))
    transport = open_transport(f'tcp:127.0.0.1:{server.getsockname()[1]}')
    assert transport.fault == 'not connected yet' and transport.fileno() == -1
    transport.reopen(0.0)
    assert transport.fault == 'Connection refused' and not transport.write(b'x')
    server.listen()
    for now in (1.0, 2.0):
        transport.reopen(now)
        peer, _ = server.accept()
        carries(transport, peer.fileno())
        assert not transport.congested()
        peer.close()
        assert wait(transport) == b'' and transport.fault == 'closed by the other end'
    transport.reopen(3.0)
    peer, _ = server.accept()
    while not transport.congested():  # nobody reads
        assert transport.write(bytes(70))
    assert transport.write(bytes(70))  # there is room for setpoints
    for end in (transport, peer, server):
        end.close()


@pytest.mark.parametrize(('url', 'reason'), [
    ('14540', 'must be udpin:HOST:PORT'), ('udpin:127.0.0.1', 'must be udpin:HOST:PORT'),
    ('tcp:127.0.0.1:0', r'port = \d+: must be an integer in \[1, 65535\]'),
    ('udpin:127.0.0.1:70000', r'port = \d+: must be an integer in \[0, 65535\]'),
    ('udpout:127.0.0.1:0', r'port = \d+: must be an integer in \[1, 65535\]'),
    ('udpin:no.such.host.invalid:14540', 'unknown host no.such.host.invalid'),
    ('/dev/ttyACM0,12345', 'baud rate must be one of 9600')])
def test_a_bad_url_is_refused_with_the_valid_forms(url, reason):
    with pytest.raises(ValueError, match=f'connection = .*{reason}'):
        open_transport(url)


def test_a_port_in_use_is_named():
    first = open_transport('udpin:127.0.0.1:0')
    url = f'udpin:127.0.0.1:{first.address[1]}'
    with pytest.raises(OSError, match=f'connection = .{url}.: cannot listen there: Address'):
        open_transport(url)
    first.close()
