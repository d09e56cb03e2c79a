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
Estimates a neighbor's position, velocity, attitude and acceleration: a Kalman filter in odom.

The state is in odom, not relative to the ego vehicle: so ego maneuvers do not appear as maneuvers
of the neighbor, and a slow drift of the odometry displaces both equally. ``neighbor_motion`` has
the motion model and the state.

A measurement is the position of a point on the body, where its markers are, and the attitude. Both
give the position of the body; the farther the point is from the body's origin, the more an
uncertain attitude adds to the uncertainty of this position.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
import math
from typing import NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import Array, skew, Transform
from flock_follower.geometry.rotation_vectors import matrix_to_rotation_vector
from flock_follower.messages import MAX_JUMP
from flock_follower.perception.innovation import (
    AlikeErrors,
    expected_innovation,
    root_of,
    scale_variances,
    squared_distance,
    to_body,
)
from flock_follower.perception.learned_noise import LearnedMotion, LEARNING_GAP
from flock_follower.perception.neighbor_motion import (
    ACCELERATION,
    ATTITUDE,
    bounded_across,
    Estimate,
    FilterParams,
    INITIAL_RATE,
    POSE,
    POSITION,
    RATE,
    STATE_SIZE,
    transition,
    turned_along,
    VELOCITY,
)
from flock_follower.perception.range_gate import RangeGate

_IDENTITY = np.eye(STATE_SIZE)
#: Rows of the error state that are measured if the attitude is not used.
_PLACE = _IDENTITY[POSITION]
#: States to which the drift of the ego position adds noise, (15, 15).
_WANDERING = _PLACE.T.dot(_PLACE)
#: Of the error state: the translation, and the rotation.
_MOVING = np.r_[POSITION, VELOCITY, ACCELERATION]
_TURNING = np.r_[ATTITUDE, RATE]
#: chi^2 with 3 degrees of freedom at a probability of 0.999.
GATE_CHI2 = 16.27
#: A measurement is refused if its chi^2 is so many times the gate's: 13 standard deviations.
WILD_FACTOR = 10.0
#: An attitude outside the gate that differs by this angle, rad, from the expected one is mirrored.
MIN_MIRROR_ANGLE = 0.3
#: An attitude is wrong if this many measurements in a row contradict it, for CONTRADICTED_FOR.
MIN_CONTRADICTIONS = 3
#: Time for which measurements contradict a wrong attitude, s: the same at every rate of images.
CONTRADICTED_FOR = 0.19
#: Nearer than this, m, a distance has no direction.
NEAREST = 0.01
#: Of a state that is moved, the velocity is uncertain by the way divided by this, s.
SETTLING = 0.2
#: The middle of a body, m.
_BODY_CENTER = np.zeros(3)
#: Direction of a distance, if the newest measurement was a pose.
_NO_DIRECTION = np.zeros(3)
_UNSCALED = [1.0] * 6  # attitude and its rate


class UpdateOutcome(Enum):
    """The outcome of a measurement."""

    STARTED = 'track started'
    USED = 'used'
    SURPRISING = 'surprising, used with care'
    POSITION_ONLY = 'implausible attitude, position used'
    OUTLIER = 'outside the gate'
    OLDER = 'older than the estimate'
    LOST = 'no track'


class Change(NamedTuple):
    """
    The difference of two successive innovations of the position, and of the attitude if used.

    ``covariance`` (n, n) is that of ``difference`` (n,), m, rad, if innovations are white.
    """

    difference: Array
    covariance: Array


class NeighborFilter:
    """
    The filter of one neighbor.

    A measurement outside the gate is used with less weight. The first one may be wrong, and gets
    the weight of a measurement on the gate. If the next one differs in the same direction, the
    track is wrong, and the covariance of the prediction is increased. A measurement beyond
    ``WILD_FACTOR``, or one outside the gate that the neighbor cannot reach, is refused:
    ``hypotheses`` tracks it separately.
    """

    def __init__(self, params: FilterParams | None = None) -> None:
        self.params = params or FilterParams()
        self.walk = 0.0
        """Drift of the ego position, m/sqrt(s)."""
        self._steps: dict[float, tuple[Array, Array, Array]] = {}
        self.reset()

    def reset(self) -> None:
        """Forget the neighbor."""
        self.change: Change | None = None
        """
        Innovation change of the newest measurement; None if unused, or if it began the track.
        """
        self.newest: Estimate | None = None
        """The state at the newest measurement; None if there is no track."""
        self._predicted: Estimate | None = None  # from that, to the time last requested
        self._turned: list[float] = []  # stamps of those in a row whose attitude was not used
        self._surprises: dict[str, Array] = {}
        self._alike = AlikeErrors()
        self._range_gate = RangeGate(most=self.params.max_rejections)
        self._range_direction = _NO_DIRECTION  # unit vector (3,) of the last distance, in odom
        self._motion = LearnedMotion()
        self._before: tuple[Array, Array] | None = None  # the last innovation, its covariance

    def predict(self, stamp: float) -> Estimate | None:
        """
        Return the state predicted for a stamp, s; None without a track, or if it is too old.

        The filter is not changed. For a stamp before the newest measurement the result is None.
        """
        now = self.newest
        if now is None or not 0.0 <= stamp - now.stamp <= self.params.max_gap:
            return None
        if stamp == now.stamp:
            return now
        if self._predicted is None or self._predicted.stamp != stamp:
            self._predicted = now.propagate(stamp, *self._transition(stamp - now.stamp))
        return self._predicted

    def place(self, stamp: float) -> Transform | None:
        """Return approximately the pose of :meth:`predict`, at far less cost."""
        now = self.newest
        if now is None or not 0.0 <= stamp - now.stamp <= self.params.max_gap:
            return None
        return Transform(now.rotation, now.position + (stamp - now.stamp) * now.velocity)

    def near(self, stamp: float) -> Estimate | None:
        """Return the state at a stamp, s, shortly before or after the newest measurement."""
        now = self.newest
        if now is None or stamp == now.stamp:
            return now
        return now.propagate(stamp, *self._transition(stamp - now.stamp))

    def continued(self, max_gap: float) -> NeighborFilter:
        """Return a copy of this filter that bridges gaps of up to ``max_gap`` s."""
        other = NeighborFilter(replace(self.params, max_gap=max_gap))
        other.walk, other.newest = self.walk, self.newest
        other._motion.factors = [max(factor, 1.0) for factor in self._motion.factors]
        return other

    def add_error(self, error: Array, later: float = 0.0) -> None:
        """
        Add an error state (15,) that was found elsewhere, and widen the covariance accordingly.

        The state then holds for a time ``later``, s, after its stamp. The motion that was learned
        with the error is forgotten.
        """
        self._motion = LearnedMotion()
        if self.newest is not None:
            covariance = self.newest.covariance + np.outer(error, error)
            covariance[VELOCITY, VELOCITY] += error.dot(error) / SETTLING**2 * np.eye(3)
            self.newest = self.newest.corrected(error, covariance)
            self.newest = self.newest._replace(stamp=self.newest.stamp + later)
            self._predicted = self._before = None

    def _nominal_transition(self, dt: float) -> tuple[Array, Array, Array]:
        dt = round(dt, 6)  # images come at even intervals, to the microsecond or so
        if dt not in self._steps:
            if len(self._steps) > 100:
                self._steps.clear()
            self._steps[dt] = transition(dt, self.params)
        return self._steps[dt]

    def _transition(self, dt: float) -> tuple[Array, Array, Array]:
        """Return the transition with the noise of the motion that was learned."""
        linear, whole, noise = self._nominal_transition(dt)
        x, y, z = self._motion.scale(dt)  # axes are independent of each other
        noise = noise * np.array([x, y, z, x, y, z, *_UNSCALED, x, y, z])
        return linear, whole, noise + self.walk**2 * abs(dt) * _WANDERING if self.walk else noise

    def update(self, stamp: float, T_odom_body: Transform, reference: Array,
               covariance: Array, reach: float = math.inf,
               alike: Array | None = None) -> UpdateOutcome:
        """
        Take in a body's pose in odom, with covariance (6, 6) along odom's axes.

        The covariance is of the position of ``reference`` (3,), a point on the body, m, then of
        the rotation vector.

        :param alike: the part of the covariance, (6, 6), by errors correlated between images.
        :param reach: the largest possible distance of the body from its newest estimate, m.
        """
        self.change = None
        now = self.newest
        if now is not None and stamp <= now.stamp:
            if now.stamp - stamp <= MAX_JUMP:
                return UpdateOutcome.OLDER
            self.reset()
        expected = self.predict(stamp)
        whole = root = None if alike is None else root_of(alike)
        if now is None or expected is None:
            return self._start(stamp, T_odom_body, reference, covariance, whole)

        prior, plausible, jacobian, noise, innovation = self._compare(
            expected, T_odom_body, reference, covariance)
        if root is not None:
            root = to_body(T_odom_body.rotation.dot(reference)).dot(root) if plausible else (
                root[:3])
        self._alike.pass_on(stamp - now.stamp, _IDENTITY if self._alike.cross is None else (
            self._nominal_transition(stamp - now.stamp)[1]))
        shared = self._alike.together(root)
        across, spread = expected_innovation(prior, jacobian, noise, shared)

        nominal = spread
        doubt = squared_distance(innovation[:3], nominal[:3, :3]) / GATE_CHI2
        solved, gain = False, np.zeros(0)
        reached = doubt <= 1.0 or math.dist(T_odom_body.translation, now.position) <= reach
        if reached and doubt <= WILD_FACTOR:  # NaN is not
            if self._surprises_again('position', innovation[:3], doubt):
                prior = scale_variances(prior, _MOVING, doubt)
                across, spread = expected_innovation(prior, jacobian, noise, shared)
            elif doubt > 1.0:
                noise = noise + (doubt - 1.0) * spread
                spread = doubt * spread
            solved, gain = cv2.solve(spread, across)
        if not solved:
            return UpdateOutcome.OUTLIER
        self._turned = [] if plausible else [*self._turned, stamp]
        if self._is_contradicted(stamp):
            return self._start(stamp, T_odom_body, reference, covariance, whole, expected)
        self._learn(stamp - now.stamp, innovation, nominal)
        remain = _IDENTITY - gain.T.dot(jacobian)
        corrected = _corrected_covariance(prior, remain, gain, noise, shared)
        self._alike.take(remain, gain.T, root)
        self._predicted, self._range_direction = None, _NO_DIRECTION
        self.newest = expected.corrected(gain.T.dot(innovation), corrected)
        if not plausible:
            return UpdateOutcome.POSITION_ONLY
        return UpdateOutcome.SURPRISING if doubt > 1.0 else UpdateOutcome.USED

    def _is_contradicted(self, stamp: float) -> bool:
        """Return whether measurements have contradicted the attitude for long enough."""
        count = len(self._turned)
        return count >= self.params.max_rejections or (
            count >= MIN_CONTRADICTIONS and stamp - self._turned[0] >= CONTRADICTED_FOR)

    def _learn(self, dt: float, innovation: Array, covariance: Array) -> None:
        """Learn from an innovation (6,), or (3,) of the position only, dt, s, after another."""
        self._motion.take(dt, innovation[:3], covariance[:3, :3])
        before, self._before = self._before, (innovation, covariance)
        if before is not None and dt <= LEARNING_GAP:
            n = min(len(innovation), len(before[0]))
            self.change = Change(innovation[:n] - before[0][:n],
                                 covariance[:n, :n] + before[1][:n, :n])

    def _compare(self, expected: Estimate, T_odom_body: Transform, reference: Array,
                 covariance: Array) -> tuple[Array, bool, Array, Array, Array]:
        """
        Compare a measurement with the expected state, the attitude first.

        Return the expected covariance (15, 15), whether the attitude is plausible, and the
        measurement's Jacobian (n, 15), noise (n, n) and innovation (n,); n is 6, or 3 if the
        attitude is not plausible and only the position is used.
        """
        prior = expected.covariance
        turn = matrix_to_rotation_vector(T_odom_body.rotation.dot(expected.rotation.T))
        spread = prior[ATTITUDE, ATTITUDE] + covariance[3:, 3:]
        doubt = squared_distance(turn, spread) / GATE_CHI2
        # A marker's mirrored pose has its position right and its attitude wrong.
        plausible = doubt <= 1.0 or (doubt <= WILD_FACTOR
                                     and float(turn.dot(turn)) < MIN_MIRROR_ANGLE**2)
        if plausible:
            if self._surprises_again('attitude', turn, doubt):
                prior = scale_variances(prior, _TURNING, doubt)
            elif doubt > 1.0:
                covariance = covariance.copy()
                covariance[3:, 3:] += (doubt - 1.0) * spread
            place = T_odom_body.translation - expected.position
            lever = to_body(T_odom_body.rotation.dot(reference))
            noise = lever.dot(covariance).dot(lever.T)
            return prior, True, POSE, noise, np.concatenate([place, turn])
        # With the attitude expected, then, from the point to the body.
        lever = expected.rotation @ reference
        innovation = T_odom_body.apply(reference) - expected.position - lever
        jacobian = _PLACE.copy()
        jacobian[:, ATTITUDE] = -skew(lever)
        return prior, False, jacobian, covariance[:3, :3], innovation

    def update_range(self, stamp: float, distance: float, own_position: Array, variance: float,
                     reference: Array = _BODY_CENTER) -> UpdateOutcome:
        """
        Update with the measured distance, m, to ``reference`` (3,), a point on the body, m.

        The update corrects the state only along the line of sight: with an uncertain direction it
        would otherwise also change the state across this line. ``range_gate`` handles outliers. No
        track begins with a distance.

        :param own_position: place of the measurement (3,), m, in odom.
        :param variance: of the distance, m^2.
        """
        now, expected = self.newest, self.predict(stamp)
        if now is None or expected is None or stamp == now.stamp:
            late = now is not None and stamp <= now.stamp
            return UpdateOutcome.OLDER if late else UpdateOutcome.LOST
        lever = expected.rotation.dot(reference)
        sight = expected.position + lever - own_position
        length = math.hypot(*sight.tolist())
        if not length > NEAREST:
            return UpdateOutcome.OUTLIER
        along, innovation = sight / length, distance - length
        prior = turned_along(expected.covariance, self._range_direction, along)
        # However uncertain the attitude, the point is no farther from the body than its lever.
        swing = np.cross(lever, along)
        noise = variance + min(float(swing.dot(prior[ATTITUDE, ATTITUDE]).dot(swing)),
                               float(lever.dot(lever)))
        spread = float(along.dot(prior[POSITION, POSITION]).dot(along)) + noise
        factors = self._range_gate.judge(innovation, spread)
        if factors is None:
            return UpdateOutcome.OUTLIER
        prior = scale_variances(prior, _MOVING, factors[0])
        across = prior[:, POSITION].dot(along)
        expected_spread = float(along.dot(across[POSITION]))
        whole = factors[1] * (expected_spread + noise)
        gain = np.zeros(STATE_SIZE)
        for part in (POSITION, VELOCITY, ACCELERATION):
            gain[part] = float(along.dot(across[part])) / whole * along
        remain = _IDENTITY.copy()
        remain[:, POSITION] -= np.outer(gain, along)
        self._alike.pass_on(stamp - now.stamp, self._nominal_transition(stamp - now.stamp)[1])
        self._alike.take(remain, gain, None)
        covariance = remain.dot(prior).dot(remain.T) + (whole - expected_spread) * np.outer(
            gain, gain)
        self.change, self._predicted, self._range_direction = None, None, along
        self.newest = expected.corrected(innovation * gain, bounded_across(
            covariance, along, length, self.params.initial_speed))
        return UpdateOutcome.USED if factors == (1.0, 1.0) else UpdateOutcome.SURPRISING

    def _surprises_again(self, quantity: str, innovation: Array, doubt: float) -> bool:
        """Return whether two successive innovations (3,) exceed the gate in the same direction."""
        before = self._surprises.pop(quantity, None)
        if doubt <= 1.0:
            return False
        self._surprises[quantity] = innovation
        return before is not None and float(innovation.dot(before)) > 0.0

    def _start(self, stamp: float, body: Transform, reference: Array, covariance: Array,
               root: Array | None, moving: Estimate | None = None) -> UpdateOutcome:
        """Start from one measurement; if ``moving`` is given, keep its velocity."""
        quiet = [min(factor, 1.0) for factor in self._motion.factors]
        self.reset()
        if moving is not None:  # a high factor may come from the cause of the restart
            self._motion.factors = quiet
        start = POSE.T @ to_body(body.rotation @ reference)
        full = start @ covariance @ start.T
        self._alike.take(_IDENTITY, start, root)
        velocity: Array = np.zeros(3)
        acceleration: Array = np.zeros(3)
        full[VELOCITY, VELOCITY] = self.params.initial_speed**2 * np.eye(3)
        full[ACCELERATION, ACCELERATION] = self.params.acceleration**2 * np.eye(3)
        if moving is not None:
            velocity, acceleration = moving.velocity, moving.acceleration
            for row in (VELOCITY, ACCELERATION):
                for column in (VELOCITY, ACCELERATION):
                    full[row, column] = moving.covariance[row, column]
        full[RATE, RATE] = INITIAL_RATE**2 * np.eye(3)
        self.newest = Estimate(stamp, body.translation, velocity, body.rotation, np.zeros(3),
                               acceleration, full)
        return UpdateOutcome.STARTED


def _corrected_covariance(prior: Array, remain: Array, gain: Array, noise: Array,
                          shared: Array | None) -> Array:
    """
    Return the covariance after an update: symmetric and positive whatever the rounding (Joseph).

    :param remain: 1 - K H. :param gain: the transpose of K.
    :param shared: covariance of state and measurement before the update, if any.
    """
    corrected: Array
    corrected = remain.dot(prior).dot(remain.T) + gain.T.dot(noise).dot(gain)
    if shared is not None:
        common = remain.dot(shared).dot(gain)
        corrected -= common + common.T
    return corrected
