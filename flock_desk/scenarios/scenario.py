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
A scenario of a simulated flight: the leader's motion, the wind, the sensors and their failures.

Each random quantity of a flight has its own generator, so a run of a scenario does not depend on
other runs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, MISSING
import zlib

import numpy as np

from flock_desk.scenarios.flock import Flock, Part
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array
from flock_follower.parameters.settings import refuse
from flock_follower.planner.params import COLUMN_V_MAX, PlannerParams
from flock_follower.ranges import parameter, Range

OUTAGES = ('marker', 'vio')
#: Of everything that chance decides.
SEED_RANGE = Range(0, 2**31 - 1, whole=True)
#: For which a scenario is flown; 0: its own duration.
DURATIONS = Range(0.0, 3600.0, 's')
OPERATIONS = ('arm', 'takeoff', 'offboard', 'engage', 'pilot', 'restart')
ENGAGE_TIME = 1.0  # s: when the planner is engaged, unless an operation does it
_ALONE = Flock(followers=1)
MOTIONS = ('legs', 'circle', 'figure_eight', 'wander', 'spline', 'random_walk', 'stairs',
           'approach')
HEADINGS = ('fixed', 'course', 'away')
Interval = tuple[float, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Start(Part):
    """Start of the follower: behind the leader, facing it, both hovering."""

    distance: Interval = parameter((1.5, 1.5), Range(0.2, 100.0, 'm'),
                                   'Distance to the leader, m; each run draws one.')
    bearing: Interval = parameter(
        (-0.3, 0.3), Range(-3.2, 3.2, 'rad'),
        "Direction of the leader's motion, rad; 0: away from the follower; each run draws one.")
    altitude: float = parameter(1.5, Range(0.5, 100.0, 'm'), 'Altitude of the follower, m.')
    above: float = parameter(
        0.0, Range(-10.0, 10.0, 'm'), 'Height of the leader above the follower, m.')


@dataclass(frozen=True)
class Leg(Part):
    """A velocity kept for a while."""

    duration: float = parameter(MISSING, Range(0.1, 600.0, 's'), 's.')
    velocity: Vector = parameter(
        MISSING, Range(-10.0, 10.0, 'm/s'),
        'm/s: away from the follower (as it stands at the start), to the left, up.')


@dataclass(frozen=True)
class LeaderMotion(Part):
    """
    Motion of the leader, after an initial hover.

    'legs' keeps given velocities one after the other, 'circle' and 'figure_eight' are level,
    'wander' is a random smooth course that stays near. Random in three dimensions, each run
    another: a 'spline' through points, a 'random_walk' of the velocity, 'stairs' that go up and
    down between level stretches, an 'approach' that leaves and comes back at the follower.
    Acceleration and jerk are bounded.
    """

    motion: str = parameter('legs', MOTIONS)
    wait: float = parameter(3.0, Range(0.0, 600.0, 's'), 'Hovering first, s.')
    speed: Interval = parameter(
        (0.4, 0.4), Range(0.0, 10.0, 'm/s'),
        'Largest speed, m/s; each run draws one. Legs have their own.')
    climb: float = parameter(
        0.0, Range(0.0, 10.0, 'm/s'),
        'Largest vertical speed of the motions in three dimensions, m/s.')
    climb_acceleration: float = parameter(
        0.5, Range(0.05, 10.0, 'm/s^2'), 'Their largest vertical acceleration, m/s^2.')
    height: float = parameter(
        1.0, Range(0.0, 100.0, 'm'), 'How far above or below its first height they go, m.')
    size: float = parameter(
        1.5, Range(0.3, 100.0, 'm'),
        'Radius of the circle, half the length of the figure eight, m.')
    legs: tuple[Leg, ...] = ()
    repeat: bool = parameter(
        False, None, 'Whether the legs begin again after the last one; otherwise it hovers.')
    acceleration: float = parameter(
        1.0, Range(0.05, 10.0, 'm/s^2'), 'Largest acceleration, m/s^2.')
    jerk: float = parameter(
        4.0, Range(0.1, 100.0, 'm/s^3'), 'Largest jerk while the speed changes, m/s^3.')
    heading: str = parameter(
        'fixed', HEADINGS,
        "Where it faces: 'fixed', away from the follower's start; along its 'course'; or 'away' "
        'from the follower wherever that is, as its pilot turns it, at most at 1 rad/s.')

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.climb > self.speed[0]:
            raise ValueError(f'climb = {self.climb:g}: must be at most speed = {self.speed[0]:g}')
        if self.climb and self.climb_acceleration > self.acceleration:
            raise ValueError(f'climb_acceleration = {self.climb_acceleration:g}: must be at most '
                             f'acceleration = {self.acceleration:g}')


@dataclass(frozen=True)
class Wind(Part):
    """A steady wind from a random direction, and gusts: first-order Gauss-Markov, per axis."""

    speed: Interval = parameter(
        (0.0, 0.0), Range(0.0, 20.0, 'm/s'), 'Mean wind speed, m/s; each run draws one.')
    gust: float = parameter(
        0.0, Range(0.0, 10.0, 'm/s'),
        'Standard deviation of gusts along each horizontal axis, m/s; half of it vertically.')
    gust_time: float = parameter(2.0, Range(0.1, 60.0, 's'), 'Correlation time of gusts, s.')


@dataclass(frozen=True)
class Response(Part):
    """Errors and delays of the follower's vehicle in lock-step flights."""

    delay: Interval = parameter(
        (0.06, 0.1), Range(0.0, 0.5, 's'),
        'Delay of setpoints, s, without the 0.15 s of the tilt; each run draws one. Measured from '
        'the wire to 63 % of the tilt: PX4 0.23 s, ArduCopter 0.27 s.')
    odometry_delay: Interval = parameter(
        (0.03, 0.06), Range(0.0, 0.5, 's'),
        'Delay of the odometry to the follower, s, besides its latency; each run draws one.')
    thrust_error: float = parameter(
        0.3, Range(0.0, 5.0, 'm/s^2'),
        'Standard deviation of the error of the hover thrust, m/s^2.')
    thrust_memory: float = parameter(
        10.0, Range(0.1, 600.0, 's'),
        'Correlation time of that error, s; PX4 erred by 1 m/s^2 for 10 s.')


@dataclass(frozen=True)
class Sensing(Part):
    """Detection of the leader; ``sensing`` has the figures of the measurement noise."""

    latency: Interval = parameter(
        (0.05, 0.15), Range(0.0, 0.5, 's'),
        'Delay from an image to the planner, s; each run draws one, each image varies by a tenth.')
    recall: float = parameter(
        0.98, Range(0.0, 1.0), 'Share of images in which a leader in the field of view is found.')
    noise: float = parameter(1.0, Range(0.0, 100.0), 'Factor on the measurement noise.')
    marker_angle: float = parameter(
        1.22, Range(0.0, 3.15, 'rad'),
        "Largest angle between line of sight and marker's normal at which it is found, rad.")
    velocity_noise: float = parameter(
        0.0, Range(0.0, 2.0, 'm/s'),
        'White noise added to each axis of the relative velocity, m/s.')
    light_changes: float = parameter(
        0.0, Range(0.0, 600.0, '1/min'), 'How often glare or shadow hides the marker, 1/min.')
    light_change: Interval = parameter(
        (0.1, 0.4), Range(0.01, 60.0, 's'),
        'Duration of each such change of light, s; each draws one.')

    def draw_light_changes(self, duration: float, rng: np.random.Generator) -> Array:
        """Return the times, s, at which the light changes in a flight of a duration, s."""
        return rng.uniform(0.0, duration, rng.poisson(self.light_changes * duration / 60.0))


@dataclass(frozen=True)
class VioErrors(Part):
    """Errors of the follower's visual-inertial odometry; most are standard deviations."""

    rate: float = parameter(
        200.0, Range(1.0, 1000.0, 'Hz'),
        'Rate of the odometry, Hz; at most 100 in flights with the nodes, 60 in lock step.')
    latency: Interval = parameter(
        (0.0, 0.0), Range(0.0, 0.5, 's'),
        'Delay from a sample to its use, s, in whole simulation steps; each run draws one.')
    position_walk: float = parameter(
        0.02, Range(0.0, 10.0, 'm'),
        'Drift of each horizontal coordinate, m after 1 s, growing with the root of time.')
    height_walk: float = parameter(0.02, Range(0.0, 10.0, 'm'),
                                   'Drift of the height, m after 1 s.')
    yaw_walk: float = parameter(
        0.0017, Range(0.0, 1.0, 'rad'),
        'Drift of the yaw, rad after 1 s; it turns the later course.')
    position: float = parameter(
        0.003, Range(0.0, 1.0, 'm'), 'Error of the position corrections, m.')
    position_memory: float = parameter(
        0.5, Range(0.01, 600.0, 's'), 'Correlation time of that error, s.')
    tilt: float = parameter(0.003, Range(0.0, 0.5, 'rad'), 'Error of roll and pitch, rad.')
    tilt_memory: float = parameter(
        5.0, Range(0.01, 600.0, 's'), 'Correlation time of that error, s.')
    tilt_bias: float = parameter(
        0.005, Range(0.0, 0.5, 'rad'),
        "Constant error of roll and pitch, with that of the camera's mounting, rad.")
    attitude: float = parameter(
        0.0004, Range(0.0, 0.5, 'rad'), 'White noise of the attitude about each axis, rad.')
    velocity: float = parameter(0.02, Range(0.0, 5.0, 'm/s'),
                                'Error of the velocity per axis, m/s.')
    velocity_memory: float = parameter(
        0.3, Range(0.01, 600.0, 's'), 'Correlation time of that error, s.')
    velocity_white: float = parameter(0.006, Range(0.0, 5.0, 'm/s'),
                                      'White noise of the velocity, m/s.')
    gyro_bias: float = parameter(
        0.002, Range(0.0, 1.0, 'rad/s'), 'Remaining bias of the gyroscopes, rad/s, constant.')
    gyro: float = parameter(
        0.006, Range(0.0, 1.0, 'rad/s'), 'White noise of the gyroscopes, rad/s.')

    @property
    def twist_covariance(self) -> Array:
        """Return the covariance (6, 6) of velocity, m/s, and angular velocity, rad/s."""
        return np.diag([self.velocity ** 2 + self.velocity_white ** 2] * 3
                       + [self.gyro_bias ** 2 + self.gyro ** 2] * 3)


@dataclass(frozen=True)
class RangeErrors(Part):
    """Errors of radios that measure the distance to the leader, or in a flock to every vehicle."""

    rate: float = parameter(0.0, Range(0.0, 60.0, 'Hz'), 'Rate of the ranges, Hz; 0: no ranges.')
    noise: float = parameter(0.1, Range(0.0, 10.0, 'm'),
                             'Standard deviation of the white noise, m.')
    bias: float = parameter(
        0.1, Range(0.0, 10.0, 'm'),
        'Standard deviation of the constant error, m; each run draws one.')
    bias_walk: float = parameter(
        0.003, Range(0.0, 1.0, 'm'),
        'Drift of that error, m after 1 s, growing with the root of time.')
    outliers: float = parameter(0.05, Range(0.0, 1.0), 'Share of ranges measured along a detour.')
    outlier: float = parameter(
        1.0, Range(0.0, 100.0, 'm'), 'Largest error by a detour, m; each draws one.')
    latency: Interval = parameter(
        (0.01, 0.03), Range(0.0, 0.5, 's'),
        'Delay from a measurement to its use, s; each run draws one.')


@dataclass(frozen=True)
class Outage(Part):
    """A temporary failure: of the view of the marker, or of the odometry ('vio')."""

    what: str = parameter(MISSING, OUTAGES)
    at: float = parameter(MISSING, Range(0.0, 3600.0, 's'), 's.')
    duration: float = parameter(MISSING, Range(0.01, 3600.0, 's'), 's.')


@dataclass(frozen=True)
class Print(Part):
    """A second print of the leader's marker, which stands still."""

    position: Vector = parameter(
        MISSING, Range(-1000.0, 1000.0, 'm'),
        'Of the leader that would carry it, m; the follower begins at [0, 0, altitude], facing x.')
    yaw: float = parameter(0.0, Range(-3.2, 3.2, 'rad'), 'Likewise, rad.')


@dataclass(frozen=True)
class Operation(Part):
    """
    An action in a lock-step flight: of the operator, of the pilot, or a failure.

    'arm', 'takeoff', 'offboard' and 'engage' are calls of the services; 'pilot' takes over by the
    mode switch and climbs; in a 'restart' the bridge dies, and starts again a while later.
    """

    what: str = parameter(MISSING, OPERATIONS)
    at: float = parameter(MISSING, Range(0.0, 3600.0, 's'), 's.')
    height: float = parameter(
        1.5, Range(0.0, 50.0, 'm'), 'm by which a take-off, or the pilot, climbs.')
    duration: float = parameter(2.0, Range(0.1, 600.0, 's'), 's for which the bridge is gone.')


@dataclass(frozen=True)
class FlightParams(Part):
    """The planner's parameters that a scenario sets; the others keep their defaults."""

    K: float = 1.0
    beta: float = 0.25
    d0: float = 1.0
    d1: float = 8.0
    a_max: float = 2.5
    v_max: float = 0.5
    altitude_min: float = parameter(
        0.0, None,
        'm above the ground by the odometry, whose height drifts by half a meter in ten minutes.')
    altitude_max: float = parameter(
        PlannerParams.altitude_max, None, 'm above the same.')
    relative_flight: bool = parameter(
        False, None, 'Whether the gate admits flight without odometry.')

    def planner(self, guard: bool) -> PlannerParams:
        """Return the parameters to plan with."""
        law = FlockingParams(K=self.K, beta=self.beta, d0=self.d0, d1=self.d1)
        return PlannerParams(law, guard, a_max=self.a_max, v_max=self.v_max,
                             altitude_min=self.altitude_min, altitude_max=self.altitude_max)

    def __post_init__(self) -> None:
        self.planner(True)
        refuse(vars(self))


@dataclass(frozen=True)
class Scenario(Part):
    """One kind of flight."""

    name: str
    summary: str
    duration: float = parameter(60.0, Range(2.0, 3600.0, 's'), 's.')
    benign: bool = parameter(
        False, None, 'Whether the law alone holds the band, so that the guard should be idle.')
    flight: FlightParams = field(default_factory=FlightParams)
    start: Start = field(default_factory=Start)
    leader: LeaderMotion = field(default_factory=LeaderMotion)
    wind: Wind = field(default_factory=Wind)
    response: Response = field(default_factory=Response)
    sensing: Sensing = field(default_factory=Sensing)
    odometry: VioErrors = field(default_factory=VioErrors)
    ranges: RangeErrors = field(default_factory=RangeErrors)
    outages: tuple[Outage, ...] = ()
    prints: tuple[Print, ...] = ()
    operations: tuple[Operation, ...] = parameter(
        (), None, 'None: in the air and in offboard mode from the start, engaged at ENGAGE_TIME.')
    flock: Flock | None = parameter(None, None, 'None: one follower.')

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.flock is not None and self.flock.ranges and not self.ranges.rate:
            raise ValueError('ranges: rate = 0: must be above 0 Hz if flock: ranges is true')
        if self.company.followers > 1 and self.flight.v_max > COLUMN_V_MAX:
            raise ValueError(f'flight: v_max = {self.flight.v_max:g}: must be at most '
                             f'{COLUMN_V_MAX:g} m/s for several followers')
        if self.flock is not None and self.prints:
            raise ValueError('prints: only for one follower: there must be no flock')

    @property
    def company(self) -> Flock:
        """Return the flock, which may be one follower."""
        return self.flock or _ALONE

    @property
    def measures_ranges(self) -> bool:
        """Return whether radios measure distances."""
        return self.ranges.rate > 0.0 and (self.flock is None or self.flock.ranges)

    @property
    def takes_off(self) -> bool:
        """Return whether the follower begins on the ground."""
        return any(o.what == 'takeoff' for o in self.operations)

    def fails(self, what: str, time: float) -> bool:
        """Return whether the view of the 'marker', or the odometry ('vio'), fails at a time, s."""
        return any(o.what == what and o.at <= time < o.at + o.duration for o in self.outages)

    def random(self, run: int, what: str, follower: int = 1) -> np.random.Generator:
        """
        Return the generator of one random quantity in one run.

        :param follower: number of the follower, if each draws its own values; the first draws
        those of a single follower.
        """
        whose = what if follower == 1 else f'{what}/follower_{follower}'
        return np.random.default_rng([run, zlib.crc32(f'{self.name}/{whose}'.encode())])
