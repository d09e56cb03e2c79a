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

"""One bag through perception, planner and gate, and everything worth remembering of it."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterable, Mapping
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


@dataclass(frozen=True)
class Topics:
    """
    The names of the topics in a bag; those of the truth are '' where there is none.

    ``images`` and ``camera_infos`` map them to the names of the cameras, '' of the only one.
    """

    images: Mapping[str, str]
    camera_infos: Mapping[str, str]
    odometry: str
    true_odometry: str
    true_neighbors: str
    ranges: str = ''

    @classmethod
    def of(cls, bag: Bag, namespace: str = '', remaps: Mapping[str, str] | None = None,
           several: Iterable[CameraValues] = ()) -> Topics:
        """
        Return the topics of a bag, images uncompressed where it has both.

        :param remaps: their names in the bag, by ours, where they are others.
        :param several: cameras with topics of their own, in place of the one.
        :raises BagError: naming a topic that is missing, or of another type, and those that it
            may be.
        """
        remaps = remaps or {}
        kinds = (RAW_IMAGES, COMPRESSED_IMAGES)
        names = names_there(namespace, remaps)
        images_by_type(names, {name: topic.msgtype for name, topic in bag.topics.items()})
        published = {name: topic.msgtype for name, topic in bag.topics.items() if topic.count}

        def find(name: str) -> str:
            topic = bag.topics.get(names[name])
            if topic is None or not topic.count:
                return ''
            if topic.msgtype != TYPES[name]:
                raise BagError(f'{bag.path}: {topic.name} holds {topic.msgtype}, '
                               f'not {TYPES[name]}{offered(name)}')
            return topic.name

        def offered(name: str) -> str:
            same = kinds if name in kinds else (name,)
            offers = offer(name, published, [n for ours, n in names.items() if ours not in same])
            return f'; {offers}' if offers else ''

        def others() -> tuple[str, ...]:
            return tuple(map(find, ('odom', 'truth/odom', 'truth/neighbors', 'ranges')))

        if named := {camera.name: _topics_of(camera, bag, namespace) for camera in several}:
            if not find('odom'):
                raise BagError(f'{bag.path}: holds no message on {names["odom"]}'
                               f'{offered("odom")}')
            return cls({image: name for name, (image, _) in named.items()},
                       {info: name for name, (_, info) in named.items()}, *others())
        # Where images are named, others that happen to be in the bag are not meant.
        meant = [full_name(remaps[kind], namespace) for kind in kinds if kind in remaps]
        image = next((name for name in map(find, kinds) if name and name in (meant or [name])), '')
        found = {RAW_IMAGES: image, **{name: find(name) for name in ('camera_info', 'odom')}}
        if missing := [name for name, topic in found.items() if not topic]:
            images = ' or '.join(meant or (names[kind] for kind in kinds))
            wanted = ', '.join(images if name == RAW_IMAGES else names[name] for name in missing)
            raise BagError(f'{bag.path}: holds no message on {wanted}, only on '
                           f'{", ".join(published)}{"".join(map(offered, missing))}')
        return cls({image: ''}, {found['camera_info']: ''}, *others())

    @property
    def truth(self) -> bool:
        """Return whether there is any truth to compare with."""
        return bool(self.true_odometry and self.true_neighbors)


def _topics_of(camera: CameraValues, bag: Bag, namespace: str) -> tuple[str, str]:
    """Return the topics of one of several cameras: images and calibration."""
    published = [name for name, topic in bag.topics.items() if topic.count]
    pair = []
    for choice in ([camera.images(t) for t in ('raw', 'compressed')], [camera.camera_info]):
        there = [name for name in (full_name(n, namespace) for n in choice) if name in published]
        if not there:
            raise BagError(f'{bag.path}: holds no message on {full_name(choice[0])} of '
                           f'camera {camera.name}, only on {", ".join(published)}')
        pair.append(there[0])
    return pair[0], pair[1]


@dataclass
class Evaluation:
    """
    What a run leaves behind; per image, tick and setpoint a few numbers each.

    ``cpu`` holds CPU times, s, by what they were spent on; ``frames`` the time of each image, s
    since the first message, ``frame_cpu`` perception's CPU time for it, s. ``ticks`` (n, 4): time,
    index of the state in STATES, norm of the commanded acceleration (NaN: none), own speed.
    ``reasons`` are those of every tick in HOLD, with its time.
    ``setpoints`` (n, 5): time, the acceleration sent (NaN: none), 1 for a command.
    """

    bag: str
    duration: float
    truth: bool
    errors: FrameErrors
    flight: RecordedFlight
    names: list[str]
    incomplete: str = ''
    """Why the bag was never finished, '' where it was."""
    findings: list[Finding] = field(default_factory=list)
    """What the rules of ``check`` found in the bag; none if they were not asked."""
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
    """Listens to the follower: writes what is published, remembers the rest."""

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
                self.own.lost, self.own.why = self.own.lost + 1, detail

    def _seconds(self, nanoseconds: int) -> float:
        return (nanoseconds - self._start) / NANOSECONDS

    def _spent(self, what: str, seconds: float) -> None:
        self.evaluation.cpu.setdefault(what, array('f')).append(seconds)


def evaluate(path: Path, values: dict[str, dict[str, Any]], result: Path,
             namespace: str = '', remaps: Mapping[str, str] | None = None,
             checked: bool = True) -> Evaluation:
    """
    Run a bag through the chain and write what the nodes would have published.

    :param values: the parameters of every node, see ``parameters.files.TABLE``.
    :param result: the MCAP file to write; one that exists is replaced.
    :param namespace: of the topics in the bag.
    :param remaps: names of topics in the bag, by ours, where they are others.
    :param checked: whether the rules of ``check`` judge the bag, too.
    :raises ValueError: for a bag that cannot be read (BagError), or values that do not fit.
    :raises OSError: where the result cannot be written.
    """
    perception = values['relative_pose']
    with open_bag(path) as bag, tempfile.TemporaryDirectory(
            dir=result.parent, prefix='.unfinished-') as unfinished:
        told = cameras(perception)
        topics = Topics.of(bag, namespace, remaps, [camera for camera in told if camera.name])
        with BagWriter(Path(unfinished) / 'result', latched=['planner/state']) as writer:
            recorder = _Recorder(writer, bag.start_ns)
            flight = RecordedFlight(values, recorder, empty, time.process_time)
            neighbors = flight.perceiver.tracker.config.neighbors
            recorder.evaluation = Evaluation(
                path.name, bag.duration_ns / NANOSECONDS, topics.truth,
                FrameErrors(neighbors, {
                    camera.name: camera_mounting(camera.position, camera.rpy) for camera in told},
                    bag.start_ns),
                flight, [n.name for n in neighbors], bag.incomplete)
            # rosbags makes the code for a type when it is first needed: now, not on the clock.
            read = [bag.topics[name].msgtype for name in (*topics.images, *topics.camera_infos)]
            for msgtype in (ODOMETRY, TRAJECTORY, STATE, *read):
                deserialize(serialize(empty(msgtype), msgtype), msgtype)
            begin = time.perf_counter()
            system = None
            if checked:
                recorder.own = OwnMotion(flight.source)
                system = RecordedSystem(bag, values, '', namespace, remaps, recorder.own)
            _play(bag, topics, flight, recorder.evaluation, system)
            if system is not None:
                recorder.evaluation.findings = system.findings()
        (Path(unfinished) / 'result' / 'result.mcap').replace(result)
        recorder.evaluation.errors.finish()
        recorder.evaluation.wall_time = time.perf_counter() - begin
    return recorder.evaluation


def _play(bag: Bag, topics: Topics, flight: RecordedFlight, evaluation: Evaluation,
          system: RecordedSystem | None) -> None:
    errors = evaluation.errors
    wanted = [*topics.images, *topics.camera_infos, topics.odometry]
    if topics.ranges:
        wanted.append(topics.ranges)
    if topics.truth:
        wanted += [topics.true_odometry, topics.true_neighbors]
    if system is not None:
        wanted += system.topics
    for topic, msgtype, stamp, data in bag.messages(wanted):
        message = None if system is None else system.take(topic, msgtype, stamp, data)
        if topic == topics.odometry:
            flight.take_odometry(stamp, data, message)
        elif topic in topics.images:
            evaluation.images += 1
            flight.take_image(stamp, msgtype, data, topics.images[topic])
        elif topic in topics.camera_infos:
            flight.take_camera_info(stamp, data, topics.camera_infos[topic])
        elif topic == topics.ranges:
            flight.take_range(stamp, data)
        elif topic == topics.true_odometry:
            errors.true_odometry(from_odometry(read_odometry(data)))
        elif topic == topics.true_neighbors:
            errors.true_neighbor(from_odometry(read_odometry(data)))
    flight.finish()


def _norm(vector: Array | None) -> float:
    return float('nan') if vector is None else float(np.linalg.norm(vector))
