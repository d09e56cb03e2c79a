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
A told state turned from its teller's frame to one's own, with all that makes it uncertain.

What one follower tells the others, and what it makes of what they tell.

It tells its own state and whom it sees, in its own odometry frame: never what it was told. What
others tell is turned to its own frame, once it is known where theirs lies (``frame_relations``);
until then it is kept, and not used.
"""

from __future__ import annotations

from collections import deque
import math

import numpy as np

from flock_follower.flock.alignment import FrameAlignment, sideways
from flock_follower.flock.frame_relations import FrameRelations
from flock_follower.flock.peers import (
    ACCELERATION_STD,
    ATTITUDE_NOISE,
    checked_name,
    FRAME,
    FUTURE,
    is_covariance,
    leapt,
    malformed,
    Moment,
    moment,
    ODOMETRY_NOISE,
    POSITION_STD_MAX,
    SEEN_TIMEOUT,
    SIGHTING_NOISE,
    TalkingVehicle,
    teller_of,
    TELLERS_MAX,
    TellerStatus,
    untold,
    WORD_AGE_MAX,
)
from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
)
from flock_follower.messages import DUPLICATE, NANOSECONDS, OdometryState, to_nanoseconds

#: Of a velocity whose covariance is not told, m/s.
VELOCITY_STD = 0.1


def position_covariance(state: OdometryState, own: bool) -> Array:
    """
    Return the covariance (3, 3) of a position told, within the frame of who tells it.

    Of oneself (``own``) the odometry's drift is no part of it: that is the frame's. So it is small
    whatever the odometry says of itself. What is seen is known as well as it was seen.
    """
    noise = ODOMETRY_NOISE if own else SIGHTING_NOISE
    told: Array = np.zeros((3, 3)) if own else state.pose_covariance[:3, :3]
    return told + noise ** 2 * np.eye(3)


def in_own_frame(state: OdometryState, teller: str, frame: str, frames: FrameAlignment
                 ) -> OdometryState:
    """Return a state told by a teller whose frame is known, in one's own frame, at its stamp."""
    rotation, yaw_variance = frames.rotation(teller), float(frames.block(teller)[0, 0])
    position, share = frames.located(teller, state.position)
    velocity, told = rotation.dot(state.velocity), state.velocity_covariance
    if not is_covariance(told):
        told = VELOCITY_STD ** 2 * np.eye(3)
    swung = sideways(velocity)
    spread = rotation.dot(told).dot(rotation.T) + yaw_variance * np.outer(swung, swung)
    quaternion = canonical_quaternion(quaternion_multiply(
        quaternion_from_yaw(frames.yaw(teller)), state.quaternion))
    to_own = quaternion_to_matrix(quaternion)
    pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
    pose[:3, :3] = share + rotation.dot(
        position_covariance(state, state.child == teller)).dot(rotation.T)
    if is_covariance(state.pose_covariance[3:, 3:]):
        pose[3:, 3:] = rotation.dot(state.pose_covariance[3:, 3:]).dot(rotation.T)
        pose[5, 5] += yaw_variance
    twist[:3, :3] = to_own.T.dot(spread).dot(to_own)
    return OdometryState(state.stamp, frame, state.child, position, quaternion, velocity,
                         state.angular_velocity, pose, twist, to_own, state.derived)


def aged(state: OdometryState, now: int) -> OdometryState:
    """
    Return a state with the covariances that it has once it is carried on to a time, ns.

    Whoever takes it does that, with its velocity, and does not know what the vehicle has done
    since. Its stamp stays: that is when it was so.
    """
    age = max((now - state.stamp) / NANOSECONDS, 0.0)
    pose, twist = state.pose_covariance.copy(), state.twist_covariance.copy()
    pose[:3, :3] += (age ** 2 * state.velocity_covariance
                     + (0.5 * ACCELERATION_STD * age ** 2) ** 2 * np.eye(3))
    twist[:3, :3] += (ACCELERATION_STD * age) ** 2 * np.eye(3)
    return state._replace(pose_covariance=pose, twist_covariance=twist)


#: Between two rounds of words, ns; a little less than 0.1 s, as timers tremble.
PERIOD = 90_000_000
#: Own states and sightings older than this, ns, or as far in the future, are not told; nor are
#: older ones taken, where newer ones came.
STALE = 500_000_000
OWN_FUTURE = 'own odometry from the future'
#: A teller silent for so long, ns, is forgotten.
FORGOTTEN = 30 * NANOSECONDS
#: Vehicles that one may see, or tell of.
SEEN_MAX = 40
#: Variance of the yaw that an odometry tells of itself, rad^2.
OWN_YAW = 0.02 ** 2
#: Where somebody tells of itself, another's word of it has to be so much surer to be preferred.
OWN_WORD = 0.5
#: Own words that may still come back, and events nobody has asked for.
REMEMBERED, EVENTS = 500, 500


class Sharing:
    """
    Messages of one follower to others, and theirs to it; times are ns.

    :param name: of this vehicle, unique in the flock.
    :raises ValueError: see ``checked_name``.

    What is not used is told by :meth:`told`, as (reason, detail).
    """

    def __init__(self, name: str) -> None:
        self.name = checked_name(name)
        self._own: OdometryState | None = None
        self._seen: dict[str, OdometryState] = {}
        self._relations = FrameRelations(name, self._refuse)
        self._spoke: int | None = None
        self._said: dict[str, int] = {}
        self._echoes: deque[tuple[int, str, bytes]] = deque(maxlen=REMEMBERED)
        self._events: list[tuple[str, str]] = []

    # In.

    def take_own(self, state: OdometryState) -> None:
        """Take one's own state, of any odometry."""
        if problem := malformed(state):
            return self._refuse(f'own odometry {problem[0]}', problem[1])
        before = self._own
        if before is not None:
            back = before.stamp - state.stamp
            if 0 <= back <= STALE:
                return None  # repeated, or out of order
            leap = 'in time' if back > 0 else leapt(before, state)
            if before.frame != state.frame:
                leap = f'from frame {before.frame!r} to {state.frame!r}'
            if leap:
                self._refuse('own odometry leapt', f'{leap}: all frames are aligned anew')
                self._seen.clear()
                self._relations.forget_all(tellers=back > 0)
        self._own = state
        self._relations.own_position = state.position
        self._relations.add(self.name, self.name, moment(
            state, position_covariance(state, True), OWN_YAW))
        return None

    def take_seen(self, state: OdometryState) -> None:
        """Take an own sighting of another vehicle, as on ``neighbors``."""
        own, name = self._own, state.child
        if DUPLICATE in name:
            return None  # a print is no vehicle
        if own is None:
            return self._refuse('sighting before own odometry', name)
        problem = malformed(state)
        if problem or name == self.name or state.frame != own.frame:
            return self._refuse('unusable sighting', problem[1] if problem else (
                f'{name!r} in frame {state.frame!r}, own odometry in {own.frame!r}'))
        before = self._seen.get(name)
        if before is not None and 0 <= before.stamp - state.stamp <= STALE:
            return None
        if before is None and len(self._seen) >= SEEN_MAX:
            return self._refuse('too many vehicles', name)
        if not is_covariance(state.pose_covariance[:3, :3]):
            return self._refuse('sighting without a covariance', name)
        doubt = float(position_covariance(state, False).trace())
        if doubt > POSITION_STD_MAX ** 2:  # known by its ranges alone, for a while
            return self._refuse('known too vaguely', f'{name}: to {math.sqrt(doubt):.2f} m')
        self._seen[name] = state
        self._relations.relate(self.name, name, self._sighting(state))
        return None

    def take_word(self, state: OdometryState, received: int) -> None:
        """Take what somebody told: a vehicle's state in the teller's frame ``NAME/odom``."""
        name = teller_of(state.frame)
        if not name:
            return self._refuse('frame of a word is not unique', f'{state.frame[:70]!r}: must be '
                                f'NAME{FRAME}, NAME being the vehicle that tells')
        if name == self.name:
            if _key(state) not in self._echoes:  # else one's own, come back
                self._refuse('somebody uses my name', f'{name} tells of {state.child[:70]!r}')
            return None
        tellers = self._relations.tellers
        teller = tellers.get(name)
        if refusal := untold(state, received):
            if refusal[0] == FUTURE and teller is not None:
                teller.ban(received, 'has a clock that is ahead')
            return self._refuse(*refusal)
        if teller is None:
            if len(tellers) >= TELLERS_MAX:
                return self._refuse('too many tellers', name)
            teller = tellers[name] = TalkingVehicle(name)
        teller.heard = received
        if why := teller.banned(received):
            return self._refuse('not listened to for a while', f'{name} {why}')
        return self._take_from(teller, state, received)

    def _take_from(self, teller: TalkingVehicle, state: OdometryState, received: int) -> None:
        """Take a word of a teller, sound in itself."""
        own, before = state.child == teller.name, teller.states.get(state.child)
        if before is not None and state.stamp <= before.stamp:
            return self._refuse('word out of order', f'{teller.name} tells of {state.child}')
        if before is None and len(teller.states) >= SEEN_MAX:
            return self._refuse('too many vehicles', f'{teller.name} tells of {state.child}')
        leap = '' if before is None else leapt(before, state)
        if own:
            if leap:
                teller.leapt_at(received)
                self._relations.align_anew(teller, f'its odometry leapt {leap}')
            teller.spoke_at(state.stamp, received)
            self._relations.anchor(teller.name, state.position)
        teller.ages.append((received - state.stamp) / NANOSECONDS)
        teller.states[state.child] = state
        fits = self._relations.relate(teller.name, state.child, moment(
            state, position_covariance(state, True), OWN_YAW
        ) if own else self._sighting(state))
        if leap or not fits:
            teller.doubted.add(state.child)
        else:
            teller.doubted.discard(state.child)
        if why := self._relations.unusable(teller):
            self._refuse(f'not aligned with {teller.name}', why)
        return None

    # Out.

    def words(self, now: int) -> list[OdometryState]:
        """Return what to tell: one's own state and whom one sees, each once, at 10 Hz at most."""
        own, name = self._own, self.name
        if own is None or now - own.stamp > STALE or (
                self._spoke is not None and 0 <= now - self._spoke < PERIOD):
            return []
        self._spoke = now
        if own.stamp - now > STALE:
            self._refuse(OWN_FUTURE, f'by {(own.stamp - now) / NANOSECONDS:.3g} s')
            return []
        words = [state._replace(frame=name + FRAME)
                 for state in (own._replace(child=name), *self._seen.values())
                 if abs(now - state.stamp) <= STALE and state.stamp != self._said.get(state.child)]
        for word in words:
            self._said[word.child] = word.stamp
            self._echoes.append(_key(word))
        return words

    def neighbors(self, now: int) -> list[OdometryState]:
        """
        Return whom one was told of and does not see, in one's own frame, one per vehicle.

        Each has the stamp at which it was so; its covariances are those of what becomes of it by
        ``now``. Of several words of one vehicle the surest is taken: they may share errors.
        """
        own, relations = self._own, self._relations
        for teller in list(relations.tellers.values()):
            if now - teller.heard > FORGOTTEN:
                relations.forget(teller)
        if own is None or now - own.stamp > to_nanoseconds(WORD_AGE_MAX):
            return []
        relations.frames.drift(now, own.position)
        surest: dict[str, tuple[float, TalkingVehicle]] = {}
        for teller in relations.tellers.values():
            if teller.banned(now) or relations.unusable(teller):
                continue
            for state in teller.states.values():
                age = (now - state.stamp) / NANOSECONDS
                if (state.child == self.name or state.child in teller.doubted
                        or age > WORD_AGE_MAX or self._sees(state.child, now)):
                    continue
                by_itself = state.child == teller.name
                doubt = relations.frames.variance(teller.name, state.position) + float(
                    position_covariance(state, by_itself).trace())
                if doubt > POSITION_STD_MAX ** 2:
                    self._refuse('heard of too vaguely',
                                 f'{state.child} by {teller.name}: to {math.sqrt(doubt):.2f} m')
                    continue
                doubt = (doubt + 0.75 * (ACCELERATION_STD * age ** 2) ** 2) * (
                    OWN_WORD if by_itself else 1.0)
                if state.child not in surest or doubt < surest[state.child][0]:
                    surest[state.child] = doubt, teller
        return [aged(in_own_frame(teller.states[name], teller.name, own.frame,
                                  relations.frames), now)
                for name, (_, teller) in surest.items()]

    def told(self) -> list[tuple[str, str]]:
        """Return what was not used since this was asked last, and why."""
        events, self._events = self._events, []
        return events

    def status(self, now: int) -> list[TellerStatus]:
        """Return how it stands with everybody who talks."""
        relations = self._relations
        return [TellerStatus(
            t.name, t.banned(now) or relations.unusable(t), *relations.stds(t.name),
            (now - t.heard) / NANOSECONDS, t.slow) for t in relations.tellers.values()]

    def why_silent(self, now: int) -> str:
        """Return why nothing that others tell can be used, or ''."""
        if self._own is None or now - self._own.stamp > STALE:
            return 'no own odometry'
        if self._own.stamp - now > STALE:
            return OWN_FUTURE
        talking = [s for s in self.status(now) if s.silent <= WORD_AGE_MAX]
        if not talking:
            return 'nobody else talks'
        return '' if any(not s.why for s in talking) else '; '.join(
            f'not aligned with {s.name}: {s.why}' for s in talking)

    def _sees(self, name: str, now: int) -> bool:
        seen = self._seen.get(name)
        return seen is not None and now - seen.stamp <= to_nanoseconds(SEEN_TIMEOUT)

    def _sighting(self, state: OdometryState) -> Moment:
        variance = float(state.pose_covariance[5, 5])
        known = 0.0 < variance < 1.0  # beyond a radian, or without covariance, it says nothing
        return moment(state, position_covariance(state, False),
                      variance + ATTITUDE_NOISE ** 2 if known else float('inf'))

    def _refuse(self, reason: str, detail: str) -> None:
        if len(self._events) < EVENTS:
            self._events.append((reason, detail))


def _key(word: OdometryState) -> tuple[int, str, bytes]:
    """Return what no two words have in common."""
    return word.stamp, word.child, word.position.tobytes()
