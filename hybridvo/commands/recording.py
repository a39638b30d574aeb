"""A recording of a run for the Rerun viewer: images, flow, weights, path and covariance."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.scores import true_trajectory
from hybridvo.files import atomic_write
from hybridvo.geometry import invert
from hybridvo.results import Step
from hybridvo.types import Frame
from hybridvo.visualization.panels import flow_colours

MAX_IMAGES = 300  # of a kind in a recording, which then has about 15 MB
MAX_SIDE = 480  # px, longer side of these images


def check_recording(path: str | Path) -> None:
    """Raise an InputError where no recording can be written to a path."""
    if Path(path).suffix != ".rrd" or Path(path).is_dir():
        raise InputError(
            f"--rrd {path!s}: expected the name of a file that ends in .rrd."
        )
    if find_spec("rerun") is None:
        raise InputError(
            "--rrd: Rerun is not installed; pip install 'hybridvo[viz]'."
        )
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(
            f"--rrd {path!s}: Rerun needs a path that is UTF-8 text."
        ) from None


class Recording:
    """Writes a recording as the frames of a sequence come in, beside their true path."""

    def __init__(self, path: str | Path, sequence: Sequence, frames: range) -> None:
        import rerun

        self.path = Path(path)
        with atomic_write(self.path, "wb"):
            pass  # Rerun reports a bad path only later, in a thread
        self._rr = rerun
        self._stride = -(-len(frames) // MAX_IMAGES)
        self._positions: list[np.ndarray] = []
        self._stream = rerun.RecordingStream(f"hybridvo {sequence.name}")
        self._stream.save(self.path)
        self._stream.log(
            "world", rerun.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True
        )
        if (truth := true_trajectory(sequence, frames)) is not None:
            line = truth.transformed(invert(truth.T_world_cam[0])).positions
            strip = rerun.LineStrips3D([line], colors=[140, 140, 140])
            self._stream.log("world/ground_truth", strip, static=True)

    def close(self) -> None:
        """Write what is still in memory, which completes the file."""
        if len(self._positions) > 1:
            strip = self._rr.LineStrips3D(
                [np.array(self._positions)], colors=[0, 114, 178]
            )
            self._stream.log("world/path", strip, static=True)
        self._stream.flush()
        self._stream.disconnect()

    def add(self, frame: Frame, step: Step, flow: np.ndarray | None) -> None:
        """Record a tracked frame; ``flow`` is (H, W, 2) px from the frame before, or None."""
        rr = self._rr
        log = self._stream.log
        self._stream.set_time("frame", sequence=step.index)
        # since 1970, or the start
        clock = "timestamp" if step.timestamp > 1e8 else "duration"
        self._stream.set_time("time", **{clock: step.timestamp})
        T = step.T_world_cam
        std = np.sqrt(np.diag(step.covariance))
        log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        log("covariance/translation_std_mm", rr.Scalars(1e3 * std[:3]))
        log("covariance/rotation_std_mdeg", rr.Scalars(1e3 * np.degrees(std[3:])))
        log("status/inlier_ratio", rr.Scalars(step.motion.inlier_ratio))
        log("status/probability", rr.Scalars(step.probability))
        if not step.ok:
            text = f"frame {step.index}: {step.status} {step.status.message}"
            log(
                "status/messages",
                rr.TextLog(text, level="WARN" if step.usable else "ERROR"),
            )
        self._positions.append(T[:3, 3].astype(np.float32))
        if (len(self._positions) - 1) % self._stride:
            return
        weights = step.motion.weights
        stride = -(-max(frame.camera.shape) // MAX_SIDE)
        height, width = (-(-size // stride) for size in frame.camera.shape)
        K = np.diag([1 / stride, 1 / stride, 1.0]) @ frame.camera.K
        log(
            "world/camera/image",
            rr.Pinhole(image_from_camera=K, width=width, height=height),
        )
        images = {
            "world/camera/image": frame.rgb,
            "flow": None if flow is None else flow_colours(flow),
            "weights": None
            if weights is None
            else (255 * np.clip(weights, 0, 1)).astype(np.uint8),
        }
        for name, image in images.items():
            if image is not None:
                log(name, rr.Image(image[::stride, ::stride].copy()).compress(70))
