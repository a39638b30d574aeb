"""Depth by a network, in metres on the camera's pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera, Frame
from hybridvo.io.onnx.images import channels_last
from hybridvo.io.onnx.network import Maps, Network

MILLIMETRE = np.float32(0.001)


class DepthNetwork(Network):
    """A network that predicts depth; called with a frame, it returns the frame with this depth.

    Args:
        text: ``onnx:FILE`` or ``onnx:FILE@DESCRIPTION``.

    Raises:
        InputError: a file is missing, or the network does not fit its description.
        FormatError: a file is damaged.

    Example:
        >>> add_depth = DepthNetwork("onnx:metric3d.onnx@metric3d_small")  # doctest: +SKIP
        >>> step = vo.track(add_depth(Frame(rgb, None, camera)))  # doctest: +SKIP
    """

    def __init__(self, text: str) -> None:
        super().__init__(text, "depth")

    def __call__(self, frame: Frame) -> Frame:
        """Return a frame with predicted depth in place of its own; without an image it has none."""
        depth = None
        if frame.rgb is not None:
            depth = self.predict(frame.rgb, frame.camera)
        return replace(
            frame, depth=depth, depth_variance=None, depth_source="network"
        )

    def predict(self, rgb: np.ndarray, camera: Camera) -> np.ndarray:
        """Predict the depth of an image.

        Args:
            rgb: (H, W, 3) uint8, red first.
            camera: its camera.

        Returns:
            (H, W) float32 metres, 0 where the network states none.
        """
        maps = self.run([rgb], camera)
        image = self.main_map(maps)
        what = self.what
        if not -image.shape[2] <= what.channel < image.shape[2]:
            raise InputError(
                f"{self.name}: the output has {image.shape[2]} channels, and {self.files[1]} "
                f"requests channel {what.channel}."
            )
        if what.recover_shift and image.shape[2] != 3:
            raise InputError(
                f"{self.name}: the output has {image.shape[2]} channels, and {self.files[1]} "
                "states 'recover_shift': expected points of 3 channels: x, y, z."
            )
        depth = image[..., what.channel]
        valid = self._valid(maps)
        if valid is not None and valid.shape != depth.shape:
            raise InputError(
                f"{self.name}: the output '{what.valid_output}' has {valid.shape} rows and "
                f"columns: expected {depth.shape}, as depth has."
            )
        viewed = maps.where.camera(camera)
        if what.recover_shift:
            depth = depth + depth_shift(maps.where.crop(image), maps, viewed, valid)
        depth = self._metres(depth, maps, viewed)
        if valid is not None:
            depth = np.where(valid, depth, np.float32(np.nan))
        return self._clean(maps.where.back(depth))

    def _metres(self, depth: np.ndarray, maps: Maps, viewed: Camera) -> np.ndarray:
        """Depth (h, w) in metres, NaN where there is none."""
        what = self.what
        with np.errstate(all="ignore"):
            metres = np.where(depth > 0, depth, np.float32(np.nan))
            if what.unit == "inverse":
                metres = 1 / metres
            if what.unit == "millimetres":
                metres = metres * MILLIMETRE
        for name in what.factor_output:
            if name in maps.outputs:
                factor = maps.outputs[name].ravel()
                if not factor.size:
                    raise InputError(f"{self.name}: the output '{name}' is empty.")
                metres = metres * np.float32(factor[0])
                break
        if what.canonical_focal is not None:
            focal = (viewed.fx + viewed.fy) / 2
            metres = metres * np.float32(focal / what.canonical_focal)
        return metres

    def _valid(self, maps: Maps) -> np.ndarray | None:
        """Where depth is valid by an output of its own, (h, w) bool."""
        what = self.what
        if not what.valid_output:
            return None
        output = maps.outputs[what.valid_output]
        level = channels_last(output, what, self.name)[..., 0]
        if what.valid_below is not None:
            return level < what.valid_below
        return level > what.valid_above

    def _clean(self, depth: np.ndarray) -> np.ndarray:
        """Depth with 0 where it is not known, or beyond what counts."""
        farthest = self.what.max_depth_m or np.inf
        is_known = np.isfinite(depth) & (depth > 0) & (depth <= farthest)
        return np.where(is_known, depth, np.float32(0)).astype(np.float32)


def depth_shift(
    points: np.ndarray, maps: Maps, viewed: Camera, valid: np.ndarray | None = None
) -> np.float32:
    """Return what must be added to z so that points lie on the rays of their pixels.

    A pixel at a distance of d px from the centre sees f x / (z + shift) = d. This is linear in the
    shift: the least-squares solution over all pixels is returned.

    Args:
        points: (h, w, 3) x, y, z on the pixels of the camera's image.
        maps: states where these pixels lie.
        viewed: the camera of the network's image.
        valid: (h, w) bool of the network's whole image, or None: all.
    """
    rows, columns = points.shape[:2]
    top, left = maps.where.corner
    u = np.arange(left, left + columns) - viewed.cx
    v = np.arange(top, top + rows)[:, None] - viewed.cy
    known = np.isfinite(points).all(axis=2)
    if valid is not None:
        known &= maps.where.crop(valid.astype(np.float32)) > 0.5
    x, y, z = points[known].astype(np.float64).T
    along_u = np.broadcast_to(u, known.shape)[known]
    along_v = np.broadcast_to(v, known.shape)[known]
    missing_u = viewed.fx * x - along_u * z
    missing_v = viewed.fy * y - along_v * z
    square = along_u @ along_u + along_v @ along_v
    if not square > 0:
        return np.float32(0)
    return np.float32((along_u @ missing_u + along_v @ missing_v) / square)
