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
from real_vio import fitted_corners, FOLDER, Recording

from flock_follower.checks.image_motion import OwnPath
from flock_follower.checks.marker_size import distance_ratio, Ratio, SIZE_WARNING
from flock_follower.checks.own_motion import SIGNIFICANT_SIGMAS
from flock_follower.geometry import quaternion_to_matrix
from flock_follower.odometry.reader import OdometrySource

if not (FOLDER / 'truth.yaml').exists():
    pytest.skip('the recordings (../shared/data/real) are not here', allow_module_level=True)
pytestmark = pytest.mark.slow
VISIT = 8e9  # ns: sightings of a tag are judged for so long
USED = 15  # of the sightings of a visit


def test_the_size_of_tags_on_walls_is_confirmed_or_named() -> None:
    recording, source = Recording('vio/flight_fla_vio.bag'), OdometrySource()
    source.place_child(recording.T_base_child)
    path = OwnPath([state for arrival, message in recording.odometry
                    if (state := source.take(message, arrival)) is not None])
    visits = defaultdict(list)
    for tag in recording.tags:
        if recording.side_length(tag.number) is not None:
            visits[tag.number, tag.stamp // VISIT].append(tag)
    seen = []
    for visit in visits.values():
        rows = []
        for tag in visit[::max(1, len(visit) // USED)]:
            fitted = fitted_corners(recording.camera, recording.side_length(tag.number) or 0.0,
                                    tag.corners, None)
            if fitted is not None:
                rows.append((tag.stamp * 1e-9, *(
                    recording.T_base_camera.rotation @ fitted[0].translation)))
        times, arms = np.array(rows)[:, 0], np.array(rows)[:, 1:]
        quaternions, known = path.attitude(times)
        if np.any(known):
            seen.append((arms[known], path.motion(times[known])[0],
                         np.array([quaternion_to_matrix(q) for q in quaternions[known]])))
    for size in (1.0, 1.25):
        found: list[Ratio] = []
        for arms, places, rotations in seen:
            # With another size in the configuration, all distances are so many times those.
            one = distance_ratio(size * arms, places, rotations,
                                 recording.T_base_camera.translation)
            found += [one] if one is not None and one.at_rest else []
        sure = [one for one in found if one.deviation < SIZE_WARNING]
        named = [abs(one.ratio - 1.0) > max(SIZE_WARNING, SIGNIFICANT_SIGMAS * one.deviation)
                 for one in (found if size == 1.0 else sure)]
        assert len(sure) >= 8, len(sure)
        assert all(named) if size != 1.0 else not any(named), found
        assert np.median([one.ratio for one in sure]) == pytest.approx(size, rel=0.03)
