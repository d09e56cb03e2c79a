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
Velocities derived from positions, and angular velocities from attitudes.

Both use the same Kalman filter: value, rate and acceleration along each axis, driven by white
jerk (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
section 6.2). The measurement noise is learned from the innovations.

``TwistFrame`` finds the frame of a source's velocity. REP-105 requires the child frame; some
sources use the header's frame, others send no velocity or a wrong velocity. The velocity is read
in both frames. In windows of ``WINDOW`` seconds the mean velocity of each reading is compared with
the displacement. If the readings differ (with yaw 0 they do not), the evidence is added up over
the windows until one frame is certain. If both readings contradict the displacement in
``AGREEING_WINDOWS`` successive windows, at any time, the velocity is not used any more. It is used
again once a reading agrees in as many windows in motion, or in ``EXPIRES`` windows at rest.

Before the frame is found, the child frame is used while both readings are equal, and the more
likely reading once the evidence favors it. The velocity is derived from the positions in all other
cases: while the last window contradicts both readings, and after a contradiction until a frame is
found again. A velocity of exactly 0 counts as missing. The covariance of the twist includes the
probability that the reading is wrong.
"""

from __future__ import annotations

from collections import deque
import math
from operator import add
from typing import Final

import numpy as np

from flock_follower.geometry import (
    Array,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_rotation_vector,
    rotation_vector_to_quaternion,
)
from flock_follower.messages import POSITION_JUMP

#: After a longer gap between two messages, s, a derivation begins anew.
ODOMETRY_GAP = 0.6
#: The noise follows the innovations in this time, s.
NOISE_TIME = 2.0


class _WhiteJerk:
    """
    A value along three axes, its ``rate`` and ``acceleration`` (3,) at ``stamp``, s.

    :param jerk: its spectral density, (unit/s^3)^2/Hz.
    :param noise: standard deviation of a measurement: initial, least, and largest.
    :param rate: initial standard deviation of the rate; :param acceleration: of the acceleration.
    """

    def __init__(self, jerk: float, noise: tuple[float, float, float], rate: float,
                 acceleration: float) -> None:
        self._jerk, self._initial = jerk, (rate**2, 0.0, acceleration**2)
        self.variance, self._least, self._most = (std**2 for std in noise)
        """Variance of a measurement along an axis, and its limits."""
        self.stamp = -math.inf
        self.value: Array = np.zeros(3)
        self.rate: Array = np.zeros(3)
        self.acceleration: Array = np.zeros(3)
        # Covariance along an axis: of value, rate, acceleration, the upper triangle row by row. In
        # plain numbers: at hundreds of messages per second matrices so small cost more.
        self._covariance = (0.0,) * 6

    def _restart(self, stamp: float, value: Array) -> None:
        self.stamp, self.value = stamp, value
        self.rate, self.acceleration = np.zeros(3), np.zeros(3)
        self._covariance = (self.variance, 0.0, 0.0, *self._initial)

    def _predict(self, dt: float) -> float:
        """Carry the covariance on by dt, s; return the variance of an innovation there."""
        pp, pv, pa, vv, va, aa = self._covariance
        q = self._jerk * dt
        pp += dt * (2.0 * pv + dt * (pa + vv + dt * (va + dt * (aa / 4.0 + q / 20.0))))
        pv += dt * (vv + pa + dt * (1.5 * va + dt * (aa / 2.0 + q / 8.0)))
        pa += dt * (va + dt * (aa / 2.0 + q / 6.0))
        vv += dt * (2.0 * va + dt * (aa + q / 3.0))
        va += dt * (aa + q / 2.0)
        aa += q
        self._covariance = pp, pv, pa, vv, va, aa
        return pp + self.variance

    def _correct(self, stamp: float, innovation: Array) -> Array:
        """Correct rate and acceleration; return the correction of the value; learn the noise."""
        dt = stamp - self.stamp
        pp, pv, pa, vv, va, aa = self._covariance
        spread = pp + self.variance
        p, v, a = pp / spread, pv / spread, pa / spread
        self._covariance = (pp - p * pp, pv - p * pv, pa - p * pa, vv - v * pv, va - v * pa,
                            aa - a * pa)
        # One innovation far out is a jump, not noise.
        squared = float(innovation.dot(innovation)) / 3.0
        seen = min(squared, 16.0 * spread) - pp
        self.variance += min(1.0, dt / NOISE_TIME) * (seen - self.variance)
        self.variance = min(max(self.variance, self._least), self._most)
        self.stamp = stamp
        self.rate = self.rate + dt * self.acceleration + v * innovation
        self.acceleration = self.acceleration + a * innovation
        correction: Array = p * innovation
        return correction


class DerivedVelocity(_WhiteJerk):
    """The velocity of a point, ``rate``, m/s, from its positions, m, in their frame."""

    #: Positions closer together than this, s, add no information: filter errors are not white.
    SHORTEST = 0.018
    #: Position errors are correlated: the measured velocity variance is 4 times the filter's.
    VARIANCE_FACTOR = 4.0
    #: A position this many deviations from where it was expected is a step, not motion: a filter
    #: that corrects itself makes them. After some in a row it is motion after all.
    STEP = 4.0
    MOST_STEPS = 2
    #: That takes a velocity and a noise that are known: not before so many s.
    SETTLED = 0.5
    #: At a low rate the vehicle's own acceleration, m/s^2, is no jump.
    MOST_ACCELERATION = 10.0

    def __init__(self) -> None:
        super().__init__(0.5, (0.003, 0.0003, 0.1), rate=1.0, acceleration=2.0)
        self._steps = 0
        self._start = 0.0

    @property
    def variance_of_velocity(self) -> float:
        """Return the variance of the velocity along an axis, (m/s)^2."""
        return self.VARIANCE_FACTOR * self._covariance[3]

    def velocity_at(self, stamp: float) -> Array:
        """Return the velocity (3,), m/s, at a stamp, s, shortly after the newest position."""
        return self.rate + (stamp - self.stamp) * self.acceleration

    def take(self, stamp: float, position: Array) -> float:
        """
        Take a position; return the size of its jump, m, or 0 without a jump.

        Only positions are compared, because not every source has a reliable velocity. ``check``,
        ``evaluate`` and the diagnostics count and report these jumps.
        """
        dt = stamp - self.stamp
        if not 0.0 < dt <= ODOMETRY_GAP:
            self._begin(stamp, position)
            return 0.0
        if dt < self.SHORTEST:
            return 0.0
        expected = self.value + dt * self.rate + 0.5 * dt * dt * self.acceleration
        innovation = position - expected
        off = float(np.abs(innovation).max())
        far = off > POSITION_JUMP + 0.5 * self.MOST_ACCELERATION * dt * dt
        settled = stamp - self._start > self.SETTLED
        step = (off > self.STEP * math.sqrt(self._predict(dt)) and settled) or far
        often = self._steps >= self.MOST_STEPS
        self._steps = self._steps + 1 if step else 0
        if far and often:
            self._begin(stamp, position)
        elif step and not often:
            # The motion goes on, from another place.
            self._covariance = self.variance, 0.0, 0.0, *self._covariance[3:]
            self.rate = self.rate + dt * self.acceleration
            self.stamp, self.value = stamp, position
        else:
            self.value = expected + self._correct(stamp, innovation)
            return 0.0
        return off if far else 0.0

    def _begin(self, stamp: float, position: Array) -> None:
        self._restart(stamp, position)
        self._start, self._steps = stamp, 0


class DerivedRates(_WhiteJerk):
    """
    The angular velocity of a body, ``rate``, rad/s, in the body, from its attitudes.

    ``value`` (x, y, z, w) takes the body to odom.
    """

    def __init__(self) -> None:
        super().__init__(300.0, (0.001, 0.0001, 0.05), rate=1.0, acceleration=5.0)

    def take(self, stamp: float, quaternion: Array) -> None:
        """Take an attitude."""
        dt = stamp - self.stamp
        if not 0.0 < dt <= ODOMETRY_GAP:
            self._restart(stamp, quaternion)
            return
        turn = dt * self.rate + 0.5 * dt * dt * self.acceleration
        expected = quaternion_multiply(self.value, rotation_vector_to_quaternion(turn))
        innovation = quaternion_to_rotation_vector(
            quaternion_multiply(quaternion_conjugate(expected), quaternion))
        self._predict(dt)
        self.value = quaternion_multiply(
            expected, rotation_vector_to_quaternion(self._correct(stamp, innovation)))


CHILD: Final = 'child'
ODOM: Final = 'odom'
NONE: Final = 'none'
AUTO: Final = 'auto'
CHOICES: Final = (AUTO, CHILD, ODOM, NONE)
#: s over which velocities and positions are compared.
WINDOW: Final[float] = 0.5
#: Length of a piece of a window, s. A filter that corrects itself makes steps in single pieces
#: (0.29 m in a real flight); a velocity read wrongly is wrong in all.
PIECE: Final[float] = 0.095
#: Least number of pieces of a window.
MIN_PIECES: Final[int] = 3
#: Windows in a row in which no frame of the twist fits, after which the twist is not used.
AGREEING_WINDOWS: Final[int] = 2
#: Windows in a row that fit, at any speed, after which a frame that was found before is used
#: again: 4 s.
EXPIRES: Final[int] = 8
#: Log of the likelihood ratio that decides for one frame: frames that differ by three deviations
#: give 4.5.
DECIDING_EVIDENCE: Final[float] = 6.0
#: Largest log of the likelihood ratio of one window, so that a single window decides nothing.
MAX_WINDOW_EVIDENCE: Final[float] = 4.0
#: Log of the likelihood ratio from which on a reading is used before one is found: 3 to 1.
LIKELY_EVIDENCE: Final[float] = 1.0
#: Readings that differ by less, m/s along any axis: REP-105's is used before the evidence decides.
SAME_VELOCITY: Final[float] = 0.1
#: Standard deviation of a sound velocity from the way covered in a window, m/s (real sources: 0.02
#: to 0.05).
VELOCITY_DEVIATION: Final[float] = 0.05
#: The same as a share of the speed, which adds to it.
SPEED_DEVIATION: Final[float] = 0.03
#: A piece: time, s, then m: way (3,), and how much longer it is by either reading (2, 3). In plain
#: numbers: arrays so small would take several times as long, for every message.
_EMPTY_PIECE: Final = (0.0,) * 10
_Numbers = tuple[float, ...]


class TwistFrame:
    """
    Determines the frame of a source's velocity, ``frame``: 'child', 'odom', or 'none'.

    :param wanted: a frame, which is then used, or 'auto'.
    """

    def __init__(self, wanted: str = AUTO) -> None:
        self.wanted = wanted
        self.found = ''
        """The frame that fits the positions; '' before the evidence decides."""
        self.contradiction: float = 0.0
        """Error of the frame in use, m/s, in the window that last contradicted it."""
        self.windows: deque[Array] = deque(maxlen=600)
        """Mean velocities (3, 3), m/s, in odom, of the last 300 s for ``check``: by the positions,
        and in the two readings.
        """
        self._before = ''  # the frame found before the velocity was dropped
        self.failing = self._moving = 0
        """The newest windows in a row that the frame in use does not fit."""
        self._agreeing = 0  # windows in a row, since it was dropped
        self._evidence = 0.0  # for 'child', against 'odom'
        self.restart()

    @property
    def frame(self) -> str:
        """Return the frame of the velocity now; 'none' while it is not known."""
        return (self.found or NONE) if self.wanted == AUTO else self.wanted

    def reading(self, child: Array, odom: Array) -> str:
        """Return the frame to use for a velocity, from its value (3,), m/s, in both readings."""
        if self.wanted != AUTO or self.found:
            return self.frame
        if self.is_contradicted or not child.any() or (
                abs(self._evidence) < LIKELY_EVIDENCE
                and float(np.abs(child - odom).max()) > SAME_VELOCITY):
            return NONE
        return CHILD if self._evidence >= 0.0 else ODOM

    @property
    def is_contradicted(self) -> bool:
        """Return whether the positions contradict the velocity, while no frame is found."""
        return self.failing > 0 or self.contradiction > 0.0

    @property
    def wrong_probability(self) -> float:
        """Return the probability that the more likely frame is wrong; 0 if decided."""
        if self.wanted != AUTO or self.found:
            return 0.0
        return 1.0 / (1.0 + math.exp(abs(self._evidence)))

    @property
    def describe(self) -> str:
        """Return the frame as configured, and the frame that fits the positions."""
        off = f', off by {self.contradiction:.2f} m/s' if self.found == NONE else ''
        return f'{self.wanted}: {self.found or "not known yet"} by the positions{off}'

    def restart(self) -> None:
        """Begin a new window, because the position jumped, or there was a gap."""
        self._last: _Numbers | None = None
        self._begin()

    def _begin(self) -> None:
        self._pieces: list[_Numbers] = []
        self._piece: _Numbers = _EMPTY_PIECE

    def take(self, stamp: float, position: Array, child: Array, odom: Array) -> None:
        """Take a position (3,), m, and the velocity in odom, m/s, by both readings."""
        now = (stamp, *position.tolist(), *child.tolist(), *odom.tolist())
        last, self._last = self._last, now
        if last is None:
            return
        then, x, y, z, cx, cy, cz, ox, oy, oz = last
        _, new_x, new_y, new_z, new_cx, new_cy, new_cz, new_ox, new_oy, new_oz = now
        dt, dx, dy, dz = stamp - then, new_x - x, new_y - y, new_z - z
        # Trapezoids: a slow source has few messages in a window.
        half = 0.5 * dt
        self._piece = tuple(map(add, self._piece, (
            dt, dx, dy, dz,
            half * (cx + new_cx) - dx, half * (cy + new_cy) - dy, half * (cz + new_cz) - dz,
            half * (ox + new_ox) - dx, half * (oy + new_oy) - dy, half * (oz + new_oz) - dz)))
        if self._piece[0] < PIECE:
            return
        self._pieces.append(self._piece)
        self._piece = _EMPTY_PIECE
        if len(self._pieces) >= MIN_PIECES:
            pieces = np.array(self._pieces)
            if pieces[:, 0].sum() > WINDOW - 0.5 * PIECE:
                self._judge(pieces[:, 0], pieces[:, 1:4], pieces[:, 4:].reshape(-1, 2, 3))
                self._begin()

    def _judge(self, times: Array, ways: Array, offs: Array) -> None:
        """
        Take the evidence of a window, by its n pieces.

        :param times: (n,), s.
        :param ways: (n, 3), m, by the positions.
        :param offs: (n, 2, 3), m: how much longer the ways are by the two readings.
        """
        time = float(times.sum())
        way, mean = ways.sum(axis=0), offs.sum(axis=0) / time
        speed = float(np.linalg.norm(way)) / time
        tolerance = 3.0 * (VELOCITY_DEVIATION + SPEED_DEVIATION * speed)
        self.windows.append(np.array([way / time, *(way / time + mean)]))
        means = np.linalg.norm(mean, axis=1)
        # Noise of the positions is least in the mean, and single steps do not show in the median.
        medians = np.linalg.norm(np.median(offs / times[:, None, None], axis=0), axis=1)
        off = np.minimum(means, medians)
        fitting = [name for name, by in zip((CHILD, ODOM), off.tolist()) if by <= tolerance]
        if self.found == NONE:
            self._recover(fitting, speed > tolerance)
            return
        fits = self.found in fitting if self.found else bool(fitting)
        self.failing = 0 if fits else self.failing + 1
        if self.failing >= AGREEING_WINDOWS:
            used = (CHILD, ODOM).index(self.found) if self.found else int(off.argmin())
            self._before, self._agreeing, self._moving = self.found, 0, 0
            self.found, self.contradiction = NONE, float(off[used])
            return
        if float(np.linalg.norm(mean[0] - mean[1])) < VELOCITY_DEVIATION:
            return  # errors would decide
        likelier = float(means[1]**2 - means[0]**2) / (2.0 * VELOCITY_DEVIATION**2)
        self._evidence += min(max(likelier, -MAX_WINDOW_EVIDENCE), MAX_WINDOW_EVIDENCE)
        if not self.found and abs(self._evidence) >= DECIDING_EVIDENCE and fits:
            self.found = CHILD if self._evidence > 0.0 else ODOM

    def _recover(self, fitting: list[str], moving: bool) -> None:
        """Use a dropped velocity again, once it has agreed for long enough."""
        self._agreeing = self._agreeing + 1 if fitting else 0
        self._moving = self._moving + moving if fitting else 0
        known = self._before in fitting
        if self._moving >= AGREEING_WINDOWS or (known and self._agreeing >= EXPIRES):
            self.found, self.failing = self._before if known else '', 0
            if not known:
                self._evidence = 0.0  # another frame, or none was known: it is sought anew
