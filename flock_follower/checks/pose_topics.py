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

"""Checks of the poses of another detector: publisher, latency, and use by the filter."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import math
from typing import Final, NamedTuple

import numpy as np

from flock_follower.checks.findings import ERROR, Finding, first, OK, UNMEASURED, WARNING
from flock_follower.checks.observations import Observations, SourceSeen, TopicSeen
from flock_follower.checks.pose_path import judge_path, MIN_OUTLIER, WholeOdometry
from flock_follower.checks.streams import BUSY, check_latency, check_rate
from flock_follower.geometry import Array, quaternion_to_matrix, Transform
from flock_follower.messages import NANOSECONDS, OdometryState
from flock_follower.messages.poses import POSE_TYPES, PoseState
from flock_follower.messages.topic_names import full_name
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.odometry.static_frames import StaticFrames
from flock_follower.parameters.neighbors_file import NeighborConfig
from flock_follower.perception.neighbor_filter import UpdateOutcome
from flock_follower.perception.pending_images import Perceiver
from flock_follower.perception.pose_sources import LATE_POSE, MANY_OUTLIERS, Sourced
from flock_follower.perception.tracker import Tracker
from flock_follower.ranges import PREDICT_TIMEOUT

MOST_REFUSED: Final = 0.5  # share of refused poses from which on there is an error
MAX_LATENCY: Final = 0.4  # s: a larger median is an error
MIN_RATE: Final = 7.0  # Hz, of a neighbor in sight; slower poses were not flown
MOST_JUDGED: Final = 600  # poses of a neighbor: each takes about a millisecond
MIN_COS_SIGHT: Final = 0.26  # cosine of the angle, 75 degrees, from the optical axis
MIN_COS_TILT: Final = 0.7  # cosine of the angle, 45 degrees, of a body from the vertical
MOST_GAPS: Final = 0.02  # share of poses after which the next one comes too late
MIN_USED: Final = 10  # poses: of fewer, outliers and axes are not judged
SMALL_OUTLIER: Final = 0.3  # m: if the noise hides those, outliers are unknown
MAX_STAMP_OFFSET: Final = 0.02  # s, of the stamps from the exposures
#: Deviations by which an offset of the stamps must differ from zero to be named.
OFFSET_SIGMAS: Final = 3.0
#: s: the stamps are right if their offset and two deviations are below.
MAX_SURE_OFFSET: Final = 0.03


class Arrival(NamedTuple):
    """A pose, and when it came, s."""

    time: float
    pose: PoseState


def judge_poses(config: NeighborConfig, arrivals: Mapping[str, Iterable[Arrival]],
                states: Iterable[OdometryState], cameras: Mapping[str, Transform],
                static: StaticFrames, max_wait: float) -> dict[str, SourceSeen]:
    """
    Pass the poses of each neighbor through the filter of relative_pose; return the outcome.

    :param cameras: the optical frames of the ego cameras on the body, by name.
    :param max_wait: the longest time for which a pose waits for odometry of its stamp, s.
    """
    perceiver = Perceiver(Tracker(config, Transform()), max_wait=max_wait)
    perceiver.sources.place_cameras(cameras.items())
    perceiver.sources.static = static
    seen = {n.name: SourceSeen(n.source.topic) for n in config.neighbors if n.source is not None}
    frames = dict.fromkeys(seen, '')
    places: dict[str, list[_Place]] = {name: [] for name in seen}
    states = sorted(states, key=lambda state: state.stamp)
    waiting = iter(states)
    state = next(waiting, None)
    ordered = sorted(((arrival, name) for name, those in arrivals.items() for arrival in those),
                     key=lambda each: each[0].time)
    for (time, pose), name in ordered:
        its = seen[name]
        if its.taken >= MOST_JUDGED:
            continue
        while state is not None and state.stamp <= time * NANOSECONDS:
            perceiver.take_odometry(state)
            state = next(waiting, None)
        its.taken += 1
        frames[name] = pose.frame
        if (refused := perceiver.take_pose(name, pose, time)) is not None:
            its.refused[refused[0]] += 1
        else:
            frame = pose.frame.lstrip('/')
            its.outside += bool(
                frame in perceiver.sources.frames
                and pose.position[2] < MIN_COS_SIGHT * np.linalg.norm(pose.position))
            places[name].append(_Place(
                pose.stamp, pose.position, perceiver.sources.mounting(frame)))
        for outcome in perceiver.sources.due(time):
            if isinstance(outcome, Sourced):
                _count(seen[outcome.name], outcome)
            elif not isinstance(outcome, int):  # odometry never reached its stamp
                reason, detail = outcome
                seen[detail.partition(':')[0]].refused[reason] += 1
    for name, its in seen.items():
        its.frame = frames[name]
        if places[name]:
            _judge_path(its, places[name], states)
    return seen


class _Place(NamedTuple):
    """The position of a pose, its stamp, ns, and its frame on the own body; None: odom."""

    stamp: int
    position: Array
    T_body_frame: Transform | None


def _judge_path(its: SourceSeen, places: list[_Place], states: list[OdometryState]) -> None:
    """Compare the poses of a neighbor that are in the frame of the newest pose."""
    its.on_body = places[-1].T_body_frame is not None
    by_stamp = {place.stamp: place.position if place.T_body_frame is None
                else place.T_body_frame.apply(place.position) for place in places
                if (place.T_body_frame is not None) == its.on_body}
    stamps, epoch = sorted(by_stamp), min(by_stamp)
    near = [state for state in states
            if stamps[0] - NANOSECONDS <= state.stamp <= stamps[-1] + NANOSECONDS]
    its.path = judge_path(
        np.array([(stamp - epoch) / NANOSECONDS for stamp in stamps]),
        np.array([by_stamp[stamp] for stamp in stamps]),
        WholeOdometry([OdometrySample.from_state(state, (state.stamp - epoch) / NANOSECONDS)
                       for state in near]),
        its.on_body)


def _count(its: SourceSeen, outcome: Sourced) -> None:
    its.used += 1
    its.outliers += any(reason == UpdateOutcome.OUTLIER.value
                        for reason, _ in outcome.sighting.rejections)
    estimate = outcome.sighting.estimates.get(outcome.name)
    if estimate is not None:
        its.tilted += bool(quaternion_to_matrix(estimate.quaternion)[2, 2] < MIN_COS_TILT)


def check_poses(seen: Observations) -> Iterator[Finding]:
    """Check the poses of the neighbors that another detector measures."""
    if seen.frames_topic:
        yield _check_frames(seen)
    for name, its in seen.sources.items():
        if not its.topic:
            continue
        what, topic = f'poses of {name}', seen.topics.get(
            full_name(its.topic, seen.namespace), TopicSeen())
        yield _check_published(seen, what, its, topic)
        if topic.arrivals:
            yield check_rate(seen, what, topic, (MIN_RATE, 0.0),
                             'raise the rate of the detector: the planner brakes without images; '
                             'hold the neighbor in its sight')
            yield check_latency(
                seen, what, topic, (LATE_POSE, MAX_LATENCY),
                'give the detector more processor time, or smaller images; the follower acts on '
                'where its neighbor was')
            yield _check_gaps(seen, what, topic)
            yield _check_use(what, its)
            yield _check_outliers(what, its)
            yield _check_stamps(what, its)
            yield _check_axes(what, its)


def _check_frames(seen: Observations) -> Finding:
    """Check the topic of the stamps of the images that the detector processes."""
    full = full_name(seen.frames_topic, seen.namespace)
    return first(
        'frames_topic', 'published',
        (full not in seen.topics, ERROR, f'the bag lacks {full}' if not seen.live else
         f'no node publishes {full}', 'name a topic of the detector that comes with each image'),
        (True, OK, full, ''))


def _check_published(seen: Observations, what: str, its: SourceSeen, topic: TopicSeen) -> Finding:
    full = full_name(its.topic, seen.namespace)
    number = len(topic.publishers)
    return first(
        what, 'one publisher of poses',
        (not number and not seen.live, ERROR, f'the bag lacks {full}', 'record it'),
        (not number, ERROR, f'no node publishes {full}', 'start the other detector'),
        (number > 1, ERROR, f'{number} publishers of {full}: none is used', 'end all but one'),
        (not {*POSE_TYPES} & {*topic.types}, ERROR, f'{full} has type {", ".join(topic.types)}',
         f'have it send {POSE_TYPES[0]}'),
        (True, OK, f'{full}; without a marker the guard keeps no viewing angle', ''))


def _check_gaps(seen: Observations, what: str, topic: TopicSeen) -> Finding:
    """Check that the planner seldom loses the neighbor because the next pose comes too late."""
    most = float(seen.value('planner', 'predict_timeout', PREDICT_TIMEOUT))
    ages = np.array(topic.arrivals)[1:] - np.array(topic.stamps)[:-1]
    share = float(np.mean(ages > most)) if len(ages) else 0.0
    measured = f'{share:.1%} of poses are older than {most:g} s before the next one comes'
    return first(
        f'{what} gaps', f'at most {MOST_GAPS:.0%} longer than predict_timeout, latency included',
        (len(ages) < MIN_USED, UNMEASURED, f'{len(topic.arrivals)} poses are too few', ''),
        (share > MOST_GAPS and seen.busy, UNMEASURED, BUSY + measured, ''),
        (share > MOST_GAPS, WARNING, measured,
         'the follower coasts or brakes then: miss fewer images, raise the rate or shorten the '
         'latency; 10 Hz with 0.15 s and a fifth of the images missing were flown'),
        (True, OK, measured, ''))


def _check_use(what: str, its: SourceSeen) -> Finding:
    """Check that poses are not refused."""
    refused = its.refused.total()
    measured = ', '.join(f'{number} of {its.taken}: {reason}'
                         for reason, number in its.refused.most_common())
    return first(
        f'{what} used', 'none refused',
        (not its.taken, UNMEASURED, 'none was read', ''),
        (refused > MOST_REFUSED * its.taken, ERROR, measured,
         'see the table of reasons in docs/other_packages.md'),
        (refused, WARNING, measured, 'see the table of reasons in docs/other_packages.md'),
        (True, OK, f'{its.taken} poses, in frame {its.frame or "?"}', ''))


def _check_outliers(what: str, its: SourceSeen) -> Finding:
    """Check that few poses are outside the gate of the filter, or off the path of the others."""
    share, path = its.outliers / max(its.used, 1), its.path
    off = path.outliers / max(path.judged, 1)
    return first(
        f'{what} outliers', f'at most {MANY_OUTLIERS:.0%}',
        (its.used < MIN_USED, UNMEASURED, f'{its.used} poses are too few', ''),
        (share > MANY_OUTLIERS, WARNING, f'{share:.1%} are outside the gate of the filter',
         'raise the threshold of the detector; is the covariance of its poses honest?'),
        (off > MANY_OUTLIERS, WARNING,
         f'{off:.1%} are farther than the noise, and {MIN_OUTLIER:g} m, from the path of the '
         'others', 'raise the threshold of the detector; the filter follows such poses'),
        (path.judged < MIN_USED, UNMEASURED, 'too few poses in a row with odometry', ''),
        (path.visible > SMALL_OUTLIER, UNMEASURED,
         f'{off:.1%}; the noise hides those below {path.visible:.1f} m', ''),
        (True, OK, f'{max(share, off):.1%}', ''))


def _check_stamps(what: str, its: SourceSeen) -> Finding:
    """Check that the stamps are those of the exposures, on the clock of the odometry."""
    offset, deviation = its.path.offset, its.path.deviation
    measured = f'{1e3 * abs(offset):.0f} ± {1e3 * deviation:.0f} ms'
    return first(
        f'{what} stamps', f'within {1e3 * MAX_STAMP_OFFSET:.0f} ms of the exposure, on the clock '
        'of the odometry',
        (its.path.judged < MIN_USED, UNMEASURED, 'too few poses in a row with odometry', ''),
        (not its.on_body, UNMEASURED, 'unknown from poses in the frame of the odometry', ''),
        (abs(offset) > max(MAX_STAMP_OFFSET, OFFSET_SIGMAS * deviation), WARNING,
         f'{measured} {"before" if offset > 0.0 else "after"} the exposure',
         'have the detector copy the stamp of its image, and the camera stamp the middle of the '
         'exposure, by the clock of the odometry: a turn moves the neighbor'),
        (abs(offset) + 2.0 * deviation <= MAX_SURE_OFFSET, OK, f'off by {measured}', ''),
        (True, UNMEASURED, f'known to ± {1e3 * deviation:.0f} ms: turned too little for the '
         'noise; yaw and roll it by hand', ''))


def _check_axes(what: str, its: SourceSeen) -> Finding:
    """Check that the neighbor is before the camera, and that its body is upright."""
    tilt = math.degrees(math.acos(MIN_COS_TILT))
    return first(
        f'{what} axes', 'optical axes in a camera frame; the body is x ahead, y left, z up',
        (its.used < MIN_USED, UNMEASURED, f'{its.used} poses are too few', ''),
        (2 * its.outside > its.used, ERROR,
         f'{its.outside} of {its.taken} are not before the camera {its.frame}',
         'send x right, y down, z ahead; or name the frame whose axes these are'),
        (2 * its.tilted > its.used, WARNING,
         f'the body is tilted by more than {tilt:.0f} degrees in {its.tilted} of {its.used}',
         'send the attitude of the body, not of its marker; or set position_only'),
        (True, OK, f'before the camera, upright in {its.used - its.tilted} of {its.used}', ''))
