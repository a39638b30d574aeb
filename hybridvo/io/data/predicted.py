"""A sequence whose depth, or masks of people, come from networks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hybridvo.core.types import Frame
from hybridvo.io.data.selected import WholeSequence
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.onnx.depth import DepthNetwork
from hybridvo.io.onnx.mask import MaskNetwork


class PredictedSequence(WholeSequence):
    """Another sequence, whose frames go through networks as they are read.

    Args:
        sequence: any sequence.
        depth: predicts depth, which replaces that of the sequence; or None.
        mask: finds people, whose pixels are not used; or None.

    Example:
        >>> sequence = open_sequence("walk.mp4", depth="onnx:metric3d.onnx")  # doctest: +SKIP
        >>> sequence.depth_source  # doctest: +SKIP
        'network'
    """

    def __init__(
        self,
        sequence: Sequence,
        depth: DepthNetwork | None = None,
        mask: MaskNetwork | None = None,
    ) -> None:
        # stamps, poses, warnings and lists of files stay those of the sequence
        super().__init__(sequence)
        self._networks = [
            network for network in (depth, mask) if network is not None
        ]
        if depth is not None:
            self.depth_source = "network"

    def frame(self, index: int) -> Frame:
        """Read a frame, and run the networks on its image."""
        frame = super().frame(index)
        for network in self._networks:
            frame = network(frame)
        return frame

    def files(self) -> list[Path]:
        """Return every file that is read, the networks among them."""
        networks = [path for network in self._networks for path in network.files]
        return sorted({*super().files(), *networks})

    def opened_with(self) -> dict[str, Any]:
        """Return what decides how the files are read, JSON-ready."""
        names = {network.what.task: network.name for network in self._networks}
        return self._original.opened_with() | {"networks": names}
