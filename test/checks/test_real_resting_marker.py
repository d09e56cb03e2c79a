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
Tags on walls in a recorded flight: their size is told right, and a wrong one is named each time.

The recording is not in this repository (../shared/data/real/vio).
"""

from __future__ import annotations

from collections import defaultdict
from functools import cache

import numpy as np
import pytest
from real_vio import CORNER, fitted_corners, FOLDER, Recording, Tag

from flock_follower.checks.image_motion import interpolated
from flock_follower.checks.resting_marker import fit_rest, OwnPath, RestFit, Sightings, SIZE, SURE
from flock_follower.geometry import quaternion_to_matrix
from flock_follower.odometry.reader import OdometrySource

if not (FOLDER / 'truth.yaml').exists():
    pytest.skip('the recordings (../shared/data/real) are not here', allow_module_level=True)
pytestmark = pytest.mark.slow
#: A visit to a tag is at most so long, and has no longer gap, s.
VISIT, GAP = 8.0, 1.0


@cache
def recorded() -> Recording:
    return Recording('vio/flight_fla_vio.bag')


def visits() -> list[list[Tag]]:
    by_number = defaultdict(list)
    for tag in recorded().tags:
        if recorded().side_length(tag.number) is not None:
            by_number[tag.number].append(tag)
    found: list[list[Tag]] = []
    for tags in by_number.values():
        found.append([])
        for tag in sorted(tags, key=lambda t: t.stamp):
            visit = found[-1]
            if visit and (tag.stamp - visit[-1].stamp > GAP * 1e9
                          or tag.stamp - visit[0].stamp > VISIT * 1e9):
                found.append([])
            found[-1].append(tag)
    return found


def fits(size: float) -> list[RestFit]:
    """Return what is found of every tag, its side told ``size`` times as long as it is."""
    recording, source = recorded(), OdometrySource()
    source.place_child(recording.T_base_child)
    states = [state for arrival, message in recording.odometry
              if (state := source.take(message, arrival)) is not None]
    stamps = np.array([(state.stamp - states[0].stamp) * 1e-9 for state in states])
    attitude = interpolated(stamps, np.array([state.quaternion for state in states]))
    motion = np.array([[*s.position, *s.velocity, *s.angular_velocity] for s in states])
    R, found = recording.T_base_camera.rotation, []
    for visit in visits():
        rows = []
        for tag in visit[::max(1, len(visit) // 60)]:
            time = (tag.stamp - states[0].stamp) * 1e-9
            (q,), (known,) = attitude(np.array([time]))
            side = recording.side_length(tag.number) or 0.0
            seen = fitted_corners(recording.camera, size * side, tag.corners, None)
            if known and seen is not None:
                spread = CORNER**2 * np.linalg.inv(seen.jacobian.T @ seen.jacobian)
                rows.append((time, quaternion_to_matrix(q), R @ seen.pose.translation,
                             np.sqrt(np.trace(spread[:3, :3])), R @ seen.pose.rotation))
        if not rows:
            continue
        times, own_R, arms, deviations, attitudes = map(np.array, zip(*rows))
        own = np.column_stack([np.interp(times, stamps, column) for column in motion.T])
        fit = fit_rest(
            Sightings(arms, deviations, attitudes, recording.T_base_camera.translation),
            OwnPath(times, own[:, :3], own[:, 3:6], own_R, own[:, 6:]))
        if fit is not None and fit.at_rest:
            found.append(fit)
    return found


def off(fit: RestFit) -> bool:
    return abs(fit.scale - 1.0) > max(SIZE, SURE * fit.deviation)


def test_tags_of_the_size_told_raise_no_alarm() -> None:
    found = fits(1.0)
    assert len(found) > 30
    told = [fit for fit in found if fit.deviation < SIZE]
    assert len(told) >= 12
    assert max(abs(fit.scale - 1.0) for fit in told) < 0.06
    assert not any(map(off, found))


@pytest.mark.parametrize('size', [0.8, 1.25])
def test_tags_of_another_size_are_named(size: float) -> None:
    told = [fit for fit in fits(size) if fit.deviation < SIZE]
    assert len(told) >= 10
    assert all(map(off, told))
    assert np.median([fit.scale for fit in told]) == pytest.approx(size, rel=0.03)
