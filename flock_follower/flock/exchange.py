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
Messages between followers: sends the ego state and sightings, transforms received states.

Each follower sends its own state and the vehicles that it sees, in its own odometry frame, and
never what it received. Received states are transformed into the ego frame once the sender's frame
is aligned; until then they are not used.

A relation between a sender's frame and the ego frame is a vehicle that is known in both frames at
one time: the sender seen by this vehicle, this vehicle seen by the sender, or a vehicle that both
see. If there is none, a vehicle that another aligned sender reports is the relation. Relations
never form a circle: a sender that is related through n other senders helps to relate only senders
that need more than n.

Relations are collected until a first fit succeeds. Later each relation updates the filter
(``alignment``), and a relation that does not fit is refused. If the relations of a sender
repeatedly do not fit, its frame has changed, and is aligned again.
"""

from __future__ import annotations

from collections import defaultdict, deque
import math

from flock_follower.flock.alignment import first_fit, in_own_frame, MIN_PAIRS, PAIR_AGE_MAX
from flock_follower.flock.peers import (
    ACCELERATION_STD,
    age_covariances,
    checked_name,
    FRAME,
    FROM_FUTURE,
    in_order,
    is_covariance,
    leapt,
    MESSAGE_AGE_MAX,
    position_covariance,
    rank,
    refusal,
    sender_of,
    too_fast,
    Track,
    track_point,
    TrackPoint,
)
from flock_follower.flock.sender import BAN_TIME, REALIGN_REFUSALS, Sender
from flock_follower.messages import (
    DUPLICATE,
    MAX_JUMP,
    NANOSECONDS,
    OdometryState,
    POSITION_STD_MAX,
    to_nanoseconds,
)

#: Between two rounds of messages, ns; a little less than 0.1 s, as timers jitter.
PERIOD = 90_000_000
#: Own states and sightings older than this, ns, or as far in the future, are not sent.
STALE_AGE = 500_000_000
DISORDER = to_nanoseconds(MAX_JUMP)  # ns by which an older state comes after a newer one
OWN_FUTURE = 'own odometry from the future'
START_YAW = 0.35  # rad: a linear filter needs a first yaw with at most this deviation
SEEN_TIMEOUT = 500_000_000  # ns after a sighting; received states are not used meanwhile
FORGOTTEN = 30 * NANOSECONDS  # ns: a sender silent for so long is forgotten
MAX_SENDERS = 32  # senders
MAX_VEHICLES = 40  # vehicles that one vehicle sees, or reports
#: A state that a vehicle sent of itself is replaced only by one with this share of its variance.
OWN_STATE_SHARE = 0.5
MAX_ECHOES = 100  # own messages that may come back
MAX_EVENTS = 500  # events that wait to be read
#: One vehicle relates two frames once in this time, ns: errors of sightings are correlated.
RELATING = 200_000_000


class Sharing:
    """
    The messages that one follower sends to other followers, and receives; times are ns.

    :param name: of this vehicle, unique in the flock.
    :raises ValueError: see ``checked_name``.

    Refused inputs are reported by :meth:`new_events`, as (reason, detail).
    """

    def __init__(self, name: str) -> None:
        self.name = checked_name(name)
        self._senders: dict[str, Sender] = {}
        self._arrived: list[tuple[OdometryState, int]] = []
        self._own: OdometryState | None = None
        self._seen: dict[str, OdometryState] = {}
        self._tracks: defaultdict[str, Track] = defaultdict(Track)
        self._last_round: int | None = None
        self._sent: dict[str, int] = {}
        self._echoes: deque[tuple[float, ...]] = deque(maxlen=MAX_ECHOES)
        self._events: list[tuple[str, str]] = []

    @property
    def senders(self) -> dict[str, Sender]:
        """Return the senders by their names, after all messages taken so far."""
        self._settle()
        return self._senders

    # In.

    def take_own(self, state: OdometryState) -> None:
        """Take the ego state, of any odometry."""
        self._settle()
        fast, before = too_fast(state), self._own
        if self._refuse_first((fast, 'own odometry not finite, or too fast', fast)):
            return
        if before is not None:
            back = before.stamp - state.stamp
            if 0 <= back <= DISORDER:
                return  # repeated, or out of order
            leap = 'in time' if back > 0 else leapt(before, state)
            if before.frame != state.frame:
                leap = f'from frame {before.frame!r} to {state.frame!r}'
            if self._refuse_first(
                    (leap, 'own odometry leapt', f'{leap}: all frames are aligned anew')):
                self._seen.clear()
                self._tracks.clear()
                self._senders.clear()
        self._own = state
        self._tracks[self.name].add(track_point(state, True))

    def take_seen(self, state: OdometryState) -> None:
        """Take a sighting of another vehicle by this one, as on ``neighbors``."""
        self._settle()
        name, before, fast = state.child, self._seen.get(state.child), too_fast(state)
        frame = None if self._own is None else self._own.frame
        doubt = float(position_covariance(state, False).trace())
        # A duplicate of a marker is not a vehicle.
        if DUPLICATE in name or self._refuse_first(
                (frame is None, 'sighting before own odometry', name),
                (fast, 'unusable sighting', fast),
                (name == self.name or state.frame != frame, 'unusable sighting',
                 f'{name!r} in frame {state.frame!r}, own odometry in {frame!r}')) or (
                     before is not None and 0 <= before.stamp - state.stamp <= DISORDER):
            return
        if self._refuse_first(
                (before is None and len(self._seen) >= MAX_VEHICLES, 'too many vehicles', name),
                (not is_covariance(state.pose_covariance[:3, :3]), 'sighting without a covariance',
                 name),
                # For a while only ranges to it are measured.
                (doubt > POSITION_STD_MAX ** 2, 'sighting too uncertain',
                 f'{name}: {math.sqrt(max(doubt, 0.0)):.2f} m')):
            return
        self._seen[name], point = state, track_point(state, False)
        self._tracks[name].add(point)
        self._relate_seen(name, point, 1)

    def take_message(self, state: OdometryState, received: int) -> None:
        """
        Take a received message: a vehicle's state in the sender's frame ``NAME/odom``.

        The order in which simultaneous messages are received has no influence.
        """
        if self._arrived and received != self._arrived[0][1]:
            self._settle()
        self._arrived.append((state, received))

    def _settle(self) -> None:
        """Process the messages that arrived at one time, each sender's own states first."""
        arrived, self._arrived = self._arrived, []
        if len(arrived) > 1:
            arrived.sort(key=lambda message: rank(message[0]))
        for message in arrived:
            self._process(*message)

    def _process(self, state: OdometryState, received: int) -> None:
        name = sender_of(state.frame)
        sender = self._senders.get(name)
        # The network may return a message of this vehicle.
        if self._refuse_first(
                (not name, 'frame of a message is not unique', f'{state.frame[:70]!r}: must be '
                 f'NAME{FRAME}, where NAME is the sending vehicle'),
                (name == self.name and (state.stamp, *state.position) not in self._echoes,
                 'another vehicle uses this name', f'{name} sends {state.child[:70]!r}')) or (
                     name == self.name):
            return
        if refused := refusal(state, received):
            if refused[0] == FROM_FUTURE and sender is not None:
                sender.ban = received + BAN_TIME, 'has a clock that is ahead'
            self._refuse(*refused)
        elif not self._refuse_first((sender is None and len(self._senders) >= MAX_SENDERS,
                                     'too many senders', name)):
            sender = self._senders.setdefault(name, Sender(name))
            sender.received = received
            if not self._refuse_first((received < sender.ban[0], 'ignored for a while',
                                       f'{name} {sender.ban[1]}')):
                self._take_from(sender, state, received)

    def _take_from(self, sender: Sender, state: OdometryState, received: int) -> None:
        """Take a valid message of a sender."""
        vehicle, of_itself = state.child, state.child == sender.name
        before, what = sender.states.get(vehicle), f'{sender.name} sends {vehicle}'
        if self._refuse_first(
                (before is not None and state.stamp <= before.stamp, 'message out of order', what),
                (before is None and len(sender.states) >= MAX_VEHICLES,
                 'too many vehicles', what)):
            return
        leap = '' if before is None else leapt(before, state)
        if of_itself:
            if leap:
                sender = self._align_anew(sender, f'its odometry leapt {leap}')
            sender.sent_at(state.stamp, received)
            if sender.frame is not None:
                sender.frame.move_anchor(state.position)
        if sender.vague and state.stamp - max(sender.related.values(), default=0) > PAIR_AGE_MAX:
            sender.hops = math.inf  # the best relation has ended: any other may follow
        sender.ages.append((received - state.stamp) / NANOSECONDS)
        point = track_point(state, of_itself)
        sender.tracks[vehicle].add(point)
        fits = self._relate(
            sender, vehicle, point, *self._relating_point(vehicle, state.stamp, sender))
        if sender.frame is not None and not of_itself:
            self._relate_seen(vehicle, sender.frame.point(point), sender.hops + 1)
        sender.states[vehicle] = state
        if not fits or (leap and not of_itself):
            del sender.states[vehicle]  # the next state decides
        why = sender.unusable_reason(received)
        self._refuse_first((why, f'not aligned with {sender.name}', why))

    # Relations between frames.

    def _relating_point(self, vehicle: str, stamp: int, of: Sender
                        ) -> tuple[TrackPoint | None, float]:
        """
        Return a vehicle at a stamp in the ego frame, and the hops of a relation by this vehicle.

        :param of: the sender to relate.
        """
        point = self._tracks[vehicle].point_at(stamp) if vehicle in self._tracks else None
        if point is not None:
            return point, 1
        for sender in sorted(self._senders.values(),
                             key=lambda s: (s.hops, s.name != vehicle, s.name)):
            if sender.hops >= of.hops or sender.frame is None or sender.vague or (
                    vehicle not in sender.tracks):
                continue
            point = sender.tracks[vehicle].point_at(stamp)
            if point is not None:
                return sender.frame.point(point), sender.hops + 1
        return None, math.inf

    def _relate_seen(self, name: str, ours: TrackPoint, hops: float) -> None:
        """Relate the frame of a vehicle in view; its own states are newer than the image."""
        if sender := self._senders.get(name):
            self._relate(sender, name, sender.tracks[name].point_at(ours.stamp), ours, hops)

    def _relate(self, sender: Sender, vehicle: str, theirs: TrackPoint | None,
                ours: TrackPoint | None, hops: float) -> bool:
        """Relate a sender's frame by a vehicle known in both frames; return whether it fits."""
        own, last = self._own, sender.related.get(vehicle)
        if theirs is None or ours is None or own is None or hops > sender.hops or (
                last is not None and abs(theirs.stamp - last) < RELATING):
            return True
        sender.related[vehicle] = theirs.stamp
        if sender.frame is None or hops < sender.hops:
            self._begin(sender, theirs, ours, hops)
            return True
        sender.frame.drift(theirs.stamp, own.position)
        doubt = sender.frame.relate(theirs, ours)
        if doubt <= 1.0:
            sender.refused = 0
            return True
        sender.refused += 1
        self._refuse('does not fit the alignment', f'{sender.name}: {doubt:.1f} times the gate')
        if sender.refused >= REALIGN_REFUSALS:
            self._align_anew(sender, f'{REALIGN_REFUSALS} times in a row it did not fit')
        return False

    def _begin(self, sender: Sender, theirs: TrackPoint, ours: TrackPoint, hops: float) -> None:
        """Collect a relation, and start the estimate of the frame if that is possible."""
        pairs = sender.pairs
        while pairs and theirs.stamp - pairs[0][0].stamp > PAIR_AGE_MAX:
            pairs.popleft()
        pairs.append((theirs, ours))
        if len(pairs) < MIN_PAIRS:
            return
        frame = first_fit(pairs)
        if frame is None:
            if len(pairs) > 4 * MIN_PAIRS:  # the older ones may be wrong
                for _ in range(len(pairs) // 2):
                    pairs.popleft()
            return
        sender.yaw_std = frame.stds[1]
        if sender.yaw_std <= START_YAW:
            sender.frame, sender.hops, sender.refused = frame, hops, 0
            pairs.clear()
            if state := sender.states.get(sender.name):
                frame.move_anchor(state.position)

    def _align_anew(self, sender: Sender, why: str) -> Sender:
        """Return a sender without its frame and the states received in it."""
        self._refuse(f'aligned anew with {sender.name}', why)
        anew = Sender(sender.name, received=sender.received, ages=sender.ages, sent=sender.sent,
                      ban=sender.ban)
        self._senders[sender.name] = anew
        return anew

    # Out.

    def messages(self, now: int) -> list[OdometryState]:
        """Return the messages to send: ego state and sightings, each once, at 10 Hz at most."""
        own, name = self._own, self.name
        if own is None or now - own.stamp > STALE_AGE or (
                self._last_round is not None and 0 <= now - self._last_round < PERIOD):
            return []
        self._last_round = now
        if own.stamp - now > STALE_AGE:
            self._refuse(OWN_FUTURE, f'by {(own.stamp - now) / NANOSECONDS:.3g} s')
            return []
        messages = [state._replace(frame=name + FRAME)
                    for state in (own._replace(child=name), *in_order(self._seen))
                    if abs(now - state.stamp) <= STALE_AGE
                    and state.stamp != self._sent.get(state.child)]
        for message in messages:
            self._sent[message.child] = message.stamp
            self._echoes.append((message.stamp, *message.position))
        return messages

    def neighbors(self, now: int) -> list[OdometryState]:
        """
        Return the received vehicles that are not seen, in the ego frame, one state per vehicle.

        A state keeps its stamp; its covariances are predicted to ``now``. If several states of one
        vehicle are known, the state with the least uncertainty is used, not their mean, because
        their errors may be correlated.
        """
        self._senders = {name: each for name, each in self.senders.items()
                         if now - each.received <= FORGOTTEN}
        own = self._own
        if own is None or now - own.stamp > to_nanoseconds(MESSAGE_AGE_MAX):
            return []
        surest: dict[str, tuple[float, OdometryState]] = {}
        for sender in in_order(self._senders):
            frame = sender.frame
            if frame is not None:
                frame.drift(now, own.position)
            if frame is None or sender.unusable_reason(now):
                continue
            for name, state in sorted(sender.states.items()):
                age, seen = (now - state.stamp) / NANOSECONDS, self._seen.get(name)
                if name == self.name or age > MESSAGE_AGE_MAX or (
                        seen is not None and now - seen.stamp <= SEEN_TIMEOUT):
                    continue
                of_itself = name == sender.name
                placed = in_own_frame(state, of_itself, frame, own.frame)
                doubt = float(placed.pose_covariance[:3, :3].trace())
                if self._refuse_first((
                        doubt > POSITION_STD_MAX ** 2, 'received position too uncertain',
                        f'{name} by {sender.name}: {math.sqrt(doubt):.2f} m')):
                    continue
                doubt = (doubt + 0.75 * (ACCELERATION_STD * age ** 2) ** 2) * (
                    OWN_STATE_SHARE if of_itself else 1.0)
                if name not in surest or doubt < surest[name][0]:
                    surest[name] = doubt, placed
        return [age_covariances(state, now) for _, state in in_order(surest)]

    def new_events(self) -> list[tuple[str, str]]:
        """Return the refusals since the last call."""
        self._settle()
        events, self._events = self._events, []
        return events

    def why_silent(self, now: int) -> str:
        """Return why no received message can be used, or ''."""
        if self._own is None or now - self._own.stamp > STALE_AGE:
            return 'no own odometry'
        if self._own.stamp - now > STALE_AGE:
            return OWN_FUTURE
        active = {name: sender.unusable_reason(now)
                  for name, sender in sorted(self.senders.items())
                  if now - sender.received <= to_nanoseconds(MESSAGE_AGE_MAX)}
        if not active:
            return 'no other sender'
        return '; '.join(f'not aligned with {name}: {why}' for name, why in active.items()
                         ) if all(active.values()) else ''

    def _refuse_first(self, *cases: tuple[object, str, str]) -> bool:
        """
        Report the first case that holds; return whether one does.

        :param cases: whether it holds, the reason, and the detail.
        """
        for holds, reason, detail in cases:
            if holds:
                self._refuse(reason, detail)
                return True
        return False

    def _refuse(self, reason: str, detail: str) -> None:
        if len(self._events) < MAX_EVENTS:
            self._events.append((reason, detail))
