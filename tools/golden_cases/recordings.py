"""Golden cases of what judges recordings: the command ``doctor``, and the evaluation.

No motion is estimated for its own sake here. A flaw of a recording grows rung by rung,
until it is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from golden_cases.figures import Record, labelled

Run = Callable[[int], list[Record]]

HEIGHT = 120
WIDTH = 160


def recording(images: Sequence[np.ndarray], depths: Sequence[np.ndarray]) -> Any:
    """Return frames as a sequence without ground truth."""
    from hybridvo import Camera, Frame
    from hybridvo.io.data.sequence import Sequence as Base

    camera = Camera(150.0, 150.0, 79.5, 59.5, height=HEIGHT, width=WIDTH)

    class Recording(Base):
        """Frames in memory, as a reader hands them out."""

        kind = "recording"
        has_flow = False

        def __init__(self) -> None:
            self.name = "recording"
            self.root = Path("recording")
            self.timestamps = np.arange(len(images)) / 30.0
            self.poses = None
            self.warnings = []

        def frame(self, index: int) -> Any:
            """Return one of the frames."""
            stamp = float(self.timestamps[index])
            return Frame(images[index], depths[index], camera, stamp, index)

    return Recording()


def doctors_word(sequence: Any, finding: str, pairs: int = 3) -> Record:
    """Return what the doctor says about one thing in a recording."""
    from hybridvo.run.commands.doctor import diagnose

    report = diagnose(sequence, pairs=pairs)
    states = {each["name"]: each["state"] for each in report["findings"]}
    return labelled(states[finding])


def blocks(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return an image and its depth: rectangles, nearer ones in front of others."""
    rng = np.random.default_rng([14, seed])
    grey = np.full((HEIGHT, WIDTH), 128.0)
    depth = np.full((HEIGHT, WIDTH), 6.0)
    for metres in np.linspace(5.5, 1.5, 40):
        top = rng.integers(0, HEIGHT - 15)
        left = rng.integers(0, WIDTH - 15)
        rows = slice(top, top + rng.integers(10, 40))
        columns = slice(left, left + rng.integers(10, 40))
        grey[rows, columns] = rng.uniform(20, 235)
        depth[rows, columns] = metres
    grey += rng.normal(0.0, 1.0, grey.shape)
    rgb = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return np.repeat(rgb[..., None], 3, axis=2), depth.astype(np.float32)


def little_depth(shares: Sequence[float], whole: int, seed: int) -> list[Record]:
    """Depth on ever fewer pixels, beside some frames with all of it or in every frame."""
    rgb, depth = blocks()
    # the number of the draw is that of the frozen figures
    rng = np.random.default_rng(16 if whole else 15)
    order = rng.permutation(depth.size).reshape(depth.shape)
    found = []
    for share in shares:
        few = np.where(order < share * depth.size, depth, np.float32(np.nan))
        depths = [few] + [depth] * whole if whole else [few, few]
        made = recording([rgb] * len(depths), depths)
        found.append(doctors_word(made, "valid depth"))
    return found


def little_texture(seed: int) -> list[Record]:
    """Images with texture on an ever smaller part of them."""
    from hybridvo.run.commands.diagnosis.inspection import sharpness

    rgb, depth = blocks()
    found = []
    for share in (0.045, 0.038, 0.034, 0.026, 0.023, 0.017):
        # the texture is in the first rows: as many of them as hold the share
        shares = [sharpness(top_of(rgb, rows)).textured for rows in range(1, 40)]
        rows = 1 + int(np.argmin(np.abs(np.array(shares) - share)))
        image = top_of(rgb, rows)
        made = recording([image, image], [depth, depth])
        found.append(doctors_word(made, "texture and focus"))
    return found


def top_of(rgb: np.ndarray, rows: int) -> np.ndarray:
    """Return an image that is grey below some rows."""
    image = np.full_like(rgb, 128)
    image[:rows] = rgb[:rows]
    return image


def blurred_images(seed: int) -> list[Record]:
    """Images with an ever wider blur."""
    rgb, depth = blocks()
    found = []
    for sigma in np.geomspace(0.5, 2.5, 10):
        image = cv2.GaussianBlur(rgb, (0, 0), sigma)
        made = recording([image, image], [depth, depth])
        found.append(doctors_word(made, "texture and focus"))
    return found


def shifted_depth(
    shifts: Sequence[int], heights: Sequence[int], seed: int
) -> list[Record]:
    """Depth of which ever more rows lie beside their image, or ever farther."""
    rgb, depth = blocks()
    found = []
    for shift in shifts:
        for rows in heights:
            moved = depth.copy()
            moved[:rows] = np.roll(depth[:rows], shift, axis=1)
            made = recording([rgb, rgb], [moved, moved])
            found.append(doctors_word(made, "depth beside images"))
    return found


def textured_surfaces(seed: int) -> list[Record]:
    """Surfaces with ever stronger texture, among which the edges of depth get lost."""
    rgb, depth = blocks()
    texture = np.random.default_rng(17).normal(0.0, 1.0, rgb.shape[:2])
    texture = cv2.GaussianBlur(texture, (0, 0), 1.5)
    texture /= texture.std()
    moved = np.roll(depth, 12, axis=1)
    found = []
    for strength in np.geomspace(4.0, 120.0, 14):
        image = rgb + strength * texture[..., None]
        image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        made = recording([image, image], [moved, moved])
        found.append(doctors_word(made, "depth beside images"))
    return found


def late_frames(
    by: Sequence[float], shares: Sequence[float], seed: int
) -> list[Record]:
    """Frames of which some come late: by an ever longer time, or ever more of them."""
    rgb, depth = blocks()
    found = []
    for times in by:
        for share in shares:
            frames = 81
            intervals = np.ones(frames - 1)
            intervals[: round(share * (frames - 1))] = times
            made = recording([rgb] * frames, [depth] * frames)
            made.timestamps = np.concatenate([[0.0], np.cumsum(intervals)])
            found.append(doctors_word(made, "time stamps", pairs=1))
    return found


def wrong_limits(kind: str, metres: float, seed: int) -> list[Record]:
    """The error beyond which a motion is called wrong: ``std``, 1e-3 px."""
    from hybridvo import Camera
    from hybridvo_lab.evaluation.scores import wrong_limit

    camera = Camera(500.0, 500.0, 319.5, 239.5, height=480, width=640)
    limit = wrong_limit(kind, camera, np.full(camera.shape, metres, np.float32))
    return [labelled("limit", std=1e3 * limit)]


def wrong_motions(seed: int) -> list[Record]:
    """Errors that grow, of which no limit is known: how many are called wrong."""
    from hybridvo_lab.evaluation.scores import pair_scores, pair_table

    found = []
    for error in (0.5, 0.6, 0.75, 0.9, 1.1, 1.25, 1.4, 1.6):
        row = {"status": "ok", "epe_l2_px": error, "rot_err_deg": 0.0}
        scores = pair_scores(pair_table([row]))
        found.append(labelled("wrong" if scores["wrong"] else "right"))
    return found


def far_positions(seed: int) -> list[Record]:
    """Positions ever farther away, until an evaluation refuses them."""
    from hybridvo.core.errors import InputError
    from hybridvo.core.trajectory import Trajectory
    from hybridvo_lab.evaluation.metrics import evaluate

    found = []
    for metres in 1e12 * np.array([0.5, 0.6, 0.75, 0.9, 1.1, 1.25, 1.4, 1.6]):
        poses = np.tile(np.eye(4), (4, 1, 1))
        poses[:, 0, 3] = np.linspace(0.0, metres, 4)
        path = Trajectory(np.arange(4.0), poses)
        try:
            evaluate(path, path)
            found.append(labelled("taken"))
        except InputError:
            found.append(labelled("refused"))
    return found


RECORDINGS: dict[tuple[str, str], Run] = {
    ("doctor", "little_depth"): partial(
        little_depth, (0.15, 0.125, 0.115, 0.085, 0.073, 0.06), 0
    ),
    ("doctor", "empty_frames"): partial(
        little_depth, (0.016, 0.0125, 0.0115, 0.0085, 0.0074, 0.006), 2
    ),
    ("doctor", "little_texture"): little_texture,
    ("doctor", "blur"): blurred_images,
    ("doctor", "shifted_depth"): partial(shifted_depth, range(8), (HEIGHT,)),
    ("doctor", "partly_shifted"): partial(
        shifted_depth, (12,), range(HEIGHT // 3, HEIGHT, 6)
    ),
    ("doctor", "textured_surfaces"): textured_surfaces,
    ("doctor", "late_by"): partial(late_frames, (1.2, 1.4, 1.6, 1.8, 2.2), (0.2,)),
    ("doctor", "late_shares"): partial(
        late_frames, (3.0,), (0.05, 0.075, 0.0875, 0.1125, 0.125, 0.15)
    ),
    ("evaluation", "wrong"): wrong_motions,
    ("evaluation", "far"): far_positions,
    ("evaluation", "synthetic"): partial(wrong_limits, "synthetic", 2.0),
    **{
        ("evaluation", f"{kind}_at_{metres:g}m"): partial(
            wrong_limits, kind, metres
        )
        for kind in ("tum", "7scenes", "folder", "kitti")
        for metres in (0.2, 20.0)
    },
}
"""Name of a ladder and of its variant -> what climbs it."""
