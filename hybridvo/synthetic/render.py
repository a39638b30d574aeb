"""Rendered sequences with exact depth, flow, visibility, camera path and moving objects.

Everything here is ground truth by construction: an oracle, and named so wherever it is used.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.image_io import write_cam, write_dpt, write_flo
from hybridvo.errors import InputError, OutputError
from hybridvo.files import make_folder
from hybridvo.geometry import invert
from hybridvo.synthetic.scene import Scene
from hybridvo.synthetic.scenes import BANDS, draw_scene
from hybridvo.types import Camera, Frame

MAX_FRAMES = 100_000
"""Of a scene: an hour at 30 frames a second. Its cameras are drawn at once, in memory."""
ATTEMPTS = 200
"""Draws of a family before a share is given up."""


def make_scene(
    kind: str,
    seed: int,
    *,
    height: int = 218,
    width: int = 512,
    frames: int | None = None,
    moving: float | None = None,
    zoom: float = 0.0,
    noise: float = 0.0,
) -> Scene:
    """Scene of a family, drawn from a seed.

    Args:
        kind: ``static``; ``light`` (several movers, about 30 % of the pixels); ``pair`` (small
            random); ``heavy_rigid``, ``heavy_deforming``, ``heavy_two``, ``heavy_ten``: 46 to 75 %
            of the pixels on movers in every frame, and at least 46 % whose flow differs from the
            camera's by over 1/512 of the width.
        seed: not negative; the same seed gives the same images.
        height: pixels.
        width: pixels.
        frames: default 20, for ``pair`` 2; at most :data:`MAX_FRAMES`.
        moving: median share of the pixels on movers; None for the family's own (light 0.3,
            heavy 0.6, pair random).
        zoom: relative amplitude of a slow change of focal length.
        noise: sensor noise, standard deviation in grey levels.

    Raises:
        InputError: an unknown kind, a value out of range, or a share that the family cannot keep.

    Example:
        >>> scene = make_scene("static", 0, height=16, width=32, frames=2)
        >>> scene.render(0).rgb.shape
        (16, 32, 3)
    """
    if frames is None:
        frames = 2 if kind == "pair" else 20
    if kind not in BANDS:
        raise InputError(f"scene kind: expected one of {', '.join(BANDS)}, got {kind!r}.")
    for name, value, least in (("seed", seed, 0), ("frames", frames, 2), ("height", height, 8),
                               ("width", width, 8)):  # fmt: skip
        if isinstance(value, bool) or int(value) != value or value < least:
            raise InputError(f"{name}: expected an integer of at least {least}, got {value!r}.")
    if frames > MAX_FRAMES:
        raise InputError(f"frames: expected at most {MAX_FRAMES}, got {frames}.")
    if not 0.0 <= zoom <= 0.3:
        raise InputError(f"zoom: expected 0 to 0.3, got {zoom}.")
    low, high = BANDS[kind]
    if moving is not None and (kind == "static" or not low < moving < high):
        raise InputError(
            f"moving: a {kind!r} scene can have {low} to {high} of its pixels moving, got {moving}."
        )
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([list(BANDS).index(kind), seed, attempt])
        scene = draw_scene(rng, kind, (height, width), frames, moving, zoom, noise)
        if scene is not None:
            return scene
    raise InputError(
        f"scene {kind!r}, seed {seed}: no draw of {ATTEMPTS} kept {moving} of the pixels moving "
        f"over {frames} frames; ask for another share or seed."
    )


@dataclass(frozen=True, eq=False)
class SyntheticSequence(Sequence):
    """A scene as a sequence, rendered on the fly.

    Args:
        scene: the scene. name: of the sequence. fps: frames per second.
    """

    scene: Scene
    name: str = "synthetic"
    fps: float = 24.0

    kind = "synthetic"
    depth_source = "true"
    has_flow = True
    flow_is_true = True

    @property
    def root(self) -> Path:  # type: ignore[override]
        """There is no folder; the name stands for it."""
        return Path(self.name)

    @property
    def timestamps(self) -> np.ndarray:  # type: ignore[override]
        """(N,) float64 seconds."""
        return np.arange(len(self)) / self.fps

    @property
    def poses(self) -> np.ndarray:  # type: ignore[override]
        """(N, 4, 4) true T_world_cam."""
        return self.scene.T_world_cam

    @property
    def warnings(self) -> list[str]:  # type: ignore[override]
        """Nothing was mended."""
        return []

    def __len__(self) -> int:
        return self.scene.frames

    def camera(self, index: int) -> Camera:
        """Intrinsics of one frame."""
        return self.scene.camera(index)

    def frame(self, index: int) -> Frame:
        """Image and true depth."""
        rendered = self.scene.render(index)
        stamp = float(self.timestamps[index])
        return Frame(rendered.rgb, rendered.depth, self.camera(index), stamp, int(index))

    def flow(self, index: int) -> tuple[np.ndarray, None]:
        """True flow from frame ``index`` to the next, (H, W, 2) float32, and no variance."""
        return self.scene.flow(index)[0], None

    def occlusion(self, index: int) -> np.ndarray:
        """(H, W) bool, True where a pixel of frame ``index`` is not visible in the next."""
        return self.scene.flow(index)[1]

    def moving(self, index: int) -> np.ndarray:
        """(H, W) bool, True on moving objects."""
        return self.scene.object_id(index) > 0

    def files(self) -> list[Path]:
        """No file is read."""
        return []


def write_sintel(scene: Scene, root: str | os.PathLike[str], name: str) -> None:
    """Writes a scene in the layout of MPI Sintel.

    ``root/training/{clean,depth,camdata_left,invalid}/NAME/frame_0001.*`` for each frame,
    ``{flow,occlusions}`` for each frame but the last, and ``moving`` (ours: 255 on moving objects)
    for each frame.

    Args:
        scene: what to write.
        root: created where absent.
        name: of the sequence, one path part.

    Raises:
        InputError: a name that is not a plain folder name.
        OutputError: a file that cannot be written.
    """
    if not name or Path(name).name != name or name in (".", ".."):
        raise InputError(f"sequence name: expected a plain folder name, got {name!r}.")
    base = Path(root) / "training"
    folders = {
        part: base / part / name
        for part in ("clean", "flow", "depth", "camdata_left", "occlusions", "invalid", "moving")
    }
    for folder in folders.values():
        make_folder(folder)
    for index in range(scene.frames):
        stem = f"frame_{index + 1:04d}"
        rendered = scene.render(index)
        camera = scene.camera(index)
        _write_png(folders["clean"] / f"{stem}.png", rendered.rgb[:, :, ::-1])
        write_dpt(folders["depth"] / f"{stem}.dpt", rendered.depth)
        extrinsic = invert(scene.T_world_cam[index])
        write_cam(folders["camdata_left"] / f"{stem}.cam", camera.K, extrinsic)
        _write_mask(folders["moving"] / f"{stem}.png", rendered.object_id > 0)
        _write_mask(folders["invalid"] / f"{stem}.png", rendered.object_id < 0)
        if index + 1 < scene.frames:
            flow, occlusion, _ = scene.flow(index)
            write_flo(folders["flow"] / f"{stem}.flo", flow)
            _write_mask(folders["occlusions"] / f"{stem}.png", occlusion)


def _write_mask(path: Path, mask: np.ndarray) -> None:
    _write_png(path, np.where(mask, 255, 0).astype(np.uint8))


def _write_png(path: Path, image: np.ndarray) -> None:
    done, data = cv2.imencode(".png", np.ascontiguousarray(image))
    if not done:
        raise OutputError(f"{path}: cannot encode an image of shape {image.shape}.")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"{path}: cannot write: {error}.") from error
