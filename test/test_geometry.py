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

import math

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from flock_follower import geometry as geo
from flock_follower import ned

finite = st.floats(-1e3, 1e3)
vectors = arrays(float, 3, elements=finite)
angles = st.floats(-math.pi, math.pi)
quaternions = arrays(float, 4, elements=st.floats(-1.0, 1.0)).filter(
    lambda q: np.linalg.norm(q) > 0.1).map(geo.normalize_quaternion)


def same_rotation(q1, q2):
    return abs(abs(float(np.dot(q1, q2))) - 1.0) < 1e-9


def test_north_in_enu_is_the_first_ned_axis_and_up_is_minus_down():
    np.testing.assert_array_equal(ned.enu_to_ned([1.0, 2.0, 3.0]), [2.0, 1.0, -3.0])


@pytest.mark.parametrize(
    'enu, expected', [(0.0, math.pi / 2), (math.pi / 2, 0.0), (math.pi, -math.pi / 2)])
def test_enu_yaw_becomes_ned_yaw(enu, expected):
    assert math.isclose(ned.yaw_enu_to_ned(enu), expected, abs_tol=1e-12)


@given(vectors, angles, quaternions)
def test_vectors_yaw_attitude_survive_enu_ned_round_trip(v, yaw, q):
    np.testing.assert_array_equal(ned.ned_to_enu(ned.enu_to_ned(v)), v)
    np.testing.assert_array_equal(ned.frd_to_flu(ned.flu_to_frd(v)), v)
    assert abs(geo.wrap_angle(ned.yaw_ned_to_enu(ned.yaw_enu_to_ned(yaw)) - yaw)) < 1e-9
    assert same_rotation(
        ned.quaternion_ned_frd_to_enu_flu(ned.quaternion_enu_flu_to_ned_frd(q)), q)


@given(quaternions, vectors)
def test_ned_attitude_takes_body_vector_to_same_place(q, v):
    in_enu = geo.quaternion_to_matrix(q) @ v
    in_ned = geo.quaternion_to_matrix(ned.quaternion_enu_flu_to_ned_frd(q)) @ ned.flu_to_frd(v)
    np.testing.assert_allclose(in_ned, ned.enu_to_ned(in_enu), atol=1e-9)


@given(quaternions)
def test_matrices_are_rotations_and_round_trip(q):
    matrix = geo.quaternion_to_matrix(q)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert math.isclose(np.linalg.det(matrix), 1.0, abs_tol=1e-12)
    assert same_rotation(geo.matrix_to_quaternion(matrix), q)


@given(quaternions, quaternions, vectors)
def test_quaternion_product_rotates_like_matrix_product(q1, q2, v):
    product = geo.quaternion_to_matrix(geo.quaternion_multiply(q1, q2))
    np.testing.assert_allclose(
        product @ v, geo.quaternion_to_matrix(q1) @ geo.quaternion_to_matrix(q2) @ v, atol=1e-9)


@given(arrays(float, 3, elements=st.floats(-1.8, 1.8)))
def test_rotation_vectors_round_trip_up_to_half_a_turn(v):
    back = geo.quaternion_to_rotation_vector(geo.rotation_vector_to_quaternion(v))
    np.testing.assert_allclose(back, v, atol=1e-9)


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_roll_pitch_yaw_are_about_fixed_axes(roll, pitch, yaw):
    def about(axis, angle):
        return geo.rotation_vector_to_matrix(np.eye(3)[axis] * angle)

    np.testing.assert_allclose(
        geo.quaternion_to_matrix(geo.quaternion_from_rpy(roll, pitch, yaw)),
        about(2, yaw) @ about(1, pitch) @ about(0, roll), atol=1e-9)


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_roll_pitch_yaw_round_trip(roll, pitch, yaw):
    R = geo.quaternion_to_matrix(geo.quaternion_from_rpy(roll, pitch, yaw))
    np.testing.assert_allclose(geo.rpy_from_matrix(R), [roll, pitch, yaw], atol=1e-6)


@pytest.mark.parametrize('pitch', [-math.pi / 2.0, math.pi / 2.0])
def test_where_roll_and_yaw_turn_about_one_axis_all_of_it_is_yaw(pitch):
    R = geo.quaternion_to_matrix(geo.quaternion_from_rpy(0.4, pitch, 0.7))
    rpy = geo.rpy_from_matrix(R)
    assert rpy[0] == 0.0
    np.testing.assert_allclose(geo.quaternion_to_matrix(geo.quaternion_from_rpy(*rpy)), R,
                               atol=1e-6)


@given(quaternions, quaternions, st.floats(0.0, 1.0))
def test_slerp_turns_at_a_constant_rate_along_the_shorter_arc(q0, q1, fraction):
    def angle(a, b):
        return 2.0 * math.acos(min(1.0, abs(float(np.dot(a, b)))))

    part = geo.slerp(q0, q1, fraction)
    assert abs(angle(q0, part) - fraction * angle(q0, q1)) < 1e-6


@given(quaternions, vectors, quaternions, vectors, vectors)
def test_transforms_compose_and_invert(q1, t1, q2, t2, p):
    a, b = geo.Transform.from_quaternion(t1, q1), geo.Transform.from_quaternion(t2, q2)
    np.testing.assert_allclose((a @ b).apply(p), a.apply(b.apply(p)), atol=1e-8)
    np.testing.assert_allclose(a.inverse().apply(a.apply(p)), p, atol=1e-8)


@given(vectors, vectors)
def test_skew_is_the_cross_product(u, v):
    np.testing.assert_allclose(geo.skew(u) @ v, np.cross(u, v), atol=1e-8)


@pytest.mark.parametrize('q', [[0, 0, 0, 0], [np.nan, 0, 0, 1], [0, 0, 1]])
def test_a_quaternion_that_is_none_is_refused_by_name_and_value(q):
    with pytest.raises(ValueError, match='quaternion = '):
        geo.normalize_quaternion(q)


@pytest.mark.parametrize('part', geo.Transform._fields)
def test_the_identity_of_all_transforms_cannot_be_changed(part):
    with pytest.raises(ValueError, match='read-only'):
        getattr(geo.Transform(), part)[0] = 1.0
