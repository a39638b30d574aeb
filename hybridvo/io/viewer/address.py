"""Where a viewer is: started here, running elsewhere, or a page in a browser."""

from __future__ import annotations

from typing import NamedTuple

from hybridvo.core.errors import InputError

HOST = "127.0.0.1"
PORT = 9876
"""Port on which Rerun's viewer listens by default."""
PAGE_PORT = 9090
"""Port on which Rerun's page is served by default."""
MAX_PORT = 65535
SPAWN = "spawn"
CONNECT = "connect"
SERVE = "serve"


class Address(NamedTuple):
    """Where a viewer is.

    Attributes:
        kind: ``spawn``, ``connect`` or ``serve``.
        host: of the viewer.
        port: of the viewer.
    """

    kind: str
    host: str = HOST
    port: int = PORT

    @property
    def url(self) -> str:
        """The address as Rerun writes it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"rerun+http://{host}:{self.port}/proxy"


def parse_address(text: str) -> Address:
    """Return where a viewer is, from what ``--view`` takes.

    Args:
        text: ``spawn``, ``serve``, ``connect``, ``connect:PORT``, ``connect:HOST`` or
            ``connect:HOST:PORT``.

    Raises:
        InputError: The text is none of these.

    Example:
        >>> parse_address("connect:robot:9000").url
        'rerun+http://robot:9000/proxy'
    """
    kind, _, rest = text.partition(":")
    if kind in (SPAWN, SERVE) and not rest:
        return Address(kind)
    if kind != CONNECT:
        raise InputError(
            f"--view {text}: expected spawn, connect[:HOST:PORT] or serve. If {text} is the "
            f"sequence, write it before --view: {text} --view."
        )
    if not rest:
        return Address(kind)
    host, _, port = rest.rpartition(":")
    if rest.isdecimal() or rest.endswith("]"):
        host = rest if rest.endswith("]") else ""
        port = "" if rest.endswith("]") else rest
    elif not host:
        host = rest
        port = ""
    host = host.removeprefix("[").removesuffix("]") or HOST
    if not port:
        return Address(kind, host)
    if not port.isdecimal() or not 0 < int(port) <= MAX_PORT:
        raise InputError(
            f"--view {text}: expected connect:HOST:PORT, as connect:{HOST}:{PORT}."
        )
    return Address(kind, host, int(port))
