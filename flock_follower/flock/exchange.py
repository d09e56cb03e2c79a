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
Messages between followers: sends the own state and detections, transforms received states.

Each follower sends its own state and the vehicles that it sees, in its own odometry frame, and
never what it received. Received states are transformed into the own frame once the sender's frame
is aligned; until then they are kept, and not used.

Two frames are related by a vehicle known in both at one time: the sender seen by this vehicle,
this vehicle seen by the sender, or any vehicle that both see or that sends its own state. The
relations of an unknown frame are collected until a first fit succeeds; later each updates the
filter (``alignment``), and one that does not fit is refused. If the relations of a
sender repeatedly do not fit, its frame has changed and is aligned again.
"""

from __future__ import annotations

from collections import defaultdict, deque
import math

from flock_follower.flock.alignment import FrameAlignment, in_own_frame, PairedFrames
from flock_follower.flock.peers import (
    ACCELERATION_STD,
    aged,
    checked_name,
    DOUBTED,
    FRAME,
    FUTURE,
    is_covariance,
    leapt,
    MESSAGE_AGE_MAX,
    position_covariance,
    POSITION_STD_MAX,
    refusal,
    SEEN_TIMEOUT,
    Sender,
    sender_of,
    SENDERS_MAX,
    SenderStatus,
    TOO_FAST,
    too_fast,
    Track,
    track_point,
    TrackPoint,
    WRONG,
    YAW_STD_MAX,
)
from flock_follower.messages import DUPLICATE, NANOSECONDS, OdometryState, to_nanoseconds

#: Between two rounds of messages, ns; a little less than 0.1 s, as timers jitter.
PERIOD = 90_000_000
#: Own states and sightings older than this, ns, or as far in the future, are not sent; nor are
#: older ones used after newer ones.
STALE = 500_000_000
OWN_FUTURE = 'own odometry from the future'
#: A sender silent for so long, ns, is forgotten.
FORGOTTEN = 30 * NANOSECONDS
#: Vehicles that one vehicle may see, or report.
SEEN_MAX = 40
#: A state that a vehicle sent of itself is replaced only by one with this share of its variance.
OWN_STATE_SHARE = 0.5
#: Own messages that may come back, and events that wait to be read.
REMEMBERED, EVENTS = 500, 500
#: One vehicle relates two frames once in this time, ns: errors of sightings last.
RELATING = 200_000_000


class Sharing:
    """
    Messages of one follower to others, and theirs to it; times are ns.

    :param name: of this vehicle, unique in the flock.
    :raises ValueError: see ``checked_name``.

    Refused inputs are reported by :meth:`new_events`, as (reason, detail).
    """

    def __init__(self, name: str) -> None:
        self.name = checked_name(name)
        self.frames = FrameAlignment(name)
        self.senders: dict[str, Sender] = {}
        self._own: OdometryState | None = None
        self._seen: dict[str, OdometryState] = {}
        # By frame and vehicle.
        self._tracks: dict[str, dict[str, Track]] = defaultdict(lambda: defaultdict(Track))
        self._pairs: dict[tuple[str, str], PairedFrames] = {}
        self._related: dict[tuple[str, str, str], int] = {}
        self._last_round: int | None = None
        self._sent: dict[str, int] = {}
        self._echoes: deque[tuple[int, str, bytes]] = deque(maxlen=REMEMBERED)
        self._events: list[tuple[str, str]] = []

    # In.

    def take_own(self, state: OdometryState) -> None:
        """Take the own state, of any odometry."""
        fast, before = too_fast(state), self._own
        if self._refused((fast, f'own odometry {TOO_FAST}', fast)):
            return
        if before is not None:
            back = before.stamp - state.stamp
            if 0 <= back <= STALE:
                return  # repeated, or out of order
            leap = 'in time' if back > 0 else leapt(before, state)
            if before.frame != state.frame:
                leap = f'from frame {before.frame!r} to {state.frame!r}'
            if self._refused((leap, 'own odometry leapt', f'{leap}: all frames are aligned anew')):
                self._align_all_anew(forget_senders=back > 0)
        self._own = state
        self._tracks[self.name][self.name].add(track_point(state, True))

    def take_seen(self, state: OdometryState) -> None:
        """Take an own sighting of another vehicle, as on ``neighbors``."""
        name, before, fast = state.child, self._seen.get(state.child), too_fast(state)
        frame = None if self._own is None else self._own.frame
        # A second print of a marker is no vehicle.
        if DUPLICATE in name or self._refused(
                (frame is None, 'sighting before own odometry', name),
                (fast, 'unusable sighting', fast),
                (name == self.name or state.frame != frame, 'unusable sighting',
                 f'{name!r} in frame {state.frame!r}, own odometry in {frame!r}')):
            return
        doubt = float(position_covariance(state, False).trace())
        if (before is not None and 0 <= before.stamp - state.stamp <= STALE) or self._refused(
                (before is None and len(self._seen) >= SEEN_MAX, 'too many vehicles', name),
                (not is_covariance(state.pose_covariance[:3, :3]), 'sighting without a covariance',
                 name),
                # It is known by its ranges alone, for a while.
                (doubt > POSITION_STD_MAX ** 2, 'known too vaguely',
                 f'{name}: to {math.sqrt(max(doubt, 0.0)):.2f} m')):
            return
        self._seen[name] = state
        self._relate(self.name, name, track_point(state, False))

    def take_message(self, state: OdometryState, received: int) -> None:
        """Take a received message: a vehicle's state in the sender's frame ``NAME/odom``."""
        name = sender_of(state.frame)
        known = name in self.senders
        # An own message may come back.
        if self._refused(
                (not name, 'frame of a message is not unique', f'{state.frame[:70]!r}: must be '
                 f'NAME{FRAME}, where NAME is the sending vehicle'),
                (name == self.name and _key(state) not in self._echoes,
                 'another vehicle uses this name', f'{name} sends {state.child[:70]!r}')) or (
                     name == self.name):
            return
        if refused := refusal(state, received):
            if refused[0] == FUTURE and known:
                self.senders[name].ban(received, 'has a clock that is ahead')
            self._refuse(*refused)
            return
        if self._refused((not known and len(self.senders) >= SENDERS_MAX, 'too many senders',
                          name)):
            return
        sender = self.senders.setdefault(name, Sender(name))
        sender.received = received
        why = sender.banned(received)
        if not self._refused((why, 'ignored for a while', f'{name} {why}')):
            self._take_from(sender, state, received)

    def _take_from(self, sender: Sender, state: OdometryState, received: int) -> None:
        """Take a valid message of a sender."""
        of_itself, before = state.child == sender.name, sender.states.get(state.child)
        what = f'{sender.name} sends {state.child}'
        if self._refused(
                (before is not None and state.stamp <= before.stamp, 'message out of order', what),
                (before is None and len(sender.states) >= SEEN_MAX, 'too many vehicles', what)):
            return
        leap = '' if before is None else leapt(before, state)
        if of_itself:
            if leap:
                sender.leapt_at(received)
                self._align_anew(sender, f'its odometry leapt {leap}')
            sender.sent_at(state.stamp, received)
            self.frames.set_anchor(sender.name, state.position)
        sender.ages.append((received - state.stamp) / NANOSECONDS)
        sender.states[state.child] = state
        fits = self._relate(sender.name, state.child, track_point(state, of_itself))
        if leap or not fits:
            sender.doubted.add(state.child)
        else:
            sender.doubted.discard(state.child)
        why = self.unusable(sender)
        self._refused((why, f'not aligned with {sender.name}', why))

    # Relations between frames.

    def unusable(self, sender: Sender) -> str:
        """Return why a sender's messages are not used, or ''."""
        if sender.name not in self.frames:
            paired = [pairs.yaw_std for names, pairs in self._pairs.items()
                      if sender.name in names]
            return ('neither sees the other, nor do both see one vehicle' if not paired else
                    f'its yaw is known to {min(paired):.1f} rad: somebody has to move')
        if sender.refused >= DOUBTED:
            return f'{sender.refused} times in a row it did not fit'
        place, yaw = self.frames.stds(sender.name)
        if place <= POSITION_STD_MAX and yaw <= YAW_STD_MAX:
            return ''
        return (f'its frame is known to {place:.2f} m and {yaw:.2f} rad, limits '
                f'{POSITION_STD_MAX:g} m and {YAW_STD_MAX:g} rad')

    def _relate(self, frame: str, vehicle: str, point: TrackPoint) -> bool:
        """Remember a vehicle in a frame, relate that to another; return whether that fits."""
        self._tracks[frame][vehicle].add(point)
        other = self._other_frame(frame, vehicle, point.stamp)
        if other is None or self._own is None:
            return True
        one, two = sorted((frame, other[0]))
        last = self._related.get((one, two, vehicle))
        if last is not None and abs(point.stamp - last) < RELATING:
            return True
        self._related[one, two, vehicle] = point.stamp
        self.frames.drift(point.stamp, self._own.position)
        if one not in self.frames or two not in self.frames:
            self._begin((frame, point), other)
            return True
        doubt = self.frames.relate((frame, point), other)
        if doubt <= 1.0:
            for known in {one, two} & self.senders.keys():
                self.senders[known].refused = 0
            return True
        blamed = self.senders.get(frame) or self.senders[other[0]]
        blamed.refused += 1
        self._refuse('does not fit the alignment', f'{blamed.name}: {doubt:.1f} times the gate')
        if blamed.refused >= WRONG:
            self._align_anew(blamed, f'{WRONG} times in a row it did not fit')
        return False

    def _other_frame(self, frame: str, vehicle: str, stamp: int) -> tuple[str, TrackPoint] | None:
        """
        Return the best other frame in which a vehicle is known at a stamp, and its track point.

        The own frame is best, then the vehicle's, then the most certain; only one counts.
        """
        names = [name for name in (self.name, *self.senders)
                 if name != frame and vehicle in self._tracks[name]]
        for name in sorted(names, key=lambda name: (
                name != self.name, name != vehicle or name not in self.frames,
                self.frames.stds(name)[0])):
            point = self._tracks[name][vehicle].at(stamp)
            if point is not None:
                return name, point
        return None

    def _begin(self, first: tuple[str, TrackPoint], second: tuple[str, TrackPoint]) -> None:
        """Collect a relation of an unknown frame, and start its estimate if that is possible."""
        (one, there), (two, here) = sorted((first, second), key=lambda end: end[0])
        pairs = self._pairs.setdefault((one, two), PairedFrames())
        pairs.add(there, here)
        reference, fresh = (one, two) if one in self.frames else (two, one)
        if reference not in self.frames:
            return
        fit = pairs.first_fit(swapped=reference == two)
        if fit is None:
            return
        self.frames.start(fresh, *fit, reference)
        state = self.senders[fresh].states.get(fresh)
        if state is not None:
            self.frames.set_anchor(fresh, state.position)
        del self._pairs[one, two]

    def _align_anew(self, sender: Sender, why: str) -> None:
        """Forget a sender's frame, and the states received in it."""
        self._refuse(f'aligned anew with {sender.name}', why)
        self._forget_frame(sender.name)
        sender.states.clear()
        sender.doubted.clear()
        sender.refused = 0

    def _forget_frame(self, name: str) -> None:
        self.frames.drop(name)
        self._tracks.pop(name, None)
        self._pairs = {names: each for names, each in self._pairs.items() if name not in names}
        self._related = {key: each for key, each in self._related.items() if name not in key[:2]}

    def _align_all_anew(self, forget_senders: bool) -> None:
        """Reset after a change of the own frame; ``forget_senders``: after a jump of time, too."""
        self.frames = FrameAlignment(self.name)
        self._seen.clear()
        self._pairs.clear()
        self._related.clear()
        self._tracks.pop(self.name, None)
        for sender in self.senders.values():
            sender.refused = 0
        if forget_senders:
            self._tracks.clear()
            self.senders.clear()

    # Out.

    def messages(self, now: int) -> list[OdometryState]:
        """Return the messages to send: the own state and sightings, each once, at most 10 Hz."""
        own, name = self._own, self.name
        if own is None or now - own.stamp > STALE or (
                self._last_round is not None and 0 <= now - self._last_round < PERIOD):
            return []
        self._last_round = now
        if own.stamp - now > STALE:
            self._refuse(OWN_FUTURE, f'by {(own.stamp - now) / NANOSECONDS:.3g} s')
            return []
        messages = [state._replace(frame=name + FRAME)
                 for state in (own._replace(child=name), *self._seen.values())
                 if abs(now - state.stamp) <= STALE and state.stamp != self._sent.get(state.child)]
        for message in messages:
            self._sent[message.child] = message.stamp
            self._echoes.append(_key(message))
        return messages

    def neighbors(self, now: int) -> list[OdometryState]:
        """
        Return the received vehicles that are not seen, in the own frame, one state per vehicle.

        Each has the stamp of its state; the covariances are those of its prediction to ``now``. If
        several states of one vehicle are known, the most certain one is used: their errors may be
        correlated.
        """
        for sender in list(self.senders.values()):
            if now - sender.received > FORGOTTEN:
                self._forget_frame(sender.name)
                del self.senders[sender.name]
        own = self._own
        if own is None or now - own.stamp > to_nanoseconds(MESSAGE_AGE_MAX):
            return []
        self.frames.drift(now, own.position)
        surest: dict[str, tuple[float, Sender]] = {}
        for sender in self.senders.values():
            if sender.banned(now) or self.unusable(sender):
                continue
            for state in sender.states.values():
                age, seen = (now - state.stamp) / NANOSECONDS, self._seen.get(state.child)
                if (state.child == self.name or state.child in sender.doubted
                        or age > MESSAGE_AGE_MAX or (seen is not None and (
                            now - seen.stamp <= to_nanoseconds(SEEN_TIMEOUT)))):
                    continue
                of_itself = state.child == sender.name
                doubt = float((self.frames.located(sender.name, state.position)[1]
                               + position_covariance(state, of_itself)).trace())
                if doubt > POSITION_STD_MAX ** 2:
                    self._refuse('heard of too vaguely',
                                 f'{state.child} by {sender.name}: to {math.sqrt(doubt):.2f} m')
                    continue
                doubt = (doubt + 0.75 * (ACCELERATION_STD * age ** 2) ** 2) * (
                    OWN_STATE_SHARE if of_itself else 1.0)
                if state.child not in surest or doubt < surest[state.child][0]:
                    surest[state.child] = doubt, sender
        return [aged(in_own_frame(sender.states[name], sender.name, own.frame, self.frames), now)
                for name, (_, sender) in surest.items()]

    def new_events(self) -> list[tuple[str, str]]:
        """Return the refusals since the last call."""
        events, self._events = self._events, []
        return events

    def status(self, now: int) -> list[SenderStatus]:
        """Return the status of every sender."""
        return [SenderStatus(
            s.name, s.banned(now) or self.unusable(s), *self.frames.stds(s.name),
            (now - s.received) / NANOSECONDS, s.slow) for s in self.senders.values()]

    def why_silent(self, now: int) -> str:
        """Return why no received message can be used, or ''."""
        if self._own is None or now - self._own.stamp > STALE:
            return 'no own odometry'
        if self._own.stamp - now > STALE:
            return OWN_FUTURE
        active = [s for s in self.status(now) if s.silent <= MESSAGE_AGE_MAX]
        if not active:
            return 'no other sender'
        return '' if any(not s.why for s in active) else '; '.join(
            f'not aligned with {s.name}: {s.why}' for s in active)

    def _refused(self, *cases: tuple[object, str, str]) -> bool:
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
        if len(self._events) < EVENTS:
            self._events.append((reason, detail))


def _key(message: OdometryState) -> tuple[int, str, bytes]:
    """Return what identifies a message."""
    return message.stamp, message.child, message.position.tobytes()
