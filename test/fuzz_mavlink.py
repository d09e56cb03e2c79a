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
Random and mutated MAVLink into the bridge's parsing: no exception, no hang, no bad setpoint.

What arrives is by lot: noise, real traffic of the embedded autopilot, the same with bits flipped,
cut short, repeated or spliced, and messages of every type with any payload and a right checksum,
which reach the code behind the parser. Between them the bridge gets commands and odometry, some of
them nonsense too, and runs its cycles; whatever it sends is decoded and judged.
"""

from __future__ import annotations

from collections import Counter, deque
from contextlib import contextmanager
import math
import random
import signal
import struct
import traceback

from memory_line import MemoryLine
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
from pymavlink.generator.mavcrc import x25crc

from flock_desk.vehicles.embedded import EmbeddedAutopilot
from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.gate import Gate
from flock_follower.gate.permission import Phase, TAKEOVER_TIME
from flock_follower.gate.setpoint_rules import COMMAND
from flock_follower.gate.velocity_check import MotionReport
from flock_follower.mavlink.bridge import Bridge
from flock_follower.mavlink.link import Link, Signing
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder
from flock_follower.mavlink.parameter_check import Recommendation
from flock_follower.messages import OdometryState
from flock_follower.messages.commands import Command

AUTOPILOT = ('127.0.0.1', 14580)
PEERS = (AUTOPILOT, AUTOPILOT, AUTOPILOT, ('127.0.0.1', 9), 'serial')
CYCLE = 0.05  # s
LONGEST = 10  # s for one step of the fuzzing; more is a hang
NASTY = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e308, -1e308, 3.5e38, 5e-324, 1.0, -1.0)
COVARIANCES = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e9, 1e308, 0.01)
#: Message ids that the bridge acts on.
RECEIVED = (0, 1, 22, 31, 32, 33, 77, 111, 147, 245, 253)
# Masks with the acceleration of at least x and y.
MASKS = (0x83F, 0xC3F, 0x43F, 0xD3B, 0x93B)


class FuzzError(AssertionError):
    """Something went wrong; says what, and how to see it again."""


@contextmanager
def no_hang(what):
    """Raise where the block takes longer than LONGEST seconds."""
    def fail(number, where):
        raise FuzzError(f'{what}: still busy after {LONGEST} s')
    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(LONGEST)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


class FuzzedLine(MemoryLine):
    """A line on which bytes come from anybody; ``arrived`` holds them with their sender."""

    def read(self):
        while self.arrived:
            yield self.arrived.pop(0)


def frame(message_id, payload, *, crc_extra, sequence=0, system=1, component=1, flags=0):
    """Return a MAVLink 2 frame with any payload, and a right checksum."""
    payload = payload.rstrip(b'\0') or b'\0'
    head = struct.pack('<BBBBBB', len(payload), flags, 0, sequence, system, component)
    body = head + struct.pack('<I', message_id)[:3] + payload
    return b'\xfd' + body + struct.pack('<H', x25crc(body + bytes([crc_extra])).crc)


class Traffic:
    """An endless source of bytes that might arrive, and the time in which it flows."""

    def __init__(self, seed, personality, signing=None):
        self._random = random.Random(seed)
        self._types = [(number, kind.crc_extra, kind.unpacker.size)
                       for number, kind in sorted(mavlink.mavlink_map.items())]
        self._ending = {number for number, kind in mavlink.mavlink_map.items()
                        if number == 0 or 'time_boot_ms' in kind.fieldnames}
        self._received = [entry for entry in self._types if entry[0] in RECEIVED]
        self.autopilot = EmbeddedAutopilot(personality, now=0.0, signing=signing)
        self.now = 0.0
        self._queue = deque()
        self._recent = deque([b'\xfd'], maxlen=50)

    def to_autopilot(self, data):
        """Let the autopilot hear what was sent."""
        self._queue += self.autopilot.receive(data, self.now)

    def chunk(self):
        """Return some bytes, and who sent them."""
        r = self._random
        kind, = r.choices(
            ('valid', 'noise', 'flipped', 'cut', 'spliced', 'forged', 'heard', 'old'),
            (50, 10, 10, 5, 5, 10, 10, 5))
        if kind == 'valid':
            return self._valid(), AUTOPILOT
        data, other = r.choice(self._recent), r.choice(self._recent)
        if kind == 'noise':
            data = r.randbytes(r.choice((1, 7, 30, 280)))
        elif kind == 'flipped':
            data = self._flipped(data)
        elif kind == 'cut':
            data = data[:r.randrange(len(data))]
        elif kind == 'spliced':
            data = data[:r.randrange(len(data))] + other[r.randrange(len(other)):]
        elif kind == 'old':
            data = b'\xfe' + self._flipped(data)[1:]
        else:
            data = self._forged(self._received if kind == 'heard' else self._types)
        return data, r.choice(PEERS)

    def _valid(self):
        deadline = self.autopilot.next_step + 10.0
        while not self._queue:
            self.now = self.autopilot.next_step
            assert self.now < deadline, 'the autopilot sends no message'
            self._queue += self.autopilot.step(self.now)
        data = self._queue.popleft()
        self._recent.append(data)
        return data

    def _flipped(self, data):
        data = bytearray(data)
        for _ in range(self._random.randint(1, 4)):
            data[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
        return bytes(data)

    def _forged(self, types):
        r = self._random
        number, crc_extra, size = r.choice(types)
        if number in self._ending and r.random() < 0.99:
            return self._forged(types)  # a forged mode or reboot ends what is going on
        words = r.choice((
            lambda: r.randbytes(4), lambda: struct.pack('<f', _single(r.choice(NASTY))),
            lambda: struct.pack('<f', r.gauss(0.0, 1.0)), lambda: b'\xff' * 4))
        payload = b''.join(words() for _ in range(size // 4 + 1))[:r.choice((size, size, 255))]
        if r.random() < 0.1:
            payload = payload[:r.randrange(size + 1)]
        return frame(number, payload, crc_extra=crc_extra, sequence=r.randrange(256),
                     system=r.choice((1, 1, 1, 1, 2, 0, 255)),
                     component=r.choice((1, 1, 1, 191, 0)), flags=r.random() < 0.02)


class BridgeUnderFire:
    """A bridge on a fake line in simulated time, and the judgment of what it sends."""

    def __init__(self, seed, personality='px4', signing_key=b''):
        self._random = random.Random(f'bridge {seed}')
        ours, theirs = (Signing(signing_key, 2e9, link_id) if signing_key else None
                        for link_id in (0, 1))
        self.traffic = Traffic(seed, personality, theirs and theirs.state)
        self.transport = FuzzedLine()
        self.link = Link(self.transport, signing=ours)
        # Forged messages look like those of a second vehicle, which would refuse offboard.
        self.link.identity.conflict = lambda now: ''
        # The random velocities are to contradict those of the autopilot now and then only.
        self.gate = Gate(GateLimits(velocity_disagreement=0.7))
        wanted = [Recommendation(name, 1.0, '') for name in ('COM_OBL_RC_ACT', 'GUID_TIMEOUT')]
        self.bridge = Bridge(
            self.link, self.gate, now=0.0, forwarder=OdometryForwarder(),
            require_failsafe=False,  # the autopilot must not fuse nonsense that is forwarded
            recommendations={'px4': wanted[:1], 'ardupilot': wanted[1:]})
        self.codec = mavlink.MAVLink(None)
        self._next_cycle = 0.0
        self._landed_state = None
        self._was_active = False  # since offboard was last requested
        self._taken_over = -math.inf
        self._free = True
        self._restarts = None
        self.sent = Counter()
        self.kinds = Counter()

    @property
    def now(self):
        return self.traffic.now

    def receive(self, data, peer):
        """Let bytes arrive; run a cycle where one is due."""
        self.transport.arrived.append((data, peer))
        for message in self.bridge.receive(self.now):
            if message.get_type() == 'EXTENDED_SYS_STATE':
                self._landed_state = message.landed_state
        self._watch()
        if self.now >= self._next_cycle:
            self._next_cycle = self.now + CYCLE
            self._ask()
            before = self.bridge.gate.permission
            cycle = self.bridge.cycle(self.now)
            self._watch()
            self.kinds[cycle.setpoint.kind] += 1
            # What a HEARTBEAT shows may end a permission, and never gives one.
            if cycle.sent and not before.streams:
                raise FuzzError(f'setpoint without permission: {before}')
            if cycle.setpoint.kind == COMMAND and before.phase is not Phase.ACTIVE:
                raise FuzzError(f'command passed while {before}')
        self._judge()

    def _watch(self):
        """Note what forbids setpoints: a vehicle that is not flown by them, and a takeover."""
        permission = self.bridge.gate.permission
        phase = permission.phase
        self._was_active = phase is Phase.ACTIVE or (
            self._was_active and phase is Phase.GIVING_BACK)
        restarts = self.bridge.telemetry.reboots, self.link.peer_changes
        if restarts != self._restarts:  # it is another flight
            self._restarts, self._taken_over = restarts, -math.inf
        if phase is not Phase.TAKEN_OVER:
            self._free = True
        elif not permission.taker.pilot:  # a failsafe bars nothing, a pilot after it does
            self._free, self._taken_over = True, -math.inf
        elif self._free:
            self._free, self._taken_over = False, self.now

    def _ask(self):
        r, now = self._random, self.now
        vector = [r.gauss(0.0, 3.0) for _ in range(3)]
        if r.random() < 0.3:
            vector[r.randrange(3)] = r.choice(NASTY)
        yaw = r.choice((*NASTY, 0.0, 0.1, 3.0))
        if r.random() < 0.8:
            away = r.choice((None, None, (1.0, 0.0, 0.0), (math.nan, 0.0, 1e9)))
            command = Command(vector, yaw if r.random() < 0.3 else 0.0,
                              r.choice((0.0, 0.0, 1e9, math.nan)), away)
            self.bridge.gate.take_command(command, r.choice((0.0, 0.05, 5.0, *NASTY[:3])), now)
        vehicle = self.traffic.autopilot.vehicle
        if r.random() < 0.5:
            report = MotionReport(vehicle.velocity + 0.1 * np.array(vector), vehicle.yaw)
            self.gate.take_motion('odom', report, r.choice((0.0, 0.1, -1.0)), now)
        self.bridge.forward(OdometryState(
            0, 'odom', 'base_link', r.choice((1.0, 1.0, 1e6)) * _vector(r),
            np.array([0.0, 0.0, 0.0, 1.0]), _vector(r), _vector(r),
            *(np.full((6, 6), r.choice(COVARIANCES)) for _ in range(2)), np.eye(3)),
            now - r.choice((0.0, 0.02, 1.0, -1.0)), now)
        if vehicle.landed and r.random() < 0.2:  # up again
            r.choice((lambda: self.bridge.requests.arm(True, now),
                      lambda: self.bridge.requests.takeoff(3.0, now)))()
        if r.random() < 0.6:
            self.bridge.requests.offboard(r.random() < 0.99, now)
        if r.random() < 0.002:
            r.choice((lambda: self.bridge.requests.arm(r.random() < 0.5, now),
                      lambda: self.bridge.requests.land(now),
                      lambda: self.bridge.requests.takeoff(2.0, now)))()

    def _judge(self):
        written, self.transport.written = self.transport.written, []
        for data in written:
            messages = self.codec.parse_buffer(data)
            if not messages or len(messages) != 1:
                raise FuzzError(f'sent what is not one message: {data.hex()}')
            kind = messages[0].get_type()
            self.sent[kind] += 1
            self.traffic.to_autopilot(data)
            if kind == 'SET_POSITION_TARGET_LOCAL_NED':
                judge_setpoint(messages[0], self.gate.limits.a_max)
                judge_moment(messages[0], self._landed_state, self._was_active,
                             self.now - self._taken_over)
            elif kind == 'ODOMETRY':
                judge_odometry(messages[0])
            elif kind == 'PARAM_SET':
                raise FuzzError(f'wrote a parameter: {messages[0]}')


def judge_setpoint(message, a_max):
    """Raise where a SET_POSITION_TARGET_LOCAL_NED is not one that may leave the bridge."""
    fields = message.to_dict()
    acceleration = [message.afx, message.afy, message.afz]
    numbers = [value for value in fields.values() if isinstance(value, float)]
    if not all(math.isfinite(number) for number in numbers):
        raise FuzzError(f'setpoint that is not finite: {fields}')
    if not math.hypot(*acceleration) <= a_max:
        raise FuzzError(f'setpoint above a_max = {a_max}: {fields}')
    if message.type_mask not in MASKS or message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
        raise FuzzError(f'setpoint of unknown meaning: {fields}')


def judge_moment(message, landed_state, was_active, since_takeover):
    """Raise where a setpoint may not leave now, whatever is in it, or not upwards."""
    if landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND and not was_active and message.afz < 0.0:
        raise FuzzError(f'upward setpoint on the ground: {message}')
    if since_takeover < TAKEOVER_TIME:
        raise FuzzError(f'setpoint {since_takeover:.2f} s after a takeover: {message}')


def judge_odometry(message):
    """Raise where an ODOMETRY has numbers that are not finite."""
    numbers = np.hstack([np.ravel(value) for value in message.to_dict().values()
                         if isinstance(value, (float, list))])
    if not np.all(np.isfinite(numbers)):
        raise FuzzError(f'odometry that is not finite: {message}')


def fuzz_bridge(count, seed, personality='px4', signing_key=b''):
    """Send ``count`` bytes at least to a bridge; return it, or raise FuzzError."""
    under_fire = BridgeUnderFire(seed, personality, signing_key)
    _fire(under_fire.traffic, under_fire.receive, count, f'{personality}, seed {seed}')
    return under_fire


def fuzz_autopilot(count, seed, personality):
    """Send ``count`` bytes at least to the embedded autopilot; return it."""
    traffic = Traffic(seed, personality)
    _fire(traffic, lambda data, peer: traffic.to_autopilot(data), count,
          f'embedded {personality}, seed {seed}')
    return traffic.autopilot


def _fire(traffic, target, count, what):
    last = deque(maxlen=4)
    done = 0
    with no_hang(what):
        while done < count:
            data, peer = traffic.chunk()
            last.append((data.hex(), peer))
            try:
                target(data, peer)
            except Exception as error:
                raise FuzzError(f'{what}, after {done} bytes: {place(error)}; the last that '
                                f'arrived: {list(last)}') from error
            done += len(data)
            signal.alarm(LONGEST)


def place(error):
    """Return an exception in words, with where it comes from."""
    frames = traceback.extract_tb(error.__traceback__)
    at = next(frame for frame in reversed(frames) if frame.name != 'fail')
    return f'{type(error).__name__}: {error} (in {at.name}, {at.filename}:{at.lineno})'


def _vector(source):
    return np.array([source.gauss(0.0, 1.0) for _ in range(3)])


def _single(value):
    """Return a number that a float32 can hold."""
    return math.copysign(math.inf, value) if math.isfinite(value) and abs(value) > 3e38 else value
