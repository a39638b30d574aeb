"""Optical flow by a network, in the camera's pixels."""

from __future__ import annotations

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera, Frame
from hybridvo.flow.providers import FlowField, forward_backward_check
from hybridvo.io.onnx.network import Network


class FlowNetwork(Network):
    """A provider of a network's flow, for ``hybridvo.Odometry(flow=...)``.

    Where both directions are computed, their disagreement gives variance and validity as that of
    DIS flow does.

    Args:
        text: ``onnx:FILE`` or ``onnx:FILE@DESCRIPTION``.

    Attributes:
        source: what steps call this flow.

    Raises:
        InputError: a file is missing, or the network does not fit its description.
        FormatError: a file is damaged.

    Example:
        >>> flow = FlowNetwork("onnx:neuflow_mixed.onnx@neuflow_v2")  # doctest: +SKIP
        >>> vo = hybridvo.Odometry(flow=flow)  # doctest: +SKIP
    """

    def __init__(self, text: str) -> None:
        super().__init__(text, "flow")
        self.source = f"onnx {self.name}"

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        """Return the flow from the previous to the current frame; none without images."""
        if prev.rgb is None or curr.rgb is None or prev.rgb.shape != curr.rgb.shape:
            return FlowField(None, source=self.source)
        forward = self.predict(prev.rgb, curr.rgb, prev.camera)
        if not self.what.both_directions:
            return FlowField(forward, source=self.source)
        backward = self.predict(curr.rgb, prev.rgb, curr.camera)
        variance, valid = forward_backward_check(forward, backward)
        return FlowField(forward, variance, valid, self.source)

    def predict(
        self, first: np.ndarray, second: np.ndarray, camera: Camera
    ) -> np.ndarray:
        """Predict the flow between two images.

        Args:
            first: (H, W, 3) uint8, red first.
            second: the same, later.
            camera: of both.

        Returns:
            (H, W, 2) float32 pixels (u, v), NaN where the network states none.
        """
        maps = self.run([first, second], camera)
        image = self.main_map(maps)
        if image.shape[2] != 2:
            raise InputError(
                f"{self.name}: flow has {image.shape[2]} channels: expected 2, u and v. Compare "
                f"'output' and 'output_layout' of {self.files[1]} with the file."
            )
        # pixels of the camera in one of the network
        stretch = 1 / np.array(maps.where.scale, np.float32)
        flow = maps.where.back(image) * (np.float32(self.what.flow_scale) * stretch)
        return np.where(np.isfinite(flow), flow, np.float32(np.nan))
