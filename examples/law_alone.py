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
The law alone, with numpy: three agents of the paper agree on a velocity, and keep their distance.

    python examples/law_alone.py [PICTURE]    # build/law_alone.png
"""

from pathlib import Path
import signal
import sys

from matplotlib.figure import Figure
import numpy as np

from flock_follower.flocking import accelerations, FlockingParams, lyapunov

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a traceback
DT, DURATION = 0.01, 20.0  # s
# d0 and d1 bound the squared distance: 1 to 2.25 m^2 is 1 to 1.5 m.
params = FlockingParams(K=1.0, sigma=1.0, beta=0.5, theta=2.0, d0=1.0, d1=2.25)
positions = np.array([[0.0, 0.0], [1.25, 0.0], [0.63, 1.08]])  # m; three dimensions work as well
headings = np.radians([45.0, 135.0, 270.0])
speeds = np.array([0.54, 0.42, 0.99])  # m/s
velocities = speeds[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=1)

tracks, energy = [positions], [lyapunov(positions, velocities, params)]
for _ in range(round(DURATION / DT)):
    velocities = velocities + DT * accelerations(positions, velocities, params)
    positions = positions + DT * velocities  # with the new velocity: stable up to steps of 0.1 s
    tracks.append(positions)
    energy.append(lyapunov(positions, velocities, params))

print(f'speeds {np.linalg.norm(velocities, axis=1).round(4)} m/s, '
      f'Lyapunov function from {energy[0]:.2f} to {energy[-1]:.2f}')
flock, times = np.array(tracks), DT * np.arange(len(tracks))
figure = Figure(figsize=(9, 4), layout='constrained')
above, apart = figure.subplots(1, 2)
for i in range(3):
    above.plot(*flock[:, i].T, label=f'agent {i + 1}')
above.plot(*flock[-1].T, 'ks')
above.set(title='from above (square: end)', xlabel='x [m]', ylabel='y [m]', aspect='equal')
apart.axhspan(params.d0**0.5, params.d1**0.5, alpha=0.1, label='the band')
for i, j in ((0, 1), (0, 2), (1, 2)):
    distance = np.linalg.norm(flock[:, i] - flock[:, j], axis=1)
    apart.plot(times, distance, label=f'{i + 1} to {j + 1}')
apart.set(title='distances', xlabel='time [s]', ylabel='[m]')
above.legend(loc='upper left', bbox_to_anchor=(1.0, 1.0))
apart.legend()
picture = Path(sys.argv[1] if len(sys.argv) > 1 else 'build/law_alone.png')
picture.parent.mkdir(parents=True, exist_ok=True)
figure.savefig(picture, dpi=120)
