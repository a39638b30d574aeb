"""A recording of a run for the Rerun viewer: pictures, flow, weights, path and covariance.

Small: pictures are shrunk, compressed and taken every few frames; poses and numbers are kept for
every frame. A recording is for looking at, so nothing that goes wrong in it may end the run: the
first error is reported once and the recording stops there.
"""

from __future__ import annotations

import logging
import os
from array import array
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridvo.checks import make_folder
from hybridvo.errors import InputError
from hybridvo.evaluation.maps import flow_colours, longest_flow
from hybridvo.types import Frame, Step

__all__ = ["Recording", "check_recording"]

MAX_PICTURES = 300
"""Pictures of a kind in a recording: with the sizes below some 15 MB at most."""
MAX_SIDE = 480
JPEG_QUALITY = 70
SIGMAS = 3.0
"""Size of the ellipsoids, in standard deviations."""
FLUSH_SECONDS = 30.0
CHUNK_ROWS = 200
"""Frames that are written together. Rerun keeps a few kB for every chunk of a file until its end
(the index in its footer), and by default begins a chunk for every entity five times a second: 70 MB
over 10 000 frames of 40 ms. So chunks end by number of frames, whatever the time between them; a
recording that is killed lacks as many."""
CHUNK_BYTES = 262144
"""The same for pictures."""
CHUNK_SECONDS = 86400.0
SINCE_1970 = 1e8
"""Stamps above this are dates: three years of recording would be the alternative."""

_logger = logging.getLogger(__name__)


def check_recording(path: str | os.PathLike[str], *, replace: bool = True) -> None:
    """Refuse what cannot become a recording, before a run is started.

    Args:
        path: file to write.
        replace: a file of that name may be replaced, or gone on with.

    Raises:
        InputError: Rerun is not installed, the name does not end in ``.rrd`` or is that of a
            folder, or it is there already and ``replace`` is False.
    """
    if Path(path).is_dir():
        raise InputError(f"--rrd {os.fspath(path)}: is a folder, expected the name of a file.")
    if not replace and os.path.lexists(path):
        raise InputError(
            f"--rrd {os.fspath(path)}: is there already. Pass --overwrite to replace it, or "
            f"another name."
        )
    if Path(path).suffix != ".rrd":
        raise InputError(f"--rrd {os.fspath(path)}: expected a name that ends in .rrd.")
    if find_spec("rerun") is None:
        raise InputError("--rrd: Rerun is not installed; pip install 'hybridvo[viz]'.")


class Recording:
    """Writes a recording as the frames come in; use as a context manager.

    Args:
        path: file to write; where it exists, as after ``--resume``, a part is written beside it
            that the viewer shows together with it.
        name: of the sequence.
        identity: the same for all parts of one run.
        frames: expected number of frames; decides the stride of the pictures.
        first: number of the first frame that will be recorded, for the name of a part.
        truth: (N, 4, 4) true T_world_cam, or None.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        name: str,
        identity: str,
        frames: int,
        *,
        first: int = 0,
        truth: np.ndarray | None = None,
    ) -> None:
        self.path = Path(path)
        if first > 0 and self.path.exists():
            self.path = self.path.with_stem(f"{self.path.stem}_from_{first:06d}")
        self._stride = max(1, -(-frames // MAX_PICTURES))
        self._count = 0
        self._positions = array("f")
        self._stream: Any = None
        self._rr: Any = None
        self.failed = False
        self._guard(self._open, name, identity, truth)

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def add(self, frame: Frame, step: Step, flow: np.ndarray | None) -> None:
        """Record a tracked frame.

        Args:
            frame: what was tracked.
            step: its outcome.
            flow: (H, W, 2) px from the frame before to this one, or None.
        """
        self._guard(self._add, frame, step, flow)

    def close(self) -> None:
        """Write what is still in memory; the file is complete afterwards."""
        self._guard(self._close)

    def _guard(self, act: Any, *arguments: Any) -> None:
        if self.failed:
            return
        try:
            act(*arguments)
        except Exception as error:  # whatever it is, the run goes on
            self.failed = True
            _logger.warning(
                "the recording %s ends at frame %d: %s: %s",
                self.path,
                self._count,
                type(error).__name__,
                error,
            )

    def _open(self, name: str, identity: str, truth: np.ndarray | None) -> None:
        import rerun

        self._rr = rerun
        make_folder(self.path.parent)
        if self.path.is_symlink():  # replaced, never followed, like all results
            self.path.unlink()
        # save() itself reports a bad path only later, in a thread
        self.path.open("wb").close()
        batches = rerun.ChunkBatcherConfig(
            flush_tick=CHUNK_SECONDS, flush_num_rows=CHUNK_ROWS, flush_num_bytes=CHUNK_BYTES
        )
        self._stream = rerun.RecordingStream(
            f"hybridvo {name}", recording_id=identity, batcher_config=batches
        )
        self._stream.save(self.path)
        self._stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        if truth is not None:
            known = truth[np.isfinite(truth).all(axis=(1, 2))]
            if len(known):
                line = (np.linalg.inv(known[0]) @ known)[:, :3, 3]
                strip = rerun.LineStrips3D([line], colors=[140, 140, 140])
                self._stream.log("world/truth", strip, static=True)

    def _add(self, frame: Frame, step: Step, flow: np.ndarray | None) -> None:
        rr, stream = self._rr, self._stream
        stream.set_time("frame", sequence=step.index)
        # stamps of sensors count from 1970, those of rendered sequences from their start
        clock = "timestamp" if step.timestamp > SINCE_1970 else "duration"
        stream.set_time("time", **{clock: step.timestamp})
        T = step.T_world_cam
        self._positions.extend(T[:3, 3])
        stream.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self._numbers(step)
        if self._count % self._stride == 0:
            self._pictures(frame, step, flow)
        self._count += 1

    def _numbers(self, step: Step) -> None:
        rr, log, motion = self._rr, self._stream.log, step.motion
        std = np.sqrt(np.maximum(np.diag(motion.covariance), 0.0))
        log("covariance/translation_std_mm", rr.Scalars(1e3 * std[:3]))
        log("covariance/rotation_std_mdeg", rr.Scalars(1e3 * np.degrees(std[3:])))
        log("status/inlier_ratio", rr.Scalars(motion.inlier_ratio))
        log("status/ms", rr.Scalars(motion.ms))
        if str(step.status) != "ok":
            text = f"frame {step.index}: {step.status} {step.status.message}"
            log("status/messages", rr.TextLog(text, level="ERROR" if not step.usable else "WARN"))
        # the covariance of the motion, in the camera where it lies
        values, axes = np.linalg.eigh(motion.covariance[:3, :3])
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1
        sizes = SIGMAS * np.sqrt(np.maximum(values, 0.0))
        log("world/camera/covariance", rr.Transform3D(mat3x3=axes))
        log("world/camera/covariance", rr.Ellipsoids3D(half_sizes=[sizes], colors=[213, 94, 0]))

    def _pictures(self, frame: Frame, step: Step, flow: np.ndarray | None) -> None:
        rr, log = self._rr, self._stream.log
        height, width = frame.camera.shape
        scale = min(1.0, MAX_SIDE / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        K = np.diag([size[0] / width, size[1] / height, 1.0]) @ frame.camera.K
        log("world/camera/image", rr.Pinhole(image_from_camera=K, width=size[0], height=size[1]))
        if frame.rgb is not None:
            log("world/camera/image", self._jpeg(_shrink(frame.rgb, size)))
        if flow is not None:
            small = flow[:: max(1, int(1 / scale)), :: max(1, int(1 / scale))]
            log("flow", self._jpeg(_shrink(flow_colours(small, longest_flow(small)), size)))
        if step.motion.weights is not None:
            weights = (255 * np.clip(step.motion.weights, 0.0, 1.0)).astype(np.uint8)
            log("weights", self._jpeg(_shrink(np.repeat(weights[..., None], 3, axis=2), size)))

    def _jpeg(self, rgb: np.ndarray) -> Any:
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        done, content = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), quality)
        if not done:
            raise ValueError(f"a picture of shape {rgb.shape} cannot be compressed")
        return self._rr.EncodedImage(contents=content.tobytes(), media_type="image/jpeg")

    def _close(self) -> None:
        if self._stream is None:
            return
        rr, stream = self._rr, self._stream
        if self._count > 1:
            line = np.array(self._positions).reshape(-1, 3)
            strip = rr.LineStrips3D([line], colors=[0, 114, 178])
            stream.log("world/path", strip, static=True)
        stream.flush(timeout_sec=FLUSH_SECONDS)
        stream.disconnect()
        self._stream = None


def _shrink(rgb: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Picture of (width, height); only ever smaller or as large as it was, weights aside."""
    larger = rgb.shape[1] < size[0]
    return cv2.resize(rgb, size, interpolation=cv2.INTER_NEAREST if larger else cv2.INTER_AREA)
