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
The pictures of ``fly``: those of its reports, its portrait, and the moving one.

The moving picture shows the camera's image, both tracks from above, and the distance.
"""

from __future__ import annotations

from collections.abc import Mapping
import io
from itertools import cycle

import cv2
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flock_desk.camera.renderer import SIDE_LENGTH, T_BODY_MARKER
from flock_desk.closed_loop.real_time_flight import real_time_camera, T_BODY_OPTICAL
from flock_desk.runs.plots import (
    add_key,
    chapters,
    COLOURS,
    draw_above,
    draw_distance,
    draw_map,
    encoded,
    equal_scales,
    FOLLOWER,
    LEADER,
    LIMIT,
    TIME,
    with_gaps,
)
from flock_desk.runs.record import LiveRecord
from flock_desk.runs.report import Chapter, Illustration
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array, Transform

RATE, LONGEST = 8.0, 15.0  # pictures per s; s, the part of the flight that is shown
_CORNERS = 0.5 * SIDE_LENGTH * np.array(
    [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])


def scenario_chapters(flight: LiveRecord) -> list[Chapter]:
    """Return the pictures of the report of ``fly``: plots, and images of the follower's camera."""
    log, times = flight.log, flight.table['time']
    epoch = int(log['image_stamp'][0]) - round(float(times[0]) * 1e9)
    return [*chapters(
        flight,
        note='Shaded: the scenario hides the leader, or withholds the odometry to place it with.'),
        Chapter("Images of the follower's camera", '', [
            Illustration(cv2.imencode('.jpg', image)[1].tobytes(), '',
                         f'{(int(stamp) - epoch) * 1e-9:.1f} s')
            for stamp, image in zip(log['picture_stamp'], log['picture'])])]


def portrait(flight: LiveRecord) -> bytes:
    """Return an image of the follower's camera beside both tracks and the distance, JPEG."""
    images = flight.log['picture']
    image: NDArray[np.uint8] = images[len(images) // 2]
    figure = Figure(figsize=(12, 4.8), dpi=100, layout='constrained')
    axes: dict[str, Axes] = figure.subplot_mosaic([['seen', 'above'], ['seen', 'distance']],
                                                  width_ratios=[1.3, 1.0],
                                                  height_ratios=[1.3, 1.0])
    axes['seen'].imshow(image, cmap='gray', vmin=0, vmax=255)
    axes['seen'].set(title="the follower's camera", xticks=[], yticks=[])
    axes['seen'].spines[['top', 'right']].set_visible(True)
    draw_above(axes['above'], flight)
    draw_distance(axes['distance'], flight, with_gaps(flight.table))
    axes['distance'].set(xlim=(0.0, flight.duration), xlabel=TIME)
    return encoded(figure, 'jpg')


def column_chapters(times: Array, tracks: Mapping[str, Array], distances: Mapping[str, Array],
                    law: FlockingParams) -> list[Chapter]:
    """
    Return the page of a column: a picture of the tracks, and the distances of all pairs.

    :param times: (n,), s; ``tracks`` (n, 3), m, by vehicle; ``distances`` (n,), m, by pair.
    """
    figure = Figure(figsize=(13, 8), dpi=110, layout='constrained')
    above, apart = figure.subplots(2, 1, height_ratios=[1.2, 1.0])
    draw_map(above, tracks, 'from above (● start, ■ end)')
    apart.axhspan(np.sqrt(law.d0), np.sqrt(law.d1), color=LEADER, alpha=0.08, lw=0)
    for (name, distance), colour in zip(distances.items(), cycle(COLOURS)):
        apart.plot(times, distance, color=colour, linewidth=1.1, label=name)
    apart.set(xlabel=TIME, ylabel='true distance [m]', xlim=(0.0, float(times[-1])),
              ylim=(0.0, None), title='distances; shaded: the band')
    add_key(apart)
    return [Chapter(
        'The column', 'In the frame of the first follower. Each has a page of its own: '
        + ', '.join(f'{name}/report.html' for name in tracks if name != 'leader') + '.',
        [Illustration(encoded(figure), 'tracks from above and distances of all pairs')])]


def moving_picture(record: LiveRecord) -> bytes:
    """
    Return the first seconds of a flight as an animated WebP.

    The camera's images are rendered again from the recorded true poses; the outline is the marker
    at the estimated position, with the true attitude.
    """
    table, log, law = record.table, record.log, record.params.law
    times = table['time']
    ticks = np.arange(times[0], min(float(times[-1]), LONGEST), 1.0 / RATE)
    rows = np.minimum(np.searchsorted(times, ticks), len(times) - 1)
    camera = real_time_camera(0, record.scenario.prints)
    figure = Figure(figsize=(9, 4.6), dpi=100, layout='constrained')
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [['seen', 'above'], ['distance', 'distance']],
        width_ratios=[1.2, 1.0], height_ratios=[1.9, 1.0])
    shown = axes['seen'].imshow(np.zeros((camera.camera.height, camera.camera.width)),
                                cmap='gray', vmin=0, vmax=255)
    outline, = axes['seen'].plot([], [], color=FOLLOWER, linewidth=2)
    axes['seen'].set(title="the follower's camera; outline: the estimate", xticks=[], yticks=[])
    tracks = []
    for (name, path), colour in zip(record.paths.items(), (LEADER, FOLLOWER)):
        axes['above'].plot(*path[:rows[-1] + 1, :2].T, color=colour, alpha=0.15)
        tracks.append((path, axes['above'].plot(
            [], [], color=colour, linewidth=2, marker='o', markevery=[-1], label=name)[0]))
    axes['above'].set(title='from above', xlabel='x [m]', ylabel='y [m]')
    axes['above'].legend(loc='best', fontsize=9)
    equal_scales(axes['above'])
    low, high = np.sqrt(law.d0), np.sqrt(law.d1)
    axes['distance'].axhspan(low, high, color=LEADER, alpha=0.1, lw=0)
    for value, text in ((low, '√d0'), (high, '√d1')):
        axes['distance'].axhline(value, color=LIMIT, linestyle='--', linewidth=1)
        axes['distance'].text(1.005, value, f'{text} = {value:.2f} m', va='center', fontsize=8,
                              transform=axes['distance'].get_yaxis_transform())
    axes['distance'].plot(times, table['true_distance'], color=FOLLOWER, linewidth=1.8)
    axes['distance'].set(xlim=(0.0, ticks[-1]), ylim=(0.8 * low, 1.1 * high), xlabel='time [s]',
                         ylabel='true distance [m]')
    now = axes['distance'].axvline(0.0, color='black', linewidth=1.2)
    canvas, pictures = FigureCanvasAgg(figure), []
    for row in rows:
        follower, leader = (Transform.from_quaternion(
            log[f'{name}_position'][row], log[f'{name}_quaternion'][row])
            for name in ('follower', 'leader'))
        optical = follower @ T_BODY_OPTICAL
        visible = [leader] if table['visible'][row] else []
        shown.set_data(camera.image(int(row), [optical], visible))
        error = np.array([table[f'position_{axis}'][row] for axis in 'xyz'])
        corners = (leader @ T_BODY_MARKER).apply(_CORNERS) + follower.rotation @ error
        outline.set_data(*camera.camera.project(
            (corners - optical.translation) @ optical.rotation).T)
        for path, line in tracks:
            line.set_data(*path[:row + 1, :2].T)
        now.set_xdata([times[row]] * 2)
        pictures.append(_drawn(canvas))
    return _animated(pictures)


def _drawn(canvas: FigureCanvasAgg) -> Image.Image:
    canvas.draw()
    canvas.figure.set_layout_engine('none')  # as in the first picture: the axes stand still
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert('RGB')


def _animated(pictures: list[Image.Image]) -> bytes:
    buffer = io.BytesIO()
    pictures[0].save(buffer, format='WEBP', save_all=True, append_images=pictures[1:],
                     duration=round(1e3 / RATE), loop=0, quality=55, method=2)
    return buffer.getvalue()
