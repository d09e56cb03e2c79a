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

"""The messages sent, the refusals and their reasons; no message can break a receiver."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_flock import Conditions, EPOCH, LEADER, MadeUpFlock
import numpy as np
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.flock.alignment import Frame
from flock_follower.flock.exchange import Sharing
from flock_follower.flock.sender import Sender
from flock_follower.geometry import quaternion_from_yaw
from flock_follower.messages import OdometryState
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import odometry

MS = 1_000_000


def state(frame: str = 'f2/odom', child: str = 'f2', stamp: int = EPOCH, position: Any = (0, 0, 1),
          variance: float = 0.01, velocity: Any = (0, 0, 0), yaw: float = 0.0) -> OdometryState:
    covariance = variance * np.eye(6)
    return OdometryState(
        stamp, frame, child, np.array(position, dtype=float), quaternion_from_yaw(yaw),
        np.array(velocity, dtype=float), np.zeros(3), covariance, covariance, np.eye(3))


def own(stamp: int = EPOCH, position: Any = (0, 0, 1)) -> OdometryState:
    return state('odom', 'base_link', stamp, position)


def listening() -> Sharing:
    sharing = Sharing('f1')
    sharing.take_own(own())
    return sharing


def reasons(sharing: Sharing) -> list[str]:
    return [reason for reason, _ in sharing.new_events()]


@pytest.mark.parametrize('name', ['', ' ', 'a/b', 'a' * 65, 'a b', 'ä'])
def test_a_vehicle_without_a_proper_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match='vehicle_name'):
        Sharing(name)


def test_own_state_and_sightings_are_sent_once_in_own_frame() -> None:
    sharing = listening()
    sharing.take_seen(state('odom', LEADER))
    messages = sharing.messages(EPOCH + 10 * MS)
    assert [(w.frame, w.child) for w in messages] == [('f1/odom', 'f1'), ('f1/odom', LEADER)]
    assert sharing.messages(EPOCH + 20 * MS) == []  # 10 Hz
    assert sharing.messages(EPOCH + 120 * MS) == []  # nothing new
    sharing.take_own(own(EPOCH + 100 * MS))
    assert [w.child for w in sharing.messages(EPOCH + 220 * MS)] == ['f1']
    assert sharing.messages(EPOCH + 900 * MS) == []  # odometry is lost


def test_a_second_print_of_a_marker_is_not_told() -> None:
    sharing = listening()
    sharing.take_seen(state('odom', f'{LEADER}/duplicate'))
    assert [w.child for w in sharing.messages(EPOCH + 10 * MS)] == ['f1']
    assert sharing.new_events() == []


def test_what_is_stamped_in_the_future_is_not_told() -> None:
    latest = (2**31 - 1) * 10**9 + 2**32 - 1  # what a stamp can hold: no Time has these seconds
    sharing, now = Sharing('f1'), EPOCH
    for stamp in (EPOCH + 800 * MS, latest):
        now += 100 * MS
        sharing.take_own(own(stamp))
        assert sharing.messages(now) == []
        assert reasons(sharing)[-1] == 'own odometry from the future'
        assert sharing.why_silent(now) == 'own odometry from the future'
    for stamp in (EPOCH + 1000 * MS, latest):
        now += 100 * MS
        sharing.take_own(own(now))
        sharing.take_seen(state('odom', LEADER, stamp))
        assert [message.child for message in sharing.messages(now)] == ['f1']


LATER = EPOCH + 10 * MS
NOT_ALIGNED, OUT_OF_ORDER = 'not aligned with f2', 'message out of order'
#: Messages with the times of their reception, and the reasons of their refusal.
REFUSED: dict[str, tuple[list[tuple[OdometryState, int]], list[str]]] = {
    **{f'{reason} {k}': ([(message, received), (state(), LATER)], [reason, NOT_ALIGNED])
       for k, (message, received, reason) in enumerate([
           (state(frame='odom'), EPOCH, 'frame of a message is not unique'),
           (state(frame='/odom'), EPOCH, 'frame of a message is not unique'),
           (state(frame='a/b/odom'), EPOCH, 'frame of a message is not unique'),
           (state(child=''), EPOCH, 'message of an unnamed vehicle'),
           (state(velocity=(0, math.inf, 0)), EPOCH, 'message not finite, or too fast'),
           (state(velocity=(60, 0, 0)), EPOCH, 'message not finite, or too fast'),
           (state(child=LEADER, variance=0.0), EPOCH, 'message without a covariance'),
           (state(child=LEADER, variance=-1.0), EPOCH, 'message without a covariance'),
           (state(child=LEADER, variance=math.nan), EPOCH, 'message without a covariance'),
           (state(), EPOCH - 25 * MS, 'message from the future'),
           (state(), EPOCH + 1100 * MS, 'message too old')])},
    'own messages that come back are no impostors': (
        [(state('f1/odom', 'f1', EPOCH), EPOCH), (state('f1/odom', 'f1', EPOCH + MS), LATER)],
        ['another vehicle uses this name']),
    'repeated or late': ([(state(stamp=stamp), EPOCH + k * MS)
                          for k, stamp in enumerate((EPOCH, EPOCH, EPOCH - MS))],
                         [NOT_ALIGNED, OUT_OF_ORDER, OUT_OF_ORDER]),
    # An image takes a while: the stamps of sightings are right, though the clock is ahead.
    'a clock that is ahead spoils older messages, too, for 5 s': (
        [(state(child=LEADER), EPOCH), (state(stamp=EPOCH + 45 * MS), EPOCH + MS),
         (state(child=LEADER, stamp=EPOCH + MS), LATER),
         (state(stamp=EPOCH + 5100 * MS), EPOCH + 5100 * MS)],
        [NOT_ALIGNED, 'message from the future', 'ignored for a while', NOT_ALIGNED]),
}


@pytest.mark.parametrize(('messages', 'expected'), REFUSED.values(), ids=REFUSED)
def test_an_impossible_message_is_refused_by_its_reason(
        messages: list[tuple[OdometryState, int]], expected: list[str]) -> None:
    sharing = listening()
    sharing.messages(EPOCH)
    for message, received in messages:
        sharing.take_message(message, received)
    assert reasons(sharing) == expected


def test_senders_and_the_vehicles_that_they_report_are_counted() -> None:
    sharing = listening()
    for k in range(40):
        sharing.take_message(state(f'v{k}/odom', f'v{k}'), EPOCH)
    assert reasons(sharing).count('too many senders') == 8
    for k in range(60):
        sharing.take_message(state('v0/odom', f'w{k}'), EPOCH)
    assert reasons(sharing).count('too many vehicles') == 21


def test_two_vehicles_of_one_name_are_not_listened_to() -> None:
    apart, near = listening(), listening()
    for k in range(60):
        now = EPOCH + k * 50 * MS
        apart.take_own(own(now))
        near.take_own(own(now))
        apart.take_message(state(stamp=now, position=(8 * (k % 2), 0, 1)), now)
        near.take_message(state(stamp=now, position=(0.1 * (k % 2), 0, 1)), now)
    assert near.senders['f2'].unusable_reason(now) == 'sends 20 times in 1.4 s'
    assert 'ignored for a while' in reasons(near)
    assert reasons(apart).count('aligned anew with f2') > 10


@pytest.mark.parametrize(('variance', 'usable'), [(1e-3, True), (0.1, False), (math.nan, False)])
def test_a_frame_is_used_if_it_is_known_well_enough(variance: float, usable: bool) -> None:
    frame = Frame(0.0, np.zeros(3), np.zeros(3), variance * np.eye(4), EPOCH)
    reason = Sender('f2', frame=frame).unusable_reason(EPOCH)
    assert reason.startswith('its frame is known') != usable


def test_why_nothing_is_heard_is_told() -> None:
    sharing = Sharing('f1')
    assert sharing.why_silent(EPOCH) == 'no own odometry'
    sharing.take_own(own())
    assert sharing.why_silent(EPOCH) == 'no other sender'
    sharing.take_message(state(), EPOCH)
    assert sharing.why_silent(EPOCH) == (
        'not aligned with f2: neither sees the other, nor do both see one vehicle')
    assert sharing.neighbors(EPOCH) == []


def test_aligned_sender_is_used_and_not_relayed() -> None:
    flock = MadeUpFlock(Conditions('line', attitude_std=0.03))
    sent: dict[str, set[str]] = {}

    def listen(name: str, message: OdometryState) -> list[OdometryState]:
        sent.setdefault(name, set()).add(message.child)
        return [message]
    flock.spoil = listen
    flock.run(4.0)
    assert sent == {f'follower_{k}': {f'follower_{k}', f'follower_{k - 1}' if k > 1 else LEADER}
                    for k in range(1, 5)}
    assert set(flock.received) == {
        (f'follower_{k}', name) for k in range(1, 5) for name in flock.names
        if name not in (f'follower_{k}', f'follower_{k - 1}' if k > 1 else LEADER)}


ANY = st.floats(width=64)
NUMBERS = st.one_of(ANY, st.floats(-3, 3))
TEXTS = st.one_of(st.text(max_size=5), st.sampled_from(
    ['f1/odom', 'f2/odom', 'f3/odom', 'odom', 'f1', 'f2', 'f3', LEADER, '']))
STAMPS = st.one_of(st.integers(0, 2 ** 63), st.integers(EPOCH - 10 ** 9, EPOCH + 10 ** 9))


@st.composite
def garbage(draw: Any) -> OdometryState | None:
    vectors = [draw(st.lists(NUMBERS, min_size=n, max_size=n)) for n in (3, 4, 3, 3)]
    covariances = [np.array(draw(st.lists(NUMBERS, min_size=6, max_size=6))) for _ in range(2)]
    full = draw(st.booleans())
    matrices = [np.outer(c, c) if full else np.diag(c) for c in covariances]
    try:
        message = odometry(empty, 0, draw(TEXTS), draw(TEXTS), *vectors, *matrices)
        return from_odometry(message)._replace(stamp=draw(STAMPS))
    except ValueError:
        return None


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
@settings(max_examples=25)
@given(st.lists(st.tuples(st.sampled_from(['own', 'seen', 'message']), garbage(), STAMPS),
                max_size=12))
def test_no_nonsense_breaks_it_or_comes_out_of_it(events: list[Any]) -> None:
    sharing = listening()
    sharing.take_seen(state('odom', 'f2'))
    for kind, what, now in events:
        if what is None:
            continue
        if kind == 'own':
            sharing.take_own(what)
        elif kind == 'seen':
            sharing.take_seen(what)
        else:
            sharing.take_message(what, now)
        for out in (*sharing.neighbors(now), *sharing.messages(now)):
            assert np.all(np.isfinite(out.position)) and np.all(np.isfinite(out.velocity))
        sharing.why_silent(now)
    sharing.new_events()


def exchanged(order: np.random.Generator | None) -> list[Any]:
    """Return what a flock exchanges if the messages of one time come in some order."""
    flock = MadeUpFlock(Conditions('wedge', 5, attitude_std=0.03, outliers=0.05))
    found: list[Any] = []
    for _ in range(40):
        flock.run(0.1)
        if order is not None:
            flock.wire = [flock.wire[k] for k in order.permutation(len(flock.wire))]
        for name, sharing in flock.sharing.items():
            for state in sharing.neighbors(flock.stamp(flock.time, name)):
                found.append((name, state.child, state.stamp, state.position.tobytes(),
                              state.pose_covariance.tobytes(), state.velocity.tobytes()))
    return found


def test_order_of_simultaneous_messages_changes_no_bit() -> None:
    first = exchanged(None)
    assert len({(name, child) for name, child, *_ in first}) > 6
    assert exchanged(np.random.default_rng(1)) == first
