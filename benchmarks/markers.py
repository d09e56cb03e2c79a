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
How far and how near markers are seen: ``python benchmarks/markers.py``, five minutes.

The marker of config/neighbors.yaml, and the panel of ``marker --panel``, rendered before a field
with houses by the camera of the simulator (640x480, 611 px) and given to the tracker. First the
follower hovers at one distance after the other, while the leader sways up to a fifth of the
distance off the image's middle; then the leader comes from 8 m to 0.3 m in 44 s.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np
import yaml

from flock_desk.camera.lens import Camera
from flock_desk.camera.renderer import (
    board,
    Face,
    marker_print,
    Renderer,
    Sensor,
    T_BODY_MARKER,
    T_BODY_OPTICAL,
)
from flock_desk.marker import layout, neighbors_file, SIZES
from flock_follower.geometry import Array, IDENTITY_QUATERNION, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.parameters.neighbors_file import Marker, NeighborConfig
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import compute_in_one_thread
from flock_follower.perception.markers import draw_marker, marker_cells, parse
from flock_follower.perception.tracker import Tracker

DICTIONARY = 'DICT_4X4_50'
DISTANCES = (0.3, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
RUNS, IMAGES = 8, 12
APPROACH, APPROACH_RATE = 44.0, 15.0  # s, Hz
CAMERA = Camera()
MODEL = CameraModel(
    np.array([[CAMERA.focal_x, 0.0, CAMERA.center_x], [0.0, CAMERA.focal_y, CAMERA.center_y],
              [0.0, 0.0, 1.0]]), np.array(CAMERA.distortion), CAMERA.model, CAMERA.width,
    CAMERA.height)
OWN = Transform(translation=np.array([0.0, 0.0, 2.0]))
FROM_TAIL = np.array([0.3, 0.0, 0.0])  # m: the camera is 0.1 m ahead, the marker 0.2 m behind
Motion = Callable[[float], Transform]


class Seen(NamedTuple):
    """An image in which the leader was found."""

    time: float
    range_error: float
    """Of the distance to the leader's middle, m."""
    error: Array
    """(3,), of the estimate, m."""
    speed_error: float
    nees: float


def printed(markers: tuple[Marker, ...]) -> list[Face]:
    """Return one print that shows markers, all of one cell size or multiples, and its board."""
    cells = marker_cells(DICTIONARY)
    cell = min(m.side_length for m in markers) / cells
    places = [T_BODY_MARKER.inverse().apply(m.T_body_marker.translation)[:2] for m in markers]
    halves = [m.side_length * (0.5 + 1.0 / cells) for m in markers]
    low = np.min([p - h for p, h in zip(places, halves)], axis=0)
    high = np.max([p + h for p, h in zip(places, halves)], axis=0)
    columns, rows = np.rint((high - low) / cell).astype(int)
    paper = np.ones((rows, columns))
    for marker, (x, y) in zip(markers, places):
        scale = round(marker.side_length / cells / cell)
        code = np.kron(draw_marker(DICTIONARY, marker.marker_id, cells) > 127,
                       np.ones((scale, scale)))
        row = round((high[1] - y - marker.side_length / 2) / cell)
        column = round((x - marker.side_length / 2 - low[0]) / cell)
        paper[row:row + len(code), column:column + len(code)] = code
    middle = T_BODY_MARKER @ Transform(translation=np.append((low + high) / 2.0, 0.0))
    face = marker_print(paper, cell, middle)
    return [*board(face), face]


def fly(renderer: Renderer, config: NeighborConfig, leader: Motion, seed: int, count: int,
        rate: float) -> list[Seen]:
    """Return what a tracker finds in images of a leader that moves so."""
    tracker = Tracker(config, T_BODY_OPTICAL)
    found = []
    for k in range(count):
        time = 1.0 + k / rate
        for stamp in ([time - 0.02] if k == 0 else []) + [time, time + 0.02]:
            tracker.feed_odometry(OdometrySample(
                stamp, OWN.translation, IDENTITY_QUATERNION, np.zeros(3), np.zeros(3)))
        leaders = [leader(moment) for moment in renderer.sensor.times(time)]
        image = renderer.image(1000 * seed + k, [OWN @ T_BODY_OPTICAL] * len(leaders), leaders)
        sighting = tracker.process_image(time, image, MODEL)
        if 'leader' not in sighting.estimates:
            continue
        estimate, true = sighting.estimates['leader'], leader(time)
        measured = sighting.measurements['leader'].T_camera_body.translation
        relative = T_BODY_OPTICAL.inverse().apply(OWN.inverse().apply(true.translation))
        error = estimate.position - true.translation
        velocity = (leader(time + 0.005).translation - leader(time - 0.005).translation) / 0.01
        found.append(Seen(
            time, float(np.linalg.norm(measured) - np.linalg.norm(relative)), error,
            float(np.linalg.norm(estimate.velocity - velocity)),
            float(error @ np.linalg.solve(estimate.covariance[:3, :3], error))))
    return found


def swaying(distance: float, seed: int) -> Motion:
    """Return a leader that stays about a distance, m, somewhere in the image."""
    rng = np.random.default_rng(seed)
    place = OWN.translation + FROM_TAIL + distance * np.array(
        [1.0, rng.uniform(-0.2, 0.2), rng.uniform(-0.17, 0.17)])
    turn = rng.normal(0.0, 0.12, 3) * [0.5, 0.5, 1.5]
    phase, frequency = rng.uniform(0.0, math.tau, 6), rng.uniform(0.2, 0.6, 6)

    def at(time: float) -> Transform:
        wave = np.sin(math.tau * frequency * time + phase)
        return Transform(rotation_vector_to_matrix(turn + 0.05 * wave[3:]),
                         place + 0.03 * min(1.0, distance) * wave[:3])
    return at


def distance_at(time: float) -> float:
    """Return how far the leader is that approaches, m."""
    share = min(max((time - 1.0) / APPROACH, 0.0), 1.0)
    return float(8.0 * (0.3 / 8.0) ** (share * share * (3.0 - 2.0 * share)))


def approaching(time: float) -> Transform:
    """Return where the leader is that comes near."""
    distance = distance_at(time)
    turn = [0.03 * math.sin(1.1 * time), 0.04 * math.sin(0.8 * time), 0.12 * math.sin(0.5 * time)]
    off = distance * np.array([1.0, 0.06 * math.sin(0.9 * time), 0.03 * math.sin(0.7 * time)])
    return Transform(rotation_vector_to_matrix(turn), OWN.translation + FROM_TAIL + off)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Print the detections."""
    argparse.ArgumentParser(description=__doc__.split('\n\n')[0]).parse_args()
    compute_in_one_thread()
    one, two = layout(DICTIONARY, [0], [0.16]), layout(DICTIONARY, [0, 1], SIZES)
    carried = {'0.16 m': parse(yaml.safe_load(neighbors_file(DICTIONARY, [one]))),
               'panel': parse(yaml.safe_load(neighbors_file(DICTIONARY, [two])))}
    renderers = {name: Renderer(CAMERA, Sensor(), printed(config.neighbors[0].markers))
                 for name, config in carried.items()}
    print('hovering: share of images, RMS of the distance, its mean error, NEES of the place')
    for distance in DISTANCES:
        for name, config in carried.items():
            seen = [each for seed in range(RUNS) for each in fly(
                renderers[name], config, swaying(distance, seed), seed, IMAGES, 30.0)]
            errors = [1e3 * each.range_error for each in seen] or [math.nan]
            print(f'{distance:4.1f} m  {name:7} {len(seen) / (RUNS * IMAGES):5.0%}  '
                  f'{rms(errors):6.1f} mm  {np.mean(errors):6.1f} mm  '
                  f'{np.mean([each.nees for each in seen] or [math.nan]):5.1f}', flush=True)
    count = round(APPROACH * APPROACH_RATE)
    for name, config in carried.items():
        seen = fly(renderers[name], config, approaching, 0, count, APPROACH_RATE)
        print(f'from 8 to 0.3 m, {name}: seen in {len(seen)} of {count} images')
        steps = [0.0, *(float(np.linalg.norm(b.error - a.error)) for a, b in pairwise(seen))]
        for near, far in ((0.3, 0.6), (0.6, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, 6.0), (6.0, 8.1)):
            part = [k for k, each in enumerate(seen) if near <= distance_at(each.time) < far]
            if part:
                place = rms([float(np.linalg.norm(seen[k].error)) for k in part])
                print(f'  {near} to {far} m: place {1e3 * place:.1f} mm RMS, largest step '
                      f'{1e3 * max(steps[k] for k in part):.1f} mm, velocity '
                      f'{rms([seen[k].speed_error for k in part]):.3f} m/s RMS, NEES '
                      f'{np.mean([seen[k].nees for k in part]):.1f}', flush=True)


if __name__ == '__main__':
    main()
