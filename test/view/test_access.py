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

"""Who may see the page, and press its buttons."""

from __future__ import annotations

import pytest

from flock_follower.view.access import Access, HOST, is_loopback, OFF, ORIGIN, TOKEN

LOCAL = Access('127.0.0.1', names=frozenset({'robot'}))
CONTROL = Access('127.0.0.1', control=True, token='secret')
REMOTE = Access('0.0.0.0', token='secret', names=frozenset({'robot', 'robot.local'}))


@pytest.mark.parametrize(('host', 'loopback'), [
    ('127.0.0.1', True), ('127.9.9.9', True), ('::1', True), ('localhost', True),
    ('0.0.0.0', False), ('::', False), ('192.168.1.5', False), ('robot', False), ('', False)])
def test_only_addresses_of_this_machine_are_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


@pytest.mark.parametrize(('host', 'control'), [
    ('0.0.0.0', False), ('192.168.1.5', False), ('robot', False), ('127.0.0.1', True)])
def test_what_needs_a_token_is_refused_without_one(host: str, control: bool) -> None:
    with pytest.raises(ValueError, match='needs a token'):
        Access(host, control)
    Access(host, control, 'secret')


@pytest.mark.parametrize(('access', 'header', 'refused'), [
    (LOCAL, '127.0.0.1:8090', ''), (LOCAL, 'localhost:9000', ''), (LOCAL, '[::1]:8090', ''),
    (LOCAL, 'LOCALHOST.:8090', ''), (LOCAL, 'robot:8090', ''),
    (LOCAL, 'evil.example:8090', HOST), (LOCAL, '192.168.1.5:8090', HOST), (LOCAL, '', HOST),
    (LOCAL, 'localhost@evil.example', HOST), (LOCAL, 'localhost:x', HOST),
    (LOCAL, 'localhost/evil', HOST), (LOCAL, '127.0.0.1.evil.example', HOST),
    (REMOTE, '192.168.1.5:8090', ''), (REMOTE, 'robot.local:8090', ''),
    (REMOTE, 'evil.example:8090', HOST)])
def test_a_host_that_is_not_ours_is_refused(access: Access, header: str, refused: str) -> None:
    assert access.refuse_host(header) == refused


@pytest.mark.parametrize(('access', 'header', 'offered', 'refused'), [
    (LOCAL, '127.0.0.1', '', ''), (LOCAL, '127.0.0.1', 'wrong', TOKEN),
    (CONTROL, '127.0.0.1', '', ''), (CONTROL, '127.0.0.1', 'wrong', TOKEN),
    (CONTROL, '127.0.0.1', 'secret', ''),
    (REMOTE, '10.0.0.1', '', TOKEN), (REMOTE, '10.0.0.1', 'wrong', TOKEN),
    (REMOTE, '10.0.0.1', 'sécret', TOKEN), (REMOTE, '10.0.0.1', 'secret', ''),
    (REMOTE, 'evil.example', 'secret', HOST)])
def test_beyond_loopback_a_reader_needs_the_token(
        access: Access, header: str, offered: str, refused: str) -> None:
    assert access.refuse_reader(header, offered) == refused


@pytest.mark.parametrize(('origin', 'refused'), [
    ('http://127.0.0.1:8090', ''), ('http://127.0.0.1:9999', ORIGIN), ('', ORIGIN),
    ('http://evil.example', ORIGIN), ('https://127.0.0.1:8090', ORIGIN), ('null', ORIGIN),
    ('http://localhost:8090', ORIGIN)])
def test_a_socket_of_another_origin_is_refused(origin: str, refused: str) -> None:
    assert LOCAL.refuse_socket('127.0.0.1:8090', origin, '') == refused


@pytest.mark.parametrize(('access', 'offered', 'refused'), [
    (LOCAL, '', OFF), (REMOTE, 'secret', OFF), (CONTROL, '', TOKEN), (CONTROL, 'wrong', TOKEN),
    (CONTROL, 'secret', ''), (CONTROL, '\udcff\udcfe', TOKEN)])  # of a cookie that is no text
def test_buttons_act_with_control_and_token(
        access: Access, offered: str, refused: str) -> None:
    assert access.refuse_button(offered) == refused


def test_the_printed_addresses_lead_to_the_page() -> None:
    assert LOCAL.urls(8090) == ['http://127.0.0.1:8090']
    assert Access('::1').urls(1) == ['http://[::1]:1']
    assert CONTROL.urls(8090) == ['http://127.0.0.1:8090/?token=secret']
    assert REMOTE.urls(80) == [f'http://{host}:80/?token=secret'
                               for host in ('localhost', 'robot', 'robot.local')]
