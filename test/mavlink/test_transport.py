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


class Terminal:
    """A pseudo terminal whose device is a link that can be pulled."""

    def __init__(self, path):
        self.path = str(path)
        self.plug()

    def plug(self):
        self.main, replica = os.openpty()
        os.symlink(os.ttyname(replica), self.path)
        self.replica = replica

    def unplug(self):
        os.unlink(self.path)
        os.close(self.replica)
        os.close(self.main)


@pytest.fixture
def terminal(tmp_path, monkeypatch):
    # The URL wants /dev; the device itself may be anywhere.
    terminal = Terminal(tmp_path / 'ttyACM0')
    opened, real = [], os.open
    monkeypatch.setattr(os, 'open', lambda path, *rest: real(
        terminal.path if path == '/dev/ttyTEST' else path, *rest))

    def make(baud=57600, unplugged=False):
        if unplugged:
            terminal.unplug()
        opened.append(open_transport(f'/dev/ttyTEST,{baud}'))
        return terminal, opened[-1]
    yield make
    for transport in opened:
        transport.close()


def wait(transport):
    assert select.select([transport], [], [], 2.0)[0]
    return b''.join(data for data, _ in transport.read())


def carries(transport, far_end):
    os.write(far_end, b'there')
    assert wait(transport) == b'there' and transport.fault == ''
    assert transport.write(b'back') and os.read(far_end, 10) == b'back'


@pytest.mark.parametrize('there', [True, False])
def test_a_serial_device_that_is_away_is_told_and_opened_when_it_comes(terminal, there):
    device, transport = terminal(unplugged=not there)
    if there:
        carries(transport, device.main)
        device.unplug()
        assert wait(transport) == b'' and transport.fault
        transport.reopen(1.0)
    assert (transport.fileno(), transport.fault) == (-1, 'No such file or directory')
    assert not transport.write(b'lost') and list(transport.read()) == []
    assert not transport.congested()
    transport.reopen(1.0)
    device.plug()
    transport.reopen(1.0 + 0.9 * RETRY_PERIOD)
    assert transport.fileno() == -1  # not too often
    transport.reopen(1.0 + RETRY_PERIOD)
    carries(transport, device.main)


def test_what_does_not_fit_is_refused_whole_and_what_begins_goes_out_whole(terminal):
    device, transport = terminal()
    sent, message = 0, bytes(range(256)) * 4
    while transport.write(message):
        sent += 1
        assert sent < 1000
    received = b''
    while len(received) < sent * len(message):
        received += os.read(device.main, 65536)
        transport.congested()  # which sends what waits
    assert received == sent * message
    assert not transport.congested() and transport.write(b'x')


def test_a_port_is_8n1_without_flow_control_however_it_was_left(terminal):
    ends, transport = terminal()
    transport.close()
    left = termios.tcgetattr(ends.replica)
    left[0] |= termios.IXON | termios.IXOFF | termios.IGNCR | termios.INLCR | termios.PARMRK
    left[2] |= termios.CRTSCTS | termios.CSTOPB
    termios.tcsetattr(ends.replica, termios.TCSANOW, left)
    transport.reopen(10.0)
    now = termios.tcgetattr(transport.fileno())
    assert not now[0]
    assert not now[2] & (termios.CRTSCTS | termios.CSTOPB | termios.PARENB)
    assert now[2] & termios.CSIZE == termios.CS8
    everything = bytes(range(256))
    os.write(ends.main, everything)
    assert wait(transport) == everything


def exclusive(device):
    return struct.unpack('i', fcntl.ioctl(device.replica, TIOCGEXCL, b'\0' * 4))[0] == 1


def test_a_serial_port_has_one_user_and_the_next_is_told_who_waits(terminal):
    device, first = terminal()
    _, second = terminal()
    assert first.capacity == 5760.0  # a tenth of its baud rate
    assert (first.fault, second.fault) == ('', 'another process uses /dev/ttyTEST')
    assert second.fileno() == -1 and exclusive(device)  # nor opens it who does not ask
    carries(first, device.main)
    first.close()
    assert not exclusive(device)
    second.reopen(1.0)
    carries(second, device.main)


@pytest.fixture
def tcp():
    """Give a transport to a server that does not listen yet, and what lets it accept."""
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2304)
    server.bind(('127.0.0.1', 0))
    transport, ends = open_transport(f'tcp:127.0.0.1:{server.getsockname()[1]}'), []

    def accept(now):
        server.listen()
        for step in range(100):
            transport.reopen(now + step)
            if not transport.fault:
                break
        assert not transport.fault
        ends.append(server.accept()[0])
        return ends[-1]
    yield transport, accept
    for end in (transport, server, *ends):
        end.close()


def test_tcp_connects_when_somebody_listens_and_again_after_a_close(tcp):
    transport, accept = tcp
    assert transport.fault == 'not connected yet' and transport.fileno() == -1
    for now in (0.0, 0.1):
        transport.reopen(now)
    assert transport.fault == 'Connection refused' and not transport.write(b'x')
    peer = accept(1.0)
    carries(transport, peer.fileno())
    peer.close()
    assert wait(transport) == b'' and transport.fault == 'closed by the other end'
    peer = accept(200.0)
    carries(transport, peer.fileno())
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b'\1\0\0\0\0\0\0\0')
    peer.close()  # with a reset
    assert not all(transport.write(b'x') for _ in range(1000))
    assert transport.fault and transport.fileno() == -1


def test_odometry_is_held_back_while_tcp_waits_for_the_other_end(tcp):
    transport, accept = tcp
    accept(0.0)
    assert not transport.congested()
    while not transport.congested():  # nobody reads
        assert transport.write(bytes(70))
    assert transport.write(bytes(70))  # there is room for setpoints


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
