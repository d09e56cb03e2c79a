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

Publishes ``image_raw``, ``camera_info``, ``odom``, ``truth/odom`` and ``truth/neighbors``, and
``ranges`` if the scenario has them, in real time. The follower is flown by an embedded
autopilot, connected to a ``mavlink_bridge`` on this machine. Follower and leader hover until
``planner/state`` reports that it is engaged and the autopilot is in offboard mode. Then the
scenario begins, and the node ends with it.

With ``vehicle:=external`` the follower is flown by an external autopilot, usually a simulator, and
``truth_connection`` reports its place. The leader appears at the place of the scenario as soon as
``mavlink_bridge/state`` is ACTIVE. The scenario ends early if the bridge is no longer ACTIVE; the
node ends when the vehicle is disarmed after the scenario. With ``leader_truth_connection`` the
leader is the vehicle of a second external autopilot, at its true pose. With ``leader_topic`` the
leader is the vehicle of another simulator node, so followers fly in a column; this node ends when
the other node ends.
"""

from __future__ import annotations

import math
import os
import sys
import time

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import String

from flock_desk.autopilot import Endpoint, loopback_address
from flock_desk.closed_loop.flown import EmbeddedVehicle, ExternalLeader, ExternalVehicle
from flock_desk.closed_loop.real_time_flight import (
    calibration,
    IMAGE_RATE,
    LATEST_NS,
    MAX_SKIPPED_SHARE,
    real_time_camera,
    RealTimeFlight,
    RenderedImage,
    STEP_NS,
)
from flock_desk.external.external_autopilot import ExternalAutopilot, ExternalVehicles
from flock_desk.runs.processes import TOO_BUSY_EXIT_CODE, TooBusyError
from flock_desk.scenarios.scenario import DURATIONS, SEED_RANGE
from flock_desk.scenarios.scenario_file import load_for_real_time
from flock_desk.sensors.vio import Odometry
from flock_desk.simulator_outputs import LATCHED_QOS, ODOMETRY, SimulatorOutputs, VehicleAhead
from flock_desk.vehicles.embedded import STEP_TIME
from flock_follower.bags.live_line import LiveLine
from flock_follower.checks.processor import children, LoadMeter
from flock_follower.geometry import Array, quaternion_to_matrix
from flock_follower.mavlink.link import ID_RANGE
from flock_follower.messages.bridge_state import ACTIVE, NO_AUTOPILOT
from flock_follower.nodes.support.diagnostics import ERROR, Problem
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.parameters.spec import Spec
from flock_follower.perception.images import compute_in_one_thread
from flock_follower.ranges import Range

SERVICE_PERIOD = 0.02  # s between looks at subscriptions, parameters and the diagnostics timer
REPORTED_DELAY = 0.5  # s behind the clock from which on /diagnostics reports an error
MAX_DELAY = 5.0  # s behind the clock from which on it may end, see end_if_busy
#: Poses of an external vehicle arrive up to this much later, ns.
POSES_LATE_NS = 40_000_000
#: Messages taken in each service period: the vehicle ahead sends at 50 Hz, too.
MESSAGES = 3
PICTURE_PERIOD = 10.0  # s between images that are logged

SPECS = [
    Spec('scenario', 'indoor',
         'a name in config/scenarios, or the path of a .yaml file'),
    Spec('dictionary', 'DICT_4X4_50',
         "dictionary of the leader's marker, whose id is 0: as that of neighbors_file"),
    Spec('seed', 0, 'seed of all random numbers', SEED_RANGE),
    Spec('duration', 0.0, 'flight time; 0: the duration of the scenario', DURATIONS),
    Spec('connection', '127.0.0.1:14540', 'HOST:PORT where the bridge listens; loopback only'),
    Spec('vehicle', 'embedded',
         'autopilot of the follower: the embedded one, or an external one',
         ('embedded', 'external')),
    Spec('truth_connection', 'udpin:127.0.0.1:19410',
         "link on which an external autopilot reports the true place of its vehicle; not the "
         "bridge's link: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/DEVICE[,BAUD]; "
         "PX4's SIH: the default, ArduPilot's SITL: tcp:127.0.0.1:5762"),
    Spec('target_system', 1, 'MAVLink system id of the autopilot', ID_RANGE),
    Spec('require_truth', False,
         'refuse the estimate of an external autopilot that sends no ground truth: set it if odom '
         'is forwarded to it'),
    Spec('leader_truth_connection', '',
         'link on which the autopilot of the leader, a second vehicle, reports its true place '
         "(vehicle = external); empty: the leader of the scenario. PX4's second SIH: "
         "udpin:127.0.0.1:19411, ArduPilot's second SITL: tcp:127.0.0.1:5772"),
    Spec('leader_target_system', 2, "MAVLink system id of the leader's autopilot", ID_RANGE),
    Spec('leader_topic', '',
         'topic with the true motion of the leader from another simulator (nav_msgs/Odometry, its '
         'truth/motion; vehicle = embedded); empty: the leader of the scenario'),
    Spec('leader_offset', [1.5, 0.0, 0.0],
         "origin of the leader's odom frame in the follower's odom frame",
         Range(unit='m'), fixed_length=True),
    Spec('end_if_busy', False,
         'end with exit code 3 if the flight falls 5 s behind the clock, or loses 2 % of its '
         'images, because the machine is too busy for the nodes of the parent process'),
    Spec('log', '', '.npz file for the true motion; empty: no log'),
]


class Simulator(FlockNode):
    """
    Steps a flight in real time, and publishes the output of the sensors.

    :raises ValueError: a bad parameter, a scenario that cannot be flown, or no external vehicle.
    :raises OSError: if the socket cannot be made.
    """

    def __init__(self) -> None:
        super().__init__('simulator')
        self._values = self.declare(SPECS, dict).values
        scenario = load_for_real_time(self._values['scenario'])
        self._external = self._links()
        self._duration: float = self._values['duration'] or scenario.duration
        self._state = ''
        self._early: tuple[float, str] | None = None
        """When the bridge ended the scenario before its time, s, and its state then."""
        self._line = LiveLine()
        parent = os.getppid()
        self._load = (LoadMeter(lambda: children(parent)) if self._values['end_if_busy']
                      else None)
        self.subscribe(String, 'planner/state', self._take_state, LATCHED_QOS, required=False)
        seed = self._values['seed']
        # It takes a second or two: the clock starts after it.
        camera = real_time_camera(seed, scenario.prints, self._values['dictionary'])
        self._outputs = SimulatorOutputs(self, CameraInfo(**calibration(camera.camera)),
                                         self.diagnostics.rate('image_raw'))
        self._vehicle: EmbeddedVehicle | ExternalVehicle
        self._end: Endpoint | ExternalVehicles
        leader: ExternalLeader | None = None
        self.diagnostics.checks.append(self._problem)
        if self._external is None:
            self._outputs.armed_below()  # armed in the air: the bridge cannot know from where
            self._start = time.monotonic()
            self._vehicle = EmbeddedVehicle(
                self._start, scenario.start.altitude, self._values['target_system'])
            self._end = Endpoint(loopback_address(self._values['connection']),
                                 self._vehicle.autopilot)
        else:
            self.subscribe(String, 'mavlink_bridge/state', self._take_permission, LATCHED_QOS)
            self._end = self._external
            self._vehicle, leader = self._found(self._external, scenario.start.altitude)
        self._epoch_ns = self.get_clock().now().nanoseconds - round(
            (time.monotonic() - self._start) * 1e9)
        self._ahead: VehicleAhead | None = None
        if self._values['leader_topic']:
            self._ahead = VehicleAhead(self, self._values['leader_topic'])
            leader = self._ahead.leader(self._epoch_ns, self._values['leader_offset'])
        external = self._external is not None or leader is not None
        self._flight = RealTimeFlight(
            scenario, seed, self._vehicle, camera,
            LATEST_NS + POSES_LATE_NS if external else LATEST_NS, leader)
        self._log = self._vehicle.log
        self._next_picture = -math.inf
        if self.context.ok():  # else interrupted meanwhile
            self.get_logger().info(f'{scenario.name}: {scenario.summary}; waiting for offboard '
                                   'mode and planner/engage')

    def _links(self) -> ExternalVehicles | None:
        """Return the links to external vehicles, or None."""
        vehicle, leader = self._values['vehicle'], self._values['leader_truth_connection']
        excluded = 'leader_truth_connection' if vehicle == 'embedded' else 'leader_topic'
        if self._values[excluded]:
            raise ValueError(f'{excluded} = {self._values[excluded]!r}: not with vehicle = '
                             f'{vehicle!r}')
        if vehicle == 'embedded':
            return None
        return ExternalVehicles(
            ExternalAutopilot(self._values['truth_connection'], self._values['target_system']),
            ExternalAutopilot(leader, self._values['leader_target_system'],
                              'leader_truth_connection') if leader else None)

    def _found(self, external: ExternalVehicles,
               altitude: float) -> tuple[ExternalVehicle, ExternalLeader | None]:
        """Wait for the vehicles; time zero is that of the follower's newest pose."""
        external.find(self._values['require_truth'], self.context.ok)
        self._start = external.start_ns * 1e-9
        for name, source in external.sources.items():
            self.get_logger().info(f'the place of the {name} comes from {source}')
        if external.follower.motion.estimated:
            self.get_logger().warning(
                "no ground truth comes: images and odometry follow the autopilot's own estimate; "
                'never forward that odometry to it')
        vehicle = ExternalVehicle(external.follower, external.start_ns,
                                  altitude if external.follower.flying else 0.0)
        return vehicle, (None if external.leader is None else ExternalLeader(
            external.leader.motion, external.start_ns, vehicle.origin))

    def fly(self) -> int:
        """Fly the scenario to its end and return the exit code; 3 if the machine is too busy."""
        if not self.context.ok():
            return 0
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        try:
            try:
                self._fly_in_real_time(executor)
            except Exception:
                if self.context.ok():
                    raise  # during a shutdown rclpy raises from any place
            self._line.end()
            if self._values['log']:
                self._save_log()  # also if asked to end: what was flown is judged
            skipped = self._flight.skipped_images
            if skipped > MAX_SKIPPED_SHARE * IMAGE_RATE * self._flight.time:
                self._blame(f'{skipped} images were not rendered in time')
        except (OSError, TooBusyError) as error:
            busy = isinstance(error, TooBusyError)
            print(f'{"too busy" if busy else "error"}: {error}', file=sys.stderr)
            return TOO_BUSY_EXIT_CODE if busy else 1
        finally:
            executor.shutdown(timeout_sec=0.5)
            self._end.close()
        return 0

    def _fly_in_real_time(self, executor: SingleThreadedExecutor) -> None:
        """Step the flight as time passes, until the scenario is flown or ROS shuts down."""
        next_service = 0.0
        while self.context.ok() and not self._finished():
            # An external vehicle is stepped once a pose has come, which ends the wait.
            wake = min(self._step_due() if self._external is None else math.inf, next_service,
                       self._start + self._outputs.next_image)
            self._end.receive(wake - time.monotonic())
            now = time.monotonic()
            while (now if self._external is None
                   else self._external.known(now)) >= self._step_due():
                self._step()
                if self._external is None:
                    break  # lost time is flown through, but the bridge is answered between
            self._outputs.send_images(now, self._start)
            if now >= next_service:
                next_service = now + SERVICE_PERIOD
                for _ in range(1 if self._ahead is None else MESSAGES):
                    executor.spin_once(timeout_sec=0.0)
                self._watch(now)

    def _blame(self, what: str) -> None:
        """Raise TooBusyError, which ends the node, if the machine was too busy."""
        load = None if self._load is None else self._load.worst()
        if load is not None and load.busy:
            raise TooBusyError(f'{what}: {load}; close other programs')

    def _save_log(self) -> None:
        """
        Write the log.

        Besides the rows it has ``epoch_ns``, ROS time, and ``start``, monotonic s, of the start;
        ``began`` and ``ended``, monotonic s, of the scenario, what came after is left out;
        ``skipped_images``; ``pose_source`` and ``pose_source_of_leader``, the messages that placed
        vehicles flown elsewhere, else '', and ``clock`` (c, 2), s, our time and the follower's;
        ``duration``, s, that was to be flown, and ``ended_early``, why it was not, else ''.
        """
        flight = self._flight
        sources, clock = ({}, []) if self._external is None else (
            self._external.sources, self._external.follower.motion.times)
        began = math.nan if flight.began_ns is None else self._start + flight.began_ns * 1e-9
        ended = self._start + flight.time_ns * 1e-9
        flown, why = self._early or (self._duration, '')
        if flight.time > flown + STEP_TIME and began + flown < ended:
            ended = began + flown
        self._log.save(
            self._values['log'], epoch_ns=self._epoch_ns, start=self._start, began=began,
            ended=ended, duration=self._duration, ended_early=why,
            skipped_images=flight.skipped_images, pose_source=sources.get('vehicle', ''),
            pose_source_of_leader=sources.get('leader', ''), clock=np.reshape(clock, (-1, 2)))

    def _finished(self) -> bool:
        """Return whether the scenario is flown, and an external vehicle has landed."""
        if self._ahead is not None:
            left = self._ahead.left(self._epoch_ns + self._flight.time_ns)
            if left is not None and self._flight.began_ns is not None:
                self._duration = (left - self._epoch_ns - self._flight.began_ns) * 1e-9
            return left is not None
        over = self._early is not None or self._flight.time >= self._duration
        return over and not (
            self._external is not None and self._external.follower.armed)

    def _step_due(self) -> float:
        """Return when the next step begins, s: always whole steps, lost time is flown through."""
        return self._start + (self._flight.time_ns + STEP_NS) * 1e-9

    def _step(self) -> None:
        due = self._step_due()
        if isinstance(self._vehicle, EmbeddedVehicle):  # an external simulator has its own wind
            self._vehicle.autopilot.controller.wind = self._flight.scenario.wind(self._flight.time)
        self._end.step(due)
        arrived = self._flight.after_step(self._state not in ('', 'IDLE'))
        now_ns = self._epoch_ns + self._flight.time_ns
        self._log.add('distance', due, self._flight.distance)
        self._outputs.publish_motion(now_ns, self._flight.follower)
        for sampled_ns, estimate in arrived:
            self._outputs.publish_odometry(ODOMETRY, self._epoch_ns + sampled_ns, estimate)
            self._log.add('odom', self._epoch_ns + sampled_ns, *_logged(estimate))
        if (distance := self._flight.measured()) is not None:
            self._outputs.publish_range(now_ns, distance)
        frame = self._flight.look(round((time.monotonic() - self._start) * 1e9))
        if frame is not None:
            self._take_image(self._epoch_ns + frame.stamp_ns, frame)

    def _take_image(self, stamp_ns: int, frame: RenderedImage) -> None:
        """Publish an image; log its truth, and some images, from the first leader on."""
        self._outputs.take_image(stamp_ns, frame)
        if frame.leader is None:
            return
        self._log.add('image', stamp_ns, frame.usable, *_logged(frame.follower),
                      *_logged(frame.leader))
        if frame.time >= 0.0 and stamp_ns >= self._next_picture:
            self._next_picture = stamp_ns + PICTURE_PERIOD * 1e9
            self._log.add('picture', stamp_ns, frame.pixels)

    def _take_state(self, message: String) -> None:
        self._state = message.data
        self._log.add('planner', time.monotonic(), message.data)

    def _take_permission(self, message: String) -> None:
        assert isinstance(self._vehicle, ExternalVehicle)
        self._vehicle.offboard = message.data.startswith('ACTIVE')
        if self._early is None and 0.0 <= self._flight.time < self._duration and (
                not message.data.startswith((ACTIVE, NO_AUTOPILOT))):
            self._early = self._flight.time, message.data

    def _problem(self, now: float) -> Problem | None:
        if self._external is None:
            late = now - self._step_due()
            return None if late < REPORTED_DELAY else (
                ERROR, f'the simulation is {late:.1f} s late: the machine is too slow or too busy')
        stalled = self._external.stalled(now, self._flight.time_ns)
        return (ERROR, stalled) if stalled else None

    def _watch(self, now: float) -> None:
        """
        Update the live line and the values of /diagnostics.

        :raises TooBusyError: if the flight is too late because the machine is too busy.
        :raises OSError: if an external vehicle is gone for good.
        """
        flight = self._flight
        if self._load is not None and flight.began_ns is not None:
            self._load.sample(now)
            if self._external is None and now - self._step_due() > MAX_DELAY:
                self._blame('the simulator does not keep up with the clock')
        if self._external is not None and (gone := self._external.gone(now)):
            raise OSError(gone)
        self.diagnostics.values['time_s'] = f'{flight.time:.2f}'
        self.diagnostics.values['skipped_images'] = flight.skipped_images
        if self._line.due(now):
            when = ('waiting' if flight.began_ns is None
                    else f'{flight.time:5.1f} of {self._duration:g} s')
            where = ('no leader' if math.isnan(flight.distance)
                     else f'distance {flight.distance:.2f} m')
            self._line.show(f'{when}  {where}  {self._state or "no planner":<6}')


def _logged(state: Odometry) -> tuple[Array, Array, Array]:
    """Return position, quaternion, and the velocity in the odom frame."""
    return (state.position, state.quaternion,
            quaternion_to_matrix(state.quaternion) @ state.linear)


def main(args: list[str] | None = None) -> int:
    """Run the node; exit code 0 at the end of the scenario, 1 or 3 if it cannot be flown."""
    compute_in_one_thread()  # OpenCV's threads take twice the time, waiting
    return run(Simulator, args, Simulator.fly)


if __name__ == '__main__':
    sys.exit(main())
