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
What a tick of the planner costs, and its projection beside others: ``make bench-planner``.

Ticks: short flights with 1, 4, 12 or 30 neighbors at 1.0 to 2.7 m around the follower, so noisy
and so contrary that most of those with many have bounds that leave no room. Beside each tick the
bare law, ``flocking.acceleration``, takes the same estimates.

Projection: the command nearest to a wanted one within two discs (a_max, v_max) and two bounds for
each neighbor, the first ones first. Beside ours: the search over all candidates that the tests
hold as reference, and quadprog, ProxQP and OSQP where they are installed (``pip install quadprog
proxsuite osqp``). Those know neither discs, for which they get polygons of 32 sides around them,
nor an order of importance. Where all bounds can be kept that is one quadratic program, "one QP";
else "in order" adds a bisection for the first bound that cannot be, and one program that meets it
as nearly as possible. They stop there, where ours goes on to the bounds after it: it is the least
that they could cost. Their error is the distance from our answer with the same polygons.

The measure is this thread's CPU time, for each input the least of several rounds over all of
them, so that what varies is the input, not what else the machine does. Exit code 0 only if the
ticks keep MOST_LAWS.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
import gc
from pathlib import Path
import sys
import time
from typing import Any, NamedTuple

import numpy as np

from flock_desk.closed_loop.metrics import is_guarded
from flock_follower.flocking import acceleration, FlockingParams
from flock_follower.geometry import Array
from flock_follower.planner.bounds import radial_bounds
from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.params import Edges, GuardParams, PlannerParams
from flock_follower.planner.projection import Discs, nearest_in_order, optimum, Side
from flock_follower.planner.step import Inputs, Memory, step

#: Numbers of neighbors: how many times the bare law a tick may take, by 99th percentiles.
MOST_LAWS = {1: 7.0, 4: 10.0, 12: 14.0, 30: 18.0}
TICKS = 12  # of one flight
NEAR, FAR = 1.0, 2.7  # m
SPEED = 0.5  # m/s
POSITION_NOISE, VELOCITY_NOISE = 0.03, 0.1  # m, m/s: standard deviations of each axis
SIDES = 32
ROUNDS = 5
FEW = 10  # problems for what takes tens of milliseconds
WIDE = 1e3  # m/s^2: radius of balls that bound nothing
PULL = 1e3  # m/s^2: the point nearest to one so far in a direction is the farthest in it

Solve = Callable[[Array, Array, Array], 'Array | None']  # nearest to w with A x >= b, or None


class Problem(NamedTuple):
    """A command wanted, m/s^2, bounds in their order, and the discs of a_max and v_max."""

    wanted: complex
    bounds: list[Side]
    discs: Discs


def main(args: Sequence[str] | None = None) -> int:
    """Run both parts, print the tables, and return the exit code."""
    parser = argparse.ArgumentParser(description='Measure the tick of the planner.')
    parser.add_argument('--flights', type=int, default=100, help='of each kind; %(default)s')
    parser.add_argument('--problems', type=int, default=200, help='of each kind; %(default)s')
    options = parser.parse_args(args)
    gc.collect()
    gc.freeze()  # as the node does before it spins
    print(f'numpy {np.__version__}, one thread, CPU time, the least of {ROUNDS} rounds\n')
    print('one tick, ms: neighbors      p50      p99     most   '
          'bare law, p50, p99    times the law   guarded')
    missed = []
    for count, most in MOST_LAWS.items():
        ms, bare, guarded = ticks(count, options.flights)
        (p50, p99), of_law = np.percentile(ms, (50, 99)), np.percentile(bare, (50, 99))
        times = p99 / of_law[1]
        print(f'{count:23d}{p50:9.3f}{p99:9.3f}{ms.max():9.3f}{of_law[0]:16.3f}{of_law[1]:8.3f}'
              f'{times:14.1f}{guarded:12.0%}', flush=True)
        if times > most:
            missed.append(f'{count} neighbors: p99 {times:.1f} times that of the bare law, must '
                          f'be at most {most:g}')
    solvers = dict(installed())
    for count in MOST_LAWS:
        contest(count, options.problems, solvers)
    print('\nevery bound holds' if not missed else '\nbounds missed:')
    for text in missed:
        print(f'  {text}')
    return 1 if missed else 0


def ticks(count: int, flights: int) -> tuple[Array, Array, float]:
    """Return the times of ticks and of the bare law, ms, and the share that was guarded."""
    params = PlannerParams()
    inputs: list[tuple[Any, ...]] = []
    guarded = 0
    for flight in range(flights):
        rng = np.random.default_rng([count, flight])
        places, velocities = NEAR + (FAR - NEAR) * rng.random(count), rng.normal(size=(count, 3))
        angles = rng.uniform(-np.pi, np.pi, count)
        positions = np.stack([places * np.cos(angles), places * np.sin(angles),
                              rng.uniform(-0.3, 0.3, count)], axis=1)
        velocities *= SPEED * rng.random((count, 1)) / np.linalg.norm(
            velocities, axis=1, keepdims=True)
        own = OwnState(0.0, np.zeros(3), np.append(rng.uniform(-0.3, 0.3, 2), 0.0), 0.0)
        memory = Memory()
        for _ in range(TICKS):
            seen = [Neighbor(
                f'n{k}', own.stamp, positions[k] + POSITION_NOISE * rng.normal(size=3),
                velocities[k] + VELOCITY_NOISE * rng.normal(size=3)) for k in range(count)]
            inputs.append((memory, Inputs(own.stamp + 0.02, True, own, seen), params))
            memory, decision = step(*inputs[-1])
            guarded += is_guarded(decision)
            a = np.zeros(3) if decision.acceleration is None else decision.acceleration
            velocity = own.velocity + params.period * a
            own = OwnState(own.stamp + params.period, own.position + params.period * velocity,
                           velocity, own.yaw)
            positions = positions + params.period * velocities
    tick, law = timed(inputs, step, bare_law)
    return tick, law, guarded / len(inputs)


def bare_law(_memory: Memory, inputs: Inputs, params: PlannerParams) -> Array:
    """Return the command of the law alone, (3,), m/s^2, for the inputs of a step."""
    own, seen = inputs.own, inputs.estimates
    assert own is not None
    return acceleration(np.array([n.position for n in seen]) - own.position,
                        np.array([n.velocity for n in seen]) - own.velocity, params.law)


def problem(count: int, rng: np.random.Generator) -> Problem:
    """Draw the projection of a tick with so many neighbors."""
    guarding = GuardParams()
    edges = Edges.of(FlockingParams(beta=0.25, d1=8.0), guarding)
    v = rng.uniform(-0.35, 0.35, 2)
    separation, cohesion = [], []
    for distance in np.sort(rng.uniform(NEAR, FAR, count)):
        angle = rng.uniform(-np.pi, np.pi)
        n = np.array([np.cos(angle), np.sin(angle)])
        w = v - rng.uniform(-0.35, 0.35, 2) + VELOCITY_NOISE * rng.normal() * n
        found = radial_bounds([*(distance * n).tolist(), 0.0], [*w.tolist(), 0.0], edges, guarding)
        separation.append((complex(*n), found[0].least))
        cohesion.append((complex(*-n), found[1].least))
    return Problem(complex(*rng.uniform(-1.5, 1.5, 2)), separation + cohesion[::-1],
                   Discs(0j, 2.5, complex(*(-v / 0.1)), 5.0))


def contest(count: int, problems: int, solvers: dict[str, Solve]) -> None:
    """Print what each method takes for the same problems, which take turns."""
    rng = np.random.default_rng(count)
    drawn = [problem(count, rng) for _ in range(problems)]
    methods: dict[str, Callable[..., Any]] = {'ours': nearest_in_order}
    if (reference := exhaustive()) is not None:
        methods['all candidates'] = reference
    room = np.array([optimum(p.wanted, False, p.bounds, p.discs)[1] == len(p.bounds)
                     for p in drawn])
    print(f'\nprojection, {count} neighbors, {2 * count} bounds, '
          f'{room.mean():.0%} with room for all')
    print('                        in order              one QP           QPs   error, m/s^2\n'
          '                     p50, ms   p99, ms    p50, ms   p99, ms   mean   median       p99')
    for name, method in methods.items():
        some = drawn[:FEW if name != 'ours' and count > 4 else None]
        spent, = timed(some, method)
        print(f'  {name:<17}{cells(spent)}{cells(spent[room[:len(some)]])}', flush=True)
    expected = [on_polygons(p) for p in drawn]
    for name, solve in solvers.items():
        spent, = timed([(solve, p) for p in drawn], in_order)
        points, solved = zip(*(in_order(solve, p) for p in drawn))
        off = np.linalg.norm(np.subtract(points, expected), axis=1)
        print(f'  {name:<17}{cells(spent)}{cells(spent[np.equal(solved, 1)])}'
              f'{np.mean(solved):7.1f}{np.median(off):9.0e}{np.percentile(off, 99):10.0e}',
              flush=True)


def cells(ms: Array) -> str:
    """Return the median and the 99th percentile of times, ms, as cells of a table."""
    return ' ' + ''.join(f'{np.percentile(ms, p):10.3f}' if len(ms) else 10 * ' '
                         for p in (50, 99))


def polygons(discs: Discs) -> tuple[Array, Array]:
    """Return the sides A x >= b around the discs: A (m, 2), b (m,)."""
    angles = 2.0 * np.pi * np.arange(SIDES) / SIDES
    normals = -np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.vstack([normals, normals]), np.concatenate(
        [normals @ pair(center) - radius for center, radius in (discs[:2], discs[2:])])


def pair(number: complex) -> Array:
    """Return a complex number as a vector (2,)."""
    return np.array([number.real, number.imag])


def on_polygons(p: Problem) -> Array:
    """Return our answer with polygons in place of the discs."""
    sides = [(complex(*normal), float(least)) for normal, least in zip(*polygons(p.discs))]
    return pair(nearest_in_order(p.wanted, [*sides, *p.bounds], Discs(0j, WIDE, 0j, WIDE)))


def in_order(solve: Solve, p: Problem) -> tuple[Array, int]:
    """Return the nearest point by quadratic programs, and how many were solved."""
    wanted = pair(p.wanted)
    sides, inside = polygons(p.discs)
    A = np.vstack([sides, [pair(normal) for normal, _ in p.bounds]])
    b = np.append(inside, [least for _, least in p.bounds])
    if (point := solve(wanted, A, b)) is not None:
        return point, 1
    solved, fits, fails = 1, len(inside), len(b)
    while fails - fits > 1:
        middle = (fits + fails) // 2
        solved += 1
        if solve(wanted, A[:middle], b[:middle]) is None:
            fails = middle
        else:
            fits = middle
    best = solve(PULL * A[fits], A[:fits], b[:fits])
    return wanted if best is None else best, solved + 1


def timed(inputs: Sequence[tuple[Any, ...]], *actions: Callable[..., Any]) -> Array:
    """Return the CPU time of each action, in turns, on each input, ms, the least of rounds."""
    least = np.full((len(actions), len(inputs)), np.inf)
    for _ in range(ROUNDS):
        for k, each in enumerate(inputs):
            for row, action in enumerate(actions):
                start = time.thread_time_ns()
                action(*each)
                least[row, k] = min(least[row, k], (time.thread_time_ns() - start) * 1e-6)
    return least


def exhaustive() -> Callable[..., Any] | None:
    """Return the search over all candidates, where the tests are at hand."""
    sys.path.append(str(Path(__file__).resolve().parents[1] / 'test' / 'planner'))
    try:
        import exhaustive_projection
    except ImportError as error:
        print(f'\nall candidates: not measured ({error})')
        return None

    found: Callable[..., Any] = exhaustive_projection.nearest_in_order
    return found


def installed() -> Iterator[tuple[str, Solve]]:
    """Yield the solvers that are installed, and say which are not."""
    print()
    for name, make in (('quadprog', quadprog), ('ProxQP', proxqp), ('OSQP', osqp)):
        try:
            yield name, make()
        except ImportError as error:
            print(f'{name}: not measured, because it is not installed ({error})')


def quadprog() -> Solve:
    """Return the dual method of Goldfarb and Idnani, of the package quadprog."""
    from quadprog import solve_qp

    def solve(w: Array, A: Array, b: Array) -> Array | None:
        try:
            point: Array = solve_qp(np.eye(len(w)), w, A.T, b)[0]
        except ValueError:  # no room
            return None
        return point
    return solve


def proxqp() -> Solve:
    """Return the proximal augmented Lagrangian method of the package proxsuite."""
    from proxsuite import proxqp as package

    def solve(w: Array, A: Array, b: Array) -> Array | None:
        qp = package.dense.QP(len(w), 0, len(b))
        qp.settings.eps_abs = 1e-7
        # Without these a problem that has no room can take a minute; none with room needs them.
        qp.settings.max_iter = qp.settings.max_iter_in = 100
        qp.init(np.eye(len(w)), -w, None, None, A, b, np.full(len(b), 1e20))
        qp.solve()
        if qp.results.info.status != package.QPSolverOutput.PROXQP_SOLVED:
            return None
        point: Array = qp.results.x
        return point
    return solve


def osqp() -> Solve:
    """Return the operator splitting method of the package OSQP, set up once for each size."""
    import osqp as package
    from scipy import sparse
    ready: dict[tuple[int, ...], Any] = {}

    def solve(w: Array, A: Array, b: Array) -> Array | None:
        if A.shape not in ready:
            ready[A.shape] = package.OSQP()
            ready[A.shape].setup(
                sparse.eye(len(w), format='csc'), -w, sparse.csc_matrix(np.ones(A.shape)), b,
                np.full(len(b), np.inf), verbose=False, eps_abs=1e-6, eps_rel=1e-6)
        # An earlier solution is no start for another problem.
        ready[A.shape].update(q=-w, l=b, Ax=A.T.ravel())
        ready[A.shape].warm_start(x=np.zeros(len(w)), y=np.zeros(len(b)))
        result = ready[A.shape].solve()
        return result.x if result.info.status == 'solved' else None
    return solve


if __name__ == '__main__':
    sys.exit(main())
