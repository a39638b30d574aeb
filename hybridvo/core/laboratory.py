"""What another distribution, hybridvo-lab, adds to this one, by entry points.

It brings methods to compare with, the paper's networks, scenes, training and scores. This
package never imports it: what is wanted of it is asked for by name.
"""

from __future__ import annotations

import functools
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from hybridvo.core.errors import InputError

METHODS = "hybridvo.methods"
"""Group of the methods: :class:`hybridvo.pipeline.Method`."""
COMMANDS = "hybridvo.commands"
"""Group of the functions that commands call."""
TEXTS = "hybridvo.texts"
"""Group of what is printed of the results of these commands."""
FUNCTIONS = "hybridvo.functions"
"""Group of functions that this package uses where they are there."""
REMEDY = (
    "pip install hybridvo-lab; in a clone of hybridvo: pip install ./hybridvo_lab"
)


@functools.cache
def _points(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group, by their names."""
    return {point.name: point for point in entry_points(group=group)}


def names_of(group: str) -> tuple[str, ...]:
    """The names in a group; none where the laboratory is not installed."""
    return tuple(_points(group))


def find(group: str, name: str) -> Any | None:
    """What stands under a name in a group; None where there is nothing."""
    point = _points(group).get(name)
    return None if point is None else point.load()


def check_there(group: str, name: str, wanted_by: str) -> None:
    """Refuse what is not there, without loading it; see :func:`wanted`."""
    if name not in _points(group):
        raise InputError(f"{wanted_by} needs hybridvo-lab: {REMEDY}.")


def wanted(group: str, name: str, wanted_by: str) -> Any:
    """What stands under a name in a group.

    Args:
        group: one of the groups of this module.
        name: a name in it.
        wanted_by: what cannot work without it, for the message.

    Raises:
        InputError: The laboratory is not installed.
    """
    check_there(group, name, wanted_by)
    return find(group, name)


def more_with_it() -> str:
    """What a list of names ends with where the laboratory is not installed."""
    return "" if names_of(METHODS) else f"; more with hybridvo-lab: {REMEDY}"


def evaluate(*args: Any, **options: Any) -> dict[str, Any]:
    """Compute the errors of a trajectory against the true one, with hybridvo-lab.

    Args:
        args: see ``hybridvo_lab.evaluation.metrics.evaluate``.
        options: likewise.

    Returns:
        The errors, and for each that is None the reason.

    Raises:
        InputError: hybridvo-lab is not installed, or the trajectories cannot be compared.

    Example:
        >>> import numpy as np
        >>> import hybridvo as hvo
        >>> path = hvo.Trajectory([0.0, 1.0], np.stack([np.eye(4), np.eye(4)]))
        >>> hvo.evaluate(path, path)["matched"]
        2
    """
    report: dict[str, Any] = wanted(FUNCTIONS, "evaluate", "hybridvo.evaluate")(
        *args, **options
    )
    return report
