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
The result of the sample bag as numbers to compare: what a change of the code must not move.

``make bless`` freezes them, see frozen.py: after a change that is meant to move them, look at the
difference and commit it with the change.
"""

from __future__ import annotations

import csv
from pathlib import Path
import tempfile

from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.messages import stamp_to_nanoseconds
from flock_follower.messages.command_reader import from_trajectory
from flock_follower.messages.state_reader import from_odometry
from flock_follower.odometry.reader import OdometrySource
from flock_follower.parameters.spec import check_values
from flock_follower.perception.parameter_table import RELATIVE_POSE, tracker
from flock_follower.perception.pending_images import Perceiver
from flock_follower.system.files import resource

GOLDEN = Path(__file__).resolve().parent / 'frozen' / 'sample.csv'
BAG = resource('bags/sample')

Row = tuple[str, int, list[float]]


def result() -> list[Row]:
    """
    Return (topic, ns since the bag's start, numbers) of all that ``evaluate`` publishes.

    The time is the image's stamp for a neighbor, and the numbers its position and velocity in
    odom; for commands and setpoints the tick, and acceleration and yaw.
    """
    # Here, because where only perception is installed the rest of the chain is not.
    from flock_desk.runs.evaluation import evaluate
    from flock_follower.parameters.files import read_parameters
    from flock_follower.parameters.flight_parameters import TABLE

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'result.mcap'
        evaluate(BAG, read_parameters(resource('config/follower.yaml'), TABLE), path)
        with open_bag(BAG) as original, open_bag(path) as published:
            rows = [_row(m.topic, deserialize(m.data, m.msgtype), original.start_ns)
                    for m in published.messages() if m.topic not in (
                        '/planner/state', '/neighbors/acceleration', '/neighbors/leader/pose')]
    return sorted(rows, key=lambda row: (row[0], row[1]))


def _row(topic: str, message: object, start: int) -> Row:
    if topic == '/neighbors':
        state = from_odometry(message)
        return topic, state.stamp - start, [*state.position, *state.velocity]
    command = from_trajectory(message, 'odom')
    return topic, command.stamp + command.ahead - start, [*command.acceleration, command.yaw]


def neighbors() -> list[Row]:
    """Return the rows of the neighbors from perception alone, which needs no pymavlink."""
    values = check_values(RELATIVE_POSE, {})
    perceiver, source = Perceiver(tracker(values), max_wait=values['max_wait']), OdometrySource()
    rows: list[Row] = []
    with open_bag(BAG) as bag:
        for topic, msgtype, time, data in bag.messages(
                ['/image_raw/compressed', '/camera_info', '/odom']):
            now, message = (time - bag.start_ns) * 1e-9, deserialize(data, msgtype)
            if topic == '/odom':
                state = source.take(message, time)
                assert state is not None
                perceiver.take_odometry(state)
            elif topic == '/camera_info':
                perceiver.take_camera_info(message)
            else:
                perceiver.take_image(message, stamp_to_nanoseconds(message.header.stamp), now)
            while (seen := perceiver.process(now)) is not None:
                rows += [('/neighbors', seen.image.stamp_ns - bag.start_ns,
                          [*estimate.position, *estimate.velocity])
                         for estimate in seen.sighting.estimates.values()]
    return rows


def read() -> list[Row]:
    """Return the golden rows."""
    with GOLDEN.open(encoding='utf-8', newline='') as file:
        _, *rows = csv.reader(file)
    named = [(name.removesuffix(' ns').split(' at '), numbers) for name, *numbers in rows]
    return [(topic, int(time), [float(n) for n in numbers]) for (topic, time), numbers in named]
