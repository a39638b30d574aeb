"""Where people are, by a network: these pixels are not used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.core.types import Camera, Frame
from hybridvo.io.onnx.network import Network


class MaskNetwork(Network):
    """A network that finds people; called with a frame, it masks them out.

    Args:
        text: ``onnx:FILE`` or ``onnx:FILE@DESCRIPTION``.

    Raises:
        InputError: a file is missing, or the network does not fit its description.
        FormatError: a file is damaged.

    Example:
        >>> mask = MaskNetwork("onnx:seg.onnx@pphumanseg")  # doctest: +SKIP
        >>> step = vo.track(mask(frame))  # doctest: +SKIP
    """

    def __init__(self, text: str) -> None:
        super().__init__(text, "mask")

    def __call__(self, frame: Frame) -> Frame:
        """Return a frame of which the pixels of people are not used."""
        if frame.rgb is None:
            return frame
        used = ~self.predict(frame.rgb, frame.camera)
        if frame.mask is not None:
            used &= frame.mask
        return replace(frame, mask=used)

    def predict(self, rgb: np.ndarray, camera: Camera) -> np.ndarray:
        """Find people in an image (H, W, 3) uint8; returns (H, W) bool, True where they are."""
        maps = self.run([rgb], camera)
        image = maps.where.back(self.main_map(maps))
        if image.ndim == 2 or image.shape[2] == 1:
            return image.reshape(rgb.shape[:2]) > self.what.threshold
        likely = np.nan_to_num(image, nan=-np.inf).argmax(axis=2)
        return np.isin(likely, self.what.classes)
