"""Pairs of two rigid parts, either of which can be the world, with one cue exchanged at a time.

A view consists of two surfaces. Each shows a picture of its own, is seen through a sensor of
its own, and moves in its own way in the camera's frame. One of them is the world, the other
one a thing that moves. What tells them apart are cues: their pictures, sensors, sizes, which
one surrounds the other, which one stands in front, and their motions. :func:`exchanged` gives
both parts the other's cue and leaves everything else as it was, so that a network can be asked
what it reads, and trained not to read what says nothing of the role.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import backproject, make_transform
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.providers import FlowProvider, dis_flow, with_flow
from hybridvo.lab.synthetic.draws import (
    log_uniform,
    random_direction,
    rotation_by,
    smooth_field,
)
from hybridvo.lab.synthetic.meshes import (
    TEAR,
    Canvas,
    Surface,
    filled_depth,
    transformed,
)
from hybridvo.lab.synthetic.paper_samples import KnownPair
from hybridvo.lab.synthetic.semi_real import Recording
from hybridvo.lab.synthetic.sensors import depth_jump
from hybridvo.lab.synthetic.training_scenes import training_scene

APPEARANCE = ("picture", "sensor")
"""Cues that say nothing of the role."""
ROLE = ("size", "border", "order", "motion")
"""Cues that may say something of it: the share of the view, which part surrounds the other,
which one stands in front, and how each moves."""
CUES = (*APPEARANCE, *ROLE)
SIZES = [(240, 320), (240, 320), (192, 320), (216, 288)]
"""(height, width) of the views, px."""
VIEW = 0.85
"""Fraction of each side of a surface that the first view shows; the rest may come into it."""
FLATNESS = 0.6
"""Exponent on the relative depth of a picture, so that one part fits before another."""
GAP = 0.92
"""Factor between the depths of the part in front and of what it hides, where they are closest."""
RENDERED_FRACTION = 0.4
"""Fraction of the pictures that are rendered."""
LARGE_FRACTION = 0.5
"""Fraction of the views in which a thing covers most of the image."""
LARGE_SHARE = (0.55, 0.75)
"""Share of the view of these things."""
OTHER_SHARE = (0.2, 0.55)
"""Share of the view of the others."""
SURROUNDED_FRACTION = 0.85
"""Fraction of the views in which the world surrounds the thing."""
BEHIND_FRACTION = 0.2
"""Fraction of the views in which the thing is farther than what stands before it."""
MIDDLE = (0.4, 0.6)
"""Where the centre of an inner part that stays within the image is, over the side."""
BORDER_FRACTION = 0.5
"""Fraction of the views for the training in which the inner part reaches the border as well."""
STILL_FRACTION = 0.15
"""Fraction of the views in which the camera hardly moves."""
FOLLOW_FRACTION = 0.15
"""Fraction of the views in which the thing stays before the camera."""
STEP_PX = (0.5, 24.0)
"""Flow of the camera's motion, px at a width of 320: the longest are those of 3 frames a second."""
APART_PX = (4.0, 24.0)
"""Difference of both flows, px at a width of 320."""
STILL_PX = 0.2
"""Flow of a camera that hardly moves, px at a width of 320."""
REFERENCE_WIDTH = 320


class Sensor(NamedTuple):
    """How one part is measured.

    Attributes:
        noise: standard deviation of the image, grey levels.
        blur_px: standard deviation of the blur of the image.
        contrast: factor on the differences from grey.
        depth_noise: relative standard deviation of the depth.
        bend_px: by how much the second image deviates from a rigid motion, smoothly: what a
            rolling shutter, a lens or a wrong mesh does.
        is_ragged: whether no depth is measured at the silhouette.
    """

    noise: float
    blur_px: float
    contrast: float
    depth_noise: float
    bend_px: float
    is_ragged: bool


class PartMotion(NamedTuple):
    """A motion in the camera's frame, whatever the distance of what moves so.

    Attributes:
        rotation: (3, 3).
        shift: (3,) translation over the median depth.
    """

    rotation: np.ndarray
    shift: np.ndarray


@dataclass(frozen=True, eq=False)
class Part:
    """One rigid part of a view, without its place in it.

    Attributes:
        picture: what it shows, larger than the view.
        sensor: how it is measured.
        motion: how it moves from the first frame to the second.
    """

    picture: Frame
    sensor: Sensor
    motion: PartMotion


@dataclass(frozen=True, eq=False)
class TwoParts:
    """A view of two rigid parts.

    Attributes:
        camera: of both frames.
        parts: the two parts.
        share: share of the view of the first part.
        surrounding: number of the part around the other one, which reaches the border.
        centre: (2,) where the inner part is, over width and height; in the middle it stays
            within the image.
        front: number of the part that stands before the other one.
        world: number of the part that is the static scene.
        distance: median depth of the part behind, metres.
        seed: of the outline and of the noise.
    """

    camera: Camera
    parts: tuple[Part, Part]
    share: float
    surrounding: int
    centre: tuple[float, float]
    front: int
    world: int
    distance: float
    seed: int


class DrawnParts(NamedTuple):
    """A view as both frames show it.

    Attributes:
        pair: the frames, with flow.
        motions: (2, 4, 4) ``T_curr_prev`` of the parts, metres: the motion of the camera if
            that part is the world.
        part: (H, W) uint8, number of the part that the first frame shows.
        depth: (H, W) metres, without errors; 0 where no depth is measured.
    """

    pair: FramePair
    motions: np.ndarray
    part: np.ndarray
    depth: np.ndarray


# --- exchanges --------------------------------------------------------------------


def exchanged(view: TwoParts, cue: str) -> TwoParts:
    """Return a view in which both parts have exchanged one of :data:`CUES`.

    Args:
        view: the view.
        cue: ``picture``, ``sensor``, ``size``, ``border``, ``order`` or ``motion``.

    Raises:
        InputError: there is no such cue.

    Example:
        >>> import numpy as np
        >>> view = draw_two_parts(np.random.default_rng(0), ())
        >>> exchanged(view, "order").front == 1 - view.front
        True
    """
    first, second = view.parts
    if cue == "size":
        return replace(view, share=1.0 - view.share)
    if cue == "border":
        return replace(view, surrounding=1 - view.surrounding)
    if cue == "order":
        return replace(view, front=1 - view.front)
    if cue in ("picture", "sensor", "motion"):
        parts = (
            replace(first, **{cue: getattr(second, cue)}),
            replace(second, **{cue: getattr(first, cue)}),
        )
        return replace(view, parts=parts)
    raise InputError(f"cue: expected {', '.join(CUES)}, got {cue!r}.")


def with_roles_exchanged(view: TwoParts) -> TwoParts:
    """Return the view in which the thing has become the world, and the world the thing.

    Each part keeps its picture and its sensor. It takes the other's place, size and motion: the
    cameras move so that the former thing stands still.
    """
    for cue in ROLE:
        view = exchanged(view, cue)
    return replace(view, world=1 - view.world)


# --- drawing by lot ---------------------------------------------------------------


def draw_two_parts(
    rng: np.random.Generator,
    recordings: Sequence[Recording],
    rendered: float = RENDERED_FRACTION,
    at_border: float = 0.0,
) -> TwoParts:
    """Draw a view of two parts, of which one is the world.

    Pictures and sensors are drawn independently of the role. Size, border, order and motions
    are those of a world and of a thing, most of the time.

    Args:
        rng: the source of randomness.
        recordings: where pictures come from.
        rendered: fraction of the pictures that are rendered; all without recordings.
        at_border: fraction of the views in which the inner part reaches the border.
    """
    height, width = SIZES[int(rng.integers(len(SIZES)))]
    focal = width * rng.uniform(0.75, 1.3)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, height, width)
    pictures = [_draw_picture(rng, recordings, rendered, camera) for _ in "ab"]
    camera_motion, thing_motion = _draw_motions(rng, camera)
    world = int(rng.integers(2))
    motions = [thing_motion, thing_motion]
    motions[world] = camera_motion
    first, second = (
        Part(picture, draw_sensor(rng), motion)
        for picture, motion in zip(pictures, motions, strict=True)
    )
    is_large = rng.random() < LARGE_FRACTION
    of_thing = rng.uniform(*(LARGE_SHARE if is_large else OTHER_SHARE))
    is_surrounded = rng.random() < SURROUNDED_FRACTION
    is_behind = rng.random() < BEHIND_FRACTION
    limits = (0.1, 0.9) if rng.random() < at_border else MIDDLE
    centre = (rng.uniform(*limits), rng.uniform(*limits))
    return TwoParts(
        camera=camera,
        parts=(first, second),
        share=of_thing if world else 1.0 - of_thing,
        surrounding=world if is_surrounded else 1 - world,
        centre=centre,
        front=world if is_behind else 1 - world,
        world=world,
        distance=log_uniform(rng, (0.5, 8.0)),
        seed=int(rng.integers(1 << 31)),
    )


def draw_sensor(rng: np.random.Generator) -> Sensor:
    """Draw how a part is measured."""
    return Sensor(
        noise=log_uniform(rng, (0.5, 6.0)),
        blur_px=log_uniform(rng, (0.3, 2.0)) if rng.random() < 0.5 else 0.0,
        contrast=rng.uniform(0.3, 1.0) if rng.random() < 0.5 else 1.0,
        depth_noise=log_uniform(rng, (5e-4, 2e-2)),
        bend_px=log_uniform(rng, (0.05, 0.8)) if rng.random() < 0.6 else 0.0,
        is_ragged=bool(rng.random() < 0.5),
    )


def _draw_picture(
    rng: np.random.Generator,
    recordings: Sequence[Recording],
    rendered: float,
    camera: Camera,
) -> Frame:
    """Draw a picture with depth, larger than the view: of a recording, or rendered."""
    surface_camera = _surface_camera(camera)
    if recordings and rng.random() >= rendered:
        chosen = recordings[int(rng.integers(len(recordings)))]
        frame = chosen.frames[int(rng.integers(len(chosen.frames)))]
        assert frame.rgb is not None and frame.depth is not None
        image = frame.rgb
        filled = filled_depth(frame.depth)
        depth = np.where(filled.known, filled.depth, 0)
    else:
        scene = training_scene(rng, *surface_camera.shape)
        static = tuple(solid for solid in scene.solids if not solid.object_id)
        frame = replace(scene, solids=static).render(0)
        assert frame.rgb is not None and frame.depth is not None
        image = frame.rgb
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0)
    if rng.random() < 0.5:
        image = image[:, ::-1]
        depth = depth[:, ::-1]
    size = surface_camera.shape[::-1]
    image = cv2.resize(
        np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA
    )
    depth = np.ascontiguousarray(depth, np.float32)
    depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    if not (depth > 0).any():
        depth[:] = 1.0
    return Frame(image, depth, surface_camera)


def _surface_camera(camera: Camera) -> Camera:
    """The camera of the pictures: with the rays of the view, and more around them."""
    height, width = (round(side / VIEW) for side in camera.shape)
    top = (height - camera.height) // 2
    left = (width - camera.width) // 2
    return Camera(
        camera.fx, camera.fy, camera.cx + left, camera.cy + top, height, width
    )


def _draw_motions(
    rng: np.random.Generator, camera: Camera
) -> tuple[PartMotion, PartMotion]:
    """Draw the motion of the camera, and that of a thing that it sees."""
    scale = camera.width / REFERENCE_WIDTH / camera.fx
    step = log_uniform(rng, STEP_PX)
    if rng.random() < STILL_FRACTION:
        step = STILL_PX
    of_camera = _draw_step(rng, scale * step)
    apart = _draw_step(rng, scale * log_uniform(rng, APART_PX))
    if rng.random() < FOLLOW_FRACTION:
        of_camera = apart
        apart = _draw_step(rng, scale * STILL_PX)
        return of_camera, apart
    rotation = of_camera.rotation @ apart.rotation
    of_thing = PartMotion(rotation, of_camera.shift + apart.shift)
    return of_camera, of_thing


def _draw_step(rng: np.random.Generator, size: float) -> PartMotion:
    """Draw a turn and a shift that together move the image by about ``size``, rad."""
    of_turn = rng.uniform(0.0, 1.0)
    turn = np.degrees(size * of_turn)
    shift = size * np.sqrt(1 - of_turn**2) * random_direction(rng)
    shift[2] *= 2.0  # along the view, a step changes the image less
    return PartMotion(rotation_by(rng, turn), shift)


# --- drawing the frames -----------------------------------------------------------


def draw_frames(view: TwoParts, flow: FlowProvider | None = None) -> DrawnParts:
    """Draw both frames of a view.

    Args:
        view: the view.
        flow: estimates the flow; None: DIS.
    """
    rng = np.random.default_rng(view.seed)
    outline = _outline(rng, view)
    bends = [
        smooth_field(rng, part.picture.camera.shape, 5, 3) for part in view.parts
    ]
    surfaces = _placed(view, outline)
    motions = np.stack(
        [
            _metric(part.motion, surface)
            for part, surface in zip(view.parts, surfaces, strict=True)
        ]
    )
    order = (1 - view.front, view.front)
    canvases = []
    for step in (0, 1):
        canvas = _empty(view.camera)
        for number in order:
            surface = surfaces[number]
            points = surface.points
            if step:
                points = transformed(points, motions[number])
                bend_px = view.parts[number].sensor.bend_px
                pixel = points[..., 2:] / view.camera.fx
                points = points + np.float32(bend_px) * pixel * bends[number]
            label = np.full(points.shape[:2], float(number))
            canvas.draw(surface, points, label, view.camera)
        canvases.append(canvas)
    sensors = (view.parts[0].sensor, view.parts[1].sensor)
    prev, curr = (_measured(rng, each, sensors, view.camera) for each in canvases)
    pair = with_flow(FramePair(prev, curr, None), flow or dis_flow())
    first = canvases[0]
    depth = np.where(first.measured > 0.5, first.depth, 0).astype(np.float32)
    part = (first.moving > 0.5).astype(np.uint8)
    return DrawnParts(pair, motions, part, depth)


def draw_exchanged_roles(
    rng: np.random.Generator,
    recordings: Sequence[Recording],
    flow: FlowProvider | None = None,
) -> list[KnownPair]:
    """Draw a pair for the training, and the same with the roles exchanged.

    Args:
        rng: the source of randomness.
        recordings: where pictures come from.
        flow: estimates the flow; None: DIS.
    """
    view = draw_two_parts(rng, recordings, at_border=BORDER_FRACTION)
    return [known_pair(each, flow) for each in (view, with_roles_exchanged(view))]


def known_pair(view: TwoParts, flow: FlowProvider | None = None) -> KnownPair:
    """Draw a view as a pair whose truth is known."""
    drawn = draw_frames(view, flow)
    moving = drawn.part != view.world
    return KnownPair(drawn.pair, drawn.motions[view.world], drawn.depth, moving)


def _outline(rng: np.random.Generator, view: TwoParts) -> np.ndarray:
    """(H, W) uint8, the part that each pixel of the first view shows."""
    height, width = view.camera.shape
    u = _away_from(np.linspace(0, 1, width), view.centre[0])
    v = _away_from(np.linspace(0, 1, height), view.centre[1])
    away = (u[None] ** 4 + v[:, None] ** 4) ** 0.25
    bumps = smooth_field(rng, view.camera.shape, 5)
    away = away + 0.2 * bumps * np.clip(1 - away, 0, 1)
    inner = 1 - view.surrounding
    of_inner = (1.0 - view.share) if inner else view.share
    is_inner = away < np.quantile(away, of_inner)
    return np.where(is_inner, inner, 1 - inner).astype(np.uint8)


def _away_from(x: np.ndarray, centre: float) -> np.ndarray:
    """(N,) distance from a centre: in the middle of 0 to 1, both ends are 1 away."""
    low, high = MIDDLE
    if low <= centre <= high:
        return np.where(
            x > centre, (x - centre) / (1 - centre), (centre - x) / centre
        )
    return 2 * np.abs(x - centre)


def _placed(view: TwoParts, outline: np.ndarray) -> list[Surface]:
    """The surfaces of both parts in the camera's frame, one before the other."""
    front = view.front
    rows, columns = (
        (side - inner) // 2
        for side, inner in zip(
            view.parts[0].picture.camera.shape, outline.shape, strict=True
        )
    )
    window = np.s_[
        rows : rows + outline.shape[0], columns : columns + outline.shape[1]
    ]
    depths = []
    measured = []
    for part in view.parts:
        assert part.picture.depth is not None
        filled = filled_depth(part.picture.depth)
        relative = (filled.depth / np.median(filled.depth[window])) ** FLATNESS
        depths.append(np.float32(view.distance) * relative.astype(np.float32))
        jumps = depth_jump(filled.depth) > 2 * TEAR * filled.depth
        measured.append((filled.known & ~jumps).astype(np.float32))
    hides = outline == front
    ratio = depths[1 - front][window][hides] / depths[front][window][hides]
    depths[front] = depths[front] * np.float32(GAP * np.quantile(ratio, 0.01))
    surfaces = []
    for number, part in enumerate(view.parts):
        camera = part.picture.camera
        assert part.picture.rgb is not None
        if number == front:
            after = [
                (before, side - before - inner)
                for before, side, inner in zip(
                    (rows, columns), camera.shape, outline.shape, strict=True
                )
            ]
            inside = np.pad(hides, after, "edge")
        else:
            inside = np.ones(camera.shape, np.bool_)
        points = backproject(depths[number], camera).astype(np.float32)
        image = part.picture.rgb.astype(np.float32)
        surfaces.append(Surface(points, image, measured[number], inside))
    return surfaces


def _metric(motion: PartMotion, surface: Surface) -> np.ndarray:
    """A part's motion (4, 4) in metres."""
    depth = float(np.median(surface.points[..., 2][surface.inside]))
    return make_transform(motion.rotation, depth * motion.shift)


def _empty(camera: Camera) -> Canvas:
    """A dark view in which nothing has been drawn."""
    nothing = np.zeros(camera.shape, np.float32)
    image = np.full((*camera.shape, 3), 8, np.float32)
    return Canvas(image, np.full_like(nothing, 1e3), nothing, nothing.copy())


def _measured(
    rng: np.random.Generator,
    canvas: Canvas,
    sensors: tuple[Sensor, Sensor],
    camera: Camera,
) -> Frame:
    """The frame that is measured of a view, each part through its own sensor."""
    is_second = canvas.moving > 0.5

    def of(field: Callable[[Sensor], float]) -> np.ndarray:
        """(H, W) a property of the sensor of each pixel."""
        return np.where(is_second, field(sensors[1]), field(sensors[0]))

    image = canvas.image
    for number, sensor in enumerate(sensors):
        if sensor.blur_px:
            blurred = cv2.GaussianBlur(image, (0, 0), sensor.blur_px)
            here = (is_second == bool(number))[..., None]
            image = np.where(here, blurred, image)
    contrast = of(lambda sensor: sensor.contrast)[..., None]
    image = contrast * image + 90 * (1 - contrast)
    white = rng.standard_normal(image.shape, dtype=np.float32)
    image = image + of(lambda sensor: sensor.noise)[..., None] * white
    error = smooth_field(rng, camera.shape, 24)
    error = error + rng.standard_normal(camera.shape, dtype=np.float32)
    depth = canvas.depth * (1 + of(lambda sensor: sensor.depth_noise) * error)
    edge = (depth_jump(canvas.depth) > TEAR * canvas.depth).astype(np.uint8)
    at_edge = cv2.dilate(edge, np.ones((3, 3), np.uint8)) > 0
    lost = (canvas.measured < 0.5) | (at_edge & (of(lambda s: s.is_ragged) > 0))
    depth = np.where(lost, 0, depth).astype(np.float32)
    return Frame(np.clip(image, 0, 255).astype(np.uint8), depth, camera)
