"""The frame after one is read ahead where it tells of it, and read once."""

from __future__ import annotations

from dataclasses import replace

import hybridvo as hvo
from hybridvo.io.data.selected import WholeSequence
from hybridvo.io.data.sequence import Sequence
from hybridvo.run.commands.frame_reading import FramesAhead

BROKEN = 4


class Watched(WholeSequence):
    """A sequence of a camera with a readout that notes what is read, and one broken frame."""

    def __init__(self, original: Sequence, readout_ms: float) -> None:
        super().__init__(original)
        self.read: list[int] = []
        self._readout_ms = readout_ms

    def frame(self, index: int) -> hvo.Frame:
        self.read.append(index)
        if index == BROKEN:
            raise hvo.InputError("broken")
        frame = super().frame(index)
        camera = replace(frame.camera, readout_ms=self._readout_ms)
        return replace(frame, camera=camera)


def test_frames_of_a_rolling_shutter_are_read_ahead_and_once(dataset) -> None:
    sequence = Watched(hvo.open_sequence(dataset), 10.0)
    ahead = FramesAhead(sequence, range(0, 4, 2))
    first = ahead.frame(0)
    following = ahead.after(first)
    assert following is not None and following.index == 2
    assert ahead.frame(2) is following
    # the run ends here
    assert ahead.after(following) is None
    assert sequence.read == [0, 2]


def test_a_frame_that_cannot_be_read_tells_nothing(dataset) -> None:
    sequence = Watched(hvo.open_sequence(dataset), 10.0)
    ahead = FramesAhead(sequence, range(6))
    assert ahead.after(ahead.frame(BROKEN - 1)) is None


def test_nothing_is_read_ahead_of_a_global_shutter(dataset) -> None:
    sequence = Watched(hvo.open_sequence(dataset), 0.0)
    ahead = FramesAhead(sequence, range(6))
    assert ahead.after(ahead.frame(0)) is None
    assert sequence.read == [0]
