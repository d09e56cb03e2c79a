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
The simulator node: the camera, the odometry and both vehicles of a flight on the desk.

Publishes ``image_raw``, ``camera_info``, ``odom``, ``truth/odom`` and ``truth/neighbors``, in real
time. The follower is flown by an embedded autopilot, which a ``mavlink_bridge`` on this machine
talks to. It hovers, as the leader does, until ``planner/state`` says that it is engaged and it is
in offboard mode; then the scenario begins, and the node ends with it.

With ``vehicle:=external`` the follower is flown by an autopilot that runs elsewhere, a simulator
most likely, and ``truth_connection`` tells where it is. The leader appears where the scenario has
it as soon as ``mavlink_bridge/state`` is ACTIVE; the node ends when, after the scenario, the
vehicle is disarmed.
"""

from __future__ import annotations

from array import array
from collections import deque
import math
import shutil
import sys
import time

from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String

from flock_follower.external.external_autopilot import ExternalAutopilot
from flock_follower.mavlink.link import IDS
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry
from flock_follower.nodes.support.diagnostics import ERROR, Problem, WARN
from flock_follower.nodes.support.node_parameters import Spec
from flock_follower.nodes.support.runtime import FlockNode, run
from flock_follower.simulation.autopilot import Endpoint, loopback_address
from flock_follower.simulation.camera.renderer import render_in_one_thread
from flock_follower.simulation.closed_loop.flown_vehicle import EmbeddedVehicle, ExternalVehicle
from flock_follower.simulation.closed_loop.real_time_flight import (
    calibration,
    LATEST_NS,
    real_time_camera,
    RealTimeFlight,
    RenderedImage,
    STEP_NS,
)
from flock_follower.simulation.closed_loop.real_time_log import RealTimeLog
from flock_follower.simulation.scenarios.scenario import DURATIONS, SEEDS
from flock_follower.simulation.scenarios.scenario_file import load_for_real_time
from flock_follower.simulation.sensors.vio import Odometry as Motion

ODOM_FRAME, BODY_FRAME, LEADER, CAMERA_FRAME = (
    'odom', 'base_link', 'leader', 'camera_optical_frame')
SERVICE_PERIOD = 0.02  # s between looks at subscriptions, parameters and the diagnostics timer
LINE_PERIOD, LOG_LINE_PERIOD = 0.1, 5.0  # s between lines on a terminal, and in a log
LATE = 0.5  # s behind the clock from which on /diagnostics complains
POSE_TIMEOUT = 30.0  # s for the first pose of a vehicle flown elsewhere
LOST = 10.0  # s without a pose of it after which there is nothing to simulate
#: A vehicle flown elsewhere is known up to this much later, ns.
POSES_LATE_NS = 40_000_000
PACE_WINDOW = 5.0  # s over which the time of its autopilot is compared with ours
SLOW = 0.95  # of our clock's pace: a simulator that goes slower is not as agile as it says

SPECS = [
    Spec('scenario', 'indoor', 'what is flown: the name of a file in config/scenarios, or the '
         'path of a .yaml file', read_only=True),
    Spec.within(SEEDS, 'seed', 0, 'of everything that chance decides', read_only=True),
    Spec.within(DURATIONS, 'duration', 0.0, 'how long to fly; 0: as long as the scenario says',
                read_only=True),
    Spec('connection', '127.0.0.1:14540', 'HOST:PORT where the bridge listens; loopback only',
         read_only=True),
    Spec('vehicle', 'embedded', 'who flies the follower: the embedded autopilot, or one elsewhere',
         choices=('embedded', 'external'), read_only=True),
    Spec('truth_connection', 'udpin:127.0.0.1:19410', 'where an external autopilot tells its '
         "vehicle's place, a link apart from the bridge's: udpin:HOST:PORT, udpout:HOST:PORT, "
         "tcp:HOST:PORT or /dev/DEVICE[,BAUD]; PX4's SIH: the default, ArduPilot's SITL: "
         'tcp:127.0.0.1:5762', read_only=True),
    Spec.within(IDS, 'target_system', 1, 'MAVLink system id of an external autopilot',
                read_only=True),
    Spec('require_truth', False, 'refuse the estimate of an external autopilot that tells no '
         'ground truth: set it where odom is forwarded to it', read_only=True),
    Spec('log', '', 'file for what really happened, .npz; none: no log', read_only=True),
]


class Simulator(FlockNode):
    """
    Steps a flight as time goes by, and publishes what the sensors see.

    :raises ValueError: a bad parameter, a scenario that cannot be flown, or no vehicle elsewhere.
    :raises OSError: where the socket cannot be made.
    """

    def __init__(self) -> None:
        super().__init__('simulator')
        self._values = self.declare(SPECS, dict).values
        scenario = load_for_real_time(self._values['scenario'])
        self._external: ExternalAutopilot | None = None
        if self._values['vehicle'] == 'external':
            self._external = ExternalAutopilot(self._values['truth_connection'],
                                               self._values['target_system'])
        else:
            address = loopback_address(self._values['connection'])
        self._duration: float = self._values['duration'] or scenario.duration
        self._state = ''
        self._pending: deque[RenderedImage] = deque()
        self._on_terminal = sys.stdout.isatty()
        self._next_line = 0.0
        self._lateness = self.diagnostics.latency('lateness')
        self._rendering = self.diagnostics.latency('rendering')
        self._odometry = self.create_publisher(Odometry, 'odom', 10)
        self._images = self.create_publisher(Image, 'image_raw', qos_profile_sensor_data)
        self._infos = self.create_publisher(CameraInfo, 'camera_info', qos_profile_sensor_data)
        self._true_own = self.create_publisher(Odometry, 'truth/odom', 10)
        self._true_leader = self.create_publisher(Odometry, 'truth/neighbors', 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.subscribe(String, 'planner/state', self._take_state, latched, required=False)
        seed = self._values['seed']
        camera = real_time_camera(seed)  # takes a second or two: the clock starts after it
        self._vehicle: EmbeddedVehicle | ExternalVehicle
        self._end: Endpoint | ExternalAutopilot
        if self._external is None:
            self.diagnostics.checks.append(self._lateness_problem)
            self._start = time.monotonic()
            self._vehicle = EmbeddedVehicle(self._start, scenario.start.altitude)
            self._end = Endpoint(address, self._vehicle.autopilot)
        else:
            self.subscribe(String, 'mavlink_bridge/state', self._take_permission, latched)
            self.diagnostics.checks += [self._pose_problem, self._pace_problem]
            self._end = self._external
            self._vehicle = self._found(self._external, scenario.start.altitude)
        self._epoch_ns = self.get_clock().now().nanoseconds - round(
            (time.monotonic() - self._start) * 1e9)
        self._flight = RealTimeFlight(
            scenario, seed, self._vehicle, camera,
            LATEST_NS if self._external is None else LATEST_NS + POSES_LATE_NS)
        self._log = RealTimeLog(self._vehicle.log, self._epoch_ns, self._start)
        self._info = CameraInfo(**calibration(camera.camera))
        self._info.header.frame_id = CAMERA_FRAME
        if self.context.ok():  # else interrupted meanwhile
            self.get_logger().info(f'{scenario.name}: {scenario.summary}; waiting for offboard '
                                   'mode and planner/engage')

    def _found(self, external: ExternalAutopilot, altitude: float) -> ExternalVehicle:
        """Wait for the vehicle; time zero is that of its newest pose."""
        external.await_pose(POSE_TIMEOUT, self._values['require_truth'], self.context.ok)
        external.receive(0.0)
        start_ns = external.motion.newest or time.monotonic_ns()
        self._start = start_ns * 1e-9
        log, source = self.get_logger(), external.motion.source
        log.info(f'{external.url}: the vehicle is where {source} says')
        if external.motion.estimated:
            log.warning("no ground truth comes: images and odometry follow the autopilot's own "
                        'estimate; never forward that odometry to it')
        return ExternalVehicle(external.motion, start_ns, altitude if external.flying else 0.0)

    def fly(self) -> int:
        """Fly the scenario to its end and return the exit code."""
        if not self.context.ok():
            return 0
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        next_service = 0.0
        try:
            while self.context.ok() and not self._finished():
                self._wait(next_service)
                now = time.monotonic()
                while self._end.known(now) >= self._step_due():
                    self._step()
                    if self._external is None:
                        break  # lost time is flown through, but the bridge is answered between
                self._send_images(now)
                if now >= next_service:
                    next_service = now + SERVICE_PERIOD
                    executor.spin_once(timeout_sec=0.0)
                    self._tell(now)
                    if self._external is not None and self._age(now) > LOST:
                        print(f'error: no pose of the vehicle for {LOST:g} s on '
                              f'{self._external.url}: {self._external.silence()}',
                              file=sys.stderr)
                        return 1
        finally:
            executor.shutdown(timeout_sec=0.5)
            self._end.close()
        if self._on_terminal:
            print()
        if self._values['log'] and self.context.ok():
            source, clock = ('', []) if self._external is None else (
                self._external.motion.source, self._external.motion.times)
            try:
                self._log.save(self._values['log'], self._flight, self._duration, source, clock)
            except OSError as error:
                print(f'error: {error.filename}: {error.strerror}', file=sys.stderr)
                return 1
        return 0

    def _finished(self) -> bool:
        """Return whether the scenario is flown, and a vehicle flown elsewhere has landed."""
        return self._flight.time >= self._duration and not (
            self._external is not None and self._external.armed)

    def _step_due(self) -> float:
        """Return when the next step begins, s: always whole steps, lost time is flown through."""
        return self._start + (self._flight.time_ns + STEP_NS) * 1e-9

    def _wait(self, next_service: float) -> None:
        """Take what comes from the autopilot until something is to be done."""
        wake = min(self._end.wake(self._step_due()), next_service)
        if self._pending:
            wake = min(wake, self._start + self._pending[0].due_ns * 1e-9)
        self._end.receive(wake - time.monotonic())

    def _step(self) -> None:
        due = self._step_due()
        self._lateness.add(time.monotonic() - due)
        self._flight.before_step()
        self._end.step(due)
        if isinstance(self._vehicle, ExternalVehicle) and self._external is not None:
            self._vehicle.armed, self._vehicle.mode = self._external.armed, self._external.mode
        arrived = self._flight.after_step(self._state not in ('', 'IDLE'))
        self._log.distance(due, self._flight.distance)
        for sampled_ns, estimate in arrived:
            stamp_ns = self._epoch_ns + sampled_ns
            self._odometry.publish(self._message(stamp_ns, BODY_FRAME, estimate))
            self._log.odometry(stamp_ns, estimate)
        began = time.monotonic()
        frame = self._flight.look(round((began - self._start) * 1e9))
        if frame is not None:
            self._rendering.add(time.monotonic() - began)
            stamp_ns = self._epoch_ns + frame.stamp_ns
            self._true_own.publish(self._message(stamp_ns, BODY_FRAME, frame.follower))
            if frame.leader is not None:
                self._true_leader.publish(self._message(stamp_ns, LEADER, frame.leader))
            self._log.image(stamp_ns, frame)
            self._pending.append(frame)

    def _send_images(self, now: float) -> None:
        """Publish the images that have been under way for long enough."""
        while self._pending and self._start + self._pending[0].due_ns * 1e-9 <= now:
            frame = self._pending.popleft()
            height, width = frame.pixels.shape
            message = Image(height=height, width=width, encoding='mono8', step=width,
                            data=array('B', frame.pixels.tobytes()))
            message.header.frame_id = CAMERA_FRAME
            message.header.stamp = nanoseconds_to_stamp(self._epoch_ns + frame.stamp_ns)
            self._info.header.stamp = message.header.stamp
            self._infos.publish(self._info)
            self._images.publish(message)
            self.diagnostics.rate('image_raw').tick(now)

    def _message(self, stamp_ns: int, child: str, motion: Motion) -> Odometry:
        return to_odometry(
            nanoseconds_to_stamp(stamp_ns), ODOM_FRAME, child, motion.position, motion.quaternion,
            motion.linear, motion.angular, motion.pose_covariance, motion.twist_covariance)

    def _take_state(self, message: String) -> None:
        self._state = message.data
        self._log.planner(time.monotonic(), message.data)

    def _take_permission(self, message: String) -> None:
        assert isinstance(self._vehicle, ExternalVehicle)
        self._vehicle.offboard = message.data.startswith('ACTIVE')

    def _age(self, now: float) -> float:
        """Return how old the newest pose of a vehicle flown elsewhere is, s."""
        return now - self._end.known(now)

    def _pose_problem(self, now: float) -> Problem | None:
        assert self._external is not None
        age = self._age(now)
        if age > LATE:
            return ERROR, (f'no pose of the vehicle for {age:.1f} s: no image, no odometry: '
                           f'{self._external.silence()}')
        if not self._vehicle.knows(self._flight.time_ns):
            return ERROR, ('poses of the vehicle come too far apart: no image, no odometry '
                           'between them')
        return None

    def _pace_problem(self, now: float) -> Problem | None:
        assert self._external is not None
        pace = self._external.motion.pace(now - PACE_WINDOW)
        if math.isnan(pace) or pace >= SLOW:
            return None
        return WARN, (f'the time of the autopilot goes at {pace:.2f} of ours: its simulator is '
                      'too slow, or this machine too busy')

    def _lateness_problem(self, now: float) -> Problem | None:
        late = now - self._step_due()
        if late < LATE:
            return None
        return ERROR, f'{late:.1f} s late: this machine is too slow, or too busy'

    def _tell(self, now: float) -> None:
        """Keep the live line, and what /diagnostics shows, up to date."""
        flight = self._flight
        self.diagnostics.values.update({
            'scenario': self._values['scenario'], 'time_s': f'{flight.time:.2f}',
            'skipped_images': flight.skipped_images})
        if self._external is not None:
            self.diagnostics.values['pose_from'] = self._external.motion.source
        if now < self._next_line:
            return
        self._next_line = now + (LINE_PERIOD if self._on_terminal else LOG_LINE_PERIOD)
        speed = sum(c * c for c in flight.follower.linear.tolist()) ** 0.5
        when = ('waiting' if flight.began_ns is None
                else f'{flight.time:5.1f} of {self._duration:g} s')
        apart = flight.distance
        where = 'no leader yet' if math.isnan(apart) else f'distance {apart:.2f} m'
        line = (f'{when}  {where}  {self._state or "no planner":<6}  '
                f'speed {speed:.2f} m/s  height {flight.follower.position[2]:.2f} m')
        if self._on_terminal:
            width = shutil.get_terminal_size().columns - 1
            print(f'\r{line[:width]}\x1b[K', end='', flush=True)
        else:
            print(line, flush=True)


def main(args: list[str] | None = None) -> int:
    """Run the node; exit code 0 at the end of the scenario, 1 for what cannot be flown."""
    render_in_one_thread()
    return run(Simulator, args, Simulator.fly)


if __name__ == '__main__':
    sys.exit(main())
