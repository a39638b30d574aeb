"""What ``hybridvo run --export`` writes into the folder ``export`` of a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.files import make_folder, remove
from hybridvo.core.geometry import invert
from hybridvo.core.results import Edge, MovingObject, Step
from hybridvo.core.trajectory import Trajectory, read_trajectory
from hybridvo.core.types import Frame
from hybridvo.io.data.image_io import read_mask_png, write_png
from hybridvo.io.data.sequence import Sequence as FrameSequence
from hybridvo.io.g2o import write_g2o
from hybridvo.io.masks import mask_of, numbers_of
from hybridvo.run.commands.export.colmap import MODEL, write_colmap
from hybridvo.run.commands.export.euroc import write_euroc
from hybridvo.run.commands.export.transforms import (
    CLOUD,
    TRANSFORMS,
    write_transforms,
)
from hybridvo.run.commands.export.views import (
    MAX_POINTS,
    ColouredPoints,
    PosedImage,
    points_of,
)
from hybridvo.tracking.depth_scale import lengthened, scale_factors

KINDS = ("colmap", "transforms", "euroc", "g2o")
FOLDER = "export"
IMAGES = "images"
MASKS = "masks"
OBJECTS = "objects"
SPARSE = "sparse/0"
PATH = "euroc.csv"
GRAPH = "graph.g2o"
MAX_POINT_FRAMES = 50
"""Frames whose depth gives points."""


def check_kinds(kinds: Sequence[str]) -> None:
    """Raise an InputError for a kind of export that is not known."""
    for kind in kinds:
        if kind not in KINDS:
            known = ", ".join(KINDS)
            raise InputError(f"--export {kind[:40]}: expected some of {known}.")


class RunExport:
    """Writes images and masks while a run goes on, and the files of poses after it.

    Args:
        out: The folder of the run.
        kinds: Which of ``KINDS``.
        sequence: What is tracked.
        mode: What happens to the results that are there already.

    Raises:
        InputError: A kind is not known, or there is an export, and the run is a new one.
    """

    def __init__(
        self,
        out: Path,
        kinds: Sequence[str],
        sequence: FrameSequence,
        mode: Literal["new", "resume", "overwrite"],
    ) -> None:
        check_kinds(kinds)
        self.out = out
        self.folder = out / FOLDER
        self.kinds = kinds
        self.sequence = sequence
        present = next(_files(self.folder), None)
        if mode == "new" and present is not None:
            raise InputError(
                f"{self.folder}: holds an export ({present.name}). Pass another --out, "
                "or --overwrite to replace it."
            )

    @property
    def _wants_images(self) -> bool:
        return "colmap" in self.kinds or "transforms" in self.kinds

    def add(self, frame: Frame, step: Step, prev: Frame | None) -> None:
        """Write image and objects of a frame, and the mask of the one its motion starts from."""
        if not self._wants_images:
            return
        self._write_image(frame)
        if step.objects:
            self._write_objects(frame.index, step.objects)
        if prev is not None and step.usable and step.motion.weights is not None:
            self._write_mask(prev, step.motion.weights)

    def finish(self) -> dict[str, Any]:
        """Write the files of poses of the run that its folder holds; returns a summary.

        Images and masks that are not there, as of frames before ``--export`` was given, are
        written without knowing what moves.
        """
        trajectory = read_trajectory(self.out / "trajectory.tum")
        if self.sequence.T_cam_frame is not None:
            # the path of that frame was written
            trajectory = trajectory.of_frame(invert(self.sequence.T_cam_frame))
        make_folder(self.folder)
        if "euroc" in self.kinds:
            write_euroc(self.folder / PATH, trajectory)
        if "g2o" in self.kinds:
            self._write_graph(trajectory)
        summary: dict[str, Any] = {
            "folder": str(self.folder),
            "kinds": [*self.kinds],
        }
        if not self._wants_images:
            return summary
        views, points = self._views(trajectory)
        if not views:
            raise InputError(f"{self.folder}: no frame has an image and a pose.")
        if "colmap" in self.kinds:
            write_colmap(self.folder / SPARSE, views, points)
        if "transforms" in self.kinds:
            write_transforms(self.folder, views, points, IMAGES, MASKS)
        return summary | {
            "images": len(views),
            "left_out": len(trajectory) - len(views),
            "points": len(points.xyz),
        }

    def _write_graph(self, trajectory: Trajectory) -> None:
        """Write the motions as they were measured, all in the scale of the trajectory.

        A motion that failed keeps the graph in one piece, and carries hardly any information.
        """
        with np.load(self.out / "steps.npz", allow_pickle=False) as steps:
            indices = steps["index"].tolist()
            factors = scale_factors(steps["depth_scale"], steps["scale_change"])
            scales = np.repeat(
                np.stack([factors, np.ones(len(factors))], 1), 3, axis=1
            )
            edges = [
                (
                    index,
                    Edge(
                        start, lengthened(T, scale[0]), scale[:, None] * C * scale
                    ),
                )
                for index, start, T, C, scale in zip(
                    indices,
                    steps["edge_start"].tolist(),
                    steps["T_curr_start"],
                    steps["edge_covariance"],
                    scales,
                    strict=True,
                )
                # the first frame is joined to itself
                if start != index
            ]
        poses = dict(zip(indices, trajectory.T_world_cam, strict=True))
        write_g2o(self.folder / GRAPH, poses, edges)

    def _views(
        self, trajectory: Trajectory
    ) -> tuple[list[PosedImage], ColouredPoints]:
        """The frames that did not fail, with their images on the disk, and points of some."""
        with np.load(self.out / "steps.npz", allow_pickle=False) as steps:
            indices = steps["index"].tolist()
            usable = (steps["status"] != "failed").tolist()
        views = list[PosedImage]()
        parts = list[ColouredPoints]()
        stride = -(-len(indices) // MAX_POINT_FRAMES)
        count = MAX_POINTS // -(-len(indices) // stride)
        for k, index in enumerate(indices):
            if not usable[k]:
                continue
            gives_points = k % stride == 0
            frame = self._frame(index, always=gives_points)
            name = _name(index)
            if not (self.folder / IMAGES / name).is_file():
                continue
            T = trajectory.T_world_cam[k]
            views.append(PosedImage(name, self.sequence.camera(index), T))
            if gives_points and frame is not None:
                mask = read_mask_png(self._mask_path(index), frame.camera.shape)
                parts.append(points_of(frame, mask, T, count))
        return views, ColouredPoints.joined(parts)

    def _frame(self, index: int, always: bool) -> Frame | None:
        """Read a frame where that is wanted, or its image or mask is not on the disk yet."""
        has_image = (self.folder / IMAGES / _name(index)).is_file()
        has_mask = self._mask_path(index).is_file()
        if has_image and has_mask and not always:
            return None
        try:
            frame = self.sequence.frame(index)
        except (InputError, OSError):
            return None
        if not has_image:
            self._write_image(frame)
        if not has_mask:
            self._write_mask(frame, None)
        return frame

    def _write_image(self, frame: Frame) -> None:
        if frame.rgb is None:
            return
        bgr = frame.rgb[:, :, ::-1] if frame.rgb.ndim == 3 else frame.rgb
        path = self.folder / IMAGES / _name(frame.index)
        write_png(path, np.ascontiguousarray(bgr))

    def _write_mask(self, frame: Frame, weights: np.ndarray | None) -> None:
        # 0 where COLMAP ignores a pixel
        image = 255 * mask_of(frame, weights).astype(np.uint8)
        write_png(self._mask_path(frame.index), image)

    def _write_objects(self, index: int, things: Sequence[MovingObject]) -> None:
        path = self.folder / OBJECTS / _name(index)
        write_png(path, numbers_of(things))

    def _mask_path(self, index: int) -> Path:
        """The mask of an image, by COLMAP's rule: its name with ``.png`` appended."""
        return self.folder / MASKS / f"{_name(index)}.png"


def clear_export(out: Path) -> None:
    """Remove the files of an export from the folder of a run; others stay."""
    remove(*_files(out / FOLDER))


def _files(folder: Path) -> Iterator[Path]:
    """The files of an export that are there."""
    for name in (
        *(f"{SPARSE}/{name}" for name in MODEL),
        TRANSFORMS,
        CLOUD,
        PATH,
        GRAPH,
    ):
        if (folder / name).is_file():
            yield folder / name
    for name in (IMAGES, MASKS, OBJECTS):
        yield from (folder / name).glob("[0-9]*.png")


def _name(index: int) -> str:
    return f"{index:06d}.png"
