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
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import cast, get_args, Literal

import numpy as np
from numpy.typing import ArrayLike

from flock_desk.flocks import graph as flock_graph
from flock_desk.flocks import integrators
from flock_desk.flocks.flock_metrics import Metrics, metrics
from flock_desk.flocks.graph import Coupling, Graph
from flock_desk.flocks.integrators import State
from flock_desk.flocks.models import accelerations, Method, velocities_after
from flock_follower import flocking
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array
from flock_follower.ranges import Range

Model = Literal['flocking', 'cucker_dong', 'cucker_smale', 'vicsek', 'vicsek_mean_velocity']
Neighbors = Literal['all', 'graph', 'nearest']
Integrator = Literal['adaptive', 'semi_implicit']

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
        graph of :mod:`flock_desk.flocks.graph`; 'nearest', the seven nearest. The
        latter two are for model 'flocking'.
    :param coupling: on the graph and among the nearest, 'flock' or 'pair': see there.
    :param leader: a prescribed acceleration of agent 0.
    :param integrator: 'adaptive' or 'semi_implicit', in steps of dt at most.
    :param sample_period: s between the times returned; for Vicsek's, rounded to whole steps.
    :param dt: s, 0.01 by default, 0.1 for Vicsek's.
    :param radius: how far an agent sees in Vicsek's model, m.
    :param method: how the sum over all pairs is computed, see :mod:`.models`.
    :param progress: called with the share done, 0 to 1.
    :raises ValueError: for unknown names, bad shapes or values, coincident agents, and a start
        where the law has no value, saying which agents, and what to change.
    :raises RuntimeError: if no finite solution goes on.
    """
    params = FlockingParams() if params is None else params
    _check_names(model, neighbors, coupling, integrator)
    discrete = model in ('vicsek', 'vicsek_mean_velocity')
    dt = (0.1 if discrete else 0.01) if dt is None else dt
    for name, value in (('duration', duration), ('sample_period', sample_period), ('dt', dt),
                        ('radius', radius)):
        _POSITIVE.check(name, value)
    x, v = _checked_start(positions, velocities)
    if leader is not None and np.shape(leader.acceleration(0.0)) != x[0].shape:
        raise ValueError(f'leader.acceleration gives shape {np.shape(leader.acceleration(0.0))}: '
                         f'must be {x[0].shape}, as the positions are')
    if discrete:
        every = max(1, round(sample_period / dt))
        time = dt * every * np.arange(round(duration / (dt * every)) + 1)
        states = _vicsek(x, v, len(time) - 1, every, dt, radius, model, leader)
        return _collected(time, states, params, model, progress)
    time = np.linspace(0.0, duration, max(1, round(duration / sample_period)) + 1)
    flock = _Flock(params, model, neighbors, coupling, method, x)
    _check_band(x, params, model, flock)
    acceleration = flock.acceleration if leader is None else _led(flock.acceleration, leader)
    if integrator == 'adaptive':
        solve = partial(integrators.adaptive, acceleration,
                        breaks=leader.breaks if leader is not None else ())
    else:
        solve = partial(integrators.semi_implicit, acceleration, dt=dt,
                        acceptable=flock.step_is_small if flock.graph is not None else None)
    states = flock.looking_around(solve, (x, v), time) if flock.graph else solve((x, v), time)
    run = _collected(time, states, params, model, progress)
    return run if flock.graph is None else replace(
        run, graph=flock.graph, joined=np.array(flock.joined))


class _Flock:
    """The accelerations of a flock, and the neighbour graph that grows with its motion."""

    def __init__(self, params: FlockingParams, model: Model, neighbors: Neighbors,
                 coupling: Coupling, method: Method, positions: Array) -> None:
        self.params, self.model, self.neighbors = params, model, neighbors
        self.coupling, self.method = coupling, method
        self._near: tuple[Array, flock_graph.Pairs] | None = None
        self.graph: Graph | None = None
        self.joined: list[float] = []
        if neighbors == 'graph':
            self.graph = flock_graph.initial_graph(positions, params)
            self.joined = [0.0] * len(self.graph.edges)

    def acceleration(self, t: float, x: Array, v: Array) -> Array:
        if not np.abs(v).max() < _ESCAPED:  # written so that NaN fails
            raise RuntimeError(f'the solution diverges near t = {t:.6g} s: take a smaller dt, or '
                               "integrator = 'adaptive', or begin further from the band's edges")
        if self.graph is not None:
            return flock_graph.accelerations(x, v, self.params, self.graph, self.coupling,
                                             self.near(x))
        if self.neighbors == 'nearest':
            return flock_graph.nearest_accelerations(
                x, v, self.params, flock_graph.nearest(x, NEAREST), self.coupling)
        return accelerations(x, v, self.params, cast(flocking.Model, self.model), self.method)

    def step_is_small(self, before: Array, after: Array) -> bool:
        assert self.graph is not None
        return flock_graph.step_is_small(before, after, self.params, self.graph,
                                         self.near(before))

    def near(self, x: Array) -> flock_graph.Pairs:
        """Return at least the pairs with r^2 < d1; all, if they are few."""
        few = len(x) <= _NEAR_BY_ALL
        if self._near is None or not (few or np.abs(x - self._near[0]).max() <= _SKIN):
            # Each of two agents may move by _SKIN along each of at most 3 axes.
            distance = np.sqrt(self.params.d1) + 2.0 * np.sqrt(3.0) * _SKIN
            self._near = (x, flock_graph.complete_graph(len(x)).edges if few
                          else flock_graph.pairs_within(x, distance))
        return self._near[1]

    def looking_around(self, solve: Callable[[State, Array], Iterator[State]], start: State,
                       time: Array) -> Iterator[State]:
        """Yield the states at each time, letting the graph grow at each, and between."""
        yield start
        state = start
        for begin, end in pairwise(time):
            looks = np.linspace(begin, end, 1 + int(np.ceil((end - begin) / _LOOK_PERIOD)))
            for since, t in pairwise(looks):
                *_, state = solve(state, np.array([since, t]))
                self._look(t, state[0])
            yield state

    def _look(self, t: float, x: Array) -> None:
        assert self.graph is not None
        self.graph = flock_graph.grown(self.graph, x, self.params, self.near(x))
        self.joined += [t] * (len(self.graph.edges) - len(self.joined))


def _led(acceleration: integrators.Acceleration, leader: Leader) -> integrators.Acceleration:
    def with_leader(t: float, x: Array, v: Array) -> Array:
        u = acceleration(t, x, v)
        u[0] = leader.acceleration(t)
        return u
    return with_leader


def _vicsek(x: Array, v: Array, samples: int, every: int, dt: float, radius: float, model: Model,
            leader: Leader | None) -> Iterator[State]:
    """Yield the first state, and one after every ``every`` steps of dt."""
    yield x, v
    for n in range(samples * every):
        after = velocities_after(x, v, radius, model == 'vicsek_mean_velocity')
        if leader is not None:
            after[0] = v[0] + dt * np.asarray(leader.acceleration(n * dt))
        x, v = x + dt * v, after  # in this order: the velocity of now takes one to the next place
        if (n + 1) % every == 0:
            yield x, v


def _collected(time: Array, states: Iterator[State], params: FlockingParams, model: Model,
               progress: Callable[[float], None] | None) -> Simulation:
    positions, velocities = [], []
    for n, (x, v) in enumerate(states):
        positions.append(x)
        velocities.append(v)
        if progress is not None:
            progress(n / (len(time) - 1))
    return Simulation(time, np.array(positions), np.array(velocities), params, model)


def _check_names(model: Model, neighbors: Neighbors, coupling: Coupling,
                 integrator: Integrator) -> None:
    for name, value, known in (('model', model, Model), ('neighbors', neighbors, Neighbors),
                               ('coupling', coupling, Coupling),
                               ('integrator', integrator, Integrator)):
        if value not in get_args(known):
            raise ValueError(f'{name} = {value!r}: must be one of {", ".join(get_args(known))}')
    if neighbors != 'all' and model != 'flocking':
        raise ValueError(f"neighbors = {neighbors!r}: must be 'all' where model = {model!r}")


def _checked_start(positions: ArrayLike, velocities: ArrayLike) -> State:
    for name, value in (('positions', positions), ('velocities', velocities)):
        a = np.asarray(value, dtype=float)
        bad = ~np.all(np.isfinite(a), axis=-1) if a.ndim == 2 else np.zeros(0, dtype=bool)
        if bad.any():
            i = int(np.argmax(bad))
            raise ValueError(f'{name}[{i}] = {a[i].tolist()}: must be finite')
    x, v = flocking.checked(positions, velocities)
    if not len(x):
        raise ValueError('positions has no agents: give at least one')
    order = np.lexsort(x.T)
    same = np.flatnonzero(np.all(np.diff(x[order], axis=0) == 0.0, axis=1))
    if len(same):
        i, j = sorted(order[same[0]:same[0] + 2])
        raise ValueError(f'positions[{i}] and positions[{j}] are both {x[i].tolist()}: '
                         'agents must start apart')
    return x, v


def _check_band(x: Array, params: FlockingParams, model: Model, flock: _Flock) -> None:
    """Raise ValueError if the law is undefined, or cannot keep its guarantees."""
    if model == 'cucker_smale' or len(x) < 2:
        return
    close = flock_graph.pairs_within(x, np.sqrt(params.d0) * (1.0 + 1e-12))
    if len(close):
        i, j = close[0]
        raise ValueError(
            f'agents {i} and {j} start {np.linalg.norm(x[i] - x[j]):.6g} m apart: must be more '
            f'than sqrt(d0) = {np.sqrt(params.d0):.6g} m (move them apart, or lower d0)')
    if flock.graph is not None and not flock.graph.connected:
        raise ValueError(
            'the agents start in groups that are not connected: each must be nearer than '
            f'sqrt(d1) = {np.sqrt(params.d1):.6g} m to another (move them closer, or raise d1)')
    if model == 'flocking' and flock.neighbors == 'all':
        for i, own in enumerate(x):
            r2 = np.sum((x - own) ** 2, axis=1)
            j = int(np.argmax(r2))
            if r2[j] >= params.d1:
                raise ValueError(
                    f'agents {i} and {j} start {np.sqrt(r2[j]):.6g} m apart: must be less than '
                    f'sqrt(d1) = {np.sqrt(params.d1):.6g} m for every two (move them closer, '
                    "raise d1, or choose neighbors = 'graph')")
