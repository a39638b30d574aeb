"""A recording of a run for the Rerun viewer: images, flow, weights, path and covariance."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.files import atomic_write
from hybridvo.core.geometry import invert
from hybridvo.core.results import Step
from hybridvo.core.types import Frame
from hybridvo.io.data.sequence import Sequence
from hybridvo.lab.evaluation.scores import true_trajectory
from hybridvo.lab.visualization.panels import flow_colours

MAX_IMAGES = 300
"""Images of a kind in a recording, which then has about 15 MB."""
MAX_SIDE_PX = 480
"""Longer side of these images, pixels."""
JPEG_QUALITY = 70
FIRST_CLOCK_TIME_S = 1e8
"""Time stamps above this count from 1970, others from the start of the recording, seconds."""
TRUTH_COLOUR = [140, 140, 140]
PATH_COLOUR = [0, 114, 178]


def check_recording(path: str | Path) -> None:
    """Raise an InputError where no recording can be written to a path."""
    path = Path(path)
    if path.suffix != ".rrd" or path.is_dir():
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
    """Writes a recording frame by frame, beside the true path of the sequence.

    Args:
        path: The file.
        sequence: The sequence.
        frames: The indices of the frames that will be tracked.

    Raises:
        OutputError: The file cannot be written.
    """

    def __init__(self, path: str | Path, sequence: Sequence, frames: range) -> None:
        import rerun

        self.path = Path(path)
        # Rerun reports a bad path only later, in a thread.
        with atomic_write(self.path, "wb"):
            pass
        self._rr = rerun
        self._image_stride = -(-len(frames) // MAX_IMAGES)
        self._positions: list[np.ndarray] = []
        self._stream = rerun.RecordingStream(f"hybridvo {sequence.name}")
        self._stream.save(self.path)
        self._stream.log(
            "world", rerun.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True
        )
        truth = true_trajectory(sequence, frames)
        if truth is not None:
            # The true path begins at the origin, as the estimated one does.
            path_from_origin = truth.transformed(invert(truth.T_world_cam[0]))
            self._log_line(
                "world/ground_truth", path_from_origin.positions, TRUTH_COLOUR
            )

    def close(self) -> None:
        """Write what is still in memory, which completes the file."""
        if len(self._positions) > 1:
            self._log_line("world/path", np.array(self._positions), PATH_COLOUR)
        self._stream.flush()
        self._stream.disconnect()

    def add(self, frame: Frame, step: Step, flow: np.ndarray | None) -> None:
        """Record a tracked frame.

        Args:
            frame: The frame.
            step: What the tracker returned for it.
            flow: (H, W, 2) pixels from the frame before, or None.
        """
        self._set_time(step)
        self._log_step(step)
        count = len(self._positions)
        self._positions.append(step.T_world_cam[:3, 3].astype(np.float32))
        if count % self._image_stride == 0:
            self._log_images(frame, step, flow)

    def _set_time(self, step: Step) -> None:
        """Set the time of all that is logged next."""
        self._stream.set_time("frame", sequence=step.index)
        if step.timestamp > FIRST_CLOCK_TIME_S:
            self._stream.set_time("time", timestamp=step.timestamp)
        else:
            self._stream.set_time("time", duration=step.timestamp)

    def _log_line(
        self, name: str, positions: np.ndarray, colour: list[int]
    ) -> None:
        """Log a path, (N, 3) metres, which is there at all times."""
        strip = self._rr.LineStrips3D([positions], colors=colour)
        self._stream.log(name, strip, static=True)

    def _log_step(self, step: Step) -> None:
        """Log the pose, the standard deviations and the status of a step."""
        rr = self._rr
        log = self._stream.log
        T = step.T_world_cam
        std = np.sqrt(np.diag(step.covariance))
        log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        log("covariance/translation_std_mm", rr.Scalars(1e3 * std[:3]))
        log("covariance/rotation_std_mdeg", rr.Scalars(1e3 * np.degrees(std[3:])))
        log("status/inlier_ratio", rr.Scalars(step.motion.inlier_ratio))
        log("status/probability", rr.Scalars(step.probability))
        if not step.ok:
            text = f"frame {step.index}: {step.status} {step.status.message}"
            level = "WARN" if step.usable else "ERROR"
            log("status/messages", rr.TextLog(text, level=level))

    def _log_images(
        self, frame: Frame, step: Step, flow: np.ndarray | None
    ) -> None:
        """Log the image, the flow and the weights of a step, at a smaller size."""
        rr = self._rr
        camera = frame.camera
        stride = -(-max(camera.shape) // MAX_SIDE_PX)
        K = np.diag([1 / stride, 1 / stride, 1.0]) @ camera.K
        pinhole = rr.Pinhole(
            image_from_camera=K,
            width=-(-camera.width // stride),
            height=-(-camera.height // stride),
        )
        self._stream.log("world/camera/image", pinhole)
        images: dict[str, np.ndarray | None] = {"world/camera/image": frame.rgb}
        if flow is not None:
            images["flow"] = flow_colours(flow)
        weights = step.motion.weights
        if weights is not None:
            images["weights"] = (255 * np.clip(weights, 0, 1)).astype(np.uint8)
        for name, image in images.items():
            if image is not None:
                small = rr.Image(image[::stride, ::stride].copy())
                self._stream.log(name, small.compress(JPEG_QUALITY))
