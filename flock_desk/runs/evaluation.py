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

"""One bag through perception, planner and gate, and the record of it."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
import tempfile
import time
from typing import Any

import numpy as np

from flock_desk.runs.frame_errors import FrameErrors
from flock_desk.runs.recorded_flight import INVALID_ODOMETRY, RecordedFlight
from flock_follower.bags.bag import Bag, BagError, deserialize, open_bag, serialize
from flock_follower.bags.message_types import empty
from flock_follower.bags.writer import BagWriter
from flock_follower.checks.findings import Finding
from flock_follower.checks.observations import OwnMotion
from flock_follower.checks.recorded_system import LONGEST, RecordedSystem
from flock_follower.checks.topic_names import (
    COMPRESSED_IMAGES,
    full_name,
    images_by_type,
    names_there,
    offer,
    RAW_IMAGES,
    TYPES,
)
from flock_follower.follower import ControlCycle, ImageOutcome, Listener, Tick
from flock_follower.geometry import Array
from flock_follower.messages import (
    from_odometry,
    NANOSECONDS,
    ODOMETRY,
    OdometryState,
    STATE,
    TRAJECTORY,
)
from flock_follower.odometry.cdr import read_odometry
from flock_follower.parameters.cameras_table import cameras, CameraValues
from flock_follower.perception.tracker import camera_mounting
from flock_follower.planner.modes import State

STATES = tuple(state.value for state in State)
_NOTHING = (float('nan'),) * 3


def topics_used(bag: Bag, namespace: str = '', remaps: Mapping[str, str] | None = None,
                several: Iterable[CameraValues] = ()) -> dict[str, tuple[str, str]]:
    """
    Return the topics of a bag that a follower uses, and the truth.

    If the bag has raw and compressed images, the raw ones are used.

    :param remaps: their names in the bag, by ours, if they differ.
    :param several: cameras with topics of their own, in place of the only one.
    :returns: our name of each topic, ``image_raw`` for all images, and the camera's name, ''
        of the only one.
    :raises BagError: naming a topic that is missing, or of another type, and those that it may be.
    """
    remaps, kinds = remaps or {}, (RAW_IMAGES, COMPRESSED_IMAGES)
    names = names_there(namespace, remaps)
    images_by_type(names, {name: topic.msgtype for name, topic in bag.topics.items()})
    published = {name: topic.msgtype for name, topic in bag.topics.items() if topic.count}
    used: dict[str, tuple[str, str]] = {}

    def offered(name: str) -> str:
        same = kinds if name in kinds else (name,)
        offers = offer(name, published, [n for ours, n in names.items() if ours not in same])
        return f'; {offers}' if offers else ''

    def found(name: str) -> bool:
        full = names[name]
        if published.get(full, TYPES[name]) != TYPES[name]:
            raise BagError(f'{bag.path}: {full} holds {published[full]}, not {TYPES[name]}'
                           f'{offered(name)}')
        if full in published:
            used[full] = RAW_IMAGES if name in kinds else name, ''
        return full in published

    missing = {}
    if several:
        for camera in several:
            used |= _topics_of(camera, bag, published, namespace)
    else:
        # If images are named, others that happen to be in the bag are not meant.
        meant = [full_name(remaps[kind], namespace) for kind in kinds if kind in remaps]
        if not any(found(kind) for kind in kinds if not meant or names[kind] in meant):
            missing[RAW_IMAGES] = ' or '.join(meant or (names[kind] for kind in kinds))
        if not found('camera_info'):
            missing['camera_info'] = names['camera_info']
    if not found('odom'):
        missing['odom'] = names['odom']
    if missing:
        raise BagError(f'{bag.path}: holds no message on {", ".join(missing.values())}, only on '
                       f'{", ".join(published)}{"".join(map(offered, missing))}')
    if not (found('truth/odom') and found('truth/neighbors')):
        used.pop(names['truth/odom'], None)
    found('ranges')
    return used


def _topics_of(camera: CameraValues, bag: Bag, published: Collection[str],
               namespace: str) -> dict[str, tuple[str, str]]:
    """Return the topics of one of several cameras: images and calibration."""
    used = {}
    for ours, choice in ((RAW_IMAGES, [camera.images(t) for t in ('raw', 'compressed')]),
                         ('camera_info', [camera.camera_info])):
        full = next((name for name in (full_name(n, namespace) for n in choice)
                     if name in published), '')
        if not full:
            raise BagError(f'{bag.path}: holds no message on {full_name(choice[0])} of '
                           f'camera {camera.name}, only on {", ".join(published)}')
        used[full] = ours, camera.name
    return used


@dataclass
class Evaluation:
    """
    The record of a run: a few numbers for each image, tick and setpoint.

    ``cpu`` holds CPU times, s, by stage; ``frames`` the time of each image, s
    since the first message, ``frame_cpu`` perception's CPU time for it, s. ``ticks`` (n, 4): time,
    index of the state in STATES, norm of the commanded acceleration (NaN: none), own speed.
    ``reasons`` has the time and the reason of every tick in HOLD.
    ``setpoints`` (n, 5): time, the acceleration sent (NaN: none), 1 for a command.
    """

    bag: str
    duration: float
    errors: FrameErrors
    flight: RecordedFlight
    names: list[str]
    incomplete: str = ''
    """Why the bag was never finished, '' if it was."""
    findings: list[Finding] = field(default_factory=list)
    """Findings of the rules of ``check`` in the bag; empty if the rules were not applied."""
    images: int = 0
    wall_time: float = 0.0
    cpu: dict[str, array[float]] = field(default_factory=dict)
    frames: array[float] = field(default_factory=lambda: array('d'))
    frame_cpu: array[float] = field(default_factory=lambda: array('f'))
    tick_rows: array[float] = field(default_factory=lambda: array('d'))
    setpoint_rows: array[float] = field(default_factory=lambda: array('d'))
    rejections: Counter[str] = field(default_factory=Counter)
    setpoint_kinds: Counter[str] = field(default_factory=Counter)
    brake_reasons: Counter[str] = field(default_factory=Counter)
    reasons: list[tuple[float, str]] = field(default_factory=list)

    @property
    def ticks(self) -> Array:
        """Return the table of ticks."""
        return np.frombuffer(self.tick_rows).reshape(-1, 4)

    @property
    def states(self) -> list[tuple[float, str]]:
        """Return the states that the planner entered, each with its time."""
        ticks = self.ticks
        return [(float(ticks[n, 0]), STATES[int(ticks[n, 1])])
                for n in np.flatnonzero(np.diff(ticks[:, 1], prepend=-1.0))]

    @property
    def setpoints(self) -> Array:
        """Return the table of setpoints."""
        return np.frombuffer(self.setpoint_rows).reshape(-1, 5)


class _Recorder(Listener):
    """Listens to the follower: writes the messages published, keeps the rest."""

    def __init__(self, writer: BagWriter, start: int) -> None:
        self._writer = writer
        self._start = start
        self.evaluation: Evaluation
        self.own: OwnMotion | None = None
        """Filled for the rules of ``check``."""
        self.own_until = start + round(LONGEST * NANOSECONDS)

    def publish(self, topic: str, msgtype: str, time: int, message: Any) -> None:
        self._writer.write(topic, msgtype, time, message)

    def odometry(self, state: OdometryState) -> None:
        self.evaluation.errors.odometry(state)
        if self.own is not None and state.stamp < self.own_until:
            self.own.states.append(state)

    def image(self, frame: ImageOutcome) -> None:
        evaluation = self.evaluation
        evaluation.errors.models[frame.camera] = evaluation.flight.perceiver.model(frame.camera)
        evaluation.frames.append(self._seconds(frame.stamp))
        evaluation.frame_cpu.append(frame.perception)
        sighting = frame.sighting
        if sighting is None:
            evaluation.errors.frame(frame.stamp, {}, {}, frame.camera)
            return
        self._spent('decode', frame.decoding)
        self._spent(sighting.stage, frame.perception)
        evaluation.errors.frame(frame.stamp, sighting.estimates, sighting.stages, frame.camera)

    def tick(self, tick: Tick) -> None:
        self._spent('planner', tick.cpu)
        if tick.decision.state is State.HOLD:
            self.evaluation.reasons.append((self._seconds(tick.time), tick.decision.reason))
        self.evaluation.tick_rows.extend((
            self._seconds(tick.time), STATES.index(tick.decision.state.value),
            _norm(tick.decision.acceleration),
            _norm(None if tick.own is None else tick.own.velocity)))

    def cycle(self, cycle: ControlCycle) -> None:
        self._spent('gate', cycle.cpu)
        decision = cycle.setpoint
        self.evaluation.setpoint_kinds[decision.kind] += 1
        if decision.reason:
            self.evaluation.brake_reasons[decision.reason] += 1
        self.evaluation.setpoint_rows.extend((
            self._seconds(cycle.time),
            *(_NOTHING if decision.kind == 'none' else decision.acceleration),
            float(decision.kind == 'command')))

    def rejected(self, reason: str, detail: str) -> None:
        self.evaluation.rejections[reason] += 1
        if self.own is not None:
            self.own.events[reason] += 1
            if reason == INVALID_ODOMETRY:
                self.own.lost, self.own.last_error = self.own.lost + 1, detail

    def _seconds(self, nanoseconds: int) -> float:
        return (nanoseconds - self._start) / NANOSECONDS

    def _spent(self, what: str, seconds: float) -> None:
        self.evaluation.cpu.setdefault(what, array('f')).append(seconds)


def evaluate(path: Path, values: dict[str, dict[str, Any]], result: Path,
             namespace: str = '', remaps: Mapping[str, str] | None = None,
             checked: bool = True) -> Evaluation:
    """
    Run a bag through the chain and write the messages that the nodes would have published.

    :param values: the parameters of every node, see ``parameters.files.TABLE``.
    :param result: the MCAP file to write; one that exists is replaced.
    :param namespace: of the topics in the bag.
    :param remaps: names of topics in the bag, by ours, if they differ.
    :param checked: whether the rules of ``check`` judge the bag, too.
    :raises ValueError: for a bag that cannot be read (BagError), or values that do not fit.
    :raises OSError: if the result cannot be written.
    """
    perception = values['relative_pose']
    with open_bag(path) as bag, tempfile.TemporaryDirectory(
            dir=result.parent, prefix='.unfinished-') as unfinished:
        mounted = cameras(perception)
        used = topics_used(bag, namespace, remaps, [camera for camera in mounted if camera.name])
        with BagWriter(Path(unfinished) / 'result', latched=['planner/state']) as writer:
            recorder = _Recorder(writer, bag.start_ns)
            flight = RecordedFlight(values, recorder, empty, time.process_time)
            neighbors = flight.perceiver.tracker.config.neighbors
            evaluation = recorder.evaluation = Evaluation(
                path.name, bag.duration_ns / NANOSECONDS, FrameErrors(neighbors, {
                    camera.name: camera_mounting(camera.position, camera.rpy)
                    for camera in mounted}, bag.start_ns),
                flight, [n.name for n in neighbors], bag.incomplete)
            # rosbags makes the code for a type when it is first needed: now, not on the clock.
            for msgtype in (ODOMETRY, TRAJECTORY, STATE, *(
                    bag.topics[topic].msgtype for topic in used)):
                deserialize(serialize(empty(msgtype), msgtype), msgtype)
            begin = time.perf_counter()
            system = None
            if checked:
                recorder.own = OwnMotion(flight.source)
                system = RecordedSystem(bag, values, '', namespace, remaps, recorder.own)
            _play(bag, used, evaluation, system)
            if system is not None:
                evaluation.findings = system.findings()
        (Path(unfinished) / 'result' / 'result.mcap').replace(result)
        evaluation.wall_time = time.perf_counter() - begin
    return evaluation


def _play(bag: Bag, used: Mapping[str, tuple[str, str]], evaluation: Evaluation,
          system: RecordedSystem | None) -> None:
    errors, flight = evaluation.errors, evaluation.flight
    for topic, msgtype, stamp, data in bag.messages([*used, *(system.topics if system else ())]):
        message, pixels = (None, None) if system is None else (
            system.take(topic, msgtype, stamp, data))
        name, camera = used.get(topic, ('', ''))
        if name == 'odom':
            flight.take_odometry(stamp, data, message)
        elif name == RAW_IMAGES:
            evaluation.images += 1
            flight.take_image(stamp, msgtype, data, camera, message, pixels)
        elif name == 'camera_info':
            flight.take_camera_info(stamp, data, camera)
        elif name == 'ranges':
            flight.take_range(stamp, data)
        elif name == 'truth/odom':
            errors.true_odometry(from_odometry(read_odometry(data)))
        elif name == 'truth/neighbors':
            errors.true_neighbor(from_odometry(read_odometry(data)))
    flight.finish()


def _norm(vector: Array | None) -> float:
    return float('nan') if vector is None else float(np.linalg.norm(vector))
