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
From a neighbor's markers in an image to its pose and covariance.

Two attitudes explain a single marker almost equally well. Both are fitted to the edges, and the
more probable attitude is used. If the image has no edges because of motion or a lens out of focus,
the smeared print is fitted as a whole.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.parameters.neighbors_file import MarkedNeighbor
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edge_fit import (
    EdgeFit,
    fit,
    MAX_PLAIN_BLOOM,
    MAX_TURN_STEP,
    REPROJECT_BEYOND,
)
from flock_follower.perception.edges import apply_step, facing, project, solve_normal
from flock_follower.perception.images import GrayImage
from flock_follower.perception.measurement import (
    angle,
    Choice,
    choose,
    DEVIATION_FACTOR,
    Hypothesis,
    Measurement,
    mix_poses,
    PosePrior,
    SAME_ATTITUDE,
)
from flock_follower.perception.print_model import edge_model, EdgeModel, shows_code
from flock_follower.perception.smear_fit import (
    descend,
    fit_smeared,
    MOST_STEPS,
    seek,
    SmearFit,
    SmearStart,
)
from flock_follower.perception.smear_print import smear_model, SmearModel
from flock_follower.perception.square_pose import ippe, mirror

#: Edge errors below this, px, cannot decide between two attitudes.
SIGMA_FLOOR = 0.05
#: If cells are narrow, in the distance or aslant, neighboring edges blur into one another. On
#: rendered markers the range was then wrong by 1.1 % at 2 px per cell, 0.2 % at 4 px, and about
#: e times less per px in between: this share at 2 px.
NARROW = 0.01
#: Of a marker that is not tracked yet, more than this share of the edges must agree; if something
#: covers it, SHARP_INLIER_SHARE.
FOUND_INLIER_SHARE = 0.8
#: If more than this share of the edges agrees, to within SHARP_RMS, none of them is smeared: if
#: the code is not shown, either they are not of the marker, or something covers it.
SHARP_INLIER_SHARE = 0.7
SHARP_RMS = 0.15  # px
#: Share of the variances of errors that are alike from image to image, unless edges are plain.
ALIKE_SHARE = 0.8
#: Plain edges are blurred by less than this share of a cell (1 sigma) and shifted by less than
#: MAX_PLAIN_BLOOM.
PLAIN_BLUR = 0.2
#: Least share of plain edges that agree.
PLAIN_INLIER_SHARE = 0.9
#: If edges are blurred by more than this share of a cell (1 sigma), the whole print says more.
RUN_TOGETHER = 0.25
#: If a print that is followed smeared is blurred by more than this, cells, it has no edges to fit.
EDGELESS = 0.3
#: An attitude that differs by more, rad, is another one.
MAX_TURN = 0.3
#: Most steps of the fits to a smeared print in one image, of both attitudes together. If the steps
#: do not suffice for the mirrored one, it is fitted in a later image.
MAX_STEPS = 9
#: Most steps of a fit from the smear of the last image, before smear and place are searched for.
AS_BEFORE_STEPS = 6
#: Longest smear of a print whose code was not read, a share of the side of the code: with more,
#: another print may look alike.
MAX_UNREAD_SMEAR = 0.55
#: Number of independent samples of a smeared print, to decide between two attitudes. Most of the
#: residuals are errors of the model, which are alike for neighboring samples.
EFFECTIVE_SMEAR_SAMPLES = 40.0
#: Probability of the mirrored attitude if no fit of the first smeared print ends there, or if
#: a part of that print is covered: one of seven such fits was to the wrong attitude.
UNRIVALED_DOUBT = 0.15


class Target(NamedTuple):
    """A neighbor and the image models of its markers, in their order."""

    neighbor: MarkedNeighbor
    model: EdgeModel
    smears: tuple[SmearModel, ...]


def target(neighbor: MarkedNeighbor, dictionary: str) -> Target:
    """Return the image model of a neighbor with markers of a dictionary."""
    return Target(neighbor, edge_model(neighbor, dictionary),
                  tuple(smear_model(marker, dictionary) for marker in neighbor.markers))


def track(image: GrayImage, camera: CameraModel, sought: Target, expected: PosePrior,
          last: Measurement | None, check_mirrored: bool) -> Measurement | None:
    """
    Return the measurement of a neighbor near its expected place, or None if no marker fits.

    :param last: the last measurement, if any. If its print was smeared, the smear is fitted first,
        and edges only if the print is sharp again.
    :param check_mirrored: whether to compare with the mirrored attitude.
    """
    if expected.pose is None:
        return None
    spacing = None if last is None else last.spacing
    smeared = last is not None and spacing is None and len(sought.model.codes) == 1
    found: EdgeFit | None = None
    whole: _Whole | None = None
    if not smeared:
        found, sharp, _ = _fit_shown(image, camera, sought.model, expected.pose, spacing)
        if sharp:
            return None
    if found is None:  # it is smeared, or it moved farther than expected
        found, whole = _fit_around(image, camera, sought, expected.pose,
                                   last if smeared else None, spacing is None)
    # The other edges may be out of reach.
    if found is not None and found.inlier_share < PLAIN_INLIER_SHARE:
        again = fit(image, camera, found.lines.model, found.pose)
        if (spacing is not None) if again is None else again.inlier_share > found.inlier_share:
            found = again
    blurred = found is not None and found.blur > RUN_TOGETHER and (
        len(found.lines.model.codes) == 1)
    if whole is None and blurred:
        whole = _fit_whole(image, camera, sought, _smear_starts(
            image, camera, sought, expected.pose, True))
    if whole is not None and (found is None or blurred):
        return _of_smears(image, camera, sought, whole, expected, last) if check_mirrored else (
            _with_doubt(sought, whole, last))
    return None if found is None else _of_edges(
        image, camera, sought, found, expected, spacing, check_mirrored)


class _Whole(NamedTuple):
    """A fit to the whole print of a marker, by its number among the neighbor's."""

    number: int
    fit: SmearFit


def _fit_around(image: GrayImage, camera: CameraModel, sought: Target, pose: Transform,
                last: Measurement | None,
                searched: bool) -> tuple[EdgeFit | None, _Whole | None]:
    """
    Return fits to the edges and to a whole print up to two cells and a half from a pose.

    :param last: the last measurement, if the print was smeared in it.
    :param searched: whether edges up to half a cell from the pose were looked for already.
    """
    smeared, starts = last is not None, list[tuple[int, SmearStart]]()
    whole = None if last is None else _fit_as_before(image, camera, sought, pose, last)
    if whole is None:
        starts = _smear_starts(image, camera, sought, pose, smeared)
        if smeared:
            whole = _fit_whole(image, camera, sought, starts)
        elif not starts and searched:
            return None, None
    if whole is not None and whole.fit.blur > EDGELESS:
        return None, whole
    place = starts[0][1].pose if starts else pose
    found, sharp, plain = _fit_shown(image, camera, sought.model,
                                     place if whole is None else whole.fit.pose, None)
    if whole is not None and found is None and not sharp:
        # Little smear leaves edges: if they are not there, the attitude may be the mirrored one.
        other = _mirrored_body(sought, whole.number, whole.fit.pose)
        if other is not None:
            found, sharp, plain = _fit_shown(image, camera, sought.model, other, None)
    if sharp:
        return None, None
    if found is not None:
        if whole is None or found.blur <= RUN_TOGETHER:  # from afar it may have settled early
            found = fit(image, camera, found.lines.model, found.pose, found.spacing) or found
        return found, whole
    return None, whole if smeared or plain else _fit_whole(image, camera, sought, starts)


def _of_edges(image: GrayImage, camera: CameraModel, sought: Target, found: EdgeFit,
              expected: PosePrior, spacing: tuple[float, float] | None,
              check_mirrored: bool) -> Measurement:
    """Return the measurement of a fit to edges, also of the mirrored attitude if necessary."""
    if not check_mirrored:
        return _measurement(sought, found, None)
    chosen = _hypothesis_of(found)
    if len(found.lines.model.codes) > 1:
        return _measurement(sought, found, Choice(chosen, math.inf))
    best = choose([chosen, *_mirrored_hypotheses(camera, found)], expected)
    if best.chosen.fit is None:
        again = fit(image, camera, found.lines.model, best.chosen.pose, spacing)
        found = found if again is None else again
    return _measurement(sought, found, best)


def locate(image: GrayImage, camera: CameraModel, sought: Target, index: int, corners: Array,
           expected: PosePrior, most_rms: float = 1.0) -> Measurement | None:
    """
    Return a neighbor with a detected marker, or None if no pose fits the marker.

    :param index: of the marker among the neighbor's.
    :param corners: where it was detected, (4, 2), px, from top-left on, clockwise; good to 2 px.
    :param most_rms: of a fit to the print as a whole if its edges are smeared, see ``Detections``.
    """
    alone, starts = _starts_of(camera, sought, index, corners)
    near = [one for start in starts if (one := fit(image, camera, alone, start)) is not None]
    fits = [one for one in near
            if one.inlier_share > max(SHARP_INLIER_SHARE, min(
                FOUND_INLIER_SHARE, 0.9 * max(each.inlier_share for each in near)))
            and (most_rms == 1.0 or one.blur < PLAIN_BLUR)  # blurred, edges of clutter look alike
            and all(_find_shown(image, one))]
    if not fits:
        return None if not most_rms or any(map(_sharp, near)) else _without_edges(
            image, camera, sought, index, starts, expected, most_rms)
    variance = (max(min(f.rms for f in fits), SIGMA_FLOOR) * DEVIATION_FACTOR)**2
    best = choose([Hypothesis(f.pose, f.rms**2 * f.degrees / variance, f) for f in fits], expected)
    found: EdgeFit = best.chosen.fit
    if len(sought.model.codes) > 1:  # the others fix the attitude that one leaves open
        joint = _fit_shown(image, camera, sought.model, found.pose, found.spacing).fit
        if joint is not None and len(joint.lines.model.codes) > 1:
            found, best = joint, Choice(Hypothesis(joint.pose, 0.0, joint), math.inf)
    return _measurement(sought, found, best)


def _starts_of(camera: CameraModel, sought: Target, index: int,
               corners: Array) -> tuple[EdgeModel, list[Transform]]:
    """Return the edges of a detected marker alone, and both poses of its neighbor."""
    marker = sought.neighbor.markers[index]
    T_marker_body = marker.T_body_marker.inverse()
    return sought.model.only(tuple(k == index for k in range(len(sought.model.codes)))), [
        pose @ T_marker_body for pose in ippe(corners, camera, marker.side_length)]


def _hypothesis_of(found: EdgeFit) -> Hypothesis:
    return Hypothesis(found.pose, found.chi2 * found.degrees / _scale(found), found)


def contradicts(image: GrayImage, camera: CameraModel, sought: Target, index: int, corners: Array,
                pose: Transform, up: Array | None) -> bool:
    """
    Return whether a detected marker fits another attitude than that of ``pose``, T_camera_body.

    This costs half as much as :func:`locate`, which returns the right pose if the result is True:
    one attitude is fitted to the image, and the mirrored attitude to the edges that this fit
    found.
    """
    alone, starts = _starts_of(camera, sought, index, corners)
    for start in starts:
        found = fit(image, camera, alone, start)
        if found is not None and found.inlier_share > FOUND_INLIER_SHARE:
            best = choose([_hypothesis_of(found), *_mirrored_hypotheses(camera, found)],
                          PosePrior(None, up))
            return angle(best.chosen.pose, pose) > MAX_TURN
    return False


def _without_edges(image: GrayImage, camera: CameraModel, sought: Target, index: int,
                   starts: list[Transform], expected: PosePrior,
                   most_rms: float) -> Measurement | None:
    """Return a neighbor by the whole print of a detected marker, smeared."""
    for start in starts:
        found = fit_smeared(image, camera, sought.smears[index], start)
        if found is not None and found.rms < most_rms and (
                most_rms == 1.0 or found.smear.dot(found.smear) < (
                    MAX_UNREAD_SMEAR * (sought.smears[index].cells - 2))**2):
            return _of_smears(image, camera, sought, _Whole(index, found), expected, None, True)
    return None


class _Shown(NamedTuple):
    """
    A fit to those markers that show their codes, if any.

    ``sharp``: whether the edges of a single marker are clear, so that none of it is smeared.
    ``plain``: whether they are there but not its code, so that something covers it.
    """

    fit: EdgeFit | None
    sharp: bool = False
    plain: bool = False


def _fit_shown(image: GrayImage, camera: CameraModel, model: EdgeModel, start: Transform,
               spacing: tuple[float, float] | None) -> _Shown:
    """Return a fit near ``start`` to those markers that show their codes."""
    turned = facing(model, start)
    if not any(turned):
        return _Shown(None)
    seen = model.only(turned)
    found = fit(image, camera, seen, start, spacing)
    shown = None if found is None else _find_shown(image, found, True)
    if shown is not None and all(shown):
        return _Shown(found)
    if len(seen.codes) == 1:
        return _Shown(None) if found is None else _Shown(
            None, _sharp(found), found.blur < PLAIN_BLUR)
    if shown is None:  # one that is covered spoils them all
        count = len(seen.codes)
        alone = [fit(image, camera, seen.only(tuple(k == one for k in range(count))), start,
                     spacing) for one in range(count)]
        shown = tuple(f is not None and _find_shown(image, f, True)[0] for f in alone)
    if not any(shown):
        return _Shown(None)
    found = fit(image, camera, seen.only(shown), start, spacing)
    return _Shown(found if found is not None and all(_find_shown(image, found, True)) else None)


def _plain(found: EdgeFit) -> bool:
    """Return whether the edges have no lasting errors by smear, over-exposure or reflexes."""
    return (found.blur < PLAIN_BLUR and found.bloom < MAX_PLAIN_BLOOM
            and found.inlier_share > PLAIN_INLIER_SHARE)


def _sharp(found: EdgeFit) -> bool:
    return found.inlier_share > SHARP_INLIER_SHARE and found.rms < SHARP_RMS


def _smear_starts(image: GrayImage, camera: CameraModel, sought: Target, pose: Transform,
                  near: bool) -> list[tuple[int, SmearStart]]:
    """Return the places at which prints that face the camera resemble the image."""
    found = ((k, seek(image, camera, sought.smears[k], pose, near))
             for k, turned in enumerate(facing(sought.model, pose)) if turned)
    return [(k, start) for k, start in found if start is not None]


def _fit_as_before(image: GrayImage, camera: CameraModel, sought: Target, pose: Transform,
                   last: Measurement) -> _Whole | None:
    """Return the fit to a single marker whose print is smeared as in the last image, or None."""
    if last.smear is None or not all(facing(sought.model, pose)):
        return None
    found = descend(image, camera, sought.smears[0], SmearStart(pose, last.smear, last.lens), True,
                    AS_BEFORE_STEPS)
    return None if found is None else _Whole(0, found)


def _fit_whole(image: GrayImage, camera: CameraModel, sought: Target,
               starts: list[tuple[int, SmearStart]]) -> _Whole | None:
    """Return the fit to the first marker whose smeared print fits the image, or None."""
    for k, start in starts:
        found = descend(image, camera, sought.smears[k], start)
        if found is not None:
            return _Whole(k, found)
    return None


def _of_smears(image: GrayImage, camera: CameraModel, sought: Target, found: _Whole,
               expected: PosePrior, last: Measurement | None,
               detected: bool = False) -> Measurement:
    """
    Return the measurement of the likelier attitude: of a fit, or of its mirrored one.

    :param last: the last measurement, if any: if its print was smeared, the mirrored attitude can
        wait for an image with steps left.
    :param detected: whether the marker was just detected: then a lone fit is in doubt.
    """
    index, fitted = found
    start = _mirrored_body(sought, index, fitted.pose)
    can_wait = last is not None and last.smear is not None
    steps = MAX_STEPS - fitted.steps if can_wait else MOST_STEPS
    other = None if start is None or steps < 1 else descend(
        image, camera, sought.smears[index], SmearStart(start, fitted.smear, fitted.lens), True,
        steps)
    if start is not None and other is None and (can_wait or detected):
        return _with_doubt(sought, found, last, detected)
    # Little smear leaves edges: if they do not fit, something covers a part of the print.
    covered = detected and fitted.blur < PLAIN_BLUR
    return _choose_smeared(sought, index, [fitted] if other is None else [fitted, other], expected,
                           UNRIVALED_DOUBT if covered else 0.0)


def _mirrored_body(sought: Target, index: int, pose: Transform) -> Transform | None:
    """Return the pose of a neighbor mirrored about the sight of a marker; None if the same."""
    on_body = sought.neighbor.markers[index].T_body_marker
    return mirror(pose, pose.apply(on_body.translation[None])[0], on_body.rotation[:, 2])


def _choose_smeared(sought: Target, index: int, fits: list[SmearFit],
                    expected: PosePrior, least_doubt: float) -> Measurement:
    """
    Return the measurement of the likelier of one or both attitudes of a smeared marker.

    The image says little about the attitude, so the expected attitude is not used: it would
    confirm itself.

    :param least_doubt: least probability of the other attitude.
    """
    least = min(each.rms for each in fits)
    best = choose([Hypothesis(each.pose, EFFECTIVE_SMEAR_SAMPLES * (each.rms / least)**2, each)
                   for each in fits], PosePrior(None, expected.up))
    return mix_poses(_smear_measurement(sought, index, best.chosen.fit),
                     best._replace(share=max(best.share, least_doubt)))


def _with_doubt(sought: Target, found: _Whole, last: Measurement | None,
                detected: bool = False) -> Measurement:
    """Return a smeared marker's measurement; the mirrored attitude keeps its last probability."""
    pose = found.fit.pose
    measurement = _smear_measurement(sought, found.number, found.fit)
    other = _mirrored_body(sought, found.number, pose)
    if other is None or (last is None and not detected):
        return measurement
    doubt = UNRIVALED_DOUBT if last is None else last.doubt
    if last is not None and angle(other, last.T_camera_body) < angle(pose, last.T_camera_body):
        doubt = 1.0 - doubt
    return mix_poses(measurement, Choice(
        Hypothesis(pose, 0.0), 0.0, Hypothesis(other, 0.0), doubt))._replace(margin=None)


def _smear_measurement(sought: Target, index: int, found: SmearFit) -> Measurement:
    return Measurement(
        sought.neighbor.name, found.pose,
        sought.neighbor.markers[index].T_body_marker.translation,
        found.covariance * DEVIATION_FACTOR**2, found.rms, None, alike=ALIKE_SHARE,
        smear=found.smear, lens=found.lens)


def _find_shown(image: GrayImage, found: EdgeFit, tracked: bool = False) -> tuple[bool, ...]:
    """Return for each of the fitted markers whether it shows its code."""
    lines, model = found.lines, found.lines.model
    # More edges would be out of place if one of the markers had the code of any other.
    clear = tracked and found.rms < SHARP_RMS and (
        (1.0 - found.inlier_share) * len(model) < 0.5 * model.distinct)
    return tuple(clear or shows_code(image, lines.cells[part], code, tracked)
                 for part, code in zip(model.cell_slices, model.codes))


def _scale(found: EdgeFit) -> float:
    """Return the factor on its variances: what covers edges moves those beside."""
    uncovered = min(found.inlier_share / PLAIN_INLIER_SHARE, 1.0)
    return max(found.chi2, 1.0) * (DEVIATION_FACTOR / uncovered)**2


def _mirrored_hypotheses(camera: CameraModel, found: EdgeFit) -> list[Hypothesis]:
    """Return the other pose that may suit the edges of a single marker, if there is one."""
    start = mirror(found.pose, found.center, found.lines.model.facings[0])
    if start is None:
        return []
    refitted = _refit(camera, found, start)
    if refitted is None or angle(refitted[0], found.pose) < SAME_ATTITUDE:
        return []
    return [Hypothesis(refitted[0], refitted[1] / _scale(found))]


def _refit(camera: CameraModel, fitted: EdgeFit,
           start: Transform) -> tuple[Transform, float] | None:
    """
    Return another pose near ``start`` that fits the edges found already, and its chi^2.

    chi^2 is the weighted sum of their squared residuals. None if no pose fits.
    """
    pose = start
    at = fitted.lines.pixels + fitted.residual[:, None] * fitted.lines.normals
    for _ in range(2):
        lines = project(camera, fitted.lines.model, pose)
        if lines is None:
            return None
        offsets = ((at - lines.pixels) * lines.normals).sum(axis=1)
        design = lines.design[:, :6]
        moment = (design * fitted.weights[:, None]).T
        step = solve_normal(moment.dot(design), moment.dot(offsets))
        if step is None or not float(np.abs(step[3:]).max()) < MAX_TURN_STEP:
            return None
        pose = apply_step(pose, lines.center, step)
        explained = design.dot(step)
        if float(np.abs(explained).max()) < REPROJECT_BEYOND:
            break
    residual = offsets - explained
    return pose, float(fitted.weights.dot(residual * residual))


def _measurement(sought: Target, found: EdgeFit, best: Choice | None) -> Measurement:
    reference = (found.center - found.pose.translation).dot(found.pose.rotation)
    covariance = found.covariance * _scale(found)
    cell = min(found.lines.narrowest)
    if cell < 6.0:
        off = NARROW * math.exp(2.0 - cell) * found.center
        covariance[:3, :3] += off[:, None] * off
    measurement = Measurement(
        sought.neighbor.name, found.pose, reference, covariance, found.rms, found.spacing,
        alike=0.0 if _plain(found) else ALIKE_SHARE)
    return measurement if best is None else mix_poses(measurement, best)
