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

"""A replayed flight as recorded: the truth of the bag, what was estimated, sent and flown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flock_desk.runs.flight_record import (
    compared,
    estimates,
    flight_figures,
    FlightRecord,
    read_record,
    Received,
)
from flock_desk.runs.report import Chapter
from flock_desk.runs.summary import jsonable, rate
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array
from flock_follower.messages import (
    from_odometry,
    from_trajectory,
    NANOSECONDS,
    stamp_to_nanoseconds,
)
from flock_follower.odometry.reader import OdometrySource
from flock_follower.planner.params import PlannerParams


class ReplayedFlight(NamedTuple):
    """What was replayed and recorded, and when the planner commanded."""

    recorded: FlightRecord
    command_times: Array


def read(bag: Path, recorded: Path, autopilot: Path, params: PlannerParams) -> ReplayedFlight:
    """
    Return the flight of two records; its time begins with the bag's first image.

    :param recorded: the bag of what the nodes published.
    :param autopilot: the log of the embedded autopilot.
    :param params: that it was flown with.
    :raises BagError: where a record cannot be read.
    :raises RuntimeError: where a node published nothing.
    """
    record = read_record(
        recorded, ['/neighbors', '/planner/state', '/command/trajectory', '/diagnostics'])
    received = np.array([t for t, _ in record['/command/trajectory']])
    ticks = np.array([tick_time(m) for m in record['/command/trajectory']])
    with open_bag(bag) as opened:
        images, *odometries = (
            [deserialize(m.data, m.msgtype) for m in opened.messages([topic])]
            for topic in ('/image_raw/compressed', '/odom', '/truth/odom', '/truth/neighbors'))
    stamps = [stamp_to_nanoseconds(image.header.stamp) for image in images]
    true_own, true_leader = (list(map(from_odometry, messages)) for messages in odometries[1:])
    source = OdometrySource()  # as the nodes read it
    own = [state for message in odometries[0]
           if (state := source.take(message, stamp_to_nanoseconds(message.header.stamp)))]
    # Its leader is in view throughout.
    table, leader, follower = compared(
        estimates(record['/neighbors']), own, true_own, true_leader, np.array(stamps),
        np.ones(len(stamps)), stamps[0])
    # The bag's clock against the monotonic one of the logs.
    origin = stamps[0] / NANOSECONDS + float(np.median(received - ticks))
    with np.load(autopilot) as file:
        log = dict(file)
    flown = (log['state_time'] >= received[0]) & (log['state_time'] <= received[-1])
    sent = (log['setpoint_time'] >= received[0]) & (log['setpoint_time'] <= received[-1])
    known = np.isfinite(table['true_distance'])
    flight = FlightRecord(
        duration=float(table['time'][-1]), params=params, table=table, leader=leader,
        follower=follower, distance=table['true_distance'][known],
        setpoint_times=log['setpoint_time'][sent] - origin,
        setpoints=log['setpoint_acceleration'][sent],
        velocity_times=log['state_time'][flown] - origin, velocities=log['velocity'][flown],
        states=[(t - origin, m.data) for t, m in record['/planner/state']],
        diagnostics=[(t - origin, m) for t, m in record['/diagnostics']])
    return ReplayedFlight(flight, ticks)


def summarize(flight: ReplayedFlight, exit_codes: Mapping[str, int | None]) -> dict[str, Any]:
    """
    Return the summary of a flight: figures by name, those that cannot be known None.

    Beside :func:`~flock_desk.runs.flight_record.flight_figures`: ``processed_share`` is of
    the bag's images, those perception looked at in time; ``recall_of_processed`` of these.
    """
    recorded = flight.recorded
    common = flight_figures(recorded, exit_codes)
    processed = recorded.value('relative_pose', 'images_processed', np.inf) / common['frames']
    return {key: jsonable(value) for key, value in {
        **common,
        'processed_share': processed,
        'recall_of_processed': (common['recall'] or 0.0) / processed if processed else 0.0,
        'planner': {'rate_hz': rate(flight.command_times), **common['planner']}}.items()}


def chapters(flight: ReplayedFlight, title: str, picture: Path) -> list[Chapter]:
    """Return what the report shows, and write the picture of the flight to a file, too."""
    from flock_desk.runs import plots
    recorded = flight.recorded
    speed = plots.Curve('vehicle that flew the commands', plots.VEHICLE, recorded.velocity_times,
                        np.linalg.norm(recorded.velocities, axis=1))
    # Its path is left out: nothing that the bag shows moves with it, so it says nothing.
    plotted = recorded.plotted([speed])
    picture.write_bytes(plots.flight_picture(plotted, title))
    return plots.chapters(plotted)


def tick_time(received: Received) -> float:
    """Return when a command applies, s: its stamp plus its point's time from start."""
    command = from_trajectory(received.message, received.message.header.frame_id)
    return (command.stamp + command.ahead) / NANOSECONDS
