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
An embedded autopilot: a small MAVLink 2 vehicle on loopback UDP that answers like PX4.

``python -m flock_follower.simulation.autopilot --connect 127.0.0.1:14540`` hovers and talks to a
bridge listening there. It is for tests and demonstrations, and refuses any address but loopback.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import ipaddress
import math
import select
import signal
import socket
import sys
import time
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from flock_follower.mavlink.transport import UdpTransport
from flock_follower.simulation.flight_controller import FlightController
from flock_follower.simulation.flight_log import FlightLog
from flock_follower.simulation.mavlink_vehicle import MavlinkVehicle, STEP
from flock_follower.simulation.vehicle import Vehicle


def main(args: Sequence[str] | None = None) -> int:
    """Run the embedded autopilot until it is told to stop; return the exit code."""
    parser = _parser()
    options = parser.parse_args(args)
    try:
        address = loopback_address(options.connect)
        server = Server(options, address)
    except (OSError, ValueError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: server.stop())
    server.run()
    return 0


def loopback_address(text: str) -> tuple[str, int]:
    """
    Return the address of 'HOST:PORT'.

    :raises ValueError: where it is malformed, or not loopback.
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
    A vehicle's end of a MAVLink connection to a bridge on this machine.

    :param address: where the bridge listens.
    :param log: takes every setpoint received.
    :raises OSError: where the socket cannot be made.
    """

    def __init__(self, address: tuple[str, int], vehicle: MavlinkVehicle, log: FlightLog) -> None:
        self.vehicle, self.log = vehicle, log
        self._transport = UdpTransport(
            f'udpin:{address[0]}:0', bind=(address[0], 0), peer=address)
        self._codec = mavlink.MAVLink(None, srcSystem=vehicle.system_id,
                                      srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._codec.robust_parsing = True

    def receive(self, wait: float) -> None:
        """Answer what arrives, the first of it within ``wait`` seconds."""
        if not select.select([self._transport], [], [], max(0.0, wait))[0]:
            return
        now = time.monotonic()
        for data, peer in self._transport.read():
            if peer != self._transport.peer:
                continue
            for message in self._codec.parse_buffer(data) or []:
                if message.get_type() == 'SET_POSITION_TARGET_LOCAL_NED':
                    self.log.setpoint(message, now)
                self._send(self.vehicle.handle(message, now))

    def step(self, now: float) -> None:
        """Fly on to ``now``, s on the monotonic clock, log the state, send what is due."""
        self._send(self.vehicle.step(now))
        self.log.state(self.vehicle.controller, now)

    def close(self) -> None:
        """Release the socket."""
        self._transport.close()

    def _send(self, messages: list[Any]) -> None:
        for message in messages:
            self._transport.write(message.pack(self._codec))
            self._codec.seq = (self._codec.seq + 1) % 256


class Server:
    """The embedded autopilot on a socket, in real time."""

    def __init__(self, options: argparse.Namespace, address: tuple[str, int]) -> None:
        self._log_path: str = options.log
        self._duration: float = options.duration
        self._stopping = False
        airborne = options.start == 'airborne'
        vehicle = Vehicle((0.0, 0.0, options.altitude if airborne else 0.0),
                          math.radians(options.yaw))
        self._start = time.monotonic()
        self._endpoint = Endpoint(address, MavlinkVehicle(
            FlightController(vehicle, self._start, armed=options.start != 'landed',
                             failsafe=options.failsafe, arming_denial=options.deny_arming),
            self._start, system_id=options.system_id,
            heartbeats_until=options.heartbeats_until), FlightLog())

    def stop(self) -> None:
        """Make ``run`` return."""
        self._stopping = True

    def run(self) -> None:
        """Fly until stopped, then write the log."""
        next_step = self._start
        while not self._stopping and time.monotonic() - self._start < self._duration:
            self._endpoint.receive(next_step - time.monotonic())
            if time.monotonic() >= next_step:
                # Always in whole steps; time lost to a busy machine is flown through.
                self._endpoint.step(next_step)
                next_step += STEP
        self._endpoint.close()
        if self._log_path:
            self._endpoint.log.save(self._log_path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='autopilot', description='An embedded PX4-like autopilot for tests and the demo.')
    parser.add_argument('--connect', default='127.0.0.1:14540', metavar='HOST:PORT',
                        help='where a bridge listens; loopback only (%(default)s)')
    parser.add_argument('--start', choices=('airborne', 'armed', 'landed'), default='airborne',
                        help='hovering in Hold, or on the ground armed or disarmed (%(default)s)')
    parser.add_argument('--altitude', type=_number(0.1, 1000.0), default=2.0, metavar='M',
                        help='of a hovering start, m (%(default)s)')
    parser.add_argument('--yaw', type=_number(-360.0, 360.0), default=0.0, metavar='DEG',
                        help='at the start, degrees anticlockwise from east (%(default)s)')
    parser.add_argument('--system-id', type=int, default=1, metavar='ID',
                        help='MAVLink system id (%(default)s)')
    parser.add_argument('--failsafe', choices=('descend', 'hold'), default='descend',
                        help='when the setpoint stream is lost (%(default)s)')
    parser.add_argument('--duration', type=_number(0.0, 1e9), default=math.inf, metavar='S',
                        help='stop after this long, s (never)')
    parser.add_argument('--log', default='', metavar='FILE.npz',
                        help='write the true state and every setpoint received')
    faults = parser.add_argument_group('faults, for tests')
    faults.add_argument('--deny-arming', default='', metavar='REASON',
                        help='refuse arming with this reason')
    faults.add_argument('--heartbeats-until', type=_number(0.0, 1e9), default=math.inf,
                        metavar='S', help='stop sending HEARTBEAT after this long, s')
    return parser


def _number(low: float, high: float) -> Any:
    def number(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f'{text}: must be in [{low:g}, {high:g}]')
        return value
    return number


if __name__ == '__main__':
    sys.exit(main())
