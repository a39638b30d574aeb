"""What each parameter of a node means: its text, its limits, and its value in force.

Texts are those of the docstrings of the options, limits those of their types, as pydantic states
both in a JSON schema.
"""

from __future__ import annotations

import re
from dataclasses import fields
from typing import Any, NamedTuple

from pydantic import TypeAdapter

from hybridvo.core.options import Options
from hybridvo.io.ros.parameters import NodeOptions

OF_RECORDINGS = (
    "flow.source",
    "depth.source",
    "run.start",
    "run.stop",
    "run.stride",
    "run.max_failed",
    "run.strict",
    "run.alignment",
)
"""Options that mean nothing to a node. A file of options may set them."""
ATTRIBUTE = re.compile(r"^    (\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)
"""An attribute in a docstring, with the lines that go on with it."""


class Description(NamedTuple):
    """A parameter of a node.

    Attributes:
        name: as ``--ros-args -p`` takes it.
        value: in force; None where it is not set.
        text: what it means.
        constraint: what its limits cannot state; empty where there is nothing.
        lower: the smallest number; None where there is no such limit.
        upper: the largest one, likewise.
        may_be_unset: whether it may have no value.
    """

    name: str
    value: Any
    text: str
    constraint: str = ""
    lower: float | None = None
    upper: float | None = None
    may_be_unset: bool = False


def descriptions(node: NodeOptions, options: Options) -> list[Description]:
    """Return what each parameter means, those of the node first.

    Args:
        node: Its own parameters.
        options: Those of the tracker.

    Example:
        >>> described = descriptions(NodeOptions(), Options())
        >>> {each.name: each.text for each in described}["odom_frame"]
        'the frame in which poses are published.'
    """
    found = _of_group("", node)
    for group in fields(Options):
        found += _of_group(f"{group.name}.", getattr(options, group.name))
    return [each for each in found if each.name not in OF_RECORDINGS]


def _of_group(prefix: str, values: Any) -> list[Description]:
    """The descriptions of a group of options."""
    schema = TypeAdapter(type(values)).json_schema()
    texts = attribute_texts(schema.get("description", ""))
    return [
        _description(
            prefix + name, getattr(values, name), texts.get(name, ""), said
        )
        for name, said in schema["properties"].items()
    ]


def _description(
    name: str, value: Any, text: str, schema: dict[str, Any]
) -> Description:
    """The description of an option, from the schema of its type."""
    kinds = schema.get("anyOf", [schema])
    kind = next(each for each in kinds if each["type"] != "null")
    lower = kind.get("minimum", kind.get("exclusiveMinimum"))
    upper = kind.get("maximum")
    constraint = ""
    if "enum" in kind:
        constraint = f"one of {', '.join(map(str, kind['enum']))}"
    if kind["type"] == "number" and "exclusiveMinimum" in kind:
        # the limits of a ROS parameter are among its values
        constraint = f"more than {lower:g}"
    if kind["type"] == "integer" and "exclusiveMaximum" in kind:
        upper = kind["exclusiveMaximum"] - 1
    return Description(
        name, value, text, constraint, lower, upper, may_be_unset=len(kinds) > 1
    )


def attribute_texts(docstring: str) -> dict[str, str]:
    r"""Return what a docstring in Google's style says of each attribute, on one line.

    Args:
        docstring: Without the indentation that all of its lines share.

    Example:
        >>> attribute_texts("A box.\n\nAttributes:\n    side: of it,\n        m.\n")
        {'side': 'of it, m.'}
    """
    _, _, attributes = docstring.partition("Attributes:\n")
    return {
        name: " ".join(text.split()).replace("``", "")
        for name, text in ATTRIBUTE.findall(attributes)
    }
