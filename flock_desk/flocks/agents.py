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
Flocks of point agents under the law or its predecessors: from a start to arrays.

    from flock_desk.flocks.agents import simulate
    from flock_desk.flocks.paper import LEADERLESS, PARAMS
    run = simulate(*LEADERLESS, PARAMS, duration=20.0)
    run.time, run.positions, run.velocities, run.metrics.min_r2

``simulate`` has every agent see all others, as in the paper; ``simulate_graph`` is for larger
flocks. Vicsek's rule (Vicsek et al. 1995) is in discrete time, without noise, in two readings: in
the literal one each agent keeps its own speed and takes the mean heading of the agents within a
radius, itself included. The paper's figure of three agents, whose speeds become equal, fits only
the other reading: each agent takes the mean velocity of these agents.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import cast, get_args, Literal

import numpy as np
from numpy.typing import ArrayLike

from flock_desk.flocks.flock_metrics import Graph, Metrics, metrics
from flock_desk.flocks.laws import (
    graph_accelerations,
    new_edges,
    Pairs,
    pairs_within,
    step_is_small,
)
from flock_desk.flocks.paper import leader_input, LEADER_SWITCH
from flock_follower import flocking
from flock_follower.flocking import accelerations, FlockingParams
from flock_follower.geometry import Array

Model = Literal['flocking', 'cucker_dong', 'cucker_smale', 'vicsek', 'vicsek_mean_velocity']
Acceleration = Callable[[float, Array, Array], Array]
State = tuple[Array, Array]

VICSEK_STEP = 0.1  # s
VICSEK_RADIUS = 1.0  # m, within which an agent sees others
_LOOK_PERIOD = 0.05  # s between searches for new edges
_SKIN = 0.05  # m that agents may move before near pairs are searched again


@dataclass(frozen=True)
class Simulation:
    """A solution: time (m,), s, positions (m, k, n), m, and velocities (m, k, n), m/s."""

    time: Array
    positions: Array
    velocities: Array
    params: FlockingParams
    graph: Graph | None = field(default=None, repr=False)
    """The neighbor graph at the end, if there is one."""

    @cached_property
    def metrics(self) -> Metrics:
        """Return the figures that flocks are compared by, at every time."""
        return metrics(self.time, self.positions, self.velocities, self.params, self.graph)


def simulate(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams, *,
             duration: float = 20.0, model: Model = 'flocking', led: bool = False,
             sample_period: float = 0.02) -> Simulation:
    """
    Return the motion of a flock from initial positions and velocities, (k, n), n = 2 or 3.

    :param led: whether agent 0 is the paper's leader, which obeys ``leader_input`` alone.
    :param duration: s to simulate; :param sample_period: s between the times returned, at least
        0.1 s for Vicsek's rule.
    :raises ValueError: for an unknown model, bad shapes or values, or a start outside the band.
    :raises RuntimeError: if the solution does not stay finite.
    """
    if model not in get_args(Model):
        raise ValueError(f'model = {model!r}: must be one of {", ".join(get_args(Model))}')
    x, v = flocking.checked(positions, velocities)
    if model.startswith('vicsek'):
        time = VICSEK_STEP * np.arange(round(duration / VICSEK_STEP) + 1)
        states = _vicsek(x, v, len(time) - 1, model, led)
    else:
        time = np.linspace(0.0, duration, max(1, round(duration / sample_period)) + 1)
        _check_band(x, params, model)
        states = adaptive(partial(_acceleration, params, cast(flocking.Model, model), led),
                          (x, v), time, (LEADER_SWITCH,) if led else ())
    x, v = map(np.array, zip(*states))
    return Simulation(time, x, v, params)


def simulate_graph(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams, *,
                   duration: float = 20.0, dt: float = 0.005, sample_period: float = 0.05,
                   progress: Callable[[], object] = lambda: None) -> Simulation:
    """
    Return the motion of a flock on its neighbor graph; see ``simulate``.

    :param dt: s, the longest step.
    :param progress: called at each of the times returned.
    :raises RuntimeError: if the flock ends at a singularity of the law.
    """
    x, v = flocking.checked(positions, velocities)
    time = np.linspace(0.0, duration, max(1, round(duration / sample_period)) + 1)
    growing = _GrowingGraph(x, params)
    states = []
    for state in growing.states((x, v), time, dt):
        states.append(state)
        progress()
    x, v = map(np.array, zip(*states))
    return Simulation(time, x, v, params, Graph(growing.edges, np.array(growing.joined)))


class _GrowingGraph:
    """The neighbor graph of a flock, which grows with its motion, and the law on it."""

    def __init__(self, positions: Array, params: FlockingParams) -> None:
        self.edges = pairs_within(positions, np.sqrt(params.d1))
        self.joined = [0.0] * len(self.edges)
        self._params = params
        self._near: tuple[Array, Pairs] | None = None

    def states(self, start: State, time: Array, dt: float) -> Iterator[State]:
        """Yield the states at each time, letting the graph grow at each, and between."""
        yield start
        state = start
        for begin, end in pairwise(time):
            looks = np.linspace(begin, end, 1 + int(np.ceil((end - begin) / _LOOK_PERIOD)))
            for since, t in pairwise(looks):
                *_, state = semi_implicit(self._accelerations, state, np.array([since, t]), dt,
                                          self._step_is_small)
                new = new_edges(self.edges, state[0], self._params, self._nearby(state[0]))
                self.edges = np.concatenate([self.edges, new])
                self.joined += [t] * len(new)
            yield state

    def _accelerations(self, _: float, x: Array, v: Array) -> Array:
        return graph_accelerations(x, v, self._params, self.edges, self._nearby(x))

    def _step_is_small(self, before: Array, after: Array) -> bool:
        return step_is_small(before, after, self._params, self.edges, self._nearby(before))

    def _nearby(self, x: Array) -> Pairs:
        """Return at least the pairs with r^2 < d1."""
        if self._near is None or np.abs(x - self._near[0]).max() > _SKIN:
            # Each of two agents may move by _SKIN along each of at most 3 axes.
            distance = np.sqrt(self._params.d1) + 2.0 * np.sqrt(3.0) * _SKIN
            self._near = x, pairs_within(x, distance)
        return self._near[1]


def _acceleration(params: FlockingParams, model: flocking.Model, led: bool, t: float, x: Array,
                  v: Array) -> Array:
    u = accelerations(x, v, params, model)
    if led:
        u[0] = leader_input(t)
    return u


def _vicsek(x: Array, v: Array, steps: int, model: Model,
            led: bool) -> Iterator[State]:
    """Yield the first state, and that after every step."""
    yield x, v
    for n in range(steps):
        after = velocities_after(x, v, model == 'vicsek_mean_velocity')
        if led:
            after[0] = v[0] + VICSEK_STEP * leader_input(n * VICSEK_STEP)
        # In this order: the present velocity leads to the next place.
        x, v = x + VICSEK_STEP * v, after
        yield x, v


def velocities_after(positions: Array, velocities: Array, mean_velocity: bool = False) -> Array:
    """
    Return the velocities (k, n), m/s, that agents take next by Vicsek's rule.

    :param positions: (k, n), m, now; :param velocities: (k, n), m/s, now.
    :param mean_velocity: take the mean velocity, not the mean heading at the agent's own speed.
    """
    offsets = positions[:, None] - positions
    seen = (np.sum(offsets ** 2, axis=2) <= VICSEK_RADIUS ** 2).astype(float)
    if mean_velocity:
        mean: Array = seen @ velocities / seen.sum(axis=1, keepdims=True)
        return mean
    speed = np.linalg.norm(velocities, axis=1, keepdims=True)
    heading = velocities / np.maximum(speed, 1e-12)
    total = seen @ heading
    length = np.linalg.norm(total, axis=1, keepdims=True)
    # Headings that cancel have no mean: an agent then keeps its own.
    return speed * np.where(length > 1e-12, total / np.maximum(length, 1e-12), heading)


def adaptive(acceleration: Acceleration, start: State, times: Array,
             breaks: Sequence[float] = ()) -> Iterator[State]:
    """
    Yield positions and velocities, both (k, n), at each time, by Dormand and Prince's 8(5,3).

    :param start: the state at ``times[0]``.
    :param breaks: times at which the acceleration jumps, s: no step contains such a time.
    :raises RuntimeError: if no step is small enough, as at a singularity of the law.
    """
    from scipy.integrate import solve_ivp
    shape, t, y = np.shape(start), float(times[0]), np.ravel(start)
    yield start
    for end in [*(b for b in sorted(breaks) if t < b < times[-1]), float(times[-1])]:
        # At the very end of a stretch the acceleration is still that of the stretch.
        last = np.nextafter(end, t)

        def rate(t: float, y: Array, last: float = last) -> Array:
            x, v = y.reshape(shape)
            return np.concatenate([v.ravel(), acceleration(min(t, last), x, v).ravel()])

        wanted = times[(times > t) & (times <= end)]
        solution = solve_ivp(rate, (t, end), y, 'DOP853', np.union1d(wanted, end),
                             rtol=1e-11, atol=1e-12)
        if not solution.success:
            raise RuntimeError(f'the solution ends after t = {t:.6g} s: {solution.message}')
        for state in solution.y.T[:len(wanted)]:
            x, v = state.reshape(shape)
            yield x, v
        t, y = end, solution.y[:, -1]


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


def _check_band(x: Array, params: FlockingParams, model: Model) -> None:
    """Raise ValueError if the law has no value at a start (k, n), m."""
    r2 = np.sum((x[:, None] - x) ** 2, axis=2)[np.triu_indices(len(x), k=1)]
    least, greatest = np.sqrt([r2.min(initial=np.inf), r2.max(initial=0.0)])
    if model != 'cucker_smale' and least ** 2 <= params.d0 * (1.0 + 1e-12):
        raise ValueError(f'two agents start {least:.6g} m apart: must be more than sqrt(d0) = '
                         f'{np.sqrt(params.d0):.6g} m')
    if model == 'flocking' and greatest ** 2 >= params.d1:
        raise ValueError(f'two agents start {greatest:.6g} m apart: must be less than sqrt(d1) = '
                         f'{np.sqrt(params.d1):.6g} m; for larger flocks: simulate_graph')
