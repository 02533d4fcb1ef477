# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Host and origin of a request: the pages of other sites cannot reach the panel."""

import ipaddress
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Return whether an address, or the name localhost, is reached from this machine alone."""
    if host.lower() == 'localhost':
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def rejection(kind: str, host: str, origin: str | None, scheme: str, *, users: bool) -> str:
    """
    Return the reason to reject a request of any session, or ''.

    Browsers send the origin with each WebSocket: a WebSocket without origin is rejected as well.

    :param kind: 'http' or 'websocket'.
    :param host: header Host.
    :param origin: header Origin.
    :param scheme: 'http' or 'https', as the browser used it.
    :param users: whether the panel has users.
    """
    # Without passwords, a page from elsewhere could reach the panel by a host name of its own that
    # leads here: host and origin then agree.
    if not users and not is_loopback(_name(host)):
        return 'unknown host name: open http://127.0.0.1 with the port of the panel'
    if (kind == 'websocket' or origin is not None) and origin != f'{scheme}://{host}':
        return 'the request comes from a page of another origin' + (
            '; if a proxy serves the panel over TLS, add its address to trusted_proxy'
            if origin == f'https://{host}' else '')
    return ''


def _name(host: str) -> str:
    try:
        return urlsplit(f'//{host}').hostname or ''
    except ValueError:
        return ''
