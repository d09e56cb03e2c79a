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
import grp
import os
import select
import socket
import struct
import termios
import time
from types import SimpleNamespace

import pytest

from flock_follower.mavlink.connection import explain_error, parse_connection
from flock_follower.mavlink.transport import (
    open_transport,
    RETRY_PERIOD,
)

DEADLINE = 40.0  # s for anything awaited
MISSING = ('No such file or directory (ENOENT): is it plugged in? `ls /dev/serial/by-id` lists '
           'what is there')
IN_USE = ('another process uses /dev/ttyTEST: end it, or have a router share the port '
          '(docs/deploy.md) (EBUSY)')
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


def test_missing_serial_device_is_reported_and_opened_later(terminal):
    plug, make, unlink = terminal
    transport = make()
    for lost_at in (1.0, 10.0):
        assert (transport.fileno(), transport.fault) == (-1, MISSING)
        assert not transport.write(b'lost') and list(transport.read()) == []
        assert not transport.is_congested()
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


def test_what_does_not_fit_is_refused_whole(terminal):
    plug, make, _ = terminal
    main, _ = plug()
    transport, sent, message = make(), 0, bytes(range(256)) * 4
    while transport.write(message):
        sent += 1
        assert sent < 1000
    received, deadline = b'', time.monotonic() + DEADLINE
    while len(received) < sent * len(message):
        assert time.monotonic() < deadline, f'{len(received)} of {sent * len(message)} bytes'
        if select.select([main], [], [], 0.01)[0]:
            received += os.read(main, 65536)
        transport.is_congested()  # which sends what waits
    assert received == sent * message
    assert not transport.is_congested() and transport.write(b'x')


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


def test_serial_port_has_one_user_next_is_told_who_waits(terminal):
    plug, make, _ = terminal
    main, replica = plug()
    first, second = make(), make()
    assert first.capacity == 5760.0  # a tenth of its baud rate
    assert (first.fault, second.fault) == ('', IN_USE)
    # Nor does another program open it.
    assert struct.unpack('i', fcntl.ioctl(replica, TIOCGEXCL, b'\0' * 4))[0] == 1
    carries(first, main)
    first.close()
    second.reopen(1.0)
    carries(second, main)


def test_tcp_reconnects_and_holds_odometry_back():
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2304)
    server.bind(('127.0.0.1', 0))
    transport = open_transport(f'tcp:127.0.0.1:{server.getsockname()[1]}')
    assert transport.fault == 'not connected yet' and transport.fileno() == -1
    transport.reopen(0.0)
    assert 'Connection refused (ECONNREFUSED): ' in transport.fault
    assert not transport.write(b'x')
    server.listen()
    for now in (1.0, 2.0):
        transport.reopen(now)
        peer, _ = server.accept()
        carries(transport, peer.fileno())
        assert not transport.is_congested()
        peer.close()
        assert wait(transport) == b'' and transport.fault == 'closed by the other end'
    transport.reopen(3.0)
    peer, _ = server.accept()
    while not transport.is_congested():  # nobody reads
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
    ('udp://:14540@192.168.1.5:14550', r'did you mean udpout:192.168.1.5:14550\?'),
    ('udp://0.0.0.0:14540@', r'did you mean udpin:0.0.0.0:14540\?'),
    ('udp://:14540', r'did you mean udpin:127.0.0.1:14540\?'),
    ('udpin:14540', r'did you mean udpin:127.0.0.1:14540\?'),
    ('/dev/ttyACM0,12345', 'baud rate must be one of 9600'),
    ('/dev/ttyACM0:12345', 'baud rate must be one of 9600')])
def test_a_bad_url_is_refused_with_the_valid_forms(url, reason):
    with pytest.raises(ValueError, match=f'connection = .*{reason}'):
        open_transport(url)


@pytest.mark.parametrize(('url', 'expected'), [
    ('/dev/ttyACM0:57600', ('serial', '', 0, '/dev/ttyACM0', 57600)),
    ('/dev/ttyACM0', ('serial', '', 0, '/dev/ttyACM0', 115200)),
    ('serial:///dev/ttyS4:921600', ('serial', '', 0, '/dev/ttyS4', 921600)),
    ('/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0,57600',
     ('serial', '', 0, '/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0', 57600)),
    ('udp:127.0.0.1:14540', ('udpin', '127.0.0.1', 14540, '', 115200)),
    ('udpin://0.0.0.0:14540', ('udpin', '0.0.0.0', 14540, '', 115200)),
    ('udpout://10.0.0.2:14550', ('udpout', '10.0.0.2', 14550, '', 115200)),
    ('tcp://localhost:5760', ('tcp', 'localhost', 5760, '', 115200))])
def test_the_forms_of_other_programs_are_taken(url, expected):
    assert parse_connection(url) == expected


def test_a_port_in_use_is_named():
    first = open_transport('udpin:127.0.0.1:0')
    url = f'udpin:127.0.0.1:{first.address[1]}'
    with pytest.raises(OSError, match=f'connection = .{url}.: cannot listen there: .*EADDRINUSE'):
        open_transport(url)
    first.close()


def test_address_without_interface_is_reported_then_listened_on(monkeypatch):
    bind, taken = socket.socket.bind, []

    class Late(socket.socket):
        def bind(self, address):
            if not taken:
                raise OSError(errno.EADDRNOTAVAIL, os.strerror(errno.EADDRNOTAVAIL))
            bind(self, address)
    monkeypatch.setattr(socket, 'socket', Late)
    transport = open_transport('udpin:127.0.0.1:0')
    assert 'EADDRNOTAVAIL' in transport.fault and transport.fileno() == -1
    assert not transport.write(b'x') and list(transport.read()) == []
    taken.append(True)
    transport.reopen(1.0)
    assert transport.fault == '' and transport.fileno() >= 0
    transport.close()


def test_unsendable_datagram_is_reported_with_remedy_until_sent(monkeypatch):
    transport = open_transport('udpout:255.255.255.255:14550')  # without the right to broadcast
    assert not transport.write(b'x')
    assert '(EACCES): a broadcast address' in transport.fault
    transport.peer = ('127.0.0.1', 9)
    assert transport.write(b'x') and transport.fault == ''
    transport.close()


@pytest.mark.parametrize(('number', 'word'), [
    (errno.ENETUNREACH, 'interface'), (errno.EHOSTUNREACH, 'address'), (errno.EPERM, 'firewall'),
    (errno.EADDRINUSE, 'end it'), (errno.EACCES, 'below 1024'), (errno.EIO, '')])
def test_an_error_has_its_name_and_a_remedy(number, word):
    text = explain_error(OSError(number, os.strerror(number)))
    assert f'({errno.errorcode[number]})' in text and word in text


@pytest.mark.parametrize(('mode', 'group', 'said'), [
    (0o660, 20, 'usermod -aG {name} '), (0o600, 20, '61-flight-controller.rules'),
    (0o660, 0, '61-flight-controller.rules')])
def test_a_serial_port_without_permission_names_its_group(monkeypatch, mode, group, said):
    name = grp.getgrgid(group).gr_name
    port, stat = '/dev/ttyACM0', os.stat
    # Other threads ask for other files.
    monkeypatch.setattr(os, 'stat', lambda path, *args, **options: SimpleNamespace(
        st_gid=group, st_mode=mode) if path == port else stat(path, *args, **options))
    text = explain_error(PermissionError(errno.EACCES, 'Permission denied'), port)
    assert text.startswith('Permission denied (EACCES): ') and said.format(name=name) in text
