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
Connection URLs, and the texts of device errors with remedies.

``udpin:HOST:PORT`` listens, ``udpout:HOST:PORT`` sends first, ``tcp:HOST:PORT`` connects,
``/dev/DEVICE[,BAUD]`` is a serial port. Other programs' forms are accepted, too: pymavlink's
``udp:`` (``udpin:``), ``udpin://HOST:PORT``, ``/dev/DEVICE:BAUD``, ``serial:///dev/...``.
"""

from __future__ import annotations

from collections.abc import Mapping
import errno
import grp
import os
import re
import stat
import termios
from typing import Final, NamedTuple

from flock_follower.ranges import Range

DEFAULT_BAUD: Final[int] = 115200
#: The termios constant of each baud rate.
BAUD_RATES: Final[Mapping[int, int]] = {
    int(name[1:]): getattr(termios, name) for name in dir(termios) if re.fullmatch(r'B\d+', name)}
_FORMS: Final[str] = 'udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/DEVICE[,BAUD]'
_NETWORK: Final = re.compile(r'(udpin|udpout|udp|tcp):(?://)?([^:\s/@]+):(\d{1,5})')
# Names of /dev/serial/by-path hold colons, too.
_SERIAL: Final = re.compile(r'(?:serial:(?://)?)?(/dev/[^,\s]+?)(?:,(\d+)|:(\d{4,7}))?')
_MAVROS: Final = re.compile(r'udp://([^:@\s]*):(\d+)@(?:([^:@\s]*):?(\d*))?')
#: Forms without a host, by what they mean.
_HOSTLESS: Final = re.compile(r'(udpin|udp|udpout|tcp):(?://)?:?(\d{1,5})')
#: What to do about an error, by its number.
_REMEDIES: Final[Mapping[int, str]] = {
    errno.EADDRINUSE: 'another program listens there, such as a second bridge or a ground '
                      'station: end it, or name another port',
    errno.EADDRNOTAVAIL: 'no network interface of this computer has that address now; to send '
                         'to another computer use udpout:',
    errno.ENETUNREACH: 'no network interface leads there: is it up, is the address right?',
    errno.EHOSTUNREACH: 'nothing answers at that address: is it on, is the address right?',
    errno.EPERM: 'a firewall of this computer forbids it',
    errno.ECONNREFUSED: 'no program listens there',
    errno.ETIMEDOUT: 'no answer: is it on, is the address right?',
    errno.ENOENT: 'is it plugged in? `ls /dev/serial/by-id` lists what is there',
    errno.ENODEV: 'is it plugged in?',
    errno.ENOTTY: 'it is no serial port',
}


class Connection(NamedTuple):
    """A parsed URL; ``host`` is '' for a serial port, ``device`` '' for a network."""

    kind: str
    host: str = ''
    port: int = 0
    device: str = ''
    baud: int = DEFAULT_BAUD


def parse_connection(url: str) -> Connection:
    """
    Return the parts of a connection URL.

    :raises ValueError: naming the URL and the valid forms, or the most similar valid URL.
    """
    if network := _NETWORK.fullmatch(url):
        kind, port = 'udpin' if network[1] == 'udp' else network[1], int(network[3])
        lowest = 0 if kind == 'udpin' else 1
        Range(lowest, 65535, whole=True).check(f'connection = {url!r}: port', port)
        return Connection(kind, network[2], port)
    if serial := _SERIAL.fullmatch(url):
        baud = int(serial[2] or serial[3] or DEFAULT_BAUD)
        if baud not in BAUD_RATES or baud == 0:
            rates = ', '.join(str(b) for b in sorted(BAUD_RATES) if b >= 9600)
            raise ValueError(f'connection = {url!r}: baud rate must be one of {rates}')
        return Connection('serial', device=serial[1], baud=baud)
    meant = ''
    if mavros := _MAVROS.fullmatch(url):
        meant = (f'udpout:{mavros[3]}:{mavros[4]}' if mavros[3] and mavros[4]
                 else f'udpin:{mavros[1] or "127.0.0.1"}:{mavros[2]}')
    elif hostless := _HOSTLESS.fullmatch(url):
        kind = 'udpin' if hostless[1] == 'udp' else hostless[1]
        meant = f'{kind}:127.0.0.1:{hostless[2]}'
    hint = f'; did you mean {meant}?' if meant else ''
    raise ValueError(f'connection = {url!r}: must be {_FORMS}{hint}')


def explain_error(error: BaseException, device: str = '', sending: bool = False) -> str:
    """
    Return the text of an OSError or termios.error, with its name and the remedy.

    :param device: the serial port of the error, '' for a network.
    :param sending: whether a datagram was sent; else an address was opened.
    """
    number = getattr(error, 'errno', None) or error.args[0]
    text = str(getattr(error, 'strerror', None) or error.args[-1])
    if not isinstance(number, int) or number not in errno.errorcode:
        return text
    remedy = _REMEDIES.get(number, '')
    if number == errno.EACCES:
        remedy = _grant(device) if device else (
            'a broadcast address: name the address of the one autopilot' if sending else
            'ports below 1024 belong to the system: name a larger one')
    return f'{text} ({errno.errorcode[number]})' + (f': {remedy}' if remedy else '')


def _grant(device: str) -> str:
    """Return how to get access to a serial port: its group, if that has access."""
    try:
        status = os.stat(device)
        group = grp.getgrgid(status.st_gid).gr_name
    except (KeyError, OSError):
        return 'its owner has to grant access'
    if stat.S_IMODE(status.st_mode) & 0o060 != 0o060 or status.st_gid == 0:
        return (f'mode {stat.S_IMODE(status.st_mode):03o} of group {group} gives no access: '
                'install deploy/61-flight-controller.rules')
    return (f'it belongs to the group {group}: sudo usermod -aG {group} $USER, then log in again')
