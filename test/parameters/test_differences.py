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

"""The difference of two sets of parameters, as text."""

from flock_follower.parameters.differences import differences, MAX_LISTED


def test_each_parameter_that_differs_is_named_with_both_values() -> None:
    before = {'v_max': 0.5, 'a_max': 2.5, 'old': True}
    assert differences(before, before) == ''
    assert differences(before, {'v_max': 1.0, 'a_max': 2.5, 'new': [1, 2]}) == (
        'new not set -> [1, 2], old True -> not set, v_max 0.5 -> 1.0')


def test_many_are_counted() -> None:
    many = {f'p{number}': number for number in range(MAX_LISTED + 3)}
    assert differences({}, many).endswith('p4 not set -> 4, and 3 more')
