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

"""A system as it should be, observed for some seconds, for tests that put one thing amiss."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from functools import cache
import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from flock_follower.checks.collector import read_own_motion
from flock_follower.checks.findings import Finding
from flock_follower.checks.image_motion import PART_COLUMNS, PART_ROWS
from flock_follower.checks.observations import (
    Machine,
    NodeStatus,
    Observations,
    OwnMotion,
    Picture,
    TopicEnd,
    TopicSeen,
)
from flock_follower.checks.processor import Load
from flock_follower.checks.reach import Reach
from flock_follower.checks.recorded_system import judge_all
from flock_follower.geometry import (
    Array,
    quaternion_conjugate,
    quaternion_from_rpy,
    quaternion_multiply,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
    R_FLU_OPTICAL,
)
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.messages import NANOSECONDS, to_nanoseconds
from flock_follower.messages.topic_names import names_there, OURS, TYPES
from flock_follower.parameters.files import read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.perception.camera import CameraModel
from flock_follower.system.files import resource

START = 1_700_000_000.0  # s
SECONDS = 5.0
FOCAL = 600.0
#: Where a leader stands, in odom, and the camera on base_link, m.
LEADER, CAMERA = np.array([1.6, 1.3, 1.4]), np.array([0.10, 0.0, 0.0])
COVARIANCE = [1e-4] * 12


def vector(numbers: Any, names: str = 'xyz') -> SimpleNamespace:
    return SimpleNamespace(**dict(zip(names, numbers)))


def calibration() -> SimpleNamespace:
    """Return the CameraInfo of its camera."""
    return SimpleNamespace(
        width=640, height=480, distortion_model='plumb_bob', d=[0.0] * 5, binning_x=0, binning_y=0,
        k=[FOCAL, 0.0, 320.0, 0.0, FOCAL, 240.0, 0.0, 0.0, 1.0], p=[0.0] * 12,
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0))


def odometry_message(row: list[float], child: str) -> SimpleNamespace:
    """Return a row of :func:`odometry_rows` as a message."""
    sec, nanosec = divmod(to_nanoseconds(row[1]), NANOSECONDS)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id='odom', stamp=SimpleNamespace(sec=sec, nanosec=nanosec)),
        child_frame_id=child,
        pose=SimpleNamespace(
            pose=SimpleNamespace(position=vector(row[2:5]), orientation=vector(row[5:9], 'xyzw')),
            covariance=np.diag(row[15:21]).ravel()),
        twist=SimpleNamespace(
            twist=SimpleNamespace(linear=vector(row[9:12]), angular=vector(row[12:15])),
            covariance=np.diag(row[21:27]).ravel()))


@dataclass
class Observed(Observations):
    """Observations whose odometry is given as ``rows``, see :func:`odometry_rows`."""

    rows: list[list[float]] = field(default_factory=list)
    child: str = 'base_link'

    def judged(self) -> list[Finding]:
        usual = _healthy(self.live)
        if (self.rows, self.parameters, self.child) == (usual.rows, usual.parameters, usual.child):
            self.own = _usual_motion(self.live)  # reading it takes longer than to judge most of it
        else:
            self.own = self.read_motion()
        return judge_all(self)

    def read_motion(self) -> OwnMotion:
        """Return the rows, read as our nodes read odometry."""
        return read_own_motion(self, [(to_nanoseconds(row[0]), odometry_message(row, self.child))
                                      for row in self.rows])


def attitude(time: float) -> Array:
    """Return (x, y, z, w) of a vehicle that is turned about by hand, s from the start."""
    return quaternion_from_rpy(0.1 * math.sin(2.1 * time), 0.12 * math.sin(2.9 * time),
                               0.7 + 0.5 * math.sin(1.7 * time))


def position(time: float) -> Array:
    """Return where it is, m: it moves ahead and back, and up and down."""
    return np.array([0.5 * math.sin(1.5 * time), 0.4 * math.sin(1.1 * time),
                     1.5 + 0.2 * math.sin(0.9 * time)])


def velocity(time: float) -> Array:
    """Return its velocity, m/s, in odom."""
    return np.array([0.75 * math.cos(1.5 * time), 0.44 * math.cos(1.1 * time),
                     0.18 * math.cos(0.9 * time)])


def between(before: float, after: float) -> Array:
    """Return the rotation vector (3,) from one time to another, in base_link, rad."""
    return quaternion_to_rotation_vector(quaternion_multiply(
        quaternion_conjugate(attitude(before)), attitude(after)))


def odometry_rows(rate: float = 50.0, late: float = 0.01) -> list[list[float]]:
    """
    Return its odometry as REP-105 wants it.

    A row holds arrival, stamp, s; position (3), attitude (x, y, z, w), velocity (3), rates (3);
    the variances of pose (6) and twist (6).
    """
    rows = []
    for n in range(round(SECONDS * rate)):
        time = n / rate
        q, stamp = attitude(time), START + time
        body = quaternion_to_matrix(q).T @ velocity(time)
        rates = between(time - 0.001, time + 0.001) / 0.002
        rows.append([stamp + late, stamp, *position(time).tolist(), *q.tolist(), *body.tolist(),
                     *rates.tolist(), *COVARIANCE])
    return rows


def shift_rows(rate: float = 15.0, offset: float = 0.0, mounted: Array | None = None
               ) -> list[list[float]]:
    """
    Return how the parts of its images moved, with a far scene; stamps ``offset`` s too late.

    ``mounted`` as that of :func:`sighting_rows`.
    """
    camera = CameraModel.from_calibration(
        (known := calibration()).k, known.d, known.distortion_model, known.width, known.height)
    pixels = np.array([[(x + 0.5) * known.width / PART_COLUMNS,
                        (y + 0.5) * known.height / PART_ROWS]
                       for y in range(PART_ROWS) for x in range(PART_COLUMNS)])
    rays = np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
    R_base_optical = (np.eye(3) if mounted is None else mounted) @ R_FLU_OPTICAL
    rows = []
    for n in range(round(SECONDS * rate) - 1):
        before, after = n / rate, (n + 1) / rate
        turn = rotation_vector_to_matrix(R_base_optical.T @ between(before, after))
        # The part that is halfway between both images at its middle moves as that does.
        half = rotation_vector_to_matrix(0.5 * R_base_optical.T @ between(before, after))
        moved = camera.project(rays @ turn @ half.T) - camera.project(rays @ half.T)
        rows.append([START + before + offset, START + after + offset,
                     *np.column_stack([moved, np.full(len(moved), 0.9)]).ravel()])
    return rows


def sighting_rows(scale: float = 1.0, mounted: Array | None = None) -> list[list[float]]:
    """
    Return where the marker of a leader at rest is seen, ``scale`` times too far.

    ``mounted`` (3, 3): how the camera is turned, R_told_true, FLU.
    """
    R_base_optical = (np.eye(3) if mounted is None else mounted) @ R_FLU_OPTICAL
    rows = []
    for n in range(round(SECONDS / 0.1)):
        time = 0.1 * n + 0.013
        R_base_odom = quaternion_to_matrix(attitude(time)).T
        arm = R_base_optical.T @ (R_base_odom @ (LEADER - position(time)) - CAMERA)
        rows.append([START + time, 0.0, *(scale * arm).tolist()])
    return rows


def at_rate(rate: float, late: float) -> dict[str, Any]:
    """Return when messages of a topic came, and their stamps."""
    stamps = [START + n / rate for n in range(round(SECONDS * rate))]
    return {'stamps': stamps, 'arrivals': [stamp + late for stamp in stamps]}


def healthy(live: bool = True) -> Observed:
    """Return what is seen of a system, or of a bag, of which nothing is amiss, to be changed."""
    return copy.deepcopy(_healthy(live))


@cache
def _usual_motion(live: bool) -> OwnMotion:
    return _healthy(live).read_motion()


@cache
def _healthy(live: bool) -> Observed:
    names = names_there('', {})
    topics = {names[name]: TopicSeen(
        [TopicEnd(sender if live else '', TYPES[name])], **at_rate(rate, late))
        for name, sender, rate, late in (
            ('image_raw', '/camera', 30.0, 0.02), ('camera_info', '/camera', 30.0, 0.02),
            ('odom', '/vio', 50.0, 0.01), ('neighbors', '/relative_pose', 30.0, 0.04),
            ('neighbors/frames', '/relative_pose', 30.0, 0.04),
            ('command/trajectory', '/planner', 10.0, 0.0),
            ('mavlink_bridge/state', '/mavlink_bridge', 2.0, 0.0),
            ('planner/state', '/planner', 2.0, 0.0))}
    rows = odometry_rows()
    parameters = read_parameters(resource('config/follower.yaml'), TABLE)
    if live:
        parameters = {node: {**own, 'use_sim_time': False} for node, own in parameters.items()}
    return Observed(
        live=live, source='' if live else 'flight', duration=SECONDS, names=names, topics=topics,
        nodes=['/camera', '/vio', *(f'/{node}' for node in OURS)] if live else [],
        parameters=parameters, rows=rows,
        calibration=calibration(), dictionary='DICT_4X4_50',
        pictures=[Picture(START + 0.4 * n, 640, 480, 'mono8', 307200, 120.0, 40.0, {0: 60.0})
                  for n in range(12)],
        shifts=shift_rows(), sightings=sighting_rows(), marker_sides={0: 0.16},
        statuses={node: NodeStatus(0, 'running', dict(BRIDGE) if node == 'mavlink_bridge' else {})
                  for node in OURS} if live else {},
        machine=Machine(Load(0.01, 0.4, 4), 8000.0, 512 * 1024, domain='0',
                        reach=[('planner', Reach.COMPUTER)]))


BRIDGE = {'link': 'alive', 'autopilot': 'PX4', 'mode': 'POSCTL', 'armed': 'False',
          'parameters': '0 of 9 differ, 0 unanswered', 'not ready to arm': '',
          'offboard would be refused': '', 'no answers': '', 'unanswered questions': ''}
