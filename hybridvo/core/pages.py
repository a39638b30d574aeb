"""Where the documentation is, for messages: who installs with pip has no ``docs`` folder."""

from __future__ import annotations

DOCUMENTATION = "https://example.org/hybridvo/docs"
"""As in ``pyproject.toml``."""


def page(name: str) -> str:
    """Return the address of a page of the documentation.

    Args:
        name: Of its file in ``docs``, without ``.md``.

    Example:
        >>> page("own-data").removeprefix(DOCUMENTATION)
        '/own-data/'
    """
    return f"{DOCUMENTATION}/{name}/"
