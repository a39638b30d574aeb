"""What is shown of a step: image, what moves, points, path, uncertainty, status and curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from hybridvo.core.geometry import (
    backproject,
    project,
    transform_points,
    valid_depth,
)
from hybridvo.core.results import (
    UNINFORMATIVE_COVARIANCE,
    MovingObject,
    State,
    Step,
    stated_stds,
)
from hybridvo.core.types import Camera, Frame
from hybridvo.flow.colours import flow_colours
from hybridvo.io.masks import (
    OBJECT_COLOURS,
    mask_of,
    numbers_of,
    object_colour,
)
from hybridvo.tracking.chains import PathCovariance

MAX_SIDE_PX = 480
"""Longer side of the images that are shown, pixels."""
MAX_POINTS_SIDE = 120
"""Points along the longer side of the depth map that are shown."""
JPEG_QUALITY = 70
FIRST_CLOCK_TIME_S = 1e8
"""Time stamps above this count from 1970, others from the start of the recording, seconds."""
SIGMAS = 3
"""Half of the axes of the ellipsoid, in standard deviations of the position."""
MAX_REMEMBERED = 20_000
"""Steps of which the uncertainty is kept: later motions may start from any of them."""
POINT_RADIUS = 2.5
"""Radius of a point on the screen."""
LAMP_RADIUS = 0.03
"""Radius of the status lamp, as a fraction of the image's width."""

GREEN = (0, 158, 115)
AMBER = (230, 159, 0)
RED = (213, 94, 0)
BLUE = (0, 114, 178)
GREY = (140, 140, 140)
MOVING_COLOUR = (255, 120, 0)
LAMPS = {State.OK: GREEN, State.DEGRADED: AMBER, State.FAILED: RED}
"""Colour of the lamp, and of the path, in each state."""
LEVELS = {State.OK: "INFO", State.DEGRADED: "WARN", State.FAILED: "ERROR"}
"""Level of a message in each state, as the viewer names it."""

IMAGE = "world/camera/image"
MOVING = f"{IMAGE}/moving"
LAMP = f"{IMAGE}/lamp"
POINTS = "world/camera/points"
OBJECTS = "world/camera/objects"
PATH = "world/path"
UNCERTAINTY = "world/uncertainty"
TRUTH = "world/ground_truth"
FLOW = "flow"
WEIGHTS = "weights"
STATE = "status/state"
MESSAGES = "status/messages"
PROBABILITY = "probability/motion"
TRANSLATION = "sigma/translation/mm"
ROTATION = "sigma/rotation/mdeg"
POSITION = "sigma/position/mm"
RATE = "rate/frames_per_second"
CURVES = {
    PROBABILITY: ("probability that the motion is right", BLUE),
    TRANSLATION: ("sigma of the translation of a step [mm]", BLUE),
    ROTATION: ("sigma of the rotation of a step [mdeg]", AMBER),
    POSITION: ("sigma of the position since the start [mm]", RED),
    RATE: ("frames a second", GREEN),
}
"""Name and colour of each curve."""


class Seen(NamedTuple):
    """A tracked frame, as it is shown.

    Attributes:
        frame: the frame.
        step: what the tracker returned for it.
        start: the frame from which the motion starts; None where it is not known.
        flow: (H, W, 2) pixels from the frame before, or None.
        rate: frames a second, or None.
        with_images: whether images, flow, weights and points are shown, or numbers alone.
    """

    frame: Frame
    step: Step
    start: Frame | None = None
    flow: np.ndarray | None = None
    rate: float | None = None
    with_images: bool = True


class Sink(Protocol):
    """What shows or records steps."""

    def add(self, seen: Seen) -> None:
        """Show or record a step."""

    def close(self) -> None:
        """Finish."""


class ViewerScene:
    """Logs steps to a Rerun stream.

    Args:
        stream: A ``rerun.RecordingStream``.
    """

    def __init__(self, stream: Any) -> None:
        import rerun

        self._rr = rerun
        self._stream = stream
        self._path = PathCovariance()
        self._position: np.ndarray | None = None
        self._log_what_never_changes()

    def add(self, seen: Seen) -> None:
        """Log a step."""
        self._set_time(seen.step)
        self._log_pose(seen.step)
        self._log_status(seen)
        self._log_curves(seen)
        if seen.with_images:
            self._log_images(seen)

    def add_line(self, name: str, positions: np.ndarray) -> None:
        """Log a path, (N, 3) metres, which is there at all times."""
        strip = self._rr.LineStrips3D([positions.astype(np.float32)], colors=GREY)
        self._stream.log(name, strip, static=True)

    # -- what never changes ----------------------------------------------------------

    def _log_what_never_changes(self) -> None:
        """Log axes, colours and the names of the curves."""
        rr = self._rr
        log = self._stream.log
        log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        classes = [(0, "", (0, 0, 0, 0)), (1, "moves", MOVING_COLOUR)]
        classes += [(2 + k, "", c) for k, c in enumerate(OBJECT_COLOURS)]
        log(MOVING, rr.AnnotationContext(classes), static=True)
        for name, (label, colour) in CURVES.items():
            log(name, rr.SeriesLines(names=label, colors=colour), static=True)
        names = [state.value for state in LAMPS]
        colours = list(LAMPS.values())
        log(STATE, rr.StateConfiguration(values=names, colors=colours), static=True)

    def _set_time(self, step: Step) -> None:
        """Set the time of all that is logged next."""
        self._stream.set_time("frame", sequence=step.index)
        if step.timestamp > FIRST_CLOCK_TIME_S:
            self._stream.set_time("time", timestamp=step.timestamp)
        else:
            self._stream.set_time("time", duration=step.timestamp)

    # -- pose, status and numbers ----------------------------------------------------

    def _log_pose(self, step: Step) -> None:
        """Log the camera, the way to it, and how far it may be from there."""
        rr = self._rr
        log = self._stream.log
        T = step.T_world_cam
        position = T[:3, 3].astype(np.float32)
        log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        if self._position is not None:
            way = [self._position, position]
            log(PATH, rr.LineStrips3D([way], colors=LAMPS[step.status.state]))
        self._position = position
        covariance = self._position_covariance(step)
        if covariance is None:
            log(UNCERTAINTY, rr.Clear(recursive=False))
            log(POSITION, rr.Clear(recursive=False))
            return
        half_axes, xyzw = ellipsoid(covariance)
        log(
            UNCERTAINTY,
            rr.Ellipsoids3D(
                centers=[position],
                half_sizes=[half_axes],
                quaternions=[rr.Quaternion(xyzw=xyzw)],
                colors=[LAMPS[step.status.state]],
                labels=[f"{SIGMAS} sigma: {1e3 * half_axes.max():.3g} mm"],
                show_labels=True,
                fill_mode="majorwireframe",
            ),
        )
        log(POSITION, rr.Scalars(1e3 * np.sqrt(np.trace(covariance))))

    def _position_covariance(self, step: Step) -> np.ndarray | None:
        """Return the covariance (3, 3) of the position, m^2; None where nothing is known."""
        path = self._path
        C = path.follow(step)
        if len(path.frames) > 2 * MAX_REMEMBERED:
            path.keep(path.frames[-MAX_REMEMBERED:])
        return position_covariance(C, step.T_world_cam)

    def _log_status(self, seen: Seen) -> None:
        """Log the lamp, the state over time, and why a motion is not ok."""
        rr = self._rr
        step = seen.step
        state = step.status.state
        colour = LAMPS[state]
        self._stream.log(STATE, rr.StateChange(state=state.value))
        text = f"{step.status}  p {step.probability:.3f}"
        width = -(-seen.frame.camera.width // stride_of(seen.frame.camera))
        radius = LAMP_RADIUS * width
        lamp = rr.Points2D(
            [(2 * radius, 2 * radius)],
            radii=radius,
            colors=[colour],
            labels=[text],
            show_labels=True,
            draw_order=100.0,
        )
        self._stream.log(LAMP, lamp)
        if not step.ok:
            text = f"frame {step.index}: {step.status} {step.status.message}"
            self._stream.log(MESSAGES, rr.TextLog(text, level=LEVELS[state]))

    def _log_curves(self, seen: Seen) -> None:
        """Log what is drawn over time; curves of a failed motion have a gap."""
        rr = self._rr
        step = seen.step
        values: dict[str, float | None] = dict.fromkeys(CURVES)
        del values[POSITION]  # it is known where the path is
        values[RATE] = seen.rate
        if np.isfinite(step.probability):
            values[PROBABILITY] = step.probability
        if step.usable and step.prev_index is not None:
            std_m, std_rad = stated_stds(step.covariance)
            values[TRANSLATION] = 1e3 * std_m
            values[ROTATION] = 1e3 * np.degrees(std_rad)
        for name, value in values.items():
            content = (
                rr.Clear(recursive=False) if value is None else rr.Scalars(value)
            )
            self._stream.log(name, content)

    # -- images and points -----------------------------------------------------------

    def _log_images(self, seen: Seen) -> None:
        """Log image, what moves, points, flow and weights, at a smaller size."""
        rr = self._rr
        log = self._stream.log
        frame = seen.frame
        camera = frame.camera
        stride = stride_of(camera)
        small = smaller(camera, stride)
        log(
            IMAGE,
            rr.Pinhole(
                image_from_camera=small.K,
                width=small.width,
                height=small.height,
                image_plane_distance=self._plane_distance(frame),
            ),
        )
        classes = self._moving_classes(seen, small, stride)
        if classes is None:
            log(MOVING, rr.Clear(recursive=False))
        else:
            log(MOVING, rr.SegmentationImage(classes, opacity=0.5))
        if frame.rgb is not None:
            self._log_jpeg(IMAGE, frame.rgb[::stride, ::stride])
        if seen.flow is not None:
            self._log_jpeg(FLOW, flow_colours(seen.flow[::stride, ::stride]))
        weights = seen.step.motion.weights
        if weights is not None:
            grey = (255 * np.clip(weights[::stride, ::stride], 0, 1)).astype(
                np.uint8
            )
            self._log_jpeg(WEIGHTS, grey)
        self._log_points(frame, classes, stride)
        self._log_objects(seen.step)

    def _log_jpeg(self, name: str, image: np.ndarray) -> None:
        """Log an image, (h, w) or (h, w, 3) uint8."""
        content = self._rr.Image(np.ascontiguousarray(image))
        self._stream.log(name, content.compress(JPEG_QUALITY))

    def _moving_classes(
        self, seen: Seen, small: Camera, stride: int
    ) -> np.ndarray | None:
        """Return 1 where something moves, (h, w) uint8 of the small image; None: not known.

        Where a step tells its moving objects apart, each of them has a class of its own.
        """
        if seen.step.objects:
            return object_classes(seen.step.objects)[::stride, ::stride]
        start = seen.start
        weights = seen.step.motion.weights
        if start is None or start.depth is None or weights is None:
            return None
        if not seen.step.usable or weights.shape != start.depth.shape:
            return None
        moving = ~mask_of(start, weights)
        if start.mask is not None:
            moving &= start.mask
        return carried(moving, start, seen.step.T_curr_prev, small, stride)

    def _log_points(
        self, frame: Frame, classes: np.ndarray | None, stride: int
    ) -> None:
        """Log the depth map as points in the colours of the image, or of what moves."""
        rr = self._rr
        if frame.depth is None:
            self._stream.log(POINTS, rr.Clear(recursive=False))
            return
        step = -(-max(frame.camera.shape) // MAX_POINTS_SIDE)
        depth = frame.depth[::step, ::step]
        is_valid = valid_depth(depth)
        points = backproject(depth, smaller(frame.camera, step))[is_valid]
        colours = np.full((*depth.shape, 3), GREY, np.uint8)
        if frame.rgb is not None:
            colours = frame.rgb[::step, ::step].copy()
        if classes is not None:
            rows = np.arange(depth.shape[0]) * step // stride
            columns = np.arange(depth.shape[1]) * step // stride
            at_points = classes[np.ix_(rows, columns)]
            palette = np.array(
                [(0, 0, 0), MOVING_COLOUR, *OBJECT_COLOURS], np.uint8
            )
            colours[at_points > 0] = palette[at_points[at_points > 0]]
        content = rr.Points3D(
            points.astype(np.float32),
            colors=colours[is_valid],
            radii=rr.Radius.ui_points(POINT_RADIUS),
        )
        self._stream.log(POINTS, content)

    def _log_objects(self, step: Step) -> None:
        """Log a box around each object, with its number."""
        rr = self._rr
        things = step.objects
        if not things:
            self._stream.log(OBJECTS, rr.Clear(recursive=False))
            return
        boxes = rr.Boxes3D(
            centers=[thing.centre for thing in things],
            half_sizes=[thing.size / 2 for thing in things],
            colors=[object_colour(thing.id) for thing in things],
            labels=[_label_of(thing) for thing in things],
            show_labels=True,
        )
        self._stream.log(OBJECTS, boxes)

    def _plane_distance(self, frame: Frame) -> float:
        """Return how far before the camera its image is drawn, metres."""
        if frame.depth is None:
            return 1.0
        known = frame.depth[valid_depth(frame.depth)]
        return 0.1 * float(np.median(known)) if known.size else 1.0


def object_classes(things: Sequence[MovingObject]) -> np.ndarray:
    """Return the class of every pixel, (H, W) uint8: 0 of none, from 2 on of the objects.

    Args:
        things: The objects of a step, at least one.
    """
    numbers = numbers_of(things).astype(np.int64)
    classes = 2 + (numbers - 1) % len(OBJECT_COLOURS)
    return np.where(numbers > 0, classes, 0).astype(np.uint8)


def _label_of(thing: MovingObject) -> str:
    """Return what is written beside an object."""
    state = "" if thing.is_seen else ", hidden"
    return f"{thing.id}{state}"


def stride_of(camera: Camera) -> int:
    """Return the distance of the pixels of an image that are shown."""
    return -(-max(camera.shape) // MAX_SIDE_PX)


def smaller(camera: Camera, stride: int) -> Camera:
    """Return the camera of an image of which every so many pixels are kept.

    >>> camera = Camera(fx=500, fy=500, cx=320, cy=240, height=481, width=640)
    >>> smaller(camera, 2).shape
    (241, 320)
    """
    return Camera(
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=camera.cx / stride,
        cy=camera.cy / stride,
        height=-(-camera.height // stride),
        width=-(-camera.width // stride),
    )


def carried(
    mask: np.ndarray,
    start: Frame,
    T_curr_prev: np.ndarray,
    small: Camera,
    stride: int,
) -> np.ndarray:
    """Carry a mask from the frame where a motion starts into the small current image.

    Every pixel goes where the camera's motion takes its point; what an object moved by itself
    meanwhile is left out.

    Args:
        mask: (H, W) bool, pixels of the start.
        start: The frame from which the motion starts, with depth.
        T_curr_prev: (4, 4) the motion, metres.
        small: The camera of the small image.
        stride: The distance of the pixels that are carried.

    Returns:
        (h, w) uint8, 1 where a pixel of the mask comes to lie.
    """
    classes = np.zeros(small.shape, np.uint8)
    chosen = mask[::stride, ::stride]
    depth = np.asarray(start.depth)[::stride, ::stride]
    chosen = chosen & valid_depth(depth)
    points = backproject(depth, smaller(start.camera, stride))[chosen]
    pixels = project(transform_points(T_curr_prev, points), small)
    rows_and_columns = np.rint(pixels[np.isfinite(pixels).all(axis=1)][:, ::-1])
    inside = (rows_and_columns >= 0) & (rows_and_columns < small.shape)
    rows, columns = rows_and_columns[inside.all(axis=1)].astype(int).T
    classes[rows, columns] = 1
    # what comes nearer spreads, and leaves holes
    square = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(classes, cv2.MORPH_CLOSE, square)


def position_covariance(
    covariance: np.ndarray, T_world_cam: np.ndarray
) -> np.ndarray | None:
    """Return the covariance of a camera's position in the axes of the world.

    Args:
        covariance: (6, 6) of delta in ``Exp(delta) T_cam_world``, m and rad.
        T_world_cam: (4, 4) metres.

    Returns:
        (3, 3) m^2; None where the position is not known at all.

    >>> position_covariance(np.diag([4.0, 1, 1, 0, 0, 0]), np.eye(4)).diagonal().tolist()
    [4.0, 1.0, 1.0]
    """
    variances = covariance[:3, :3]
    if np.trace(variances) >= UNINFORMATIVE_COVARIANCE[0, 0]:
        return None
    R = T_world_cam[:3, :3]
    return R @ variances @ R.T


def ellipsoid(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the half axes (3,), metres, and the rotation (xyzw) of three standard deviations.

    Args:
        covariance: (3, 3) m^2.

    >>> ellipsoid(np.diag([1e-4, 4e-4, 9e-4]))[0].round(3).tolist()
    [0.03, 0.06, 0.09]
    """
    from scipy.spatial.transform import Rotation

    values, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    half_axes = SIGMAS * np.sqrt(np.maximum(values, 0.0))
    return half_axes, Rotation.from_matrix(axes).as_quat()
