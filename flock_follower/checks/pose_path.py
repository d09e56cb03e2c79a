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
The path of a neighbor through the poses of another detector: outliers, and an offset of stamps.

In flight the filter knows only earlier poses; a check knows all poses. Each position is predicted
from the positions before and after it, by the model of ``time_offset``: a path with any start,
driven by white jerk. The ratio of jerk to noise is the ratio that predicts best. The noise along
the line of sight is estimated separately, because it is larger for most detectors.

The offset is the value in the grid of ``time_offset`` that makes the path without outliers
smoothest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array
from flock_follower.odometry.buffer import OdometryBuffer, OdometrySample
from flock_follower.perception.time_offset import (
    fit_offset,
    GRID_REACH,
    INITIAL_DEVIATION,
    OFFSET_GRID,
    path_precision,
)

#: Longest window, s.
WINDOW_LENGTH: Final = 20.0
#: Most poses of a window.
WINDOW_POSES: Final = 150
#: Fewest poses of a window.
MIN_WINDOW_POSES: Final = 10
#: s: a window ends at a longer gap between two poses.
WINDOW_GAP: Final = 1.0
#: Ratios of the density of the jerk to the variance of the noise, 1/s^5.
JERK_RATIOS: Final = tuple(10.0**k for k in range(-2, 6))
#: m: a pose nearer to the path of the others is no outlier.
MIN_OUTLIER: Final = 0.15
#: Largest share of the poses of a window that are set aside as outliers.
MOST_OUTLIERS: Final = 0.3
#: Least deviation of the noise, m.
LEAST_NOISE: Final = 1e-4
#: chi^2 of an outlier: that of the filter's gate would also exclude long tails of honest noise.
OUTLIER_CHI2: Final = 25.0
#: Deviations of the noise by which most outliers must be away to exceed it.
VISIBLE_SIGMAS: Final = 5.3
#: Poses over which the noise is a median: it changes with the distance.
NOISE_POSES: Final = 31
#: Medians of chi^2 with one and two degrees of freedom.
MEDIAN_CHI2: Final = np.array([0.455, 1.386])
#: Step of the grid that is no offset.
_NO_OFFSET: Final = len(OFFSET_GRID) // 2


class PosePath(NamedTuple):
    """
    The poses of a neighbor against its path.

    ``judged`` is the number of poses, ``outliers`` the number of outliers among them. ``visible``,
    m, is the size from which outliers are found. ``offset`` is the delay from the stamps to the
    exposures, s, and its standard deviation.
    """

    judged: int = 0
    outliers: int = 0
    visible: float = math.inf
    offset: float = 0.0
    deviation: float = INITIAL_DEVIATION


class WholeOdometry(OdometryBuffer):
    """All samples of an observation."""

    HORIZON = math.inf

    def __init__(self, samples: Sequence[OdometrySample]) -> None:
        self.CAPACITY = max(len(samples), 1)
        super().__init__()
        for sample in samples:
            self.add(sample)

    def covers(self, stamps: Array) -> NDArray[np.bool_]:
        """Return for each stamp (n,) whether there is odometry for every offset of the grid."""
        held = self._rows[:, 0]
        if len(held) < 2:
            return np.zeros(len(stamps), dtype=bool)
        wide = np.concatenate([[0], np.cumsum(np.diff(held) > self.MAX_GAP)])
        first = held.searchsorted(stamps - GRID_REACH, 'right') - 1
        last = held.searchsorted(stamps + GRID_REACH)
        inside = (first >= 0) & (last < len(held))
        inside[inside] = wide[first[inside]] == wide[last[inside]]
        return inside


class _Window:
    """
    Poses in a row, at ``times`` (n,), s, from the first.

    ``places`` (k, n, 3), m: along the mean line of sight, and across it, for the offsets of the
    grid. ``sights`` (n, 3): the line of sight of each, along these axes, of length 1.
    ``kept`` (n,): whether a pose is no outlier.
    """

    def __init__(self, times: Array, places: Array, sights: Array) -> None:
        self.times, self.places, self.sights = times - times[0], places, sights
        self.kept = np.ones(len(times), dtype=bool)

    def precision(self, ratio: float) -> Array:
        """Return the inverse covariance of the poses kept, for noise of unit variance."""
        return path_precision(self.times[self.kept], 1.0, ratio)

    def residuals(self, ratio: float, step: int) -> _Residuals:
        """Return how far each pose kept is off the path of the others, for a step of the grid."""
        precision = self.precision(ratio)
        variances = 1.0 / np.diag(precision)
        off = variances[:, None] * (precision @ self.places[step, self.kept])
        along = (off * self.sights[self.kept]).sum(axis=1)**2
        return _Residuals(np.stack([along, (off**2).sum(axis=1) - along]), variances)


class _Residuals(NamedTuple):
    """Squared residuals (2, n), m^2, along and across; variances (n,) for unit noise."""

    squares: Array
    variances: Array


def judge_path(times: Array, points: Array, odometry: WholeOdometry, on_body: bool) -> PosePath:
    """
    Return the outliers among poses, and the offset of their stamps.

    :param times: their stamps (n,), s, in order; :param points: their positions (n, 3), m, on the
        ego body, or in odom if not ``on_body``: then the offset cannot be measured.
    """
    windows = list(_windows(times, points, odometry, on_body))
    if not windows:
        return PosePath()
    judged = sum(len(window.times) for window in windows)
    noise = _set_aside(windows, _NO_OFFSET)
    offset, deviation = _offset(windows) if on_body else (0.0, INITIAL_DEVIATION)
    if abs(offset) > deviation:  # it makes the path rough
        for window in windows:
            window.kept[:] = True
        noise = _set_aside(windows, int(np.abs(OFFSET_GRID - offset).argmin()))
        offset, deviation = _offset(windows)
    return PosePath(
        judged, judged - _count_kept(windows), VISIBLE_SIGMAS * noise, offset, deviation)


def _count_kept(windows: list[_Window]) -> int:
    return sum(int(np.count_nonzero(window.kept)) for window in windows)


def _set_aside(windows: list[_Window], step: int) -> float:
    """
    Set the outliers of windows aside; return the deviation of a prediction, m.

    :param step: of the grid of offsets.
    """
    while True:
        by_ratio = [[window.residuals(ratio, step) for window in windows] for ratio in JERK_RATIOS]
        along, across = (min(by_ratio, key=partial(_median_square, axis)) for axis in (0, 1))
        chi2 = [np.stack([a.squares[0] / a.variances, b.squares[1] / b.variances])
                for a, b in zip(along, across)]
        noise = np.median(np.concatenate(chi2, axis=1), axis=1) / MEDIAN_CHI2
        before = _count_kept(windows)
        for window, a, b, squares in zip(windows, along, across, chi2):
            # A neighbor farther away is measured with more noise.
            local = np.maximum(_running_median(squares) / MEDIAN_CHI2[:, None], noise[:, None])
            doubt = (squares / np.maximum(local, LEAST_NOISE**2)).sum(axis=0)
            doubt[a.squares[0] + b.squares[1] < MIN_OUTLIER**2] = 0.0
            # An outlier is also in the path of those beside it.
            beside = np.maximum(np.append(0.0, doubt[:-1]), np.append(doubt[1:], 0.0))
            worst = np.flatnonzero((doubt > OUTLIER_CHI2) & (doubt >= beside))
            if len(doubt) - len(worst) >= (1.0 - MOST_OUTLIERS) * len(window.times):
                window.kept[np.flatnonzero(window.kept)[worst]] = False
        if _count_kept(windows) == before:
            return math.sqrt(max(
                variance * float(np.median(np.concatenate([each.variances for each in chosen])))
                for variance, chosen in zip(noise.tolist(), (along, across))))


def _median_square(axis: int, residuals: list[_Residuals]) -> float:
    """Return the median of the squared residuals along (0) or across (1) the line of sight."""
    return float(np.median(np.concatenate([each.squares[axis] for each in residuals])))


def _running_median(values: Array) -> Array:
    """Return the running median (2, n) of values (2, n)."""
    half = min(NOISE_POSES, values.shape[1]) // 2
    padded = np.pad(values, ((0, 0), (half, half)), mode='reflect')
    median: Array = np.median(np.lib.stride_tricks.sliding_window_view(
        padded, 2 * half + 1, axis=1), axis=2)
    return median


def _offset(windows: list[_Window]) -> tuple[float, float]:
    """Return the offset of the exposures after their stamps, s, and its deviation."""
    each = _count_kept(windows) - 3.0 * len(windows)  # degrees of freedom of one axis
    likeliest, chosen = [-math.inf, -math.inf], [np.zeros(len(OFFSET_GRID))] * 2
    for ratio in JERK_RATIOS:
        information, misfits = 0.0, np.zeros((len(OFFSET_GRID), 3))
        for window in windows:
            precision, places = window.precision(ratio), window.places[:, window.kept]
            misfits += ((precision @ places) * places).sum(axis=1)
            # The precision has no inverse: the path may begin with any state.
            free = np.linalg.qr(np.vander(window.times[window.kept], 3))[0]
            information += float(np.linalg.slogdet(precision + free @ free.T)[1])
        for k, axes in enumerate((slice(0, 1), slice(1, 3))):  # along, and across
            misfit = misfits[:, axes].sum(axis=1)
            freedom = (axes.stop - axes.start) * each
            if not misfit.min() > 0.0:  # NaN is not
                return 0.0, INITIAL_DEVIATION
            likelihood = (axes.stop - axes.start) * information - freedom * math.log(misfit.min())
            if likelihood > likeliest[k]:
                likeliest[k], chosen[k] = likelihood, misfit * (freedom / misfit.min())
    return fit_offset(np.add(*chosen), 3.0 * each)


def _windows(times: Array, points: Array, odometry: WholeOdometry, on_body: bool
             ) -> Iterator[_Window]:
    """Yield the poses in a row for which there is odometry."""
    covered = odometry.covers(times)
    start = 0
    for end in range(1, len(times) + 1):
        if end < len(times) and covered[end] == covered[start] and (
                times[end] - times[end - 1] <= WINDOW_GAP
                and times[end] - times[start] <= WINDOW_LENGTH and end - start < WINDOW_POSES):
            continue
        if covered[start] and end - start >= MIN_WINDOW_POSES:
            part = slice(start, end)
            window = _make_window(times[part], points[part], odometry, on_body)
            if window is not None:
                yield window
        start = end


def _make_window(times: Array, points: Array, odometry: WholeOdometry, on_body: bool
                 ) -> _Window | None:
    shifted = times + OFFSET_GRID[:, None]
    own = odometry.places(shifted, np.zeros_like(points))
    if own is None:
        return None
    places = odometry.places(shifted, points) if on_body else np.broadcast_to(
        points, (len(OFFSET_GRID), *points.shape))
    if places is None:
        return None
    sights = places[_NO_OFFSET] - own[_NO_OFFSET]
    sights /= np.maximum(np.linalg.norm(sights, axis=1, keepdims=True), 1e-9)
    axes = np.linalg.svd(sights.mean(axis=0)[None, :])[2]  # the first is along, of either sign
    return _Window(times, places @ axes.T, sights @ axes.T)
