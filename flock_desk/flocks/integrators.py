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
Solutions of dx/dt = v, dv/dt = u(t, x, v) at given instants.

The choice is part of a simulation's specification: near the edges of its band the law is stiff,
and the paper's leader-follower run leaves the band under explicit Euler from dt = 0.02 s on,
where velocity-first (semi-implicit) Euler keeps it at 0.1 s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from flock_follower.geometry import Array

Acceleration = Callable[[float, Array, Array], Array]
State = tuple[Array, Array]


def adaptive(acceleration: Acceleration, start: State, times: Array,
             breaks: Sequence[float] = (), rtol: float = 1e-11,
             atol: float = 1e-12) -> Iterator[State]:
    """
    Yield positions and velocities, both (k, n), at each time, by Dormand and Prince's 8(5,3).

    :param start: the state at ``times[0]``.
    :param breaks: where the acceleration jumps, s: no step straddles these.
    :raises RuntimeError: if no step is small enough, as at a singularity of the law.
    """
    from scipy.integrate import DOP853
    shape = np.shape(start)
    t, y = float(times[0]), np.ravel(start)
    yield start
    waiting = 1
    for end in [*(b for b in sorted(breaks) if t < b < times[-1]), float(times[-1])]:
        # At the very end of a stretch the acceleration is still that of the stretch.
        last = np.nextafter(end, t)

        def rate(t: float, y: Array, last: float = last) -> Array:
            x, v = y.reshape(shape)
            return np.concatenate([v.ravel(), acceleration(min(t, last), x, v).ravel()])

        solver = DOP853(rate, t, y, end, rtol=rtol, atol=atol)
        while solver.status == 'running':
            message = solver.step()
            if solver.status == 'failed':
                raise RuntimeError(f'the solution ends at t = {solver.t:.6g} s: {message}')
            passed = int(np.searchsorted(times, solver.t, side='right'))
            if passed > waiting:
                for state in solver.dense_output()(times[waiting:passed]).T:
                    x, v = state.reshape(shape)
                    yield x, v
                waiting = passed
        t, y = end, solver.y


def semi_implicit(acceleration: Acceleration, start: State, times: Array, dt: float,
                  acceptable: Callable[[Array, Array], bool] | None = None) -> Iterator[State]:
    """
    Yield positions and velocities, both (k, n), at each time, by steps of dt s at most.

    Each step takes the velocity forward first and the position with the new velocity (also
    called symplectic Euler): first order, and stable where explicit Euler is not.

    :param acceptable: of the positions before and after a step: if it returns False the step is
        halved, and lengthened again, doubling, by the steps that follow.
    :raises RuntimeError: if a step a millionth of dt long is not acceptable yet.
    """
    x, v = start
    t, h = float(times[0]), dt
    yield x, v
    for end in times[1:]:
        while end - t > 1e-9 * dt:
            left = end - t
            # Equal steps to the end of the interval, not a sliver after it.
            step = left / np.ceil(left / h - 1e-9)
            u = acceleration(t, x, v)
            while True:
                new_v = v + step * u
                new_x = x + step * new_v
                if acceptable is None or acceptable(x, new_x):
                    break
                step *= 0.5
                if step < 1e-6 * dt:
                    raise RuntimeError(f'the solution ends at t = {t:.6g} s, at a singularity')
            t, x, v = t + step, new_x, new_v
            h = min(dt, 2.0 * step)
        t = float(end)
        yield x, v
