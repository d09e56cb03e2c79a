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
What the gate has to remember between two decisions: the newest of each input, and when it came.

Everything is decided in ``setpoint_rules.decide``; here messages become its arguments.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, wrap_angle
from flock_follower.mavlink import setpoint_rules
from flock_follower.mavlink.gate_limits import GateLimits
from flock_follower.mavlink.known_motion import (
    AUTOPILOT,
    finite_vector,
    FUTURE_TOLERANCE,
    KnownMotion,
    Motion,
    ODOM,
    VELOCITIES_DISAGREE,
)
from flock_follower.mavlink.setpoint_rules import Setpoint
from flock_follower.mavlink.velocity_comparison import VelocityComparison
from flock_follower.mavlink.wind_observer import WindObserver
from flock_follower.messages import Command
from flock_follower.planner.limits import limit_norm, SENT_INSIDE

#: A command may rest on an image of at most this age, s; planners coast before.
OLDEST_SOURCE: Final[float] = 2.5
VELOCITY_SOURCES: Final[tuple[str, ...]] = (ODOM, AUTOPILOT, 'auto')
#: Braking has brought the vehicle to rest once it was slower than this, m/s, for REST_TIME, s.
REST_SPEED: Final[float] = 0.1
REST_TIME: Final[float] = 0.5


@dataclass(frozen=True)
class AcceptedCommand:
    """A command that was accepted; times are on the monotonic clock."""

    command: Command
    time: float
    """When it applies, s."""
    source_time: float
    """When the image it rests on was taken, s."""
    number: int


@dataclass
class _Source:
    """The newest of what one source said, and when it was so, s."""

    velocity: Array
    velocity_time: float = -math.inf
    yaw: float = 0.0
    yaw_time: float = -math.inf

    def motion(self, now: float) -> Motion:
        return Motion(self.velocity, now - self.velocity_time, self.yaw, now - self.yaw_time)


class SetpointGate:
    """
    Feeds ``setpoint_rules.decide``.

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
        self._command: AcceptedCommand | None = None
        self._accepted = 0
        self._sources = {ODOM: _Source(np.zeros(3)), AUTOPILOT: _Source(np.zeros(3))}
        self._has_flown = False
        self._resting_since: float | None = None
        self._rested_since = math.inf
        self._comparison = VelocityComparison()
        self._distrusted_since = math.inf
        self._wind = WindObserver()
        self._flown: Array | None = None
        self._held_yaw: float | None = None
        self._last_yaw: float | None = None

    def accept_command(self, command: Command, age: float, now: float,
                       source_age: float | None = None) -> str:
        """
        Take a command for the time ``now - age``; return '' or why it is refused.

        ``source_age`` is the age of the image the command rests on, for latency statistics.
        """
        a = finite_vector(command.acceleration)
        if a is None or not (math.isfinite(command.yaw) and math.isfinite(age)):
            return 'not finite'
        if age > self.limits.planner_timeout:
            return 'too old'
        if age < -FUTURE_TOLERANCE:
            return 'from the future'
        source = age if source_age is None else source_age
        if not source <= OLDEST_SOURCE:
            return 'resting on an old image'
        self._accepted += 1
        self._command = AcceptedCommand(
            command._replace(acceleration=a), now - max(age, 0.0), now - source, self._accepted)
        return ''

    def update_velocity(self, source: str, velocity: ArrayLike, age: float, now: float) -> str:
        """Take a velocity (3,), m/s, of 'odom' or 'autopilot'; return '' or why it is refused."""
        v = finite_vector(velocity)
        if v is None or not math.isfinite(age):
            return 'not finite'
        if age > self.limits.odom_timeout:
            return 'too old'
        if age < -FUTURE_TOLERANCE:
            return 'from the future'
        known = self._sources[source]
        known.velocity, known.velocity_time = v, now - max(age, 0.0)
        return ''

    def distrust(self, why: str, now: float) -> None:
        """Note, each cycle, why the velocity that the autopilot tells is not believed, or ''."""
        self._distrusted_since = min(self._distrusted_since, now) if why else math.inf

    def update_yaw(self, source: str, yaw: float, now: float) -> None:
        """Take the vehicle's yaw, rad, ENU, as 'odom' or 'autopilot' knew it at ``now``."""
        if math.isfinite(yaw):
            known = self._sources[source]
            known.yaw, known.yaw_time = wrap_angle(yaw), now

    def yaw_difference(self, now: float) -> float | None:
        """Return the yaw of odom minus that of the autopilot, rad; None where one is not fresh."""
        return self._known(now).yaw_difference(self.limits)

    def contradiction(self, now: float) -> str:
        """Return what odom and the autopilot disagree about, in words for people, or ''."""
        what = self._known(now).contradiction(self.limits)
        if what != VELOCITIES_DISAGREE:
            return what
        return (f'{what} by {self.velocity_difference:.2f} m/s, more than '
                f'{self.limits.velocity_tolerance:.2f} m/s (velocity_disagreement)')

    def misaligned(self, now: float) -> str:
        """Return that the frames do not fit together, and what that would do, or ''."""
        known = self._known(now)
        difference = known.yaw_difference(self.limits)
        if difference is None or not known.yaws_disagree(self.limits):
            return ''
        return (f'yaw of odom and of the autopilot differ by {math.degrees(difference):.0f} deg: '
                'their frames are not aligned, commands would go the wrong way')

    @property
    def velocity_difference(self) -> float:
        """Return the average difference between the velocities of odom and autopilot, m/s."""
        return self._comparison.difference

    @property
    def wind(self) -> float:
        """Return what acceleration by the wind is being set against, m/s^2."""
        return float(np.linalg.norm(self._wind.acceleration))

    def speed(self, now: float) -> float | None:
        """Return the freshest known speed, m/s, or None."""
        velocity = self._known(now).braking_velocity(self.limits)
        return None if velocity is None else float(np.linalg.norm(velocity.vector))

    def decide(self, now: float, *, link_age: float = 0.0, offboard: bool = True,
               armed: bool = True, withheld: str = '', grounded: bool = False
               ) -> tuple[Setpoint, AcceptedCommand | None]:
        """
        Return what to send at ``now``, and the command it comes from, if any.

        See ``setpoint_rules.decide``. Once the vehicle flies our setpoints (``offboard`` and
        ``armed``) the yaw to hold is frozen where braking begins; before, it follows the vehicle.
        What then disturbs it is set against, except where it is ``grounded``.
        """
        engaged = offboard and armed and not withheld
        self._comparison.take(self._known(now).velocity_difference(self.limits),
                              self.limits.velocity_tolerance, engaged, now)
        known = self._known(now)  # with what the comparison has just found
        self._hold_yaw(known, engaged)
        command = self._command
        newest, age = (None, math.inf) if command is None else (
            command.command, now - command.time)
        setpoint = setpoint_rules.decide(
            self.limits, known=known, command=newest, command_age=age, link_age=link_age,
            offboard=offboard, armed=armed, withheld=withheld,
            rested_for=now - self._rested_since, held_yaw=self._held_yaw)
        self._remember(setpoint, now, engaged)
        setpoint = self._against_wind(setpoint, known, engaged and not grounded, now)
        passed = setpoint.kind == setpoint_rules.COMMAND
        return setpoint, command if passed else None

    def blind(self, now: float) -> bool:
        """Return whether there has been no velocity to believe for too long."""
        return self._known(now).blind(self.limits)

    def forget_command(self) -> None:
        """Drop the command, so that the gate brakes until the next one."""
        self._command = None

    def _source(self) -> str:
        if self.velocity_source != 'auto':
            return self.velocity_source
        # Once odometry was heard, losing it must brake: the autopilot's own estimate often rests
        # on that odometry, and drifts metres without it.
        return ODOM if math.isfinite(self._sources[ODOM].velocity_time) else AUTOPILOT

    def _known(self, now: float) -> KnownMotion:
        return KnownMotion(
            odom=self._sources[ODOM].motion(now), autopilot=self._sources[AUTOPILOT].motion(now),
            source=self._source(), disagreeing_for=self._comparison.disagreeing_for(now),
            distrusted_for=now - self._distrusted_since)

    def _remember(self, setpoint: Setpoint, now: float, engaged: bool) -> None:
        if setpoint.kind == setpoint_rules.COMMAND:
            self._held_yaw, self._last_yaw = None, setpoint.yaw
        if setpoint.kind == setpoint_rules.COMMAND or not engaged:
            self._has_flown = engaged
            self._resting_since, self._rested_since = None, math.inf
        elif self._has_flown and setpoint.kind == setpoint_rules.BRAKE:
            speed = self.speed(now)
            if speed is None or speed >= REST_SPEED:
                self._resting_since = None
            elif self._resting_since is None:
                self._resting_since = now
            elif now - self._resting_since >= REST_TIME:
                self._rested_since = min(self._rested_since, now)

    def _against_wind(self, setpoint: Setpoint, known: KnownMotion, flown: bool,
                      now: float) -> Setpoint:
        """Return the setpoint with which the vehicle accelerates as wanted in the wind."""
        trusted = not known.contradiction(self.limits)
        velocity = known.source_first[0].fresh_velocity(self.limits) if trusted else None
        self._wind.step(self._flown, None if velocity is None else velocity.vector,
                        self.limits.wind_compensation, now)
        if setpoint.kind in (setpoint_rules.COMMAND, setpoint_rules.BRAKE) and np.any(
                self._wind.acceleration):
            setpoint = setpoint._replace(acceleration=limit_norm(
                setpoint.acceleration - self._wind.acceleration, self.limits.a_max, SENT_INSIDE))
        self._flown = setpoint.acceleration if flown and setpoint.kind != (
            setpoint_rules.NONE) else None
        return setpoint

    def _hold_yaw(self, known: KnownMotion, engaged: bool) -> None:
        if self._held_yaw is not None and engaged:
            return
        # The autopilot's own yaw first: it is the one that will obey.
        for motion in (known.autopilot, known.odom):
            if motion.yaw_age <= self.limits.odom_timeout:
                self._held_yaw = self._last_yaw = motion.yaw
                return
        if self._last_yaw is not None:
            self._held_yaw = self._last_yaw
