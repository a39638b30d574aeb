"""The plain part of YAML that settings need: keys, scalars and lists, and nothing that unfolds.

``yaml.safe_load`` runs nothing, but a few bytes can still cost minutes or gigabytes: aliases and
merge keys double what they repeat, ``1:1:1...`` is a number of base 60, and tags and dates raise
whatever their constructors raise. None of these says anything about a camera, so they are errors.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from hybridvo.errors import FormatError

__all__ = ["MAX_YAML_BYTES", "plain_yaml"]

MAX_YAML_BYTES = 2**16
"""Largest settings file that is read; they are a few kilobytes, and PyYAML is slow."""

MAX_SCALAR, MAX_DEPTH = 1000, 20
"""Characters of one value, levels of nesting: beyond them is no setting."""


class _PlainLoader(yaml.SafeLoader):
    """SafeLoader without aliases, tags, merge keys, dates, numbers of base 60 and repeated keys."""

    depth = 0

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """One mapping; of a key that stands there twice PyYAML would keep the last."""
        seen = set()
        for key, _ in node.value:
            name = getattr(key, "value", None)
            if isinstance(name, str) and name in seen:
                line = key.start_mark.line + 1
                raise yaml.YAMLError(f"line {line}: the key {name[:40]!r} is there twice")
            seen.add(name if isinstance(name, str) else None)
        return super().construct_mapping(node, deep)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One value, after a look at what it is."""
        event = self.peek_event()
        what = None
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            what = "anchors and aliases (& and *) are"
        elif getattr(event, "tag", None) is not None:
            what = "tags (!) are"
        elif len(getattr(event, "value", "")) > MAX_SCALAR:
            what = f"values of more than {MAX_SCALAR} characters are"
        elif self.depth >= MAX_DEPTH:
            what = f"more than {MAX_DEPTH} levels of nesting are"
        if what is not None:
            raise yaml.YAMLError(f"line {event.start_mark.line + 1}: {what} not read here")
        self.depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1


# The words and numbers of YAML 1.1 as PyYAML resolves them, less merge keys, dates and base 60.
_LEFT_OUT = ("tag:yaml.org,2002:merge", "tag:yaml.org,2002:timestamp", "tag:yaml.org,2002:value")
_BASE_60 = re.compile(r"[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?$")
_PlainLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _LEFT_OUT]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
# YAML 1.1 reads 1e-3 and 1.0e9 as words; everybody who writes them means the numbers.
_POWER_OF_TEN = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$")
for _first in "-+.0123456789":
    _PlainLoader.yaml_implicit_resolvers[_first] = [
        ("tag:yaml.org,2002:str", _BASE_60),
        ("tag:yaml.org,2002:float", _POWER_OF_TEN),
        *_PlainLoader.yaml_implicit_resolvers.get(_first, []),
    ]


def plain_yaml(text: str, where: str) -> Any:
    """Content of a YAML document of keys, scalars and lists.

    Args:
        text: the document.
        where: file or option, for the message.

    Raises:
        FormatError: not YAML, or more of YAML than settings need (aliases, tags, deep nesting).

    Example:
        >>> plain_yaml("fx: 525.0", "camera.yaml")
        {'fx': 525.0}
    """
    try:
        loader = _PlainLoader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    # ValueError: '0x_' and other words that look like numbers
    except (yaml.YAMLError, ValueError) as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise FormatError(f"{where}: not a plain YAML file ({reason}).") from None
