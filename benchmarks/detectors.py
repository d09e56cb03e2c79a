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
Other marker detectors, and the pose from the corners that they find.

The package needs none of them. ``aruco2`` is the library of the author of ArUco
(github.com/rmsalinas/aruco2): a Python module ``aruco2`` with ``detectFiducialMarkers(image,
dictionary)`` as its README describes. ``apriltag`` is AprilTag 3 by ``pip install
pupil-apriltags``, with its default parameters, which search the image at half its size, and
``apriltag_full`` at its full size. One thread each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
import sys
from typing import NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage

ARUCO, TAG = 'DICT_4X4_50', 'DICT_APRILTAG_36h11'
#: Returns the corners of marker 0 (4, 2), px, from the top left one on, clockwise, or None.
Corners = Callable[[GrayImage], Array | None]


class Look(NamedTuple):
    """
    A detector and the pose of a square from its corners.

    ``side_length``: of the marker, m. Calling it returns ``T_camera_marker``, or None.
    """

    camera: CameraModel
    corners: Corners
    side_length: float

    def __call__(self, image: GrayImage) -> Transform | None:
        """Return the pose of marker 0 in an image."""
        found = self.corners(image)
        if found is None:
            return None
        h, K, D = self.side_length / 2.0, self.camera.matrix, self.camera.distortion
        square = np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
        points = np.reshape(found, (-1, 1, 2)).astype(np.float64)
        if self.camera.model == 'equidistant':
            points = cv2.fisheye.undistortPoints(points, K, D)
            K, D = np.eye(3), np.zeros(4)
        ok, r, t = cv2.solvePnP(square, points, K, D, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        return Transform(rotation_vector_to_matrix(r.ravel()), t.ravel()) if ok else None


def detectors(dictionary: str) -> Mapping[str, Corners]:
    """Return the detectors that can be used, by name; print why another one cannot."""
    found = {'default': opencv(dictionary, cv2.aruco.CORNER_REFINE_NONE),
             'subpix': opencv(dictionary, cv2.aruco.CORNER_REFINE_SUBPIX)}
    others: dict[str, Callable[[], Corners]] = {'aruco2': lambda: aruco2(dictionary)}
    if dictionary == TAG:
        others |= {'apriltag': lambda: apriltag(2.0), 'apriltag_full': lambda: apriltag(1.0)}
    for name, make in others.items():
        try:
            found[name] = make()
        except (ImportError, OSError) as error:
            print(f'{name}: left out: {error}', file=sys.stderr)
    return found


def opencv(dictionary: str, refinement: int) -> Corners:
    """Return OpenCV's detector with a corner refinement."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), parameters)

    def corners(image: GrayImage) -> Array | None:
        found, ids, _ = detector.detectMarkers(image)
        return next((each for each, marker_id in zip(found, [] if ids is None else np.ravel(ids))
                     if marker_id == 0), None)
    return corners


def aruco2(dictionary: str) -> Corners:
    """
    Return the detector of aruco2, with its default parameters.

    The corners that it finds of a tag begin at the bottom right one.

    :raises ImportError, OSError: if it is not installed.
    """
    detect, number = import_module('aruco2').detectFiducialMarkers, getattr(cv2.aruco, dictionary)

    turn = 2 if dictionary == TAG else 0

    def corners(image: GrayImage) -> Array | None:
        return next((np.roll(np.asarray(m.corners), turn, axis=0)
                     for m in detect(image, number) if m.id == 0), None)
    return corners


def apriltag(decimation: float) -> Corners:
    """
    Return the detector of AprilTag 3 for the dictionary TAG.

    Its corners are counted from the edge of the first pixel, and begin at the top right one.

    :param decimation: by which the image searched is smaller.
    :raises ImportError: if it is not installed.
    """
    detector = import_module('pupil_apriltags').Detector(
        families='tag36h11', nthreads=1, quad_decimate=decimation)

    def corners(image: GrayImage) -> Array | None:
        return next((tag.corners[[1, 0, 3, 2]] - 0.5 for tag in detector.detect(image)
                     if tag.tag_id == 0), None)
    return corners
