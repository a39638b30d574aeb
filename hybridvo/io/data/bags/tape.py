"""Messages by number: forward as from a tape, and backward by winding it back."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator

import numpy as np

from hybridvo.core.errors import FormatError
from hybridvo.io.data.bags.source import Bag, Message

KEPT = 6
"""Messages of a topic that are kept: colour and depth of a frame do not come at once."""
KEPT_BYTES = 2**27
"""Bytes of all that is kept, but for the newest message."""
LONGEST_WALK = 60
"""Messages of a topic that are rather read past than that the bag is searched anew."""


class Tape:
    """Reads messages of some topics of a bag by their number among those of their topic.

    Frames in their order cost one pass over the bag; a few messages are in memory.
    """

    def __init__(self, bag: Bag, times: dict[str, np.ndarray]) -> None:
        """Prepare a tape.

        Args:
            bag: An open bag.
            times: Topic -> times of recording of its messages, ns, in the order of the bag.
        """
        self._bag = bag
        self._times = times
        self._next = dict.fromkeys(times, 0)
        self._kept = {topic: OrderedDict[int, bytes]() for topic in times}
        self._stream: Iterator[Message] | None = None

    def read(self, topic: str, number: int) -> bytes:
        """Return the data of a message.

        Raises:
            FormatError: It lies in a damaged part of the bag.
        """
        kept = self._kept[topic]
        if number in kept:
            return kept[number]
        ahead = number - self._next[topic]
        if self._stream is None or not 0 <= ahead <= LONGEST_WALK:
            self._wind_to(int(self._times[topic][number]))
        try:
            return self._walk_to(topic, number)
        except FormatError:
            # a damaged part lies before the message
            self._wind_to(int(self._times[topic][number]))
            return self._walk_to(topic, number)

    def _walk_to(self, topic: str, number: int) -> bytes:
        if self._stream is None:
            raise FormatError(f"{self._bag.path}: the tape is not wound.")
        try:
            for message in self._stream:
                here = self._next[message.topic]
                self._next[message.topic] = here + 1
                kept = self._kept[message.topic]
                kept[here] = message.data
                if len(kept) > KEPT or self._kept_bytes() > KEPT_BYTES:
                    self._forget(kept)
                if message.topic == topic and here == number:
                    return message.data
        except FormatError:
            self._stream = None
            raise
        self._stream = None
        raise FormatError(
            f"{self._bag.path}: {topic}: message {number} is not there any more."
        )

    def _kept_bytes(self) -> int:
        return sum(
            len(data) for kept in self._kept.values() for data in kept.values()
        )

    def _forget(self, kept: OrderedDict[int, bytes]) -> None:
        """Forget the oldest message of a topic, if it has another one."""
        if len(kept) > 1:
            kept.popitem(last=False)

    def _wind_to(self, time: int) -> None:
        for topic, times in self._times.items():
            self._next[topic] = int(np.searchsorted(times, time, side="left"))
            self._kept[topic].clear()
        self._stream = self._bag.messages(set(self._times), start=time)
