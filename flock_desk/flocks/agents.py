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
Flocks of point agents under the law or its predecessors: one function from start to arrays.

    from flock_desk.flocks.agents import simulate
    from flock_desk.flocks.paper import LEADERLESS, PARAMS
    run = simulate(LEADERLESS.positions, LEADERLESS.velocities, PARAMS, duration=20.0)
    run.time, run.positions, run.velocities, run.metrics.min_r2
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import cast, Literal

import numpy as np
from numpy.typing import ArrayLike

from flock_desk.flocks import laws
from flock_desk.flocks.flock_metrics import Metrics, metrics
from flock_desk.flocks.laws import Coupling, Graph, Method, Pairs
from flock_follower import flocking
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array
from flock_follower.ranges import Range

Model = Literal['flocking', 'cucker_dong', 'cucker_smale', 'vicsek', 'vicsek_mean_velocity']
Neighbors = Literal['all', 'graph', 'nearest']
Integrator = Literal['adaptive', 'semi_implicit']
Acceleration = Callable[[float, Array, Array], Array]
State = tuple[Array, Array]

NEAREST = 7  # neighbours that a starling follows (Ballerini et al. 2008)
_LOOK_PERIOD = 0.05  # s between looks for new edges of the graph, at most
_POSITIVE = Range(0.0, above=True)
_ESCAPED = 1e6  # m/s: no flock flies so fast
_NEAR_BY_ALL = 64  # up to so many agents every pair may count as near: cheaper than a search
_SKIN = 0.05  # m that agents may move before near pairs are searched again


@dataclass(frozen=True)
class Leader:
    """
    A prescribed acceleration of agent 0, which then reacts to no other.

    ``acceleration`` gives (n,), m/s^2, at a time in s; ``breaks`` are the times of its jumps.
    """

    acceleration: Callable[[float], ArrayLike]
    breaks: Sequence[float] = ()


@dataclass(frozen=True)
class Simulation:
    """A solution: time (m,), s, positions (m, k, n), m, and velocities (m, k, n), m/s."""

    time: Array
    positions: Array
    velocities: Array
    params: FlockingParams
    model: Model
    graph: Graph | None = field(default=None, repr=False)
    """The neighbour graph at the end, where the model acts on one; its edges only ever join."""
    joined: Array | None = field(default=None, repr=False)
    """Time at which each edge of the graph was added (edges,), s."""

    @cached_property
    def metrics(self) -> Metrics:
        """Return the figures flocks are judged by, at every time."""
        return metrics(self.time, self.positions, self.velocities, self.params,
                       self.graph, self.joined)


def simulate(positions: ArrayLike, velocities: ArrayLike,
             params: FlockingParams | None = None, *, duration: float = 20.0,
             model: Model = 'flocking', neighbors: Neighbors = 'all',
             coupling: Coupling = 'flock', leader: Leader | None = None,
             integrator: Integrator = 'adaptive', sample_period: float = 0.02,
             dt: float | None = None, radius: float = 1.0, method: Method = 'auto',
             progress: Callable[[float], None] | None = None) -> Simulation:
    """
    Return how a flock moves from its positions and velocities, both (k, n) with n = 2 or 3.

    :param params: of the law, those of the paper's simulations by default.
    :param duration: s to simulate.
    :param model: 'flocking', 'cucker_dong', 'cucker_smale'; 'vicsek', each at its own speed, or
        'vicsek_mean_velocity', both in steps of dt.
    :param neighbors: the neighbours of an agent: 'all' as in the paper; 'graph', the neighbour
        graph of :mod:`.laws`; 'nearest', the seven nearest. The latter two are for model
        'flocking'.
    :param coupling: on the graph and among the nearest, 'flock' or 'pair': see there.
    :param leader: a prescribed acceleration of agent 0.
    :param integrator: 'adaptive' or 'semi_implicit', in steps of dt at most.
    :param sample_period: s between the times returned; for Vicsek's, rounded to whole steps.
    :param dt: s, 0.01 by default, 0.1 for Vicsek's.
    :param radius: how far an agent sees in Vicsek's model, m.
    :param method: how the sum over all pairs is computed, see :func:`.laws.accelerations`.
    :param progress: called with the share done, 0 to 1.
    :raises ValueError: for unknown names, bad shapes or values, coincident agents, and a start
        where the law has no value, saying which agents, and what to change.
    :raises RuntimeError: if no finite solution goes on.
    """
    params = FlockingParams() if params is None else params
    _check_choices(model, neighbors, coupling, integrator)
    discrete = model in ('vicsek', 'vicsek_mean_velocity')
    dt = (0.1 if discrete else 0.01) if dt is None else dt
    for name, value in (('duration', duration), ('sample_period', sample_period), ('dt', dt),
                        ('radius', radius)):
        _POSITIVE.check(name, value)
    x, v = _checked_start(positions, velocities, leader)
    growing = None
    if discrete:
        every = max(1, round(sample_period / dt))
        time = dt * every * np.arange(round(duration / (dt * every)) + 1)
        states = _vicsek(x, v, len(time) - 1, every, dt, radius, model, leader)
    else:
        time = np.linspace(0.0, duration, max(1, round(duration / sample_period)) + 1)
        growing = _GrowingGraph(x, params, coupling) if neighbors == 'graph' else None
        _check_band(x, params, model, neighbors, growing)
        acceleration = _acceleration(params, model, growing or neighbors, coupling, method, leader)
        solve = partial(adaptive, acceleration, breaks=leader.breaks if leader else ())
        if integrator == 'semi_implicit':
            solve = partial(semi_implicit, acceleration, dt=dt,
                            acceptable=growing.step_is_small if growing else None)
        states = growing.followed(solve, (x, v), time) if growing else solve((x, v), time)
    run: list[State] = []
    for state in states:
        run.append(state)
        if progress is not None:
            progress((len(run) - 1) / (len(time) - 1))
    x, v = map(np.array, zip(*run))
    return Simulation(time, x, v, params, model, *(
        () if growing is None else (growing.graph, np.array(growing.joined))))


def _check_choices(model: Model, neighbors: Neighbors, coupling: Coupling,
                   integrator: Integrator) -> None:
    for name, choice, known in (('model', model, Model), ('neighbors', neighbors, Neighbors),
                                ('coupling', coupling, Coupling),
                                ('integrator', integrator, Integrator)):
        laws.check_choice(name, choice, known)
    if neighbors != 'all' and model != 'flocking':
        raise ValueError(f"neighbors = {neighbors!r}: must be 'all' where model = {model!r}")


class _GrowingGraph:
    """The neighbour graph of a flock, which grows with its motion, and the law on it."""

    def __init__(self, positions: Array, params: FlockingParams, coupling: Coupling) -> None:
        self.graph = laws.initial_graph(positions, params)
        self.joined = [0.0] * len(self.graph.edges)
        self._params, self._coupling = params, coupling
        self._near: tuple[Array, Pairs] | None = None

    def accelerations(self, x: Array, v: Array) -> Array:
        return laws.graph_accelerations(x, v, self._params, self.graph, self._coupling,
                                        self._nearby(x))

    def step_is_small(self, before: Array, after: Array) -> bool:
        return laws.step_is_small(before, after, self._params, self.graph, self._nearby(before))

    def followed(self, solve: Callable[[State, Array], Iterator[State]], start: State,
                 time: Array) -> Iterator[State]:
        """Yield the states at each time, letting the graph grow at each, and between."""
        yield start
        state = start
        for begin, end in pairwise(time):
            looks = np.linspace(begin, end, 1 + int(np.ceil((end - begin) / _LOOK_PERIOD)))
            for since, t in pairwise(looks):
                *_, state = solve(state, np.array([since, t]))
                x = state[0]
                self.graph = laws.grown(self.graph, x, self._params, self._nearby(x))
                self.joined += [t] * (len(self.graph.edges) - len(self.joined))
            yield state

    def _nearby(self, x: Array) -> Pairs:
        """Return at least the pairs with r^2 < d1; all, if they are few."""
        few = len(x) <= _NEAR_BY_ALL
        if self._near is None or not (few or np.abs(x - self._near[0]).max() <= _SKIN):
            # Each of two agents may move by _SKIN along each of at most 3 axes.
            distance = np.sqrt(self._params.d1) + 2.0 * np.sqrt(3.0) * _SKIN
            self._near = (x, laws.complete_graph(len(x)).edges if few
                          else laws.pairs_within(x, distance))
        return self._near[1]


def _acceleration(params: FlockingParams, model: Model, neighbors: Neighbors | _GrowingGraph,
                  coupling: Coupling, method: Method, leader: Leader | None) -> Acceleration:
    """Return the function that gives the accelerations of a flock."""
    def acceleration(t: float, x: Array, v: Array) -> Array:
        if not np.abs(v).max() < _ESCAPED:  # written so that NaN fails
            raise RuntimeError(f'the solution diverges near t = {t:.6g} s: take a smaller dt, or '
                               "integrator = 'adaptive', or begin further from the band's edges")
        if isinstance(neighbors, _GrowingGraph):
            u = neighbors.accelerations(x, v)
        elif neighbors == 'nearest':
            u = laws.nearest_accelerations(x, v, params, laws.nearest(x, NEAREST), coupling)
        else:
            u = laws.accelerations(x, v, params, cast(flocking.Model, model), method)
        if leader is not None:
            u[0] = leader.acceleration(t)
        return u
    return acceleration


def _vicsek(x: Array, v: Array, samples: int, every: int, dt: float, radius: float, model: Model,
            leader: Leader | None) -> Iterator[State]:
    """Yield the first state, and one after every ``every`` steps of dt."""
    yield x, v
    for n in range(samples * every):
        after = laws.velocities_after(x, v, radius, model == 'vicsek_mean_velocity')
        if leader is not None:
            after[0] = v[0] + dt * np.asarray(leader.acceleration(n * dt))
        x, v = x + dt * v, after  # in this order: the velocity of now takes one to the next place
        if (n + 1) % every == 0:
            yield x, v


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


def _checked_start(positions: ArrayLike, velocities: ArrayLike,
                   leader: Leader | None) -> State:
    x, v = flocking.checked(positions, velocities)
    if not len(x):
        raise ValueError('positions has no agents: give at least one')
    if len(same := laws.pairs_within(x, 0.0)):
        i, j = same[0]
        raise ValueError(f'positions[{i}] and positions[{j}] are both {x[i].tolist()}: '
                         'agents must start apart')
    if leader is not None and np.shape(leader.acceleration(0.0)) != x[0].shape:
        raise ValueError(f'leader.acceleration gives shape {np.shape(leader.acceleration(0.0))}: '
                         f'must be {x[0].shape}, as the positions are')
    return x, v


def _check_band(x: Array, params: FlockingParams, model: Model, neighbors: Neighbors,
                growing: _GrowingGraph | None) -> None:
    """Raise ValueError if the law is undefined, or cannot keep its guarantees."""
    if model == 'cucker_smale' or len(x) < 2:
        return
    close = laws.pairs_within(x, np.sqrt(params.d0) * (1.0 + 1e-12))
    if len(close):
        i, j = close[0]
        raise ValueError(
            f'agents {i} and {j} start {np.linalg.norm(x[i] - x[j]):.6g} m apart: must be more '
            f'than sqrt(d0) = {np.sqrt(params.d0):.6g} m (move them apart, or lower d0)')
    if growing is not None and not growing.graph.connected:
        raise ValueError(
            'the agents start in groups that are not connected: each must be nearer than '
            f'sqrt(d1) = {np.sqrt(params.d1):.6g} m to another (move them closer, or raise d1)')
    if model == 'flocking' and neighbors == 'all':
        for i, own in enumerate(x):
            r2 = np.sum((x - own) ** 2, axis=1)
            j = int(np.argmax(r2))
            if r2[j] >= params.d1:
                raise ValueError(
                    f'agents {i} and {j} start {np.sqrt(r2[j]):.6g} m apart: must be less than '
                    f'sqrt(d1) = {np.sqrt(params.d1):.6g} m for every two (move them closer, '
                    "raise d1, or choose neighbors = 'graph')")
