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
Tags on walls in a recorded flight: the configured size is confirmed, and a wrong one is named.

The recording is not in this repository (../shared/data/real/vio).
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from real_vio import CORNER, fitted_corners, FOLDER, Recording, Tag

from flock_follower.checks.image_motion import interpolated
from flock_follower.checks.resting_marker import (
    fit_rest,
    OwnPath,
    RestFit,
    Sightings,
    SIZE,
    SURE,
)
from flock_follower.geometry import quaternion_to_matrix
from flock_follower.odometry.reader import OdometrySource

if not (FOLDER / 'truth.yaml').exists():
    pytest.skip('the recordings (../shared/data/real) are not here', allow_module_level=True)
pytestmark = pytest.mark.slow
VISIT = 8e9  # ns: sightings of a tag are judged for so long
USED = 30  # of the sightings of a visit


def test_the_size_of_tags_on_walls_is_confirmed_or_named() -> None:
    recording, source = Recording('vio/flight_fla_vio.bag'), OdometrySource()
    source.place_child(recording.T_base_child)
    states = [state for arrival, message in recording.odometry
              if (state := source.take(message, arrival)) is not None]
    stamps = np.array([(state.stamp - states[0].stamp) * 1e-9 for state in states])
    attitude = interpolated(stamps, np.array([state.quaternion for state in states]))
    motion = np.array([[*s.position, *s.velocity, *s.angular_velocity] for s in states])
    visits = defaultdict(list)
    for tag in recording.tags:
        if recording.side_length(tag.number) is not None:
            visits[tag.number, tag.stamp // VISIT].append(tag)

    def fit(visit: list[Tag], size: float) -> RestFit | None:
        """Return the fit to a visit if the configured side is ``size`` times the true one."""
        rows, R = [], recording.T_base_camera.rotation
        for tag in visit[::max(1, len(visit) // USED)]:
            time = (tag.stamp - states[0].stamp) * 1e-9
            (q,), (known,) = attitude(np.array([time]))
            side = recording.side_length(tag.number) or 0.0
            seen = fitted_corners(recording.camera, size * side, tag.corners, None)
            if known and seen is not None:
                pose, jacobian = seen
                spread = CORNER**2 * np.linalg.inv(jacobian.T @ jacobian)
                rows.append((time, quaternion_to_matrix(q), R @ pose.translation,
                             np.sqrt(np.trace(spread[:3, :3])), R @ pose.rotation))
        if not rows:
            return None
        times, own_R, arms, deviations, attitudes = map(np.array, zip(*rows))
        own = np.column_stack([np.interp(times, stamps, column) for column in motion.T])
        return fit_rest(
            Sightings(arms, deviations, attitudes, recording.T_base_camera.translation),
            OwnPath(times, own[:, :3], own[:, 3:6], own_R, own[:, 6:]))

    for size in (1.0, 1.25):
        found = [one for visit in visits.values()
                 if (one := fit(visit, size)) is not None and one.at_rest]
        sure = [one for one in found if one.deviation < SIZE]
        assert len(sure) >= 8
        named = [abs(one.scale - 1.0) > max(SIZE, SURE * one.deviation)
                 for one in (found if size == 1.0 else sure)]
        assert all(named) if size != 1.0 else not any(named)
        assert np.median([one.scale for one in sure]) == pytest.approx(size, rel=0.03)
