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

import errno
import fcntl
import os
import select
import socket
import struct
import termios
import time

import pytest

from flock_follower.mavlink.transport import (
    LONGEST_TCP_DELAY,
    open_transport,
    RETRY_PERIOD,
    TCP_BUFFER,
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


def test_an_unplugged_serial_device_is_told_and_opened_again_when_it_is_back(terminal):
    device, transport = terminal()
    os.write(device.main, b'one')
    assert wait(transport) == b'one' and transport.fault == ''
    device.unplug()
    assert wait(transport) == b''
    assert transport.fileno() == -1 and transport.fault
    assert not transport.write(b'lost')
    transport.reopen(1.0)
    assert transport.fault == 'No such file or directory'
    device.plug()
    transport.reopen(1.0 + 0.9 * RETRY_PERIOD)
    assert transport.fileno() == -1  # not too often
    transport.reopen(1.0 + RETRY_PERIOD)
    assert transport.fault == ''
    os.write(device.main, b'two')
    assert wait(transport) == b'two'
    assert transport.write(b'three') and os.read(device.main, 10) == b'three'


def test_a_serial_device_absent_at_the_start_is_told_and_opened_when_it_comes(terminal):
    device, absent = terminal(unplugged=True)
    assert absent.fileno() == -1 and absent.fault == 'No such file or directory'
    assert not absent.write(b'lost') and list(absent.read()) == [] and not absent.congested()
    absent.reopen(1.0)
    assert absent.fault == 'No such file or directory'
    device.plug()
    absent.reopen(1.0 + RETRY_PERIOD)
    assert absent.fault == ''
    os.write(device.main, b'one')
    assert wait(absent) == b'one'
    assert absent.write(b'two') and os.read(device.main, 10) == b'two'


def test_a_file_that_is_no_serial_device_is_told():
    transport = open_transport('/dev/null')
    assert transport.fileno() == -1 and transport.fault == 'Inappropriate ioctl for device'


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
    assert first.fault == '' and second.fileno() == -1
    assert second.fault == 'another process uses /dev/ttyTEST'
    os.write(device.main, b'all')
    assert wait(first) == b'all' and not second.write(b'lost')
    first.close()
    second.reopen(1.0)
    assert second.fault == ''
    os.write(device.main, b'now')
    assert wait(second) == b'now'


def test_a_program_that_does_not_ask_cannot_open_the_port_either(terminal, monkeypatch):
    device, transport = terminal()
    assert exclusive(device)
    transport.close()
    assert not exclusive(device)

    def busy(*_):
        raise OSError(errno.EBUSY, 'Device or resource busy')  # what all but root get
    monkeypatch.setattr(os, 'open', busy)
    transport.reopen(1.0)
    assert transport.fault == 'another process uses /dev/ttyTEST'


def test_the_capacity_of_a_serial_line_is_a_tenth_of_its_baud_rate(terminal):
    assert terminal(57600)[1].capacity == 5760.0


def listener():
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    server.bind(('127.0.0.1', 0))
    return server


def connect(transport, now):
    for step in range(100):
        transport.reopen(now + step)
        if not transport.fault:
            return now + step
    raise AssertionError(transport.fault)


def test_tcp_connects_when_somebody_listens_and_again_after_a_close():
    server = listener()
    transport = open_transport(f'tcp:127.0.0.1:{server.getsockname()[1]}')
    assert transport.fault == 'not connected yet' and transport.fileno() == -1
    transport.reopen(0.0)
    transport.reopen(0.1)
    assert transport.fault == 'Connection refused' and not transport.write(b'x')
    server.listen()
    now = connect(transport, 1.0)
    peer = server.accept()[0]
    peer.sendall(b'one')
    assert wait(transport) == b'one'
    assert transport.write(b'two') and peer.recv(10) == b'two'
    with socket.socket(fileno=os.dup(transport.fileno())) as ours:
        assert ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == LONGEST_TCP_DELAY
        assert ours.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 4 * TCP_BUFFER
    peer.close()
    assert wait(transport) == b'' and transport.fault == 'closed by the other end'
    connect(transport, now + 1.0)
    peer = server.accept()[0]
    assert transport.write(b'again') and peer.recv(10) == b'again'
    for end in (transport, peer, server):
        end.close()


def test_odometry_is_held_back_while_tcp_waits_for_the_other_end():
    server = listener()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2304)
    server.listen()
    transport = open_transport(f'tcp:127.0.0.1:{server.getsockname()[1]}')
    connect(transport, 0.0)
    peer = server.accept()[0]
    assert not transport.congested()
    sent = received = 0
    while not transport.congested():  # nobody reads
        assert transport.write(bytes(70)) and sent < 1e6
        sent += 70
    assert transport.write(bytes(70))  # there is room for setpoints
    while received < sent + 70:
        received += len(peer.recv(4096))
    end = time.monotonic() + 2.0
    while transport.congested() and time.monotonic() < end:
        select.select([], [], [], 0.01)
    assert not transport.congested()
    for side in (transport, peer, server):
        side.close()


def test_a_connection_that_dies_while_writing_is_noticed():
    server = listener()
    server.listen()
    transport = open_transport(f'tcp:127.0.0.1:{server.getsockname()[1]}')
    connect(transport, 0.0)
    peer = server.accept()[0]
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b'\1\0\0\0\0\0\0\0')
    peer.close()  # with a reset
    for _ in range(1000):
        if not transport.write(b'x'):
            break
    assert transport.fault and transport.fileno() == -1
    server.close()
