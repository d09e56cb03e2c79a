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

"""The moving picture of a flight: the camera's image, both paths from above, the distance."""

from __future__ import annotations

import io

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from PIL import Image

from flock_desk.camera.renderer import T_BODY_OPTICAL
from flock_desk.closed_loop.real_time_flight import real_time_camera
from flock_desk.runs.plots import draw_above, draw_distance, FOLLOWER, LEADER, TIME
from flock_desk.runs.record import LiveFlight
from flock_follower.geometry import Transform

PICTURE_RATE = 8.0  # pictures per s
MAX_DURATION = 15.0  # s, the part of the flight that is shown


def moving_picture(flight: LiveFlight) -> bytes:
    """
    Return the first seconds of a flight as an animated WebP.

    The camera's images are rendered again from the recorded true poses.
    """
    times, log = flight.table['time'], flight.log
    ticks = np.arange(times[0], min(float(times[-1]), MAX_DURATION), 1.0 / PICTURE_RATE)
    camera = real_time_camera(0, flight.scenario.prints)
    figure = Figure(figsize=(9, 4.6), dpi=100, layout='constrained')
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [['seen', 'above'], ['distance', 'distance']],
        width_ratios=[1.2, 1.0], height_ratios=[1.9, 1.0])
    shown = axes['seen'].imshow(np.zeros((camera.camera.height, camera.camera.width)),
                                cmap='gray', vmin=0, vmax=255)
    axes['seen'].set(title="the follower's camera", xticks=[], yticks=[])
    draw_above(axes['above'], flight)
    draw_distance(axes['distance'], flight)
    axes['distance'].set(xlim=(0.0, ticks[-1]), xlabel=TIME)
    now = axes['distance'].axvline(0.0, color='black', linewidth=1.2)
    places = [(path, axes['above'].plot([], [], 'o', color=color, markersize=9)[0])
              for path, color in zip(flight.paths.values(), (LEADER, FOLLOWER))]
    canvas, pictures = FigureCanvasAgg(figure), []
    for row in np.minimum(np.searchsorted(times, ticks), len(times) - 1):
        follower, leader = (Transform.from_quaternion(
            log[f'{name}_position'][row], log[f'{name}_quaternion'][row])
            for name in ('follower', 'leader'))
        visible = [leader] if flight.table['visible'][row] else []
        shown.set_data(camera.image(int(row), [follower @ T_BODY_OPTICAL], visible))
        for path, place in places:
            place.set_data(path[row:row + 1, 0], path[row:row + 1, 1])
        now.set_xdata([times[row]] * 2)
        canvas.draw()
        figure.set_layout_engine('none')  # as in the first picture: the axes stand still
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert('RGB'))
    buffer = io.BytesIO()
    pictures[0].save(buffer, format='WEBP', save_all=True, append_images=pictures[1:],
                     duration=round(1e3 / PICTURE_RATE), loop=0, quality=55, method=2)
    return buffer.getvalue()
