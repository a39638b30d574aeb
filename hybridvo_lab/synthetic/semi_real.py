"""Semi-real pairs: recordings of static scenes, in which pieces
of other recordings move.

The static scene is two frames of a recording, or one frame as it is viewed
from two places, or a rendered scene: there are few recordings, and methods
are used in other places.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import backproject, invert, se3_exp
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.providers import FlowProvider, dis_flow, with_flow
from hybridvo_lab.synthetic.draws import (
    draw_mask,
    log_uniform,
    rotation_about,
    smooth_field,
)
from hybridvo_lab.synthetic.meshes import (
    TEAR,
    Canvas,
    Surface,
    filled_depth,
    image_points,
    surface_of,
    transformed,
)
from hybridvo_lab.synthetic.paper_samples import KnownPair
from hybridvo_lab.synthetic.recordings import SPLITS, Recording, load_recording
from hybridvo_lab.synthetic.sensors import depth_jump
from hybridvo_lab.synthetic.training_scenes import training_scene

MARGIN = 0.85
"""Fraction of each side of a frame that is drawn; what lies
around it may come into view."""
PIXELS = (76_800, 172_800)
"""Pixels of a small and of a large image: 320 x 240, 480 x 360."""
DISTINCT_FRAMES = 12
"""Frames of one recording that are so far apart show different things."""
NEIGHBOUR_FRACTION = 0.65
"""Fraction of the clips of a recording that show neighbouring frames,
where their motion is known."""
PHOTOGRAPH_FRACTION = 0.5
"""Fraction of the rendered static scenes whose surfaces show a photograph."""
STOP_PROBABILITY = 0.2
"""Probability that an object stops, or starts, between two steps of a clip."""
STATIC_PX = 0.5
"""Difference from the ego flow below which a pixel counts as
static, px at a width of 1024."""
MIN_MEASURED_FRACTION = 0.3
"""Fraction of an object's silhouette that needs a measured depth."""
NEAR_PROBABILITY = 0.2
"""Probability that an object is about as far away as what it hides."""
SPARE_OBJECTS = 4
"""Further objects that are drawn where the first ones cover
too little of the image."""
RENDERED = "rendered"
"""Name of a rendered static scene, in place of a recording's path."""


class ObjectKind(NamedTuple):
    """What kind of objects move in a clip."""

    probability: float
    counts: tuple[int, int]  # fewest and most objects
    coverage: tuple[float, float]  # fraction of the image that they cover
    motions: tuple[str, ...]
    together: float  # probability that the next object shares the motion
    # probability that an object is about as far away as what it hides
    behind: float


OBJECT_KINDS = (
    # a large rigid thing
    ObjectKind(
        0.45, (1, 1), (0.35, 0.85), ("slide", "turn", "both", "approach"), 1, 0.2
    ),
    # many objects in one direction
    ObjectKind(0.2, (4, 8), (0.25, 0.8), ("slide",), 1.0, 0.2),
    # things that come closer or go away
    ObjectKind(0.1, (1, 3), (0.15, 0.8), ("approach",), 0.3, 0.2),
    # things behind parts of the static scene
    ObjectKind(0.15, (1, 3), (0.3, 0.9), ("slide", "both"), 0.7, 0.8),
    # things that stay before the camera
    ObjectKind(0.1, (1, 2), (0.15, 0.7), ("follow",), 0.5, 0.1),
)
"""Kinds of moving objects beside those of :func:`draw_clip`."""


class Views(NamedTuple):
    """Views of a static scene from several places."""

    canvases: list[Canvas]
    motions: list[np.ndarray]  # T_curr_prev (4, 4) between neighbours
    camera: Camera


@functools.cache
def load_split(
    folder: str | Path, split: str, pixels: int = PIXELS[0]
) -> tuple[Recording, ...]:
    """Load the recordings of a part of
    :data:`~hybridvo_lab.synthetic.recordings.SPLITS` that are in a folder.

    Args:
        folder: the data folder.
        split: ``train``, ``development`` or ``test``.
        pixels: number of pixels of the images that are drawn from the recordings.

    Raises:
        InputError: the part does not exist, or the folder has
            none of its static scenes.
    """
    if split not in SPLITS:
        raise InputError(f"split: expected {', '.join(SPLITS)}, got {split!r}.")
    sources = [source for place in SPLITS[split].values() for source in place]
    present = [
        source for source in sources if (Path(folder) / source.path).is_dir()
    ]
    if not any(source.is_static for source in present):
        raise InputError(
            f"{folder}: no recording of '{split}', such as {sources[0].path}."
        )
    return tuple(
        load_recording(Path(folder), source, pixels, MARGIN) for source in present
    )


# --- clips ------------------------------------------------------------------------


def draw_clip(
    rng: np.random.Generator,
    recordings: Sequence[Recording],
    objects: int | None = None,
    rendered: float = 0.0,
    frames: int = 2,
    rolling: float = 0.0,
    of_kind: float = 0.0,
    flow: FlowProvider | None = None,
) -> list[KnownPair]:
    """Draw the pairs of neighbouring frames of a clip, with DIS flow.

    Args:
        rng: the source of randomness.
        recordings: where static scenes and moving objects come from.
        objects: number of moving objects, which stop and start; None: zero to four.
        rendered: fraction of the clips of two frames whose static scene is rendered,
            so that only the objects are recorded.
        frames: number of frames of the clip.
        rolling: fraction of the clips that are recorded through a rolling shutter, by a
            camera whose turning changes.
        of_kind: fraction of the clips whose objects are of one of :data:`OBJECT_KINDS`;
            ``objects`` states nothing about these.
        flow: estimates the flow; None: DIS.

    Returns:
        One pair less than ``frames``.
    """
    recording, at = _draw_place(rng, recordings)
    is_rendered = rendered > 0 and frames == 2 and rng.random() < rendered
    if is_rendered:
        has_photograph = rng.random() < PHOTOGRAPH_FRACTION
        photograph = recording.frames[at].rgb if has_photograph else None
        views = _rendered_views(rng, photograph)
    else:
        views = _recorded_views(rng, recording, at, frames)
    _change_contrast(rng, views.canvases)

    # objects show other recordings, or other places of the same one
    sources = [
        source.frames[k]
        for source in recordings
        for k in range(len(source.frames))
        if is_rendered or source is not recording or abs(k - at) > DISTINCT_FRAMES
    ]
    if of_kind > 0 and rng.random() < of_kind:
        _draw_kind(rng, sources, views)
    else:
        if objects is None:
            objects = int(rng.choice(5, p=(0.3, 0.3, 0.2, 0.1, 0.1)))
        _draw_objects(rng, sources, objects, views)
    if rolling > 0 and rng.random() < rolling:
        _roll_shutter(rng, views)
    name = RENDERED if is_rendered else recording.source.path
    return _measured_pairs(rng, views, name, flow or dis_flow())


def _draw_place(
    rng: np.random.Generator, recordings: Sequence[Recording]
) -> tuple[Recording, int]:
    """A recording of a static scene, and the index of one of its frames."""
    static = [r for r in recordings if r.source.is_static]
    weight = np.sqrt([len(r.frames) for r in static])
    chosen = static[int(rng.choice(len(static), p=weight / weight.sum()))]
    return chosen, int(rng.integers(len(chosen.frames)))


def _change_contrast(rng: np.random.Generator, canvases: list[Canvas]) -> None:
    """Lower the contrast of half of the static scenes, as of
    far or dark ones, in place.
    """
    contrast = rng.uniform(0.25, 1.0) if rng.random() < 0.5 else 1.0
    grey = np.float32(90 * (1 - contrast))
    for canvas in canvases:
        canvas.image = canvas.image * np.float32(contrast) + grey


def _draw_objects(
    rng: np.random.Generator, sources: list[Frame], count: int, views: Views
) -> None:
    """Draw moving objects, cut from ``sources``, onto all views."""
    coverage = rng.uniform(0.1, 0.8)
    if not count:
        return
    _draw_pieces(rng, sources, views, count, coverage, lambda: rng.random() < 0.5)


def _draw_kind(
    rng: np.random.Generator, sources: list[Frame], views: Views
) -> None:
    """Draw moving objects of one of :data:`OBJECT_KINDS` onto all views."""
    probabilities = [kind.probability for kind in OBJECT_KINDS]
    kind = OBJECT_KINDS[int(rng.choice(len(OBJECT_KINDS), p=probabilities))]
    min_count, max_count = kind.counts
    count = int(rng.integers(min_count, max_count + 1))
    coverage = rng.uniform(*kind.coverage)
    _draw_pieces(
        rng,
        sources,
        views,
        count,
        coverage,
        lambda: rng.random() >= kind.together,
        kind.behind,
        kind.motions,
    )


def _draw_pieces(
    rng: np.random.Generator,
    sources: list[Frame],
    views: Views,
    count: int,
    coverage: float,
    changes_motion: Callable[[], bool],
    behind: float = NEAR_PROBABILITY,
    motions: Sequence[str] = (),
) -> None:
    """Draw pieces of ``sources`` that move onto all views.

    Args:
        rng: the source of randomness.
        sources: frames from which the pieces are cut.
        views: the views, changed in place.
        count: number of pieces; a few more where these cover too little.
        coverage: fraction of the image that they are to cover.
        changes_motion: draws whether a piece moves otherwise than the last one.
        behind: probability that a piece is about as far away as what it hides.
        motions: kinds of motion of which each has one; empty: any.
    """
    canvas = views.canvases[0]
    camera = views.camera
    area = coverage / count * camera.height * camera.width
    side = int(1.6 * np.sqrt(area))
    motion = None
    for tried in range(count + SPARE_OBJECTS):
        if tried >= count and canvas.moving.mean() > 0.7 * coverage:
            break
        source = sources[int(rng.integers(len(sources)))]
        cut = _cut(rng, source, side, canvas, camera, behind)
        if cut is None:
            continue
        if motion is None or changes_motion():
            motion = _draw_motion(rng, cut, camera, motions)
        _draw_object(rng, cut, motion, views)


def _roll_shutter(rng: np.random.Generator, views: Views) -> None:
    """See the views through a rolling shutter.

    Its change between frames bends the flow.
    """
    # px, about, from the first row to the last
    turn_px = log_uniform(rng, (0.3, 8.0)) * rng.standard_normal(3)
    exposure = rng.uniform(0, 1)
    for canvas in views.canvases:
        change_px = log_uniform(rng, (0.3, 3.0)) * rng.standard_normal(3)
        turn = (turn_px + change_px) / views.camera.fx
        canvas.roll(turn, views.camera, exposure)


def _measured_pairs(
    rng: np.random.Generator, views: Views, name: str, flow: FlowProvider
) -> list[KnownPair]:
    """The pairs of neighbouring views, as a sensor measures them."""
    frames = [_measure(rng, canvas, views.camera) for canvas in views.canvases]
    pairs = []
    for k, T in enumerate(views.motions):
        canvas = views.canvases[k]
        depth = np.where(canvas.measured > 0.5, canvas.depth, 0).astype(np.float32)
        pair = with_flow(FramePair(frames[k], frames[k + 1], None), flow)
        pairs.append(KnownPair(pair, T, depth, canvas.moving > 0.5, name))
    return pairs


# --- static scenes ----------------------------------------------------------------


def _recorded_views(
    rng: np.random.Generator, recording: Recording, at: int, frames: int
) -> Views:
    """Views of a recording near frame ``at``: of several of
    its frames, or of this one.
    """
    window = _window(recording.frames[0].camera)
    pairs = [pair for pair in recording.pairs if pair.prev == at]
    if pairs and rng.random() < NEIGHBOUR_FRACTION:
        pair = pairs[int(rng.integers(len(pairs)))]
        indices = [at + k * (pair.curr - pair.prev) for k in range(frames)]
        views = _views_of_frames(rng, recording, indices, window)
        if views is not None:
            return views
    return _views_of_surface(
        rng, surface_of(recording.frames[at]), frames, window.camera
    )


class _Window(NamedTuple):
    """The middle of a frame, which is drawn."""

    camera: Camera
    slices: tuple[slice, slice]


def _window(full: Camera) -> _Window:
    """The middle of the images of a camera, without the margin."""
    height = round(MARGIN * full.height)
    width = round(MARGIN * full.width)
    top = (full.height - height) // 2
    left = (full.width - width) // 2
    camera = Camera(
        full.fx, full.fy, full.cx - left, full.cy - top, height=height, width=width
    )
    return _Window(camera, np.s_[top : top + height, left : left + width])


def _views_of_frames(
    rng: np.random.Generator,
    recording: Recording,
    indices: list[int],
    window: _Window,
) -> Views | None:
    """Frames of a recording, forwards or backwards.

    None where a motion is not known.
    """
    known = {(pair.prev, pair.curr): pair.T_curr_prev for pair in recording.pairs}
    steps = list(itertools.pairwise(indices))
    if not all(step in known for step in steps):
        return None
    motions = [known[step] for step in steps]
    if rng.random() < 0.5:
        indices = indices[::-1]
        motions = [invert(T) for T in motions[::-1]]
    canvases = []
    for frame in (recording.frames[k] for k in indices):
        assert frame.depth is not None and frame.rgb is not None
        filled = filled_depth(frame.depth)
        depth = filled.depth[window.slices].copy()
        measured = filled.known[window.slices].astype(np.float32)
        image = frame.rgb[window.slices].astype(np.float32)
        canvases.append(Canvas(image, depth, measured, 0 * depth))
    return Views(canvases, motions, window.camera)


def _views_of_surface(
    rng: np.random.Generator, surface: Surface, frames: int, camera: Camera
) -> Views:
    """Views of one frame's surface from several places, to and fro."""
    near = float(np.median(surface.points[..., 2]))
    shift_px = log_uniform(rng, (0.5, 16))
    turn_px = log_uniform(rng, (0.5, 16))
    sizes = np.repeat([near * shift_px, turn_px], 3)
    step = rng.standard_normal(6) * sizes / camera.fx / 1.5
    half = np.clip(step / 2, -0.3 * near, 0.3 * near)
    swing = -np.cos(np.pi * np.arange(frames) / min(frames - 1, 3))
    canvases = []
    for place in swing:
        canvas = _empty_canvas(camera)
        points = transformed(surface.points, se3_exp(place * half))
        canvas.draw(surface, points, np.zeros(points.shape[:2]), camera)
        canvases.append(canvas)
    motions = [se3_exp(change * half) for change in np.diff(swing)]
    return Views(canvases, motions, camera)


def _empty_canvas(camera: Camera) -> Canvas:
    """A dark view in which nothing has been drawn."""
    nothing = np.zeros(camera.shape, np.float32)
    image = np.full((*camera.shape, 3), 8, np.float32)
    return Canvas(image, np.full_like(nothing, 1e3), nothing, nothing)


def _rendered_views(
    rng: np.random.Generator, photograph: np.ndarray | None
) -> Views:
    """Two views of a rendered scene without its moving objects, by day or by night.

    A photograph is projected onto its surfaces, from a place
    beside the first camera.
    """
    shape = (240, 320) if rng.random() < 0.6 else (160, 480)
    scene = training_scene(rng, *shape)
    static = tuple(solid for solid in scene.solids if not solid.object_id)
    scene = replace(scene, solids=static)
    gamma, brightness = rng.uniform((0.7, 0.5), (2.5, 1.1))
    T_projector_world = se3_exp(0.1 * rng.standard_normal(6))
    # renderers state a depth of the sky, sensors measure none
    sky_depth = log_uniform(rng, (100, 5e4)) if rng.random() < 0.4 else 0.0

    canvases = []
    for k in (0, 1):
        frame = scene.render(k)
        assert frame.rgb is not None and frame.depth is not None
        unit = frame.rgb.astype(np.float32) / 255
        image = np.float32(255 * brightness) * unit ** np.float32(gamma)
        hit = np.isfinite(frame.depth)
        if photograph is not None:
            points = backproject(np.where(hit, frame.depth, 1e3), scene.camera)
            points = transformed(points, T_projector_world @ scene.T_world_cam[k])
            image *= _projected_light(photograph, points, scene.camera)
        far = sky_depth or 1.5 * np.max(frame.depth, where=hit, initial=1)
        depth = np.where(hit, frame.depth, far).astype(np.float32)
        measured = (hit | (sky_depth > 0)).astype(np.float32)
        nothing = np.zeros(shape, np.float32)
        canvases.append(Canvas(image, depth, measured, nothing))
    T = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
    return Views(canvases, [T], scene.camera)


def _projected_light(
    photograph: np.ndarray, points: np.ndarray, camera: Camera
) -> np.ndarray:
    """Factor (H, W, 3) on the light at points (H, W, 3), metres
    in the projector's frame.
    """
    slide = cv2.resize(photograph, camera.shape[::-1]) / np.float32(128)
    u, v = cv2.split(image_points(points, camera))
    return cv2.remap(slide, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


# --- moving objects ---------------------------------------------------------------


class _Motion(NamedTuple):
    """What an object does in a step.

    ``T``: (4, 4) motion in the static scene, or in the camera's frame
    where the object follows it.
    """

    kind: str
    T: np.ndarray


def _cut(
    rng: np.random.Generator,
    frame: Frame,
    side: int,
    canvas: Canvas,
    camera: Camera,
    behind: float = NEAR_PROBABILITY,
) -> Surface | None:
    """Cut a piece out of a frame and place it in the first view.

    Args:
        rng: the source of randomness.
        frame: the frame that shows the object.
        side: larger side of its silhouette, px.
        canvas: the first view.
        camera: the camera of the views.
        behind: probability that it is about as far away as what it hides.

    Returns:
        The object's surface, or None where too little of it has depth.
    """
    assert frame.depth is not None
    height, width = frame.camera.shape
    mask = draw_mask(rng, max(24, min(side, height - 2)))
    h, w = mask.shape
    top = int(rng.integers(height - h + 1))
    left = int(rng.integers(max(width - w, 0) + 1))
    window = np.s_[top : top + h, left : left + w]
    mask = mask[:, : width - left]
    surface = surface_of(frame)
    points = surface.points[window]
    measured = surface.measured[window]
    if (measured * mask).sum() < MIN_MEASURED_FRACTION * mask.sum():
        return None

    z = points[..., 2]
    middle = float(np.median(z[mask & (measured > 0)]))
    mask &= np.abs(z - middle) < rng.uniform(0.15, 0.8) * middle
    is_ragged = rng.random() < 0.5  # as a sensor sees hair and leaves
    if is_ragged:
        mask &= smooth_field(rng, mask.shape, 12) > -1.3

    centre = points[h // 2, min(w, mask.shape[1]) // 2]
    target = rng.uniform(0.0, 1.0, 2) * (camera.width - 1, camera.height - 1)
    depth_behind = canvas.depth[int(target[1]), int(target[0])]
    is_free = rng.random() < behind  # else it stands in front of the static scene
    nearness = rng.uniform(0.9, 1.4) if is_free else rng.uniform(0.3, 0.95)
    size = rng.uniform(0.8, 1.25) * frame.camera.fx / camera.fx
    # rays are shifted to the target; scaled in depth the object is still one rigid
    # thing
    ray = points[..., :2] / z[..., None]
    target_ray = (target - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    ray = (ray - centre[:2] / centre[2]) * size + target_ray
    z = z * (nearness * depth_behind / middle)
    placed = np.concatenate([ray * z[..., None], z[..., None]], axis=2)
    image = surface.image[window].copy()
    return Surface(placed.astype(np.float32), image, measured.copy(), mask)


MOTIONS = ("slide", "turn", "both", "approach", "follow", "stand")
"""What objects do."""
MOTION_PROBABILITIES = (0.32, 0.12, 0.24, 0.1, 0.16, 0.06)


def _draw_motion(
    rng: np.random.Generator,
    surface: Surface,
    camera: Camera,
    kinds: Sequence[str] = (),
) -> _Motion:
    """Draw what an object does in a step: one of ``kinds``, or anything."""
    if kinds:
        kind = str(rng.choice(kinds))
    else:
        kind = str(rng.choice(MOTIONS, p=MOTION_PROBABILITIES))
    centre = surface.centre
    t = np.zeros(3)
    axis_angle = np.zeros(3)
    if kind in ("slide", "both", "follow"):
        limits_px = (0.05, 2.0) if kind == "follow" else (1.5, 25.0)
        length = log_uniform(rng, limits_px) / camera.fx
        t = rng.standard_normal(3) * (1.0, 0.7, 0.6) * length * centre[2]
    if kind in ("turn", "both"):
        axis_angle = rng.standard_normal(3) * log_uniform(rng, (0.02, 0.2))
    if kind == "approach":
        t = centre * rng.uniform(-0.12, 0.12)
    R = Rotation.from_rotvec(axis_angle).as_matrix()
    return _Motion(kind, rotation_about(R, centre, t))


def _draw_object(
    rng: np.random.Generator, surface: Surface, motion: _Motion, views: Views
) -> None:
    """Draw an object onto all views, in each where it is at that time."""
    camera = views.camera
    stands = motion.kind == "stand"
    min_px = STATIC_PX * camera.width / 1024
    for k, T in enumerate(views.motions):
        if k and rng.random() < STOP_PROBABILITY:
            stands = not stands
        if stands:
            step = T
        elif motion.kind == "follow":
            step = motion.T
        else:
            step = T @ motion.T
        points = _moved(rng, surface, step, not stands, camera)
        static = transformed(surface.points, T)
        difference = image_points(points, camera) - image_points(static, camera)
        moving = np.linalg.norm(difference, axis=2) > min_px
        views.canvases[k].draw(surface, surface.points, moving, camera)
        # the light on an object changes a little
        surface.image *= np.float32(rng.uniform(0.95, 1.05))
        surface.points = points
    views.canvases[-1].draw(surface, surface.points, moving, camera)


def _moved(
    rng: np.random.Generator,
    surface: Surface,
    motion: np.ndarray,
    moves: bool,
    camera: Camera,
) -> np.ndarray:
    """An object's points (h, w, 3) in the next view.

    Some have a hinge or deform a little.
    """
    points = surface.points
    centre = surface.centre
    out = transformed(points, motion)
    if moves and rng.random() < 0.2:
        beside_hinge = (points[..., :2] - centre[:2]) @ rng.standard_normal(2) > 0
        swing = rng.standard_normal(6) * log_uniform(rng, (0.03, 0.25))
        R = Rotation.from_rotvec(swing[3:]).as_matrix()
        swung = transformed(points, motion @ rotation_about(R, centre))
        out = np.where(beside_hinge[..., None], swung, out)
    if moves and rng.random() < 0.4:
        wobble = smooth_field(rng, points.shape[:2], 5, 3)
        out = out + wobble * np.float32(rng.uniform(0, 0.5) * centre[2] / camera.fx)
    return out


# --- what a camera and a depth sensor measure -------------------------------------


def _measure(rng: np.random.Generator, canvas: Canvas, camera: Camera) -> Frame:
    """The frame that a camera and a depth sensor make of a view."""
    rgb = _measure_image(rng, canvas.image)
    depth = canvas.depth.copy()
    lost = _draw_lost(rng, depth, canvas.measured < 0.5)
    error = _draw_relative_error(rng, camera.shape)
    depth *= 1 + np.float32(log_uniform(rng, (0.0005, 0.006))) * error
    depth[lost] = 0
    return Frame(rgb, depth, camera)


def _measure_image(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) uint8 with a random gain, offset, blur and noise."""
    gain = rng.uniform(0.96, 1.04)
    offset = rng.uniform(-4, 4)
    image = image * np.float32(gain) + np.float32(offset)
    if rng.random() < 0.5:
        image = cv2.GaussianBlur(image, (0, 0), log_uniform(rng, (0.3, 1.0)))
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    image = image + noise * np.float32(log_uniform(rng, (0.7, 4.0)))
    return np.clip(image, 0, 255).astype(np.uint8)


def _draw_lost(
    rng: np.random.Generator, depth: np.ndarray, unknown: np.ndarray
) -> np.ndarray:
    """Where the sensor measures no depth, (H, W) bool; ``unknown`` is part."""
    lost = unknown
    shape = depth.shape
    if rng.random() < 0.6:  # no depth at silhouettes
        edge = depth_jump(depth) > TEAR * depth
        edge &= smooth_field(rng, shape, 30) > rng.uniform(-1.5, 0.5)
        lost |= cv2.dilate(edge.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if rng.random() < 0.5:  # holes, on objects as in the static scene
        field = smooth_field(rng, shape, int(rng.integers(4, 24)))
        lost |= field > rng.uniform(0.8, 2.5)
    if rng.random() < 0.4:  # no depth beyond the sensor's range
        middle, far = np.quantile(depth[::5, ::5], (0.5, 0.98))
        max_depth = rng.uniform(middle, max(far, middle + 1e-3))
        lost |= depth > max_depth * (1 + 0.2 * smooth_field(rng, shape, 16))
    if rng.random() < 0.3:  # the sensor's field of view ends before the image
        height, width = shape
        limits = (height // 8, height // 8, width // 8, width // 8)
        top, bottom, left, right = rng.integers(0, limits)
        lost[:top] = True
        lost[height - bottom :] = True
        lost[:, :left] = True
        lost[:, width - right :] = True
    return lost


def _draw_relative_error(
    rng: np.random.Generator, shape: tuple[int, int]
) -> np.ndarray:
    """Errors of depth (H, W), partly correlated in space, of about
    unit standard deviation.
    """
    smooth = smooth_field(rng, shape, 24)
    return smooth + 0.5 * rng.standard_normal(shape, dtype=np.float32)
