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
Write the sample bag, and longer, harder ones: one seeded flight, rendered and recorded.

``python -m flock_desk.sample_bag`` writes bags/sample again: the same flight and odometry, byte
for byte with the pinned versions, and images of today's camera. No clock is read.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
import os
from pathlib import Path
import shutil
import sys
import tempfile
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_desk.camera.lens import Camera
from flock_desk.camera.renderer import Renderer, Sensor, T_BODY_OPTICAL
from flock_desk.closed_loop.real_time_flight import calibration
from flock_desk.runs.console import guarded, progress, within
from flock_desk.runs.processes import computed
from flock_desk.scenarios.scenario import VioErrors
from flock_desk.scenarios.trajectories import fly, Swing
from flock_desk.sensors.vio import Odometry, odometry, true_odometry
from flock_follower.bags.bag import BagError, BagMessage, serialize, typestore
from flock_follower.bags.message_types import empty
from flock_follower.bags.writer import BagWriter
from flock_follower.messages.state_writer import odometry as odometry_message
from flock_follower.parameters.files import FLOWN
from flock_follower.perception.images import compute_in_one_thread
from flock_follower.ranges import Range

#: Stamp of the flight's time 0: an arbitrary but fixed date, ns.
START_NS = 1_700_000_000_000_000_000
ODOMETRY_RATE = 200  # Hz
IMAGE_RATE = 30  # Hz
#: Odometry arrives 1.5 ms after its stamp, and up to 0.5 ms of transport later.
ODOMETRY_ERRORS = VioErrors(rate=ODOMETRY_RATE, latency=(0.0015, 0.0015), tilt_bias=0.0)

_NS_PER_MS = 1_000_000  # ns
_FIRST_IMAGE_NS = 12_500_000  # not on an odometry stamp: cameras seldom are
_INFO, _ODOMETRY = 'sensor_msgs/msg/CameraInfo', 'nav_msgs/msg/Odometry'


@dataclass(frozen=True)
class Variant:
    """The options of one bag."""

    summary: str
    duration: float = 12.0
    """s."""
    camera: Camera = field(default_factory=Camera)
    sensor: Sensor = field(default_factory=Sensor)
    swing: Swing | None = None
    """None: the follower flies by the flocking law."""
    jpeg_quality: int | None = None
    """None: raw mono8."""


def _enlarge_lens(width: int, height: int) -> Camera:
    """Return the sample's lens on a finer sensor with the same horizontal field of view."""
    small = Camera()
    finer = width / small.width
    return Camera(width, height, finer * small.focal_x, finer * small.focal_y,
                  width / 2 + finer * (small.center_x - small.width / 2),
                  height / 2 + finer * (small.center_y - small.height / 2))


VARIANTS = {
    'sample': Variant('what the demo and the tests replay', jpeg_quality=80),
    'raw': Variant('the sample, uncompressed mono8'),
    'hard': Variant('from 1 to 4 m, exposed for 18 ms, with twice the noise', sensor=Sensor(
        exposure=0.018, sub_poses=12, full_well=3000.0, read_noise=6.0),
        swing=Swing(1.1, 3.95, 12.0, 0.9)),
    'fisheye': Variant('a lens of 165 degrees, equidistant model: the marker is small',
                       camera=Camera(848, 800, 286.1, 285.9, 421.3, 403.6, 'equidistant',
                                     (-0.0076, 0.0450, -0.0426, 0.0076)),
                       sensor=Sensor(vignetting=0.15)),
    # A sensor as large: each pixel has a fourth, a ninth of the sample's area and electrons.
    'hd': Variant('1280 x 720', camera=_enlarge_lens(1280, 720),
                  sensor=Sensor(full_well=3000.0, read_noise=6.0)),
    'full_hd': Variant('1920 x 1080', camera=_enlarge_lens(1920, 1080),
                       sensor=Sensor(full_well=1333.0, read_noise=4.0)),
    'blur': Variant('exposed for 25 ms', sensor=Sensor(exposure=0.025, sub_poses=12)),
    'dark': Variant('dusk: exposed for 12 ms, little light, much noise', sensor=Sensor(
        exposure=0.012, sub_poses=6, gain=0.25, full_well=800.0, read_noise=9.0)),
}


class Recording:
    """The topics of one flight; images are rendered on request."""

    def __init__(self, variant: Variant, seed: int = 1) -> None:
        self.variant, self.seed = variant, seed
        # Longer than recorded, so that the last image's exposure ends within the flight.
        self.leader, self.follower = fly(variant.duration + 0.1, seed, variant.swing)
        count = round(variant.duration * IMAGE_RATE)
        self.image_stamps_ns = [START_NS + _FIRST_IMAGE_NS + k * 1000 * _NS_PER_MS // IMAGE_RATE
                                for k in range(count)]
        rng = np.random.default_rng([seed, 2])
        #: When the images arrive: after exposure, read-out, transport.
        self.image_arrivals_ns = [
            stamp + round(variant.sensor.exposure * 5e8) + 8 * _NS_PER_MS + int(jitter)
            for stamp, jitter in zip(self.image_stamps_ns, rng.integers(0, 2 * _NS_PER_MS, count))]

    @cached_property
    def odometry(self) -> list[Odometry]:
        """Return the odometry of the follower's VIO."""
        times = np.arange(round(self.variant.duration * ODOMETRY_RATE) + 1) / ODOMETRY_RATE
        # Rounded: the last bits differ between processors.
        return [Odometry(o.time, o.position.round(6), o.quaternion.round(8), o.linear.round(6),
                         o.angular.round(6), o.pose_covariance.round(12), o.twist_covariance)
                for o in odometry(self.follower, times, ODOMETRY_ERRORS, self.seed)]

    @cached_property
    def renderer(self) -> Renderer:
        """Return the camera."""
        return Renderer(self.variant.camera, self.variant.sensor, seed=self.seed)

    def pixels(self, k: int) -> NDArray[np.uint8]:
        """Return image k (height, width), mono8."""
        times = self.variant.sensor.times(_seconds(self.image_stamps_ns[k]))
        return self.renderer.image(
            k, [self.follower.pose(t) @ T_BODY_OPTICAL for t in times],
            [self.leader.pose(t) for t in times])

    def image(self, k: int) -> BagMessage:
        """Return image k as it is recorded."""
        pixels, types = self.pixels(k), typestore().types
        header = _header(self.image_stamps_ns[k], 'camera_optical_frame')
        if self.variant.jpeg_quality is None:
            topic, name = '/image_raw', 'sensor_msgs/msg/Image'
            message = types[name](header, *pixels.shape, 'mono8', 0, pixels.shape[1],
                                  pixels.ravel())
        else:
            topic, name = '/image_raw/compressed', 'sensor_msgs/msg/CompressedImage'
            data = cv2.imencode('.jpg', pixels, [
                cv2.IMWRITE_JPEG_QUALITY, self.variant.jpeg_quality,
                cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1]
            message = types[name](header, 'jpeg', data.ravel())
        return BagMessage(topic, name, self.image_arrivals_ns[k], serialize(message, name))

    def camera_info(self, k: int) -> BagMessage:
        """Return the calibration recorded just before image k."""
        info, types = calibration(self.variant.camera), typestore().types
        message = types[_INFO](
            _header(self.image_stamps_ns[k], 'camera_optical_frame'), info['height'],
            info['width'], info['distortion_model'], *(np.array(info[name]) for name in 'dkrp'),
            0, 0, types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False))
        return BagMessage('/camera_info', _INFO, self.image_arrivals_ns[k] - 20_000,
                          serialize(message, _INFO))

    def truth(self, k: int) -> list[BagMessage]:
        """Return the true motion of both vehicles at the stamp of image k."""
        stamp, arrival = self.image_stamps_ns[k], self.image_arrivals_ns[k] + 20_000
        return [
            _odometry_message(topic, child, stamp, arrival,
                              true_odometry(track, _seconds(stamp)))
            for topic, child, track in (
                ('/truth/odom', 'base_link', self.follower),
                ('/truth/neighbors', 'leader', self.leader))]

    def odom(self) -> list[BagMessage]:
        """Return the follower's odometry."""
        jitter = np.random.default_rng([self.seed, 3]).integers(0, _NS_PER_MS // 2,
                                                                len(self.odometry))
        latency = round(1e9 * ODOMETRY_ERRORS.latency[0])
        messages = []
        for k, (state, late) in enumerate(zip(self.odometry, jitter)):
            stamp = START_NS + k * 1000 * _NS_PER_MS // ODOMETRY_RATE
            messages.append(_odometry_message('/odom', 'base_link', stamp,
                                              stamp + latency + int(late), state))
        return messages

    def messages(self, images: Iterable[BagMessage]) -> Iterator[BagMessage]:
        """Yield every message, and the given images, in the order of arrival."""
        odom = deque(self.odom())
        for k, image in enumerate(images):
            info = self.camera_info(k)
            while odom and odom[0].stamp_ns < info.stamp_ns:
                yield odom.popleft()
            yield from (info, image, *self.truth(k))
        yield from odom


#: The file beside the bag: the parameters of the flight that are not the defaults.
PARAMETERS = """\
# The parameters of this flight that are not the defaults. `evaluate` and `make demo` read them;
# beside a replay start planner and bridge with --params-file and this file.
/**:
  ros__parameters:
    v_max: 2.0                 # m/s; a first flight has 0.5
"""


def write(variant: Variant, seed: int, out: Path, jobs: int) -> None:
    """
    Write a bag, in place of an older one there, rendering in processes of its own.

    :param jobs: number of processes; they change nothing but the time it takes.
    :raises BagError: if something other than a bag is in the way, or cannot be written.
    """
    if out.exists() and not (out / 'metadata.yaml').is_file():
        raise BagError(f'{out}: exists and is not a bag: not replaced')
    out.parent.mkdir(parents=True, exist_ok=True)
    recording = _make_recording(variant, seed)
    count = len(recording.image_stamps_ns)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix='.writing-') as scratch:
        images = computed(partial(_render_images, variant, seed), range(count), jobs)
        with BagWriter(Path(scratch) / out.name) as bag:
            for message in recording.messages(_count_images(images, count, out.name)):
                bag.write(message.topic, message.msgtype, message.stamp_ns, message.data)
        (Path(scratch) / out.name / FLOWN).write_text(PARAMETERS, encoding='utf-8')
        if out.exists():
            shutil.rmtree(out)
        shutil.move(str(Path(scratch) / out.name), out)


@lru_cache(maxsize=1)
def _make_recording(variant: Variant, seed: int) -> Recording:
    """Return the recording; once in each process that renders."""
    compute_in_one_thread()
    return Recording(variant, seed)


def _render_images(variant: Variant, seed: int, k: int) -> BagMessage:
    return _make_recording(variant, seed).image(k)


def _count_images(images: Iterable[BagMessage], count: int, name: str) -> Iterator[BagMessage]:
    """Yield the images, showing how many have been."""
    with progress(count) as bar:
        bar.set_description_str(f'{name}, {count} images')
        for image in images:
            yield image
            bar.update()


def _odometry_message(topic: str, child: str, stamp_ns: int, arrival_ns: int,
                      state: Odometry) -> BagMessage:
    return BagMessage(topic, _ODOMETRY, arrival_ns, serialize(odometry_message(
        empty, stamp_ns, 'odom', child, state.position, state.quaternion, state.linear,
        state.angular, state.pose_covariance, state.twist_covariance), _ODOMETRY))


def _header(stamp_ns: int, frame: str) -> Any:
    types = typestore().types
    stamp = types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 1000 * _NS_PER_MS))
    return types['std_msgs/msg/Header'](stamp, frame)


def _seconds(stamp_ns: int) -> float:
    return (stamp_ns - START_NS) * 1e-9


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 1 after an error."""
    repository = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(
        prog='sample', description='Render a flight and write it as a bag.',
        epilog='; '.join(f'{name}: {variant.summary}' for name, variant in VARIANTS.items()))
    parser.add_argument('--variant', nargs='+', choices=[*VARIANTS, 'all'], default=['sample'],
                        metavar='NAME', help=f'{", ".join(VARIANTS)} or all (default: sample)')
    parser.add_argument('--output', '--out', type=Path,
                        help='folder that will hold the bags (default: bags '
                        'for sample, build/bags for the others)')
    parser.add_argument('--seed', type=int, default=1, help='of all that is random (%(default)s)')
    parser.add_argument('--jobs', type=within(Range(1, whole=True)), default=os.cpu_count() or 1,
                        help='processes that render (default: one per processor)')
    options = parser.parse_args(args)

    def render() -> int:
        for name in VARIANTS if 'all' in options.variant else options.variant:
            folder = options.output or repository / ('bags' if name == 'sample' else 'build/bags')
            write(VARIANTS[name], options.seed, folder / name, options.jobs)
        return 0
    return guarded(render)


if __name__ == '__main__':
    sys.exit(main())
