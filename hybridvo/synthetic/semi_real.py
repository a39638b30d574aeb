"""Semi-real pairs: recordings of static scenes, in which pieces of other recordings move.

The static scene is two frames of a recording, or one frame as it is seen from two places; or it is
rendered, for there are few recordings and methods are used in other places.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.data.sequence import open_sequence, resize_frame
from hybridvo.errors import InputError
from hybridvo.flow import dis_flow, with_flow
from hybridvo.geometry import backproject, invert, rotation_angle, se3_exp
from hybridvo.refinement.refine import Selection, refine_pair
from hybridvo.results import StageFailed
from hybridvo.synthetic.diverse import training_scene
from hybridvo.synthetic.draws import about, cut_out, log_uniform, smooth_field
from hybridvo.synthetic.layered import KnownPair
from hybridvo.synthetic.meshes import (
    TEAR,
    Canvas,
    Surface,
    filled_depth,
    image_points,
    surface_of,
    transformed,
)
from hybridvo.synthetic.sensors import depth_jump
from hybridvo.types import Camera, Frame, FramePair

PIXELS = (76_800, 172_800)  # of a small and a large image: 320 x 240, 480 x 360
# share of each side of a frame that is drawn: what lies around may come into view
MARGIN = 0.85
APART = 12  # frames of one recording that lie so far apart show different things
# of the rendered static scenes: share whose surfaces show a photograph
PHOTOGRAPHS = 0.5
HALT = 0.2  # probability that a mover stops, or starts, between two steps of a clip
# at a width of 1024: what moves by less beside the ego flow counts as static
STILL_PX = 0.5


@dataclass(frozen=True)
class Source:
    """Frames ``start`` to ``stop`` of a recording below the data folder."""

    path: str
    start: int = 0
    stop: int | None = None
    # between the two frames of a pair; none: single frames only
    strides: tuple[int, ...] = ()
    world: bool = True  # whether it serves as a static scene; all serve as movers


SPLITS = {
    "train": (
        Source("real_static/rooms_110", 0, 90, (1,)),
        Source("tum/redwood_livingroom_5", strides=(1, 2, 3)),
    ),
    "development": (
        Source("real_static/rooms_110", 93, 110, (1,)),
        Source("tum/rgbd_dataset_freiburg1_xyz_first10", strides=(1, 2, 3, 4)),
    ),
    "test": (
        Source("tum/rgbd_dataset_freiburg1_rpy_100", strides=(1, 2)),
        Source("tartanair_v2/P000", strides=(1,)),
        Source("real_dynamic/kitti06_stereo", strides=(1,)),
        Source("real_dynamic/adt_slam_left"),
        Source("real_dynamic/jvosf_two_people_moving"),
        Source("real_dynamic/jvosf_robot"),
        Source("real_dynamic/jvosf_opening_door", world=False),
        Source("real_dynamic/kitti02_stereo", world=False),
    ),
}
"""The recordings by what they may be used for. No frame serves in two parts."""


@dataclass(frozen=True, eq=False)
class Recording:
    """The frames of a source, and the pairs of them whose motion is known."""

    source: Source
    frames: tuple[Frame, ...]  # 1 / MARGIN as large as the images drawn from them
    # index of the first, of the second, T_curr_prev
    pairs: tuple[tuple[int, int, np.ndarray], ...]


Views = tuple[list[Canvas], list[np.ndarray], Camera]
"""Views of a scene, the motions T_curr_prev between neighbours, their camera."""


@functools.cache
def load_split(
    folder: str | Path, split: str, pixels: int = PIXELS[0]
) -> tuple[Recording, ...]:
    """Load the recordings of a part of :data:`SPLITS`, for images of so many pixels."""
    if split not in SPLITS:
        raise InputError(f"split: expected {', '.join(SPLITS)}, got {split!r}.")
    there = [s for s in SPLITS[split] if (Path(folder) / s.path).is_dir()]
    if not any(s.world for s in there):
        raise InputError(
            f"{folder}: no recording of '{split}', such as {SPLITS[split][0].path}."
        )
    return tuple(_load(Path(folder), source, pixels) for source in there)


def _load(folder: Path, source: Source, pixels: int) -> Recording:
    sequence = open_sequence(folder / source.path)
    poses = sequence.poses
    if poses is None:
        raise InputError(
            f"{source.path}: expected a recording with ground truth, got none."
        )
    indices = range(
        source.start, len(sequence) if source.stop is None else source.stop
    )
    frames = []
    for i in indices:
        frame = sequence.frame(i)
        scale = (
            np.sqrt(pixels / (frame.camera.height * frame.camera.width)) / MARGIN
        )
        size = [round(scale * side / 2) * 2 for side in frame.camera.shape]
        frames.append(resize_frame(frame, *size))
    pairs = []
    for i, j in [
        (k, k + n) for n in source.strides for k in range(len(frames) - n)
    ]:
        stated = invert(poses[indices[j]]) @ poses[indices[i]]
        T = _measured_motion(frames[i], frames[j], stated)
        if T is not None:
            pairs.append((i, j, T))
    return Recording(source, tuple(frames), tuple(pairs))


def _measured_motion(
    prev: Frame, curr: Frame, T_stated: np.ndarray
) -> np.ndarray | None:
    """The recorded motion, often wrong by pixels, refined on the pair; None if both disagree."""
    pair = with_flow(FramePair(prev, curr, None), dis_flow())
    try:
        found = refine_pair(pair, Selection(T_stated))
    except StageFailed:
        return None
    gap = invert(T_stated) @ found.T_curr_prev
    far = 0.02 + 0.15 * np.linalg.norm(T_stated[:3, 3])
    near = np.linalg.norm(gap[:3, 3]) <= far and rotation_angle(
        gap[:3, :3]
    ) <= np.radians(1.0)
    return (
        found.T_curr_prev
        if found.usable and found.inlier_ratio >= 0.5 and near
        else None
    )


def draw_clip(
    rng: np.random.Generator,
    recordings: Sequence[Recording],
    movers: int | None = None,
    rendered: float = 0.0,
    frames: int = 2,
    rolling: float = 0.0,
) -> list[KnownPair]:
    """Draw the pairs of neighbouring frames of a clip, with DIS flow: one pair by default.

    So many movers, by default none to four, stop and start in it. ``rendered``: share of the clips
    of two frames whose static scene is rendered, and only movers are recorded. ``rolling``: share
    that is seen through a rolling shutter by a camera whose turning changes.
    """
    worlds = [r for r in recordings if r.source.world]
    share = np.sqrt([len(r.frames) for r in worlds])
    world = worlds[int(rng.choice(len(worlds), p=share / share.sum()))]
    at = int(rng.integers(len(world.frames)))
    drawn = rendered > 0 and frames == 2 and rng.random() < rendered
    photograph = (
        world.frames[at].rgb if drawn and rng.random() < PHOTOGRAPHS else None
    )
    views = (
        _rendered_world(rng, photograph)
        if drawn
        else _world(rng, world, at, frames)
    )
    canvases, motions, camera = views
    # far away or in the dark, the static scene has less contrast than the movers
    contrast = rng.uniform(0.25, 1.0) if rng.random() < 0.5 else 1.0
    for canvas in canvases:
        canvas.image = canvas.image * np.float32(contrast) + np.float32(
            90 * (1 - contrast)
        )
    # movers show other recordings, or other places of the same one
    numbered = [(r, k) for r in recordings for k in range(len(r.frames))]
    sources = [
        r.frames[k]
        for r, k in numbered
        if drawn or r is not world or abs(k - at) > APART
    ]
    if movers is None:
        movers = int(rng.choice(5, p=(0.3, 0.3, 0.2, 0.1, 0.1)))
    coverage = rng.uniform(0.1, 0.8)
    motion = None
    # four more where they cover too little
    for tried in range(movers + 4 if movers else 0):
        if tried >= movers and canvases[0].moving.mean() > 0.7 * coverage:
            break
        source = sources[int(rng.integers(len(sources)))]
        side = 1.6 * np.sqrt(coverage / movers * camera.height * camera.width)
        mover = _cut(rng, source, int(side), canvases[0], camera)
        if mover is None:
            continue
        # else it moves together with the last one
        if motion is None or rng.random() < 0.5:
            motion = _own_motion(rng, mover, camera)
        _draw_mover(rng, mover, motion, views)
    if rolling > 0 and rng.random() < rolling:
        # px, about, from the first row to the last; the change from frame to frame bends the flow
        turn = log_uniform(rng, (0.3, 8.0)) * rng.standard_normal(3)
        exposure = rng.uniform(0, 1)
        for canvas in canvases:
            change = log_uniform(rng, (0.3, 3.0)) * rng.standard_normal(3)
            canvas.roll((turn + change) / camera.fx, camera, exposure)
    seen = [_sensed(rng, canvas, camera) for canvas in canvases]
    name = "rendered" if drawn else world.source.path
    known = []
    for canvas, T, prev, curr in zip(
        canvases, motions, seen, seen[1:], strict=False
    ):
        depth = np.where(canvas.measured > 0.5, canvas.depth, 0).astype(np.float32)
        pair = with_flow(FramePair(prev, curr, None), dis_flow())
        known.append(KnownPair(pair, T, depth, canvas.moving > 0.5, name))
    return known


def _world(
    rng: np.random.Generator, recording: Recording, at: int, frames: int
) -> Views:
    """Views of a recording near a frame."""
    full = recording.frames[0].camera
    height, width = (round(MARGIN * side) for side in full.shape)
    v0 = (full.height - height) // 2
    u0 = (full.width - width) // 2
    camera = Camera(full.fx, full.fy, full.cx - u0, full.cy - v0, height, width)
    pairs = [pair for pair in recording.pairs if pair[0] == at]
    canvases = []
    if pairs and rng.random() < 0.65:
        i, j, _ = pairs[int(rng.integers(len(pairs)))]
        known = {pair[:2]: pair[2] for pair in recording.pairs}
        indices = [i + k * (j - i) for k in range(frames)]
        steps = list(itertools.pairwise(indices))
        if all(step in known for step in steps):
            motions = [known[step] for step in steps]
            if rng.random() < 0.5:
                indices = indices[::-1]
                motions = [invert(T) for T in motions[::-1]]
            window = np.s_[v0 : v0 + height, u0 : u0 + width]
            for frame in (recording.frames[k] for k in indices):
                assert frame.depth is not None and frame.rgb is not None
                depth, there = (x[window].copy() for x in filled_depth(frame.depth))
                image = frame.rgb[window].astype(np.float32)
                canvases.append(
                    Canvas(image, depth, there.astype(np.float32), 0 * depth)
                )
            return canvases, motions, camera
    surface = surface_of(recording.frames[at])
    near = float(np.median(surface.points[..., 2]))
    shift_px = log_uniform(rng, (0.5, 16))
    turn_px = log_uniform(rng, (0.5, 16))
    step = (
        rng.standard_normal(6)
        * np.repeat([near * shift_px, turn_px], 3)
        / camera.fx
        / 1.5
    )
    half = np.clip(step / 2, -0.3 * near, 0.3 * near)
    # to the other side and back
    swing = -np.cos(np.pi * np.arange(frames) / min(frames - 1, 3))
    nothing = np.zeros((height, width), np.float32)
    for place in swing:
        image = np.full((height, width, 3), 8, np.float32)
        canvas = Canvas(image, np.full_like(nothing, 1e3), nothing, nothing)
        points = transformed(surface.points, se3_exp(place * half))
        canvas.draw(surface, points, np.zeros(points.shape[:2]), camera)
        canvases.append(canvas)
    return canvases, [se3_exp(change * half) for change in np.diff(swing)], camera


def _rendered_world(
    rng: np.random.Generator, photograph: np.ndarray | None
) -> Views:
    """Two views of a drawn scene without its movers, by day or by night.

    A photograph is thrown on its surfaces as by a projector beside the first camera.
    """
    shape = (240, 320) if rng.random() < 0.6 else (160, 480)
    scene = training_scene(rng, *shape)
    scene = replace(scene, solids=tuple(s for s in scene.solids if not s.object_id))
    (gamma, light), nothing = (
        rng.uniform((0.7, 0.5), (2.5, 1.1)),
        np.zeros(shape, np.float32),
    )
    slide = (
        None
        if photograph is None
        else cv2.resize(photograph, shape[::-1]) / np.float32(128)
    )
    beside = se3_exp(0.1 * rng.standard_normal(6))
    # renderers state a depth of the sky, sensors measure none
    sky = log_uniform(rng, (100, 5e4)) if rng.random() < 0.4 else 0.0
    canvases = []
    for k in (0, 1):
        frame = scene.render(k)
        assert frame.rgb is not None and frame.depth is not None
        image = np.float32(255 * light) * (
            frame.rgb.astype(np.float32) / 255
        ) ** np.float32(gamma)
        seen = np.isfinite(frame.depth)
        if slide is not None:
            points = backproject(np.where(seen, frame.depth, 1e3), scene.camera)
            points = transformed(points, beside @ scene.T_world_cam[k])
            u, v = cv2.split(image_points(points, scene.camera))
            image *= cv2.remap(
                slide, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
            )
        far = sky or 1.5 * np.max(frame.depth, where=seen, initial=1)
        depth = np.where(seen, frame.depth, far).astype(np.float32)
        canvases.append(
            Canvas(image, depth, (seen | (sky > 0)).astype(np.float32), nothing)
        )
    return (
        canvases,
        [invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]],
        scene.camera,
    )


def _cut(
    rng: np.random.Generator,
    frame: Frame,
    side: int,
    canvas: Canvas,
    camera: Camera,
) -> Surface | None:
    """A piece of a frame, placed in the first view; None where too little of it has depth."""
    assert frame.depth is not None
    height, width = frame.camera.shape
    mask = cut_out(rng, max(24, min(side, height - 2)))
    h, w = mask.shape
    v0 = int(rng.integers(height - h + 1))
    u0 = int(rng.integers(max(width - w, 0) + 1))
    window = np.s_[v0 : v0 + h, u0 : u0 + w]
    mask = mask[:, : width - u0]
    surface = surface_of(frame)
    points = surface.points[window]
    measured = surface.measured[window]
    if (measured * mask).sum() < 0.3 * mask.sum():
        return None
    z = points[..., 2]
    middle = float(np.median(z[mask & (measured > 0)]))
    mask &= np.abs(z - middle) < rng.uniform(0.15, 0.8) * middle
    if rng.random() < 0.5:  # ragged, as a sensor sees hair and leaves
        mask &= smooth_field(rng, mask.shape, 12) > -1.3
    # its rays are shifted to where it is placed; scaled in depth it is still one rigid thing
    centre = points[h // 2, min(w, mask.shape[1]) // 2]
    to = rng.uniform(0.0, 1.0, 2) * (camera.width - 1, camera.height - 1)
    behind = canvas.depth[int(to[1]), int(to[0])]
    part = rng.uniform(0.9, 1.4) if rng.random() < 0.2 else rng.uniform(0.3, 0.95)
    goal = (to - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    size = rng.uniform(0.8, 1.25) * frame.camera.fx / camera.fx
    rays = (points[..., :2] / z[..., None] - centre[:2] / centre[2]) * size + goal
    z = z * (part * behind / middle)
    placed = np.concatenate([rays * z[..., None], z[..., None]], axis=2).astype(
        np.float32
    )
    return Surface(placed, surface.image[window].copy(), measured.copy(), mask)


def _own_motion(
    rng: np.random.Generator, mover: Surface, camera: Camera
) -> tuple[np.ndarray, str]:
    """What a mover does in a step: a motion (4, 4) in the static scene, or with the camera."""
    kind = str(rng.choice(["slide", "turn", "both", "approach", "follow", "stand"],
                          p=(0.32, 0.12, 0.24, 0.1, 0.16, 0.06)))  # fmt: skip
    centre = mover.centre
    step = np.zeros(6)
    if kind in ("slide", "both", "follow"):
        reach = (0.05, 2.0) if kind == "follow" else (1.5, 25.0)
        px = log_uniform(rng, reach) / camera.fx
        step[:3] = rng.standard_normal(3) * (1.0, 0.7, 0.6) * px * centre[2]
    if kind in ("turn", "both"):
        step[3:] = rng.standard_normal(3) * log_uniform(rng, (0.02, 0.2))
    if kind == "approach":
        step[:3] = centre * rng.uniform(-0.12, 0.12)
    return about(Rotation.from_rotvec(step[3:]).as_matrix(), centre, step[:3]), kind


def _draw_mover(
    rng: np.random.Generator,
    mover: Surface,
    motion: tuple[np.ndarray, str],
    views: Views,
) -> None:
    """Draw a mover onto all views, in each where it is by then."""
    (own, kind), (canvases, motions, camera) = motion, views
    stands = kind == "stand"
    for k, T in enumerate(motions):
        if k and rng.random() < HALT:
            stands = not stands
        step = T if stands else own if kind == "follow" else T @ own
        points = _moved(rng, mover, step, not stands, camera)
        static = transformed(mover.points, T)
        beside = image_points(points, camera) - image_points(static, camera)
        moving = np.linalg.norm(beside, axis=2) > STILL_PX * camera.width / 1024
        canvases[k].draw(mover, mover.points, moving, camera)
        mover.image *= np.float32(rng.uniform(0.95, 1.05))
        mover.points = points
    canvases[-1].draw(mover, mover.points, moving, camera)


def _moved(
    rng: np.random.Generator,
    mover: Surface,
    motion: np.ndarray,
    moves: bool,
    camera: Camera,
) -> np.ndarray:
    """A mover's points (h, w, 3) in the next view; some have a hinge or deform a little."""
    points = mover.points
    centre = mover.centre
    out = transformed(points, motion)
    if moves and rng.random() < 0.2:
        side = (points[..., :2] - centre[:2]) @ rng.standard_normal(2) > 0
        swing = rng.standard_normal(6) * log_uniform(rng, (0.03, 0.25))
        other = motion @ about(Rotation.from_rotvec(swing[3:]).as_matrix(), centre)
        out = np.where(side[..., None], transformed(points, other), out)
    if moves and rng.random() < 0.4:
        wobble = smooth_field(rng, points.shape[:2], 5, 3)
        out = out + wobble * np.float32(rng.uniform(0, 0.5) * centre[2] / camera.fx)
    return out


def _sensed(rng: np.random.Generator, canvas: Canvas, camera: Camera) -> Frame:
    """The frame that a camera and a depth sensor make of a view."""
    shape = camera.shape
    gain = rng.uniform(0.96, 1.04)
    offset = rng.uniform(-4, 4)
    image: np.ndarray = canvas.image * np.float32(gain) + np.float32(offset)
    if rng.random() < 0.5:
        image = cv2.GaussianBlur(image, (0, 0), log_uniform(rng, (0.3, 1.0)))
    noise = rng.standard_normal((*shape, 3), dtype=np.float32)
    image = image + noise * np.float32(log_uniform(rng, (0.7, 4.0)))
    rgb = np.clip(image, 0, 255).astype(np.uint8)
    depth = canvas.depth.copy()
    lost = canvas.measured < 0.5
    if rng.random() < 0.6:  # no depth at silhouettes
        edge = depth_jump(depth) > TEAR * depth
        edge &= smooth_field(rng, shape, 30) > rng.uniform(-1.5, 0.5)
        lost |= cv2.dilate(edge.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if rng.random() < 0.5:  # holes, on movers as in the static scene
        field = smooth_field(rng, shape, int(rng.integers(4, 24)))
        lost |= field > rng.uniform(0.8, 2.5)
    if rng.random() < 0.4:  # no depth beyond the sensor's range
        middle, far = np.quantile(depth[::5, ::5], (0.5, 0.98))
        reach = rng.uniform(middle, max(far, middle + 1e-3))
        lost |= depth > reach * (1 + 0.2 * smooth_field(rng, shape, 16))
    if rng.random() < 0.3:  # the sensor's field of view ends before the image
        cut = rng.integers(
            0, (shape[0] // 8, shape[0] // 8, shape[1] // 8, shape[1] // 8)
        )
        lost[: cut[0]] = lost[shape[0] - cut[1] :] = True
        lost[:, : cut[2]] = lost[:, shape[1] - cut[3] :] = True
    error = smooth_field(rng, shape, 24) + 0.5 * rng.standard_normal(
        shape, dtype=np.float32
    )
    depth *= 1 + np.float32(log_uniform(rng, (0.0005, 0.006))) * error
    depth[lost] = 0
    return Frame(rgb, depth, camera)
