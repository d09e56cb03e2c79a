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
Who may see the live page, and who may press its buttons.

A foreign page that is open in the same browser can send requests to this server: from another
origin, or under a foreign host name that resolves to this machine (DNS rebinding). So the host of
each request and the origin of each WebSocket are checked. On loopback everyone who can reach the
address can read; beyond loopback, and for the buttons, a token is required.
"""

from __future__ import annotations

from dataclasses import dataclass
import hmac
from ipaddress import ip_address
from typing import Final
from urllib.parse import urlsplit

#: Reasons of a refusal.
HOST, ORIGIN, TOKEN, OFF = 'host', 'origin', 'token', 'off'
#: Bytes of randomness in a token: it cannot be guessed over a network.
TOKEN_BYTES: Final = 16


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a host; the only such name is localhost."""
    if host == 'localhost':
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def split_host(value: str) -> str:
    """Return the host in a Host header, without port and brackets, in lower case; or ''."""
    try:
        parts = urlsplit(f'//{value}')
        _ = parts.port  # raises for a port that is no number
        if parts.username is not None or parts.path or parts.query or parts.fragment:
            return ''
        return (parts.hostname or '').rstrip('.')
    except ValueError:
        return ''


@dataclass(frozen=True)
class Access:
    """
    The rules of one page.

    :param host: the address of the server.
    :param control: whether the page has buttons.
    :param token: '' if there is none.
    :param names: host names of this machine; numeric addresses are always accepted, because
        they are no foreign names.
    :raises ValueError: without a token if one is needed.
    """

    host: str
    control: bool = False
    token: str = ''
    names: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.needs_token and not self.token:
            raise ValueError(f'host = {self.host!r}, control = {self.control}: needs a token')

    @property
    def open_to_readers(self) -> bool:
        """Return whether reading needs no token."""
        return is_loopback(self.host)

    @property
    def needs_token(self) -> bool:
        """Return whether reading or the buttons need a token."""
        return self.control or not self.open_to_readers

    def matches(self, offered: str) -> bool:
        """Return whether a token is right; the comparison takes constant time."""
        # Bytes that are no UTF-8 come as surrogates, which encode() alone refuses.
        return bool(self.token) and hmac.compare_digest(
            offered.encode(errors='surrogatepass'), self.token.encode())

    def refuse_host(self, header: str) -> str:
        """Return ``HOST`` if the Host header of a request names none of our addresses; or ''."""
        host = split_host(header)
        try:
            ip_address(host)
        except ValueError:
            known = {'localhost', self.host.lower(), *(name.lower() for name in self.names)}
            return '' if host and host in known else HOST
        return HOST if self.open_to_readers and not is_loopback(host) else ''

    def refuse_reader(self, header: str, offered: str) -> str:
        """
        Return why a request is refused, or ''.

        :param header: its Host header. :param offered: the token that it offers, '' if none.
        """
        if refused := self.refuse_host(header):
            return refused
        if self.open_to_readers and not offered:
            return ''
        return '' if self.matches(offered) else TOKEN

    def refuse_socket(self, header: str, origin: str, offered: str) -> str:
        """
        Return why a WebSocket is refused, or ''.

        :param origin: its Origin header, which every browser sends; '' is refused.
        """
        if refused := self.refuse_host(header):
            return refused
        if origin.lower() != f'http://{header}'.lower():
            return ORIGIN
        return self.refuse_reader(header, offered)

    def refuse_button(self, offered: str) -> str:
        """Return why a pressed button is refused, or ''."""
        if not self.control:
            return OFF
        return '' if self.matches(offered) else TOKEN

    def urls(self, port: int) -> list[str]:
        """Return the addresses to open, the nearest first."""
        hosts = [self.host] if self.host not in ('0.0.0.0', '::', '') else [
            'localhost', *sorted(self.names)]
        query = f'/?token={self.token}' if self.token else ''
        return [f'http://{f"[{host}]" if ":" in host else host}:{port}{query}' for host in hosts]
