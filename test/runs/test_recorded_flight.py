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

"""Perception, planner and gate on the bag's clock: order, timing, and input that stops."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from bag_excerpts import Change, edited, SAMPLE
import numpy as np
import pytest

from flock_desk.runs.evaluation import RecordedFlight
from flock_follower.bags.bag import BagMessage, open_bag
from flock_follower.bags.message_types import empty
from flock_follower.follower import ControlCycle, ImageOutcome, Listener, Tick
from flock_follower.messages import (
    OdometryState,
    stamp_to_nanoseconds,
)
from flock_follower.parameters.files import parse_parameters, TABLE

IMAGE, ODOM, CAMERA = '/image_raw/compressed', '/odom', '/camera_info'
TENTH = 100_000_000  # ns


@dataclass
class Log(Listener):
    """A listener that remembers everything."""

    published: list[tuple[str, int, Any]] = field(default_factory=list)
    states: list[OdometryState] = field(default_factory=list)
    frames: list[ImageOutcome] = field(default_factory=list)
    ticks: list[Tick] = field(default_factory=list)
    setpoints: list[ControlCycle] = field(default_factory=list)
    rejections: Counter[str] = field(default_factory=Counter)

    def publish(self, topic: str, msgtype: str, time: int, message: Any) -> None:
        self.published.append((topic, time, message))

    def odometry(self, state: OdometryState) -> None:
        self.states.append(state)

    def image(self, frame: ImageOutcome) -> None:
        self.frames.append(frame)

    def tick(self, tick: Tick) -> None:
        self.ticks.append(tick)

    def cycle(self, setpoint: ControlCycle) -> None:
        self.setpoints.append(setpoint)

    def rejected(self, reason: str, detail: str) -> None:
        self.rejections[reason] += 1

    def on(self, topic: str) -> list[Any]:
        return [message for name, _, message in self.published if name == topic]


def play(messages: list[BagMessage], **parameters: Any) -> Log:
    log = Log()
    parameters.setdefault('odom_twist_frame', 'child')  # the bag is too short to find it out
    values = parse_parameters({'/**': {'ros__parameters': parameters}}, TABLE)
    flight = RecordedFlight(values, log, empty)
    ours = {ODOM: 'odom', CAMERA: 'camera_info', IMAGE: 'image_raw'}
    for message in messages:
        flight.take(ours[message.topic], message.stamp_ns, message.msgtype, message.data)
    flight.follower.finish()
    return log


def messages(seconds: float = 1.2, change: Change | None = None) -> list[BagMessage]:
    with open_bag(SAMPLE) as bag:
        taken = bag.messages([ODOM, CAMERA, IMAGE], stop_ns=bag.start_ns + round(seconds * 1e9))
        changed = [change(m) if change else m for m in taken]
        return [m for m in changed if m is not None]


@pytest.fixture(scope='module')
def log() -> Log:
    return play(messages())


def test_ticks_and_setpoints_come_at_their_rates_from_one_interval_on(log: Log) -> None:
    start = messages(0.01)[0].stamp_ns
    assert [t.time - start for t in log.ticks] == [k * TENTH for k in range(1, len(log.ticks) + 1)]
    assert len(log.ticks) == 11
    assert [s.time - start for s in log.setpoints] == [
        k * TENTH // 2 for k in range(1, len(log.setpoints) + 1)]


def test_an_estimate_is_out_when_image_and_odometry_are_recorded(log: Log) -> None:
    recorded = {ODOM: [], IMAGE: []}  # type: dict[str, list[int]]
    for message in messages():
        recorded.setdefault(message.topic, []).append(message.stamp_ns)
    published = [(time, message) for topic, time, message in log.published if topic == 'neighbors']
    assert len(published) == len(recorded[IMAGE]) == len(log.frames)
    for image, (time, message) in zip(recorded[IMAGE], published):
        stamp = stamp_to_nanoseconds(message.header.stamp)
        reached = next(state for state in log.states if state.stamp >= stamp)
        came = recorded[ODOM][log.states.index(reached)]
        assert time == max(image, came)


def test_a_tick_comes_before_a_message_of_the_same_time(log: Log) -> None:
    start, *others = [m for m in messages(0.2) if m.topic == ODOM]
    tick = start.stamp_ns + TENTH
    last = next(m for m in others if m.stamp_ns > tick)
    played = play([start, last._replace(stamp_ns=tick)])
    (first,) = played.ticks
    assert first.time == tick and first.own is not None
    assert first.own.stamp < 0.0  # that of the first message, which came before the first tick


def test_a_calibration_that_changes_is_taken() -> None:
    half = messages(0.01)[0].stamp_ns + 3 * TENTH
    log = play(messages(0.6, lambda m: uncalibrated(m) if m.stamp_ns > half else m))
    assert log.rejections['invalid camera_info'] == 1
    assert 5 < len(log.on('neighbors')) < 11 and log.rejections['no usable camera_info'] > 5


def test_where_odometry_stops_images_wait_then_drop_and_setpoints_end() -> None:
    start = messages(0.01)[0].stamp_ns
    silent = start + 6 * TENTH
    log = play(messages(4.0, lambda m: None if m.topic == ODOM and m.stamp_ns > silent else m))
    reasons = log.rejections
    assert reasons['odometry has not reached the image stamp'] + reasons[
        'odometry lags behind the images'] > 90
    assert log.ticks[-1].decision.acceleration is None
    assert log.ticks[-1].decision.state.value == 'HOLD'
    kinds = [s.setpoint.kind for s in log.setpoints]
    assert kinds[10] == 'command' and kinds[20] == 'level' and kinds[-1] == 'none'
    assert len(log.frames) == sum(m.topic == IMAGE for m in messages(4.0))


def test_when_images_cease_the_planner_brakes_at_once() -> None:
    start = messages(0.01)[0].stamp_ns
    last = max(m.stamp_ns for m in messages(0.7) if m.topic == IMAGE)
    log = play(messages(change=lambda m: None if m.topic == IMAGE and m.stamp_ns > last else m))
    held = next(t for t in log.ticks if t.decision.state.value == 'HOLD')
    assert held.decision.reason == 'no image processed for 0.20 s'
    # Odometry may have let the last image wait for a moment; but no tick is waited for.
    assert 0 <= held.time - last - 200_000_000 < 20_000_000
    assert {t.decision.state.value for t in log.ticks if t.time > held.time} == {'HOLD'}
    assert sum((t.time - start) % TENTH != 0 for t in log.ticks) == 1


def uncalibrated(message: BagMessage) -> BagMessage:
    if message.topic != CAMERA:
        return message
    return edited(message, lambda fields: setattr(fields, 'k', np.zeros(9)))


def test_truncated_messages_are_counted_and_survived() -> None:
    log = play(messages(0.3, lambda m: m._replace(data=m.data[:30])))
    assert set(log.rejections) == {'invalid camera_info', 'invalid image', 'invalid odom'}


def test_a_silence_of_years_is_skipped_with_the_ticks_in_step() -> None:
    years = 10**17
    taken = messages(0.4)
    log = play([*taken, *(m._replace(stamp_ns=m.stamp_ns + years) for m in taken)])
    assert len(log.ticks) < 120
    off = [t for t in log.ticks if (t.time - taken[0].stamp_ns) % TENTH]
    assert [t.decision.state.value for t in off] == ['HOLD']  # images ceased
    assert log.ticks[-1].time > years


def test_the_velocity_of_odom_stands_in_for_the_autopilots(log: Log) -> None:
    other = play(messages(), velocity_source='autopilot')
    assert [s.setpoint.kind for s in other.setpoints] == [s.setpoint.kind for s in log.setpoints]
