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

from bag_excerpts import Change, SAMPLE

from flock_desk.runs.evaluation import RecordedFlight
from flock_follower.bags.bag import BagMessage, open_bag
from flock_follower.bags.message_types import empty
from flock_follower.follower import ControlCycle, ImageOutcome, Listener, Tick
from flock_follower.parameters.files import parse_parameters, TABLE

IMAGE, ODOM, CAMERA = '/image_raw/compressed', '/odom', '/camera_info'
TENTH = 100_000_000  # ns


@dataclass
class Log(Listener):
    """A listener that remembers everything."""

    frames: list[ImageOutcome] = field(default_factory=list)
    ticks: list[Tick] = field(default_factory=list)
    setpoints: list[ControlCycle] = field(default_factory=list)
    rejections: Counter[str] = field(default_factory=Counter)

    def image(self, frame: ImageOutcome) -> None:
        self.frames.append(frame)

    def tick(self, tick: Tick) -> None:
        self.ticks.append(tick)

    def cycle(self, setpoint: ControlCycle) -> None:
        self.setpoints.append(setpoint)

    def rejected(self, reason: str, detail: str) -> None:
        self.rejections[reason] += 1


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
