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

"""Which computers can reach the ROS of a process: read from the process's sockets in /proc."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
import ipaddress
import os
from pathlib import Path
import struct
from typing import Final

#: The ports of a domain by DDSI-RTPS 9.6.2: PORTS_FROM + PORTS_PER_DOMAIN * domain and upwards.
#: The first one receives the announcements of the network; the others what is sent to this
#: computer by its address.
PORTS_FROM: Final = 7400
PORTS_PER_DOMAIN: Final = 250


class Reach(Enum):
    """The computers that can reach a node; each value includes the values before it."""

    COMPUTER = 'this computer'
    ADDRESS = 'computers that name the address of this one as a peer'
    NETWORK = 'every computer on the network'


def find_reach(process: int, domain: int, proc: Path = Path('/proc')) -> Reach | None:
    """
    Return which computers can reach the ROS of a process; None if no socket of ROS is found.

    Only this computer can reach a socket that is bound to the loopback interface. A socket that is
    bound to a multicast address counts in the same way, because another computer gets no answer
    from it. The function detects neither firewalls nor middleware with other ports than DDS
    (Zenoh).

    :param process: its id. :param domain: its ROS_DOMAIN_ID.
    """
    first = PORTS_FROM + PORTS_PER_DOMAIN * domain
    try:
        bound = [(address, port) for address, port in _bound_sockets(proc / str(process))
                 if first <= port < first + PORTS_PER_DOMAIN]
    except OSError:  # ended meanwhile, or of another user
        return None
    outside = {port for address, port in bound
               if not address.is_loopback and not address.is_multicast}
    if not bound:
        return None
    if first in outside:
        return Reach.NETWORK
    return Reach.ADDRESS if outside else Reach.COMPUTER


def _bound_sockets(process: Path
                   ) -> Iterator[tuple[ipaddress.IPv4Address | ipaddress.IPv6Address, int]]:
    """Yield address and port of each UDP socket of a process, from its folder in /proc."""
    links = set()
    for descriptor in (process / 'fd').iterdir():
        try:
            links.add(os.readlink(descriptor))
        except OSError:  # closed meanwhile
            continue
    for table in ('udp', 'udp6'):
        path = process / 'net' / table  # of the network namespace of that process
        if not path.exists():  # udp6: a kernel without IPv6
            continue
        for line in path.read_text(encoding='ascii').splitlines()[1:]:
            fields = line.split()
            if f'socket:[{fields[9]}]' in links:
                address, port = fields[1].split(':')
                yield _parse_address(address), int(port, 16)


def _parse_address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Return an address of /proc/net: words of 32 bits, each in the byte order of the host."""
    address = ipaddress.ip_address(b''.join(
        struct.pack('=I', int(text[i:i + 8], 16)) for i in range(0, len(text), 8)))
    return getattr(address, 'ipv4_mapped', None) or address
