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
Measure perception beside other marker detectors: CPU time, recall, accuracy, consistency.

``make bench-perception``, or ``python benchmarks/perception.py --flights sample hard``. A flight
is a bag of images, odometry and truth. Every image goes, in one process on one thread, through

- default: ``cv2.aruco.ArucoDetector`` with its default parameters over the whole image, then the
  square's pose by IPPE; velocity from the difference of two positions;
- subpix: the same with ``CORNER_REFINE_SUBPIX``;
- aruco2 and apriltag, if their packages are installed: see ``benchmarks/detectors.py``;
- ours: ``Tracker.process_image`` as the node calls it, fed with the odometry.

They take turns every thirty images, so that a slow moment of the machine is nobody's alone, and
yet each finds its own code and data in the caches. If images are rare, a turn is shorter: odometry
is kept for 2 s. The measure is this process's CPU time; decoding is outside. Exit code 0 only if
every bound holds. The flight ``tag36h11`` is the sample with a marker that AprilTag and OpenCV
both know.

``--flights cameras`` compares two cameras with one in the same way, on the sample: a second one
that sees the leader as well, and a second one that looks back and sees nobody.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
import gc
import json
import os
from pathlib import Path
import sys
import time
from typing import Any, NamedTuple

import cv2
from detectors import ARUCO, detectors, Look, TAG
import numpy as np

from flock_desk.camera.renderer import (
    leader,
    marker_print,
    Renderer,
    SIDE_LENGTH,
    T_BODY_MARKER,
    T_BODY_OPTICAL,
)
from flock_desk.runs.frame_errors import FrameErrors
from flock_desk.sample_bag import (
    IMAGE_RATE,
    Recording,
    START_NS,
    VARIANTS,
    write,
)
from flock_follower.bags.bag import BagError, deserialize, open_bag
from flock_follower.bags.writer import BagWriter
from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import slerp
from flock_follower.messages import NANOSECONDS, OdometryState, stamp_to_nanoseconds
from flock_follower.messages.state_reader import from_odometry
from flock_follower.odometry.buffer import OdometryBuffer
from flock_follower.parameters.neighbors_file import NeighborConfig
from flock_follower.perception import markers as neighbors
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import compute_in_one_thread, GrayImage
from flock_follower.perception.pending_images import PendingImage, Perceiver
from flock_follower.perception.time_offset import MountedCamera
from flock_follower.perception.tracker import camera_mounting, Sighting, Tracker
from flock_follower.planner.params import PlannerParams
from flock_follower.system.files import resource

BAGS = Path(__file__).resolve().parents[1] / 'build' / 'bags'
SHORT = 100  # images of a flight that is rendered only to measure time
TURN = 30  # images in a row that a method gets
LONGEST_TURN = 0.6 * OdometryBuffer.HORIZON  # s from the first image of a turn to its end
SHORT_TURN = 10  # the same where cameras are compared, by the median over the turns
MAX_WAIT = 0.05  # s that an image waits for odometry, as in the node
WRONG = np.deg2rad(20.0)
#: A velocity less certain than this, m/s, does not count: the planner does not use it either.
VELOCITY_STD = PlannerParams().max_velocity_std


class Bounds(NamedTuple):
    """What a flight must reach; infinite if it need not."""

    ratio: float
    """CPU time of default over ours, at least."""
    distance_rms: float = np.inf
    """m, at most."""
    velocity_rms: float = np.inf
    """m/s, at most."""
    turned: float = np.inf
    """Share of attitudes more than 20 degrees wrong, at most."""


FLIGHTS = {
    'sample': Bounds(7.0, 0.004, 0.03, 0.01),
    'hd': Bounds(12.0, 0.004, 0.03, 0.01),
    'full_hd': Bounds(25.0, 0.004, 0.03, 0.01),
    'hard': Bounds(7.0, 0.015),
    'fisheye': Bounds(7.0),
    'tag36h11': Bounds(7.0, 0.004, 0.03, 0.01),
}
#: Of the normalized estimation error squared (NEES) of position and of velocity: half to twice
#: their three dimensions.
NEES = 1.5, 6.0


#: Of two cameras the second sees the leader, too, or nobody: CPU time over that of one, at most.
CAMERAS = {'two, both see': 2.2, 'two, one sees': 1.3}
BACK = camera_mounting([-0.10, 0.0, 0.0], [0.0, 0.0, np.pi])


class Figures(NamedTuple):
    """What one method reached on one flight; NaN if it has no such thing."""

    cpu_ms_mean: float
    cpu_ms_p50: float
    cpu_ms_p99: float
    recall: float
    distance_bias_m: float
    distance_rms_m: float
    velocity_rms_m_s: float
    turned_share: float
    nees_position: float
    nees_velocity: float


class State(NamedTuple):
    """A leader as a detector alone sees it, in odom; it has nothing to say on its errors."""

    position: Array
    rotation: Array
    velocity: Array
    covariance: Array = np.full((6, 6), np.nan)


def main(args: Sequence[str] | None = None) -> int:
    """Run the flights, print the tables and the bounds missed, and return the exit code."""
    parser = argparse.ArgumentParser(
        description='Measure perception beside other marker detectors.')
    choices = [*FLIGHTS, 'cameras']
    parser.add_argument('--flights', nargs='+', choices=choices, default=choices,
                        metavar='NAME', help=f'of {", ".join(choices)} (default: all)')
    parser.add_argument('--frames', type=int, default=0, help='images of each (default: all)')
    parser.add_argument('--json', type=Path, help='file to write the figures to')
    options = parser.parse_args(args)
    if options.frames < 0:
        parser.error(f'--frames = {options.frames}: must be at least 0')
    compute_in_one_thread()
    print(f'OpenCV {cv2.__version__}, numpy {np.__version__}, one thread, CPU time')
    figures: dict[str, dict[str, dict[str, float]]] = {}
    missed: list[str] = []
    try:
        for name in options.flights:
            if name == 'cameras':
                shares = Cameras(flight_bag('sample'), options.frames).shares()
                missed += [f'{setup}: CPU {share:.2f} times that of one camera, must be at most '
                           f'{CAMERAS[setup]:g}' for setup, share in shares.items()
                           if share > CAMERAS[setup]]
                figures[name] = {'cpu_share': shares}
                continue
            results = Flight(flight_bag(name), options.frames,
                             TAG if name == 'tag36h11' else ARUCO).figures()
            show(name, results)
            missed += [f'{name}: {text}' for text in misses(results, FLIGHTS[name])]
            figures[name] = {method: f._asdict() for method, f in results.items()}
        if options.json:
            options.json.write_text(json.dumps(figures, indent=1) + '\n', encoding='utf-8')
    except (BagError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    print('\nevery bound holds' if not missed else '\nbounds missed:')
    for text in missed:
        print(f'  {text}')
    return 1 if missed else 0


def flight_bag(name: str) -> Path:
    """Return the bag of a flight, rendered first where it is not there."""
    if name == 'sample':
        return resource('bags/sample')
    whole, short = BAGS / name, BAGS / 'short' / name
    if whole.exists() or short.exists():
        return whole if whole.exists() else short
    if name == 'tag36h11':
        write_tagged(short)
        return short
    variant, bag = VARIANTS[name], whole
    if name in ('hd', 'full_hd'):  # the same flight as the sample: what is new is the time
        variant, bag = replace(variant, duration=SHORT / IMAGE_RATE), short
    write(variant, 1, bag, os.cpu_count() or 1)
    return bag


def write_tagged(bag: Path) -> None:
    """Write the first images of the sample, with marker 0 of the dictionary TAG on the leader."""
    variant = replace(VARIANTS['sample'], duration=SHORT / IMAGE_RATE)
    recording, cells = Recording(variant), neighbors.marker_cells(TAG)
    code = np.pad(neighbors.draw_marker(TAG, 0, cells) > 127, 1, constant_values=True)
    recording.renderer = Renderer(variant.camera, variant.sensor, leader(
        marker_print(code.astype(float), SIDE_LENGTH / cells)))
    with BagWriter(bag) as writer:
        for message in recording.messages(map(recording.image, range(SHORT))):
            writer.write(message.topic, message.msgtype, message.stamp_ns, message.data)


class Flight:
    """
    Plays a bag through every method, turn by turn.

    :param count: images to play, 0 for all.
    :param dictionary: of the leader's marker.
    :param others: names of the detectors beside ours, None for all.
    """

    def __init__(self, bag: Path, count: int, dictionary: str = ARUCO,
                 others: Sequence[str] | None = None) -> None:
        self.config = replace(neighbors.load(resource('config/neighbors.yaml')),
                              dictionary=dictionary)
        found = detectors(dictionary)
        self.detectors = {name: found[name] for name in others or found}
        self.methods = (*self.detectors, 'ours')
        self.milliseconds: dict[str, list[float]] = {m: [] for m in self.methods}
        self.errors = {m: FrameErrors(self.config.neighbors, T_BODY_OPTICAL, START_NS)
                       for m in self.methods}
        self.perceiver = perceiver(self.config)
        self.looks: dict[str, Look] = {}
        self.own: list[OdometryState] = []
        self.last: dict[str, tuple[int, Array]] = {}  # where each detector saw the leader
        #: Stamps, ns and s, pixels and calibration.
        self.waiting: list[tuple[int, float, GrayImage, CameraModel]] = []
        self.turns = self.images = 0
        self.info: Any = None
        with open_bag(bag) as opened:
            for topic, msgtype, now, data in opened.messages():
                self.take(topic, msgtype, now, data)
                if self.images and self.images == count:
                    break
        self.race()

    def take(self, topic: str, msgtype: str, now: int, data: bytes) -> None:
        """Take a message that came at a time, ns, and process the images it sets free."""
        message = deserialize(data, msgtype)
        if topic == '/odom':
            self.own.append(from_odometry(message))
            self.perceiver.take_odometry(self.own[-1])
            for errors in self.errors.values():
                errors.odometry(self.own[-1])
        elif topic == '/truth/odom':
            for errors in self.errors.values():
                errors.truth(from_odometry(message), own=True)
        elif topic == '/truth/neighbors':
            for errors in self.errors.values():
                errors.truth(from_odometry(message))
        elif topic == '/camera_info':
            self.info = message
            if self.perceiver.take_camera_info(message):
                model = self.perceiver.model()
                assert model is not None
                self.looks = {name: Look(model, corners, SIDE_LENGTH)
                              for name, corners in self.detectors.items()}
        else:
            stamp = stamp_to_nanoseconds(message.header.stamp)
            self.perceiver.take_image(message, stamp, now * 1e-9)
        self._race_in_time()
        while (ready := self.perceiver.process(now * 1e-9)) is not None:
            image, pixels = ready.image, ready.pixels
            assert image.model is not None and pixels is not None
            if not self.images:
                self.warm_up(pixels, image.model)
            self.waiting.append((image.stamp_ns, image.stamp, pixels, image.model))
            self.images += 1
            if len(self.waiting) == TURN:
                self.race()

    def _race_in_time(self) -> None:
        """Race before the odometry of the first image that waits is forgotten."""
        if self.waiting and self.own[-1].stamp - self.waiting[0][0] > LONGEST_TURN * NANOSECONDS:
            self.race()

    def race(self) -> None:
        """Give the images that wait to every method, another one first each time."""
        for k in range(len(self.methods)):
            method = self.methods[(self.turns + k) % len(self.methods)]
            for image in self.waiting:
                self.milliseconds[method].append(self.timed(method, *image))
        self.turns += 1
        self.waiting.clear()

    def timed(self, method: str, stamp: int, seconds: float, image: GrayImage,
              model: CameraModel) -> float:
        """Give an image to a method, store its result, and return the CPU time, ms."""
        look = self.looks.get(method)
        start = time.process_time_ns()
        if look is None:
            sighting = Tracker.process_image(self.perceiver.tracker, seconds, image, model)
            spent = time.process_time_ns() - start
            self.errors[method].frame(stamp, sighting.estimates, sighting.stages)
        else:
            seen = look(image)
            spent = time.process_time_ns() - start
            states: Any = {} if seen is None else {'leader': self.state(method, stamp, seen)}
            self.errors[method].frame(stamp, states, {})
        return spent * 1e-6

    def warm_up(self, image: GrayImage, model: CameraModel) -> None:
        """Let every method run untimed: first calls fill caches."""
        other = perceiver(self.config)
        other.take_camera_info(self.info)
        for state in self.own[-3:]:
            other.take_odometry(state)
            Tracker.process_image(other.tracker, 1e-9 * (state.stamp - self.own[-3:][0].stamp),
                                  image, model)
        for look in self.looks.values():
            look(image)
        gc.collect()
        gc.freeze()  # as the node does before it spins

    def state(self, method: str, stamp: int, T_camera_marker: Transform) -> State:
        """Return a detector's state of the leader, its velocity from two positions."""
        before, after = next((a, b) for a, b in zip(self.own[-2::-1], self.own[:0:-1])
                             if a.stamp <= stamp)
        f = (stamp - before.stamp) / (after.stamp - before.stamp)
        own = Transform.from_quaternion(
            (1.0 - f) * before.position + f * after.position,
            slerp(before.quaternion, after.quaternion, f))
        pose = own @ T_BODY_OPTICAL @ T_camera_marker @ T_BODY_MARKER.inverse()
        velocity = np.full(3, np.nan)
        if method in self.last:
            then, place = self.last[method]
            velocity = (pose.translation - place) / ((stamp - then) * 1e-9)
        self.last[method] = stamp, pose.translation
        return State(pose.translation, pose.rotation, velocity)

    def figures(self) -> dict[str, Figures]:
        """Return what every method reached."""
        return {method: self._figures(method) for method in self.methods}

    def _figures(self, method: str) -> Figures:
        table = self.errors[method].table('leader')
        recall = float(np.isfinite(table['distance']).mean())
        # The truth of the last images may come after the end of a short run.
        found = np.isfinite(table['distance'] - table['true_distance'])
        off = (table['distance'] - table['true_distance'])[found]
        velocity, sigma = table['velocity'][found], table['velocity_sigma'][found]
        # A detector has no deviation, but no velocity either from its first sighting.
        usable = np.isfinite(velocity[:, 0]) & ~(np.sum(sigma**2, axis=1) > VELOCITY_STD**2)
        ms = np.array(self.milliseconds[method])
        return Figures(
            float(ms.mean()), *(float(np.percentile(ms, p)) for p in (50, 99)),
            recall, float(off.mean()), float(np.sqrt(np.mean(off**2))),
            float(np.sqrt(np.mean(np.sum(velocity[usable]**2, axis=1)))),
            float(np.mean(table['turned'][found] > WRONG)),
            *(float(np.mean(table[f'nees_{kind}'][found])) for kind in ('position', 'velocity')))


class Cameras:
    """
    Plays a bag through one camera and through two, turn by turn.

    :param count: images to play, 0 for all.
    """

    def __init__(self, bag: Path, count: int) -> None:
        config = neighbors.load(resource('config/neighbors.yaml'))
        ahead = T_BODY_OPTICAL
        self.perceivers = {
            'one': perceiver(config), 'two, both see': perceiver(config, [ahead, ahead]),
            'two, one sees': perceiver(config, [ahead, BACK])}
        self.spent: dict[str, list[float]] = {setup: [] for setup in self.perceivers}  # ms a turn
        self.found = dict.fromkeys(self.perceivers, 0)
        self.waiting: dict[str, list[tuple[PendingImage, GrayImage]]] = {
            setup: [] for setup in self.perceivers}
        self.turns = self.images = 0
        with open_bag(bag) as opened:
            for topic, msgtype, now, data in opened.messages():
                self.images += 'image' in topic
                self.take(topic, deserialize(data, msgtype), now)
                if self.images and self.images == count:
                    break
        self.race()

    def take(self, topic: str, message: Any, now: int) -> None:
        """Take a message that came at a time, ns; images reach every camera of each."""
        for setup, one in self.perceivers.items():
            for camera in one.tracker.cameras:
                if topic == '/camera_info':
                    one.take_camera_info(message, camera)
                elif 'image' in topic:
                    stamp = stamp_to_nanoseconds(message.header.stamp)
                    one.take_image(message, stamp, now * 1e-9, camera)
            if topic == '/odom':
                one.take_odometry(from_odometry(message))
            while (ready := one.process(now * 1e-9)) is not None:
                pixels = ready.pixels
                assert pixels is not None
                if setup == 'two, one sees' and ready.image.camera == '1':
                    pixels = np.ascontiguousarray(pixels[:, ::-1])  # a marker of nobody
                self.waiting[setup].append((ready.image, pixels))
        if len(self.waiting['one']) >= SHORT_TURN:
            self.race()

    def race(self) -> None:
        """Give the images that wait to each, another one first each time."""
        setups = [*self.perceivers]
        for k in range(len(setups)):
            setup = setups[(self.turns + k) % len(setups)]
            one = self.perceivers[setup]
            start = time.process_time_ns()
            for image, pixels in self.waiting[setup]:
                assert image.model is not None
                if Tracker.wanted(one.tracker, image.stamp, image.model, image.camera):
                    sighting = Tracker.process_image(
                        one.tracker, image.stamp, pixels, image.model, image.camera)
                    self.found[setup] += len(sighting.estimates)
            self.spent[setup].append((time.process_time_ns() - start) * 1e-6)
            self.waiting[setup].clear()
        self.turns += 1

    def shares(self) -> dict[str, float]:
        """Print what each took, and return that of two cameras over that of one."""
        of_one = {setup: [spent / one for spent, one in zip(turns, self.spent['one'])]
                  for setup, turns in self.spent.items()}
        print('\ncameras      CPU, ms per image of the first   of one, median   neighbors found')
        for setup, turns in self.spent.items():
            print(f'  {setup:<15}{sum(turns) / self.images:8.2f}'
                  f'{np.median(of_one[setup]):28.2f}{self.found[setup]:17d}')
        return {setup: float(np.median(of_one[setup])) for setup in CAMERAS}


class Waiting(Tracker):
    """A tracker whose images are decoded, and processed later, in a turn."""

    def wanted(self, *_: Any) -> bool:
        """Return that an image is decoded."""
        return True

    def process_image(self, *_: Any) -> Sighting:
        """Return nothing yet."""
        return Sighting()


def perceiver(config: NeighborConfig,
              mountings: Sequence[Transform] = ()) -> Perceiver:
    """Return what perceives with one camera, or with several, named '0', '1' and so on."""
    several = {str(k): MountedCamera(place) for k, place in enumerate(mountings)}
    return Perceiver(Waiting(config, several or T_BODY_OPTICAL), max_wait=MAX_WAIT)


def misses(results: dict[str, Figures], bounds: Bounds) -> list[str]:
    """Return what each bound that is missed asks for, and the figure."""
    ours, default = results['ours'], results['default']
    ratio = default.cpu_ms_mean / ours.cpu_ms_mean
    checks = [
        (f'CPU ratio {ratio:.1f}, must be at least {bounds.ratio:g}', ratio >= bounds.ratio),
        (f'recall {ours.recall:.3f}, must be at least that of default, {default.recall:.3f}',
         ours.recall >= default.recall),
        (f'distance RMS {100 * ours.distance_rms_m:.2f} cm, must be at most '
         f'{100 * bounds.distance_rms:.2g} cm', ours.distance_rms_m <= bounds.distance_rms),
        (f'velocity RMS {ours.velocity_rms_m_s:.3f} m/s, must be at most '
         f'{bounds.velocity_rms:g} m/s', ours.velocity_rms_m_s <= bounds.velocity_rms),
        (f'attitude off by more than 20 degrees in {ours.turned_share:.1%}, must be in at most '
         f'{bounds.turned:.0%}', ours.turned_share <= bounds.turned),
        *((f'NEES of {what} {value:.2f}, must be in [{NEES[0]}, {NEES[1]}]',
           NEES[0] <= value <= NEES[1])
          for what, value in (('position', ours.nees_position),
                              ('velocity', ours.nees_velocity)))]
    return [text for text, holds in checks if not holds]


def show(name: str, results: dict[str, Figures]) -> None:
    """Print the table of a flight."""
    print(f'\n{name:<13}    CPU, ms per image            recall   distance, cm     velocity   '
          'turned     NEES of 3\n'
          '                   mean     p50     p99   ratio           bias     RMS    RMS m/s   '
          '> 20 deg   position  velocity')
    for method, f in results.items():
        ratio = results['default'].cpu_ms_mean / f.cpu_ms_mean
        nees = '' if not np.isfinite(f.nees_position) else (
            f'{f.nees_position:11.2f}{f.nees_velocity:10.2f}')
        print(f'  {method:<13}{f.cpu_ms_mean:8.2f}{f.cpu_ms_p50:8.2f}{f.cpu_ms_p99:8.2f}'
              f'{ratio:8.1f}{f.recall:9.3f}{100 * f.distance_bias_m:8.2f}'
              f'{100 * f.distance_rms_m:8.2f}{f.velocity_rms_m_s:11.3f}{f.turned_share:11.1%}'
              f'{nees}', flush=True)


if __name__ == '__main__':
    sys.exit(main())
