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
One bag through perception, planner and gate, and the record of it.

Each message is processed at its recording time, so images and odometry have the latency and the
order of the flight. From the first message on the planner is engaged, and the vehicle is armed, in
the air and in offboard mode. A bag has no velocity and yaw of the autopilot: if
``velocity_source`` requires them, those of ``odom`` are used.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from functools import cached_property
import math
from pathlib import Path
import sys
import tempfile
import time
from typing import Any, Final

import numpy as np

from flock_desk.follower import Follower
from flock_desk.follower.outcomes import ControlCycle, ImageOutcome, Listener, Tick
from flock_desk.runs.decoding import decoded_ahead
from flock_desk.runs.frame_errors import FrameErrors, Table
from flock_follower.bags.bag import Bag, BagError, deserialize, open_bag, serialize
from flock_follower.bags.live_line import LiveLine
from flock_follower.bags.message_types import empty
from flock_follower.bags.schedule import Gaps
from flock_follower.bags.writer import BagWriter
from flock_follower.checks.findings import Finding
from flock_follower.checks.observations import OwnMotion
from flock_follower.checks.recorded_system import MAX_DURATION, RecordedSystem
from flock_follower.gate.gate import Gate
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.gate.velocity_check import AUTOPILOT
from flock_follower.geometry import Array
from flock_follower.mavlink.parameter_table import gate_limits
from flock_follower.messages import NANOSECONDS, OdometryState, read_stamp, STATE
from flock_follower.messages.command_writer import TRAJECTORY
from flock_follower.messages.poses import from_pose, from_range, POSE_TYPES, stamp_of
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import ODOMETRY
from flock_follower.messages.topic_names import (
    COMPRESSED_IMAGES,
    full_name,
    images_by_type,
    names_there,
    offer,
    RAW_IMAGES,
    TYPES,
)
from flock_follower.odometry.reader import OdometrySource, read_odometry, SourceParams
from flock_follower.parameters.cameras import cameras, CameraValues
from flock_follower.parameters.neighbors_file import load, NeighborConfig
from flock_follower.parameters.spec import filled
from flock_follower.perception.parameter_table import tracker
from flock_follower.perception.pending_images import INVALID_IMAGE, Perceiver
from flock_follower.perception.tracker import camera_mounting
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.modes import State
from flock_follower.planner.parameter_table import planner_params
from flock_follower.system.files import resource

STATES = tuple(state.value for state in State)
#: The assumed status of the autopilot while the bag was recorded.
FLYING: Final = VehicleStatus(True, 'OFFBOARD', True)
INVALID_ODOMETRY: Final = 'invalid odom'
IMAGES: Final = (RAW_IMAGES, COMPRESSED_IMAGES)
CAMERA_INFO: Final = TYPES['camera_info']
NEEDED: Final = (RAW_IMAGES, 'camera_info', 'odom')
POSES: Final = 'poses'  # of another detector; its neighbor stands in place of a camera
TRUTHS: Final = ('truth/odom', 'truth/neighbors')
#: Where a message with a header goes on after encapsulation and stamp.
_AFTER_STAMP: Final = 12
_NOTHING = (math.nan,) * 3


def topics_used(bag: Bag, namespace: str = '', remaps: Mapping[str, str] | None = None,
                several: Sequence[CameraValues] = (),
                config: NeighborConfig | None = None) -> dict[str, tuple[str, str]]:
    """
    Return the topics of a bag that a follower uses, and the truth.

    If the bag has raw and compressed images, the raw ones are used.

    :param remaps: their names in the bag, by ours, if they differ.
    :param several: cameras with topics of their own, in place of the only one.
    :param config: the neighbors: with markers, or with topics of other detectors.
    :returns: our name of each topic, ``image_raw`` for all images, and the camera's name, ''
        of the only one.
    :raises BagError: naming topics that are missing, or of another type, and those that may be.
    """
    remaps = remaps or {}
    names = names_there(namespace, remaps)
    images_by_type(names, {name: topic.msgtype for name, topic in bag.topics.items()})
    published = {name: topic.msgtype for name, topic in bag.topics.items() if topic.count}
    # If images are named, others that happen to be in the bag are not used.
    images = [full_name(remaps[kind], namespace) for kind in IMAGES if kind in remaps]
    # Our name, the camera's, and the topics that it may be.
    wanted: list[tuple[str, str, list[str]]] = [
        (ours, camera.name, [full_name(name, namespace) for name in choice])
        for camera in several for ours, choice in (
            (RAW_IMAGES, [camera.images('raw'), camera.images('compressed')]),
            ('camera_info', [camera.camera_info]))]
    wanted = wanted or [(RAW_IMAGES, '', images or [names[kind] for kind in IMAGES]),
                        ('camera_info', '', [names['camera_info']])]
    wanted += [(ours, '', [names[ours]]) for ours in ('odom', *TRUTHS, 'ranges')]
    neighbors = config.neighbors if config else ()
    needed = NEEDED if not config or any(n.markers for n in neighbors) else ('odom',)
    wanted += [(POSES, n.name, [full_name(n.source.topic, namespace)])
               for n in neighbors if n.source is not None and n.source.topic]
    used: dict[str, tuple[str, str]] = {}
    faults: dict[str, str] = {}
    for ours, camera_name, choices in wanted:
        full = next((full for full in choices if full in published), '')
        types = [*POSE_TYPES] if ours == POSES else [
            TYPES[kind] for kind in (IMAGES if ours == RAW_IMAGES else (ours,))]
        if full and published[full] in types:
            used[full] = ours, camera_name
        elif full:
            faults[ours] = f'{full} has type {published[full]}, not {types[0]}'
        elif ours in (*needed, POSES):
            whose = f' of camera {camera_name}' if camera_name and ours != POSES else ''
            faults[ours] = f'no message on {" or ".join(choices)}{whose}'
    if faults:
        offers = filter(None, (
            offer(ours, published, used) for ours in faults if ours != POSES))
        raise BagError(f'{bag.path}: ' + '; '.join(
            [*faults.values(), f'it holds {", ".join(published)}', *offers]))
    whole = all(names[truth] in used for truth in TRUTHS)
    return {full: use for full, use in used.items() if whole or use[0] not in TRUTHS}


class Evaluation(Listener):
    """
    A follower fed from the messages of a bag, and the record of its run.

    ``cpu`` holds CPU times, s, by stage; ``frames`` counts the images. ``tick_rows``: time, s
    since the first message, index of the state in STATES, norm of the commanded acceleration (NaN:
    none), own speed. ``reasons`` has the time and the reason of every tick in HOLD.
    ``setpoint_rows``: time, the acceleration sent (NaN: none), 1 for a command.

    :param values: the checked values of every parameter, by node, see ``TABLE``.
    :raises ValueError: if values do not fit together, or the neighbors file is wrong.
    :raises OSError: if the neighbors file cannot be read.
    """

    def __init__(self, bag: Bag, values: dict[str, dict[str, Any]], writer: BagWriter) -> None:
        perception = values['relative_pose']
        self.bag, self.writer, self._values = bag, writer, values
        self.params = planner_params(values['planner'])
        self._gaps, self._skipped_ns = Gaps(), 0
        self._calibrations: dict[str, bytes] = {}
        self.follower, self.perceiver = self._new_follower()
        self.source = OdometrySource(filled(SourceParams(), perception, 'odom_'))
        self.own: OwnMotion | None = None
        """Filled for the rules of ``check``."""
        self.findings: list[Finding] = []
        """Findings of the rules of ``check`` in the bag; empty if the rules were not applied."""
        self.neighbors = self.perceiver.tracker.config.neighbors
        self.errors = FrameErrors(self.neighbors, {
            camera.name: camera_mounting(camera.position, camera.rpy)
            for camera in cameras(perception)}, bag.start_ns)
        self.wall_time = 0.0
        self.cpu: defaultdict[str, list[float]] = defaultdict(list)
        self.frames = 0
        self.tick_rows: list[tuple[float, ...]] = []
        self.setpoint_rows: list[tuple[float, ...]] = []
        self.rejections, self.setpoint_kinds, self.brake_reasons = (
            Counter[str](), Counter[str](), Counter[str]())
        self.reasons: list[tuple[float, str]] = []

    def _new_follower(self) -> tuple[Follower, Perceiver]:
        """Return a follower without a past, and its perception."""
        perception, bridge = self._values['relative_pose'], self._values['mavlink_bridge']
        perceiver = Perceiver(tracker(perception), max_wait=perception['max_wait'])
        # Other inputs of the planner, such as require_bridge, are as when the bridge flies it.
        return Follower(
            PlannerLoop(), self.params, Gate(gate_limits(bridge), bridge['velocity_source']),
            self, empty, perceiver=perceiver, stream_rate=bridge['stream_rate'],
            autopilot_velocity=bridge['velocity_source'] == AUTOPILOT,
            cameras={camera.name: (camera.rpy, camera.rectified)
                     for camera in cameras(self._values['planner'])},
            cpu_time=time.thread_time), perceiver

    @property
    def duration(self) -> float:
        """Return the length of the bag without its gaps, s."""
        return (self.bag.duration_ns - self._skipped_ns) / NANOSECONDS

    def begin(self, time: int) -> None:
        """Begin at a time, ns: the vehicle flies, and the planner is engaged."""
        self.follower.engage(time, True)
        self.follower.permit(time, -math.inf)
        self.follower.vehicle(time, FLYING)
        calibrations, self._calibrations = self._calibrations, {}
        for camera, data in calibrations.items():
            self.take('camera_info', time, CAMERA_INFO, data, camera)

    def pass_gap(self, time: int) -> bool:
        """
        Return whether times step before a message recorded at a time, ns: then begin anew.

        Results from before the step are invalid after it. The figures omit the step.
        """
        if not self._gaps.take(time):
            return False
        self.follower.finish()
        self._skipped_ns = self._gaps.skipped_ns
        self.follower, self.perceiver = self._new_follower()
        return True

    def take(self, name: str, time: int, msgtype: str, data: bytes, camera: str = '',
             message: Any = None) -> None:
        """
        Take a message of our topic ``name``; bytes that are no message of the type are counted.

        :param time: when it was recorded, ns.
        :param camera: the name of the camera, if there are several.
        :param message: its fields, if they were read, or the decoded image.
        """
        if name == 'camera_info' and not self._is_new(camera, data):
            return
        try:
            if message is None:
                message = read_odometry(data) if name == 'odom' else deserialize(data, msgtype)
            if name == 'camera_info':
                self.follower.camera_info(time, message, camera)
            elif name == 'odom':
                state = self.source.take(message, time)
            elif name == 'ranges':
                measured = from_range(message)
            elif name == POSES:
                pose = from_pose(message)
            else:
                stamp = read_stamp(message.header.stamp)
        except ValueError as error:
            self.follower.advance(time)
            self.reject(INVALID_IMAGE if name == RAW_IMAGES else f'invalid {name}', str(error))
            if name == RAW_IMAGES:
                self.image(ImageOutcome(time, camera=camera))
            return
        # Outside of the try: an error in the follower is no fault of the message.
        if name == 'odom':
            for event in self.source.new_events():
                self.reject(*event)
            if state is not None:
                self.follower.odometry(time, state)
        elif name == 'ranges':
            self.follower.range(time, measured)
        elif name == POSES:
            self.follower.pose(time, camera, pose)
        elif name == RAW_IMAGES:
            self.follower.image(time, message, stamp, camera)

    def _is_new(self, camera: str, data: bytes) -> bool:
        """Return whether a calibration differs from the last one of its camera; most do not."""
        before, self._calibrations[camera] = self._calibrations.get(camera, b''), data
        return data[_AFTER_STAMP:] != before[_AFTER_STAMP:]

    @cached_property
    def tables(self) -> dict[str, Table]:
        """Return the errors of each neighbor by its name, once all messages were taken."""
        return {each.name: self.errors.table(each.name) for each in self.neighbors}

    @property
    def ticks(self) -> Array:
        """Return the ticks, (n, 4)."""
        return np.reshape(np.array(self.tick_rows, dtype=float), (-1, 4))

    @property
    def states(self) -> list[tuple[float, str]]:
        """Return the states that the planner entered, each with its time."""
        ticks = self.ticks
        return [(float(ticks[n, 0]), STATES[int(ticks[n, 1])])
                for n in np.flatnonzero(np.diff(ticks[:, 1], prepend=-1.0))]

    @property
    def setpoints(self) -> Array:
        """Return the setpoints, (n, 5)."""
        return np.reshape(np.array(self.setpoint_rows, dtype=float), (-1, 5))

    def publish(self, topic: str, msgtype: str, time: int, message: Any) -> None:
        """Write a message that a node would publish."""
        self.writer.write(topic, msgtype, time, message)

    def odometry(self, state: OdometryState) -> None:
        """Take the ego state, for the errors and for the rules of ``check``."""
        self.errors.odometry(self._close_gaps(state))
        if self.own is not None and state.stamp < self.bag.start_ns + MAX_DURATION * NANOSECONDS:
            self.own.states.append(state)

    def image(self, outcome: ImageOutcome) -> None:
        """Take the outcome of an image."""
        seen, camera = outcome.sighting, outcome.camera
        stamp = outcome.stamp - self._skipped_ns
        self.errors.models[camera] = self.perceiver.model(camera)
        self.frames += 1
        if seen is None:
            self.errors.frame(stamp, {}, {}, camera)
        else:
            self.cpu['decode'].append(outcome.decoding)
            self.cpu[seen.stage].append(outcome.perception)
            self.errors.frame(stamp, seen.estimates, seen.stages, camera)

    def tick(self, tick: Tick) -> None:
        """Take the outcome of a tick of the planner."""
        self.cpu['planner'].append(tick.cpu)
        if tick.decision.state is State.HOLD:
            self.reasons.append((self._seconds(tick.time), tick.decision.reason))
        self.tick_rows.append((
            self._seconds(tick.time), STATES.index(tick.decision.state.value),
            _norm(tick.decision.acceleration),
            _norm(None if tick.own is None else tick.own.velocity)))

    def cycle(self, cycle: ControlCycle) -> None:
        """Take the outcome of a cycle of the control."""
        self.cpu['gate'].append(cycle.cpu)
        decision = cycle.setpoint
        self.setpoint_kinds[decision.kind] += 1
        self.brake_reasons.update(filter(None, [decision.reason]))
        self.setpoint_rows.append((
            self._seconds(cycle.time),
            *(_NOTHING if decision.kind == 'none' else decision.acceleration),
            float(decision.kind == 'command')))

    def reject(self, reason: str, detail: str) -> None:
        """Take the reason why something was dropped."""
        self.rejections[reason] += 1
        if self.own is not None:
            self.own.events[reason] += 1
            if reason == INVALID_ODOMETRY:
                self.own.lost, self.own.last_error = self.own.lost + 1, detail

    def _seconds(self, nanoseconds: int) -> float:
        return (nanoseconds - self._skipped_ns - self.bag.start_ns) / NANOSECONDS

    def _close_gaps(self, state: OdometryState) -> OdometryState:
        """Return a state with its stamp as if the bag had no gaps."""
        return state._replace(stamp=state.stamp - self._skipped_ns) if self._skipped_ns else state

    def truth(self, state: OdometryState, own: bool) -> None:
        """Take the true state of the follower, or of a neighbor."""
        self.errors.truth(self._close_gaps(state), own=own)


def evaluate(path: Path, values: dict[str, dict[str, Any]], result: Path,
             namespace: str = '', remaps: Mapping[str, str] | None = None,
             with_check: bool = True) -> Evaluation:
    """
    Run a bag through the chain and write the messages that the nodes would have published.

    :param values: the parameters of every node, see ``parameters.files.TABLE``.
    :param result: the MCAP file to write; one that exists is replaced.
    :param namespace: of the topics in the bag; ``remaps``: their names, by ours, if they differ.
    :param with_check: whether the rules of ``check`` judge the bag, too.
    :raises ValueError: for a bag that cannot be read (BagError), or values that do not fit.
    :raises OSError: if the result cannot be written.
    """
    with open_bag(path) as bag, tempfile.TemporaryDirectory(
            dir=result.parent, prefix='.unfinished-') as unfinished:
        config = neighbors_of(values['relative_pose'])
        used = topics_used(bag, namespace, remaps, [
            camera for camera in cameras(values['relative_pose']) if camera.name], config)
        frames = full_name(config.frames_topic, namespace) if config.frames_topic else ''
        with BagWriter(Path(unfinished) / 'result', latched=['planner/state']) as writer:
            evaluation = Evaluation(bag, values, writer)
            # rosbags makes the code for a type when it is first needed: now, not on the clock.
            for msgtype in (ODOMETRY, TRAJECTORY, STATE, *(
                    bag.topics[topic].msgtype for topic in used)):
                deserialize(serialize(empty(msgtype), msgtype), msgtype)
            begin = time.perf_counter()
            system = None
            if with_check:
                evaluation.own = OwnMotion(evaluation.source)
                system = RecordedSystem(bag, values, '', namespace, remaps, evaluation.own)
            _play(bag, used, evaluation, system, frames)
            if system is not None:
                evaluation.findings = system.findings()
        (Path(unfinished) / 'result' / 'result.mcap').replace(result)
        evaluation.wall_time = time.perf_counter() - begin
    return evaluation


def _play(bag: Bag, used: Mapping[str, tuple[str, str]], evaluation: Evaluation,
          system: RecordedSystem | None, frames: str = '') -> None:
    began = False
    line = LiveLine(sys.stderr)
    line.due(time.monotonic())  # a short bag needs no line
    shown = False
    # Of several cameras not every image is decoded.
    images = [topic for topic, use in used.items() if use == (RAW_IMAGES, '')]
    for (topic, msgtype, stamp, data), message in decoded_ahead(bag.messages([
            *used, *(system.topics if system else ()), *([frames] if frames else ())]), images):
        if line.due(time.monotonic()):
            done = (stamp - bag.start_ns) / max(bag.end_ns - bag.start_ns, 1)
            line.show(f'{done:4.0%} of {bag.path.name}')
            shown = True
        if system is not None:
            message = system.take(topic, msgtype, stamp, data, message)
        name, camera = used.get(topic, ('', ''))
        began &= not evaluation.pass_gap(stamp)
        if name in TRUTHS:
            evaluation.truth(from_odometry(read_odometry(data)), own=name == 'truth/odom')
        elif name:
            if not began:
                began = True
                evaluation.begin(stamp)
            evaluation.take(name, stamp, msgtype, data, camera, message)
        if topic == frames and began:
            evaluation.follower.source_frame(stamp, stamp_of(data))
    if shown:
        line.end()
    evaluation.follower.finish()


def neighbors_of(perception: Mapping[str, Any]) -> NeighborConfig:
    """Return the neighbors of the parameters of relative_pose."""
    return load(perception['neighbors_file'] or resource('config/neighbors.yaml'))


def _norm(vector: Array | None) -> float:
    return math.nan if vector is None else float(np.linalg.norm(vector))
