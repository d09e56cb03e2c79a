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
The setpoint gate: what may be sent to the autopilot now.

A command passes only while it is fresh and finite, the odometry it rests on is fresh, and the
autopilot is heard; it is then limited to ``a_max`` and ``v_max``. Otherwise the gate brakes, and
never repeats what has gone stale. It has to: an autopilot goes on accelerating for seconds when
its setpoints stop, and none applies a speed limit to acceleration setpoints.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, wrap_angle
from flock_follower.guard import brake, limit_command

#: A stamp may lie this far in the future, s: clocks and ``/clock`` come in steps.
FUTURE_TOLERANCE: Final[float] = 0.1
#: A command may rest on an image of at most this age, s; planners coast before.
OLDEST_SOURCE: Final[float] = 2.5
#: Yaw rates are clipped to this, rad/s; autopilots turn more slowly anyway.
YAW_RATE_MAX: Final[float] = math.pi
ODOM: Final[str] = 'odom'
AUTOPILOT: Final[str] = 'autopilot'
VELOCITY_SOURCES: Final[tuple[str, ...]] = (ODOM, AUTOPILOT, 'auto')


@dataclass(frozen=True)
class GateLimits:
    """Limits and timeouts of the gate; validated, ValueError names parameter, value and range."""

    a_max: float = 2.5
    """Largest acceleration, m/s^2."""
    v_max: float = 0.5
    """Largest speed, m/s."""
    planner_timeout: float = 0.2
    """Oldest command used, s."""
    odom_timeout: float = 0.3
    """Oldest velocity used, s."""
    blind_timeout: float = 2.0
    """After this long without a velocity that was known before, the stream stops, s."""
    speed_horizon: float = 0.3
    """The speed is predicted this far ahead, s: twice a quadrotor's attitude lag, so that a
    vehicle which answers late does not overshoot ``v_max``."""
    brake_time: float = 0.3
    """Time constant of braking, s."""
    yaw_disagreement: float = 0.35
    """Largest difference between the yaws of odom and of the autopilot, rad."""
    velocity_disagreement: float = 0.7
    """Largest difference between their velocities, m/s."""

    def __post_init__(self) -> None:
        for name, highest, unit in (
                ('a_max', 20.0, 'm/s^2'), ('v_max', 20.0, 'm/s'), ('planner_timeout', 1.0, 's'),
                ('odom_timeout', 1.0, 's'), ('blind_timeout', 10.0, 's'),
                ('speed_horizon', 2.0, 's'), ('brake_time', 2.0, 's'),
                ('yaw_disagreement', 3.2, 'rad'), ('velocity_disagreement', 100.0, 'm/s')):
            value = getattr(self, name)
            if not 0.0 < value <= highest:
                raise ValueError(f'{name} = {value}: must be in (0, {highest:g}] {unit}')


@dataclass(frozen=True)
class Command:
    """A command that was accepted; times are on the monotonic clock."""

    acceleration: Array
    yaw: float
    yaw_rate: float
    time: float
    """When it applies, s."""
    source_time: float
    """When the image it rests on was taken, s."""
    number: int


class SetpointDecision(NamedTuple):
    """What to send now."""

    kind: str
    """'command', 'brake', 'level' (zero acceleration) or 'none' (send nothing)."""
    reason: str
    """Why it is no command; '' if it is."""
    acceleration: Array
    """(3,), m/s^2, ENU."""
    yaw: float | None
    """rad, ENU; None where none is known."""
    yaw_rate: float
    """rad/s, anticlockwise."""
    limited: str
    """What limited the acceleration: '', 'a_max', 'v_max' or both."""
    command: Command | None
    """The command used, if any."""


class _Velocity(NamedTuple):
    time: float
    velocity: Array


class SetpointGate:
    """
    Decides what is sent; see the module.

    Vectors are ENU. ``now`` is a monotonic clock, s; ``age`` is the age of a message's stamp when
    it was received, s, so that the gate needs no second clock.

    :param velocity_source: whose velocity a command is judged with and has to be fresh: 'odom',
        'autopilot', or 'auto', which is odom as soon as odom has been heard once.
    """

    def __init__(self, limits: GateLimits | None = None, velocity_source: str = 'auto') -> None:
        if velocity_source not in VELOCITY_SOURCES:
            raise ValueError(f'velocity_source = {velocity_source!r}: must be one of '
                             f'{", ".join(VELOCITY_SOURCES)}')
        self.limits = limits or GateLimits()
        self.velocity_source = velocity_source
        self._command: Command | None = None
        self._accepted = 0
        self._velocities: dict[str, _Velocity] = {}
        self._yaws: dict[str, tuple[float, float]] = {}
        self._held_yaw: float | None = None
        self._last_yaw: float | None = None

    def accept_command(self, acceleration: ArrayLike, yaw: float, age: float, now: float, *,
                       source_age: float | None = None, yaw_rate: float = 0.0) -> str:
        """
        Take a command for the time ``now - age``; return '' or why it is refused.

        ``source_age`` is the age of the image the command rests on, for latency statistics.
        """
        a = np.array(acceleration, dtype=float)
        values = [*a.ravel().tolist(), yaw, age, yaw_rate]
        if a.shape != (3,) or not all(math.isfinite(value) for value in values):
            return 'not finite'
        if age > self.limits.planner_timeout:
            return 'too old'
        if age < -FUTURE_TOLERANCE:
            return 'from the future'
        source = age if source_age is None else source_age
        if not source <= OLDEST_SOURCE:
            return 'resting on an old image'
        self._accepted += 1
        rate = min(max(yaw_rate, -YAW_RATE_MAX), YAW_RATE_MAX)
        self._command = Command(a, wrap_angle(yaw), rate, now - max(age, 0.0), now - source,
                                self._accepted)
        return ''

    def update_velocity(self, source: str, velocity: ArrayLike, age: float, now: float) -> str:
        """Take a velocity (3,), m/s, of 'odom' or 'autopilot'; return '' or why it is refused."""
        v = np.array(velocity, dtype=float)
        if v.shape != (3,) or not np.all(np.isfinite(v)) or not math.isfinite(age):
            return 'not finite'
        if age > self.limits.odom_timeout:
            return 'too old'
        if age < -FUTURE_TOLERANCE:
            return 'from the future'
        self._velocities[source] = _Velocity(now - max(age, 0.0), v)
        return ''

    def update_yaw(self, source: str, yaw: float, now: float) -> None:
        """Take the vehicle's yaw, rad, ENU, as 'odom' or 'autopilot' knows it."""
        if math.isfinite(yaw):
            self._yaws[source] = (now, wrap_angle(yaw))

    def yaw_difference(self, now: float) -> float | None:
        """Return the yaw of odom minus that of the autopilot, rad; None where one is not fresh."""
        odom, autopilot = self._yaw_of(ODOM, now), self._yaw_of(AUTOPILOT, now)
        return None if odom is None or autopilot is None else wrap_angle(odom - autopilot)

    def speed(self, now: float) -> float | None:
        """Return the freshest known speed, m/s, or None."""
        velocity = self._any_velocity(now)
        return None if velocity is None else float(np.linalg.norm(velocity))

    def decide(self, now: float, *, link_alive: bool, engaged: bool = True) -> SetpointDecision:
        """
        Return what to send at ``now``.

        ``engaged`` says whether the autopilot obeys (OFFBOARD): the yaw to hold is frozen then,
        and follows the vehicle before.
        """
        limits = self.limits
        command, reason = self._command, self._obstacle(now, link_alive)
        if command is not None and not reason:
            velocity = self._velocities[self._required_source()].velocity
            safe = limit_command(command.acceleration, velocity, limits.a_max, limits.v_max,
                                 limits.speed_horizon)
            self._held_yaw, self._last_yaw = None, command.yaw
            return SetpointDecision('command', '', safe.acceleration, command.yaw,
                                    command.yaw_rate, safe.reason, command)
        known = self._any_velocity(now)
        if known is None:
            kind = 'none' if self._blind(now) else 'level'
            return SetpointDecision(kind, reason, np.zeros(3), self._hold_yaw(now, engaged), 0.0,
                                    '', None)
        wanted = brake(known, limits.a_max, limits.brake_time)
        safe = limit_command(wanted, known, limits.a_max, limits.v_max, limits.speed_horizon)
        return SetpointDecision('brake', reason, safe.acceleration, self._hold_yaw(now, engaged),
                                0.0, safe.reason, None)

    def forget_command(self) -> None:
        """Drop the command, so that the gate brakes until the next one."""
        self._command = None

    def _required_source(self) -> str:
        if self.velocity_source != 'auto':
            return self.velocity_source
        # Odometry that was there and is lost must brake; the autopilot's estimate often rests on
        # the same odometry and drifts metres without it.
        return ODOM if ODOM in self._velocities else AUTOPILOT

    def _obstacle(self, now: float, link_alive: bool) -> str:
        if not link_alive:
            return 'link lost'
        source = self._required_source()
        if source not in self._velocities:
            return f'no velocity from {source}'
        if self._fresh_velocity(source, now) is None:
            return f'velocity from {source} stale'
        if contradiction := self._contradiction(now):
            return contradiction
        if self._command is None:
            return 'no command'
        if now - self._command.time > self.limits.planner_timeout:
            return 'command stale'
        return ''

    def _fresh_velocity(self, source: str, now: float) -> Array | None:
        known = self._velocities.get(source)
        if known is None or now - known.time > self.limits.odom_timeout:
            return None
        return known.velocity

    def _contradiction(self, now: float) -> str:
        """
        Return what odom and the autopilot disagree about, or ''.

        Frames turned against one another make braking accelerate, however fresh the input.
        """
        turned = self.yaw_difference(now)
        if turned is not None and abs(turned) > self.limits.yaw_disagreement:
            return 'yaws of odom and of the autopilot disagree'
        odom, own = self._fresh_velocity(ODOM, now), self._fresh_velocity(AUTOPILOT, now)
        if self._required_source() == ODOM and odom is not None and own is not None and (
                np.linalg.norm(odom - own) > self.limits.velocity_disagreement):
            return 'velocities of odom and of the autopilot disagree'
        return ''

    def _any_velocity(self, now: float) -> Array | None:
        first = self._required_source()
        if self._contradiction(now):
            first = AUTOPILOT  # its own frame is the one in which it obeys
        second = AUTOPILOT if first == ODOM else ODOM
        velocity = self._fresh_velocity(first, now)
        return self._fresh_velocity(second, now) if velocity is None else velocity

    def _blind(self, now: float) -> bool:
        if not self._velocities:
            return False  # never seen: the vehicle is still on the ground
        newest = max(known.time for known in self._velocities.values())
        return now - newest > self.limits.odom_timeout + self.limits.blind_timeout

    def _yaw_of(self, source: str, now: float) -> float | None:
        time, yaw = self._yaws.get(source, (-math.inf, 0.0))
        return yaw if now - time <= self.limits.odom_timeout else None

    def _hold_yaw(self, now: float, engaged: bool) -> float | None:
        if self._held_yaw is None or not engaged:
            # The autopilot's own yaw first: it is the one that will obey.
            for yaw in (self._yaw_of(AUTOPILOT, now), self._yaw_of(ODOM, now), self._last_yaw):
                if yaw is not None:
                    self._held_yaw = self._last_yaw = yaw
                    break
        return self._held_yaw
