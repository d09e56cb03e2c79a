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
An embedded autopilot: a small MAVLink 2 vehicle on loopback UDP, like PX4 or like ArduCopter.

``python -m flock_desk.autopilot --connect 127.0.0.1:14540`` hovers and connects to a bridge that
listens there. The program is for tests and demonstrations; it refuses any address but loopback.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
import ipaddress
import math
import select
import signal
import socket
import sys
import time
from typing import Any

from flock_desk.runs.console import guarded, within
from flock_desk.vehicles.embedded import EmbeddedAutopilot, STARTS
from flock_desk.vehicles.profiles import PROFILES
from flock_follower.mavlink.dialects import Version
from flock_follower.mavlink.parameter_check import read_recommendations
from flock_follower.mavlink.transport import UdpTransport
from flock_follower.ranges import Range
from flock_follower.signals import ending
from flock_follower.system.files import read_text


def parser() -> argparse.ArgumentParser:
    """Return the parser of the options."""
    new = argparse.ArgumentParser(
        prog='autopilot', description='An embedded autopilot for tests and the demo.')
    new.add_argument('--connect', default='127.0.0.1:14540', metavar='HOST:PORT',
                     help='where a bridge listens; loopback only (%(default)s)')
    new.add_argument('--personality', choices=tuple(PROFILES), default='px4',
                     help='whose modes, masks and answers (%(default)s)')
    new.add_argument('--firmware', default='', metavar='VERSION', help='its version: ' + '; '.join(
        f'{name} {", ".join(profile.firmwares)}' for name, profile in PROFILES.items())
        + ' (the first)')
    new.add_argument('--start', choices=STARTS, default='airborne',
                     help='hovering, or on the ground armed or disarmed (%(default)s)')
    new.add_argument('--altitude', type=within(Range(0.1, 1000.0, 'm')), default=2.0, metavar='M',
                     help='of a hovering start, m (%(default)s)')
    new.add_argument('--yaw', type=within(Range(-360.0, 360.0, 'degrees')), default=0.0,
                     metavar='DEG', help='at the start, anticlockwise from east (%(default)s)')
    new.add_argument('--param-file', default='', metavar='FILE',
                     help='set the parameters in a file such as config/px4.params, except '
                     'those for forwarded odometry')
    new.add_argument('--param', action='append', default=[], metavar='NAME=VALUE',
                     help='set a parameter of the autopilot; may be repeated')
    new.add_argument('--log', default='', metavar='FILE.npz',
                     help='write the true state and every setpoint received')
    return new


def main(args: Sequence[str] | None = None) -> int:
    """Run the embedded autopilot until a signal ends it; return the exit code."""
    return guarded(partial(_fly, parser().parse_args(args)))


def _fly(options: argparse.Namespace) -> int:
    address = loopback_address(options.connect)
    autopilot = EmbeddedAutopilot(now=time.monotonic(), **settings(options))
    serve(options.log, autopilot, [Endpoint(address, autopilot)])
    return 0


def serve(log: str, autopilot: EmbeddedAutopilot, ends: Sequence[Endpoint]) -> None:
    """
    Fly in real time until a signal ends it; write the log to a file, if one is named.

    :param ends: the links; the first is that of ``autopilot``.
    """
    stop: list[int] = []
    for number in ending():
        signal.signal(number, lambda number, _: stop.append(number))
    while not stop:
        ends[0].receive(autopilot.next_step - time.monotonic())
        due = autopilot.next_step
        if time.monotonic() >= due:
            # Always in whole steps; time lost to a busy machine is flown through.
            for end in ends:
                end.receive(0.0)
                end.step(due)
    for end in ends:
        end.close()
    if log:
        autopilot.log.save(log)


def settings(options: argparse.Namespace) -> dict[str, Any]:
    """
    Return the parameters of ``EmbeddedAutopilot`` that the command line gives.

    :raises ValueError: for a parameter without a number, or an unknown version.
    :raises OSError: for an unreadable file.
    """
    parameters = {}
    version = PROFILES[options.personality].version(options.firmware)
    if options.param_file:
        text = read_text(options.param_file)
        parameters.update({entry.name: entry.value for entry in read_recommendations(
            text, forwarding=False) if entry.applies(Version(*map(int, version.split('.'))))})
    for text in options.param:
        name, _, value = text.partition('=')
        try:
            parameters[name] = float(value)
        except ValueError:
            raise ValueError(f'param = {text!r}: must be NAME=NUMBER') from None
    return {'personality': options.personality, 'start': options.start,
            'altitude': options.altitude, 'yaw': math.radians(options.yaw),
            'parameters': parameters, 'version': version}


def loopback_address(text: str) -> tuple[str, int]:
    """
    Return the address of 'HOST:PORT'.

    :raises ValueError: if it is malformed, or not loopback.
    """
    host, _, port = text.rpartition(':')
    if not host or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise ValueError(f'connect = {text!r}: must be HOST:PORT with a port in [1, 65535]')
    try:
        ip = socket.gethostbyname(host)
    except OSError:
        raise ValueError(f'connect = {text!r}: unknown host {host}') from None
    if not ipaddress.ip_address(ip).is_loopback:
        raise ValueError(f'connect = {text!r}: must be a loopback address such as 127.0.0.1')
    return ip, int(port)


class Endpoint:
    """
    An embedded autopilot's end of a MAVLink connection to a bridge on this machine.

    :param address: where the bridge listens.
    :param autopilot: the autopilot, or another link of it with the same ``receive`` and ``step``.
    :raises OSError: if the socket cannot be made.
    """

    def __init__(self, address: tuple[str, int], autopilot: Any) -> None:
        self.autopilot = autopilot
        self._transport = UdpTransport(
            f'udpin:{address[0]}:0', bind=(address[0], 0), peer=address)

    def receive(self, wait: float) -> None:
        """Answer the messages that arrive, the first of them within ``wait`` seconds."""
        if not select.select([self._transport], [], [], max(0.0, wait))[0]:
            return
        for data, peer in self._transport.read():
            if peer == self._transport.peer:
                self._send(self.autopilot.receive(data, time.monotonic()))

    def step(self, now: float) -> None:
        """Simulate until ``now``, s on the monotonic clock, and send the messages that are due."""
        self._send(self.autopilot.step(now))

    def close(self) -> None:
        """Release the socket."""
        self._transport.close()

    def _send(self, datagrams: list[bytes]) -> None:
        for data in datagrams:
            self._transport.write(data)


if __name__ == '__main__':
    sys.exit(main())
