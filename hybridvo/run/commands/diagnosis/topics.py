"""``hybridvo topics``: the topics of a bag, and for what each is taken."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hybridvo.core.errors import InputError
from hybridvo.io.data.bags.reader import BagSequence, summaries_of
from hybridvo.io.data.bags.source import Bag
from hybridvo.io.data.bags.topics import Topics, choose_topics

ROLES = {
    "rgb": "colour",
    "depth": "depth",
    "rgb_info": "camera of colour",
    "depth_info": "camera of depth",
    "truth": "true poses",
}
"""For what a topic is taken, by the name of the field."""


def topics(path: str | Path) -> dict[str, Any]:
    """List the topics of a bag.

    Args:
        path: The file, or the folder of ROS 2.

    Returns:
        A report, JSON-ready: ``topics`` with name, type, number of messages, encoding of images
        and what each is taken for; ``problem`` where the bag cannot be tracked as it is; and
        ``warnings``.

    Raises:
        InputError: It is no bag, or nothing of it can be read.
    """
    path = Path(path)
    if not BagSequence.knows(path):
        got = "something else" if path.exists() else "no such file"
        raise InputError(f"{path}: expected a bag of ROS 1 or ROS 2, got {got}.")
    bag = Bag(path.absolute())
    try:
        summaries = summaries_of(bag)
    finally:
        bag.close()
    chosen = None
    problem = ""
    warnings = list(bag.notes)
    try:
        chosen = choose_topics(summaries)
        warnings.append(chosen.guessed)
    except InputError as error:
        problem = str(error)
    rows = [
        {
            "name": summary.name,
            "type": summary.type,
            "messages": summary.messages,
            "encoding": summary.encoding,
            "taken_for": _roles(summary.name, chosen),
        }
        for summary in sorted(summaries)
    ]
    return {
        "bag": str(path),
        "topics": rows,
        "problem": problem,
        "warnings": warnings,
    }


def _roles(name: str, chosen: Topics | None) -> str:
    """For what a topic is taken, in words; empty where it is not read."""
    if chosen is None:
        return ""
    taken = [
        role for field, role in ROLES.items() if getattr(chosen, field) == name
    ]
    return ", ".join(taken)
