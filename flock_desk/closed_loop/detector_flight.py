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
A lock-step flight with the poses of another detector, without clock, messages and images.

The detector is simulated: true poses of the leader in the camera's frame, with noise, latency,
missing poses and outliers. The poses take the same path as in the nodes: ``pose_sources``, filter,
planner and gate, in one ``follower.Follower``. The embedded PX4 flies the setpoints.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from flock_desk.camera.lens import Camera
from flock_desk.camera.renderer import T_BODY_OPTICAL
from flock_desk.closed_loop.flown import EmbeddedVehicle
from flock_desk.closed_loop.real_time_flight import (
    body_pose,
    calibration,
    RealTimeFlight,
    RenderedImage,
    STEP_NS,
)
from flock_desk.follower import Follower
from flock_desk.follower.outcomes import ControlCycle, Listener, Tick
from flock_desk.scenarios.scenario import Part, Scenario
from flock_desk.sensors.sensing import facing, in_view, PerceptionNoise
from flock_desk.sensors.vio import Due, Odometry
from flock_desk.vehicles.px4 import OFFBOARD
from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.gate import Gate
from flock_follower.gate.setpoint_rules import NONE
from flock_follower.gate.vehicle_status import AutopilotTraits, VehicleStatus
from flock_follower.geometry import quaternion_to_matrix, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.mavlink.dialects import PX4
from flock_follower.mavlink.setpoint_encoding import encode_setpoint
from flock_follower.messages import Make, NANOSECONDS
from flock_follower.messages.poses import from_pose, pose_with_covariance, PoseState
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import odometry
from flock_follower.parameters.neighbors_file import parse
from flock_follower.perception.neighbor_motion import FilterParams
from flock_follower.perception.observed_wait import MAX_WAIT
from flock_follower.perception.pending_images import Perceiver
from flock_follower.perception.tracker import Tracker
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.modes import State
from flock_follower.planner.params import Member
from flock_follower.ranges import parameter, Range

LEADER = 'leader'
EPOCH_NS = 1_700_000_000 * NANOSECONDS  # stamp of time zero
CAMERA_FRAME = 'camera_optical_frame'
REPORT_STEPS = 5  # of the autopilot, between two reports of velocity, attitude and height
STATUS_STEPS = 50  # of the autopilot, between two reports of its mode
REQUEST_TIME = 1.0  # s: offboard and engage are called then
GAP_PERIOD = 5.0  # s: poses are missing at its end
LATENCY_SPREAD = 0.1  # share by which a single latency differs at the most


@dataclass(frozen=True)
class Detector(Part):
    """A detector that is not ours, and the faults of its poses."""

    rate: float = parameter(30.0, Range(1.0, 30.0, 'Hz'), 'Images that it processes, Hz.')
    latency: float = parameter(0.05, Range(0.0, 0.3, 's'), 'From exposure to pose, s.')
    missing: float = parameter(0.0, Range(0.0, 1.0), 'Share of images without a pose.')
    outliers: float = parameter(0.0, Range(0.0, 1.0), 'Share of poses that are outliers.')
    outlier: float = parameter(1.0, Range(0.0, 10.0, 'm'), 'Length of their error, m.')
    position_std: float = parameter(0.03, Range(0.001, 1.0, 'm'), 'Per axis, m.')
    attitude_std: float = parameter(0.1, Range(0.001, 1.0, 'rad'), 'Per axis, rad.')
    gap: float = parameter(
        0.0, Range(0.0, 5.0, 's'), f'Time without a pose in each {GAP_PERIOD:g} s, s.')
    stamp_error: float = parameter(
        0.0, Range(-0.2, 0.2, 's'), 'By which stamps are later than the exposure, s.')
    position_only: bool = parameter(False, None, 'Whether the attitude is not used.')


_DEGRADED = Detector(rate=10.0, latency=0.15, missing=0.2, outliers=0.05)
#: Detectors by name; those after 'degraded' are degraded further in one respect.
DETECTORS = {
    'full pose': Detector(),
    'position only': Detector(position_only=True),
    'degraded': _DEGRADED,
    '5 Hz': replace(_DEGRADED, rate=5.0),
    '0.3 s late': replace(_DEGRADED, latency=0.3),
    '40 % missing': replace(_DEGRADED, missing=0.4),
    'gaps of 0.5 s': replace(_DEGRADED, gap=0.5),
    'outliers of 0.3 m': replace(_DEGRADED, outlier=0.3),
    'outliers of 3 m': replace(_DEGRADED, outlier=3.0),
    'stamps 50 ms late': replace(_DEGRADED, stamp_error=0.05),
    'stamps 50 ms early': replace(_DEGRADED, stamp_error=-0.05),
}


class Figures(NamedTuple):
    """The result of a flight, from the begin of the scenario."""

    in_band: float
    """Share of time."""
    nearest: float
    """True distance, m."""
    farthest: float
    """True distance, m."""
    acceleration: float
    """Largest of a setpoint that was sent, m/s^2."""
    speed: float
    """Largest true speed of the follower, m/s."""
    track: float
    """Share of the planner's ticks in TRACK."""
    reasons: dict[str, int]
    """Number of rejections by reason."""


class DetectorFlight(Listener):
    """
    One run of a scenario on the poses of a detector.

    :param make: returns an empty message of a type.
    :param params: of the motion of neighbors.
    """

    def __init__(self, scenario: Scenario, run: int, detector: Detector, make: Make,
                 params: FilterParams | None = None) -> None:
        self._detector, self._make = detector, make
        self._band = scenario.flight
        self._vehicle = EmbeddedVehicle(0.0, scenario.start.altitude)
        self._flight = RealTimeFlight(scenario, run, self._vehicle, None)
        self._random, self._angle = scenario.random(run, 'detector'), scenario.sensing.marker_angle
        self._due = Due(detector.rate)
        gate = Gate(GateLimits(a_max=scenario.flight.a_max, v_max=scenario.flight.v_max,
                               height_max=100.0, radius_max=1000.0))
        gate.autopilot = AutopilotTraits(PX4.hover_thrust, not PX4.compensates_wind)
        tracker = Tracker(parse({'frames_topic': 'detections', 'neighbors': [{
            'name': LEADER, 'pose_topic': 'poses', 'position_only': detector.position_only}]}),
            T_BODY_OPTICAL, params)
        self._follower = Follower(
            PlannerLoop(), replace(scenario.flight.planner(True), vehicles={
                LEADER: Member(faces=())}), gate, self, make,
            perceiver=Perceiver(tracker, max_wait=MAX_WAIT))
        self._coming: list[tuple[float, int, PoseState | None]] = []
        """Results under way: when each arrives, s, the stamp of its image, ns, and the pose."""
        self._steps = 0
        self._state = State.IDLE
        self._distances: list[float] = []
        self._speeds: list[float] = []
        self._accelerations: list[float] = []
        self._tracks: list[bool] = []
        self._reasons: Counter[str] = Counter()
        info = make('sensor_msgs/msg/CameraInfo')
        info.header.frame_id = CAMERA_FRAME
        for name, value in calibration(Camera()).items():
            setattr(info, name, np.array(value) if isinstance(value, list) else value)
        self._follower.camera_info(EPOCH_NS, info)

    @property
    def _has_begun(self) -> bool:
        return self._flight.began_ns is not None

    def fly(self, duration: float) -> Figures:
        """
        Fly for a time, s, after offboard mode is reached; return the figures.

        :raises RuntimeError: if it is not reached.
        """
        while self._flight.time < duration:
            self._step()
            if not self._has_begun and self._flight.time_ns > 10 * NANOSECONDS:
                raise RuntimeError(f'not in offboard mode after 10 s: {dict(self._reasons)}')
        squares = np.array(self._distances)**2
        return Figures(
            float(np.mean((squares > self._band.d0) & (squares < self._band.d1))),
            float(np.sqrt(squares.min())), float(np.sqrt(squares.max())),
            max(self._accelerations), max(self._speeds), float(np.mean(self._tracks)),
            dict(self._reasons))

    def _step(self) -> None:
        flight, autopilot, follower = self._flight, self._vehicle.autopilot, self._follower
        autopilot.controller.wind = flight.scenario.wind(flight.time)
        autopilot.step((flight.time_ns + STEP_NS) * 1e-9)
        arrived = flight.after_step(self._state is not State.IDLE)
        self._steps += 1
        now = flight.time_ns * 1e-9
        time = EPOCH_NS + flight.time_ns
        self._call_services(now, time)
        for sampled, state in arrived:
            follower.odometry(time, from_odometry(odometry(
                self._make, EPOCH_NS + sampled, 'odom', 'base_link', state.position,
                state.quaternion, state.linear, state.angular, state.pose_covariance,
                state.twist_covariance)))
        if self._steps % REPORT_STEPS == 0:
            estimator = autopilot.controller.estimator
            follower.estimate(time, estimator.velocity)
            follower.attitude(time, estimator.quaternion, autopilot.vehicle.angular_velocity)
            height = float(autopilot.vehicle.position[2])
            follower.height(time, float(autopilot.barometer.heights(
                autopilot.vehicle.position[2:], now)[0]), height)
        image = flight.look(flight.time_ns)
        if image is not None and self._due.at(image.stamp_ns * 1e-9):
            self._detect(image)
        for each in [each for each in self._coming if each[0] <= now]:
            self._coming.remove(each)
            _, stamp, pose = each
            if pose is not None:
                follower.pose(time, LEADER, pose)
            follower.source_frame(time, stamp)
        follower.advance(time)
        if self._has_begun and self._steps % REPORT_STEPS == 0:
            self._distances.append(flight.distance)
            self._speeds.append(float(np.linalg.norm(autopilot.vehicle.velocity)))

    def _call_services(self, now: float, time: int) -> None:
        """Report the mode; call offboard and engage, and change the mode once permitted."""
        controller = self._vehicle.autopilot.controller
        if self._steps % STATUS_STEPS == 0:
            self._follower.vehicle(time, VehicleStatus(
                controller.armed, controller.mode, controller.mode == OFFBOARD))
        if self._steps == round(REQUEST_TIME * 100.0):
            self._follower.permit(time, now)
            self._follower.engage(time, True)
        if self._steps == round((REQUEST_TIME + PX4.stream_before_offboard) * 100.0):
            controller.change_mode(OFFBOARD, now)

    def _detect(self, image: RenderedImage) -> None:
        """Let the detector process an image."""
        detector, random, leader = self._detector, self._random, image.leader
        found, away = random.normal(size=6), random.normal(size=3)
        missing, odd = random.random(2).tolist()
        latency = detector.latency * (1.0 + LATENCY_SPREAD * random.uniform(-1.0, 1.0))
        pose, stamp = None, EPOCH_NS + image.stamp_ns + round(detector.stamp_error * NANOSECONDS)
        in_gap = image.stamp_ns * 1e-9 % GAP_PERIOD >= GAP_PERIOD - detector.gap
        if leader is not None and image.usable and missing >= detector.missing and (
                not in_gap and self._in_sight(image.follower, leader)):
            deviations = np.repeat([detector.position_std, detector.attitude_std], 3)
            error = deviations * found
            if odd < detector.outliers:
                error[:3] += detector.outlier * away / np.linalg.norm(away)
            true = (body_pose(image.follower) @ T_BODY_OPTICAL).inverse() @ body_pose(leader)
            pose = from_pose(pose_with_covariance(
                self._make, stamp, CAMERA_FRAME,
                Transform(rotation_vector_to_matrix(error[3:]) @ true.rotation,
                          true.translation + error[:3]), np.diag(deviations**2)))
        self._coming.append((image.stamp_ns * 1e-9 + latency, stamp, pose))

    def _in_sight(self, follower: Odometry, leader: Odometry) -> bool:
        """Return whether the leader is in the image, and shows its back."""
        offset = (leader.position - follower.position)[None]
        return bool(in_view(offset, quaternion_to_matrix(follower.quaternion)[None],
                            PerceptionNoise())[0]
                    and facing(offset, quaternion_to_matrix(leader.quaternion)[None],
                               self._angle)[0])

    # The outcomes of the follower.

    def tick(self, tick: Tick) -> None:
        self._state = tick.decision.state
        if self._has_begun:
            self._tracks.append(self._state is State.TRACK)

    def cycle(self, cycle: ControlCycle) -> None:
        setpoint = cycle.setpoint
        if setpoint.kind == NONE:
            return
        now = self._flight.time_ns * 1e-9
        message = encode_setpoint(setpoint.acceleration, setpoint.yaw, round(now * 1e3))
        self._vehicle.log.add_message(message, now)
        self._vehicle.autopilot.controller.on_setpoint(message, now)
        if self._has_begun:
            self._accelerations.append(math.hypot(message.afx, message.afy, message.afz))

    def reject(self, reason: str, detail: str) -> None:
        self._reasons[reason] += 1
