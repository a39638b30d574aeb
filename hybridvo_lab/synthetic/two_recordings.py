"""Two recordings in one view: a static scene, and a part of another one that moves as its own
camera moved.

Every pixel is a real one, of the frame and of the depth map that its recording has for that
moment: the part keeps its noise, its blur, its shutter and its exposure, and fits its own motion
neither better nor worse than the scene fits the camera's. With the two recordings exchanged only
their roles are exchanged, so what an estimator knows of one picture or of one sensor does not help.

The part is cut along an outline on its surfaces in one frame, which is followed through the others
by the recording's own motions and depth. Its lengths are scaled, so that it stands before the scene
or reaches into it; that changes no flow.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import backproject, invert
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.providers import FlowProvider, dis_flow, with_flow
from hybridvo_lab.synthetic.draws import smooth_field
from hybridvo_lab.synthetic.meshes import filled_depth, image_points, transformed
from hybridvo_lab.synthetic.paper_samples import KnownPair
from hybridvo_lab.synthetic.recordings import SPLITS, Recording, load_recording
from hybridvo_lab.synthetic.semi_real import PIXELS, STATIC_PX

MIN_SIZE = (110, 150)
"""Smallest image that both recordings fill, rows and columns."""
SHARES = (0.05, 0.95)
"""Fraction of the image that the outline encloses."""
HOLD_PROBABILITY = 0.25
"""Probability that a recording is held from one frame of a clip to the next."""
SURROUNDS = 0.75
"""Fraction of the image's border from which a part surrounds the other."""
MAX_DRAWS = 300
"""Draws of two recordings after which they count as impossible to put together."""
SHARPNESS = 1.2
"""How many times coarser an image may become without being blurred before."""


class Layout(NamedTuple):
    """Where things are drawn."""

    # probabilities of an outline in the middle, on one side, around the middle
    outlines: tuple[float, float, float]
    # a and b of the beta distribution of the fraction of the image between both SHARES
    share: tuple[float, float]
    before: float  # probability that the part stands before all of the scene


EVERY = Layout((1 / 3, 1 / 3, 1 / 3), (1, 1), 0.6)
"""The scene may as well be what moves: its share is that of the thing, and so is its border."""
USUAL = Layout((0.6, 0.3, 0.1), (1.5, 2.5), 0.85)
"""The scene mostly surrounds the thing, is larger, and is farther away."""


class Footage(NamedTuple):
    """Frames of one recording, as the camera of the clip sees them."""

    frames: list[Frame]
    motions: list[np.ndarray]  # T_curr_prev (4, 4) between neighbours
    place: str


class TwoRecordings(NamedTuple):
    """What is put together into a clip."""

    world: Footage
    thing: Footage
    # (H, W) in the thing's first frame; it is cut where this is positive
    outline: np.ndarray
    # by what quantile and factor the thing's depth follows from the scene's
    nearness: tuple[float, float]

    def exchanged(self) -> TwoRecordings:
        """Return the same with the two recordings exchanged."""
        return self._replace(world=self.thing, thing=self.world)


class Clip(NamedTuple):
    """The pairs of neighbouring frames of two recordings in one view."""

    pairs: list[KnownPair]
    T_thing: list[np.ndarray]  # (4, 4) T_curr_prev as the thing alone shows it
    # whether what lies along the border tells which part is the scene; else nothing does
    is_known: bool


def load_places(
    folder: Path, splits: Sequence[str], pixels: int = PIXELS[1]
) -> dict[str, list[Recording]]:
    """Load the recordings with known motions of parts of
    :data:`~hybridvo_lab.synthetic.recordings.SPLITS` that are in a folder.

    Args:
        folder: the data folder.
        splits: some of ``train``, ``development`` and ``test``.
        pixels: number of pixels of their images.

    Returns:
        By place.
    """
    loaded = {}
    places = [place for split in splits for place in SPLITS[split].items()]
    for place, sources in places:
        present = [
            source
            for source in sources
            if source.strides and (folder / source.path).is_dir()
        ]
        if present:
            loaded[place] = [
                load_recording(folder, each, pixels) for each in present
            ]
    return loaded


def draw_two_recordings(
    rng: np.random.Generator,
    places: Mapping[str, Sequence[Recording]],
    frames: int = 2,
    layout: Layout = EVERY,
) -> TwoRecordings:
    """Draw a scene of one place, and a part of another place that moves before it.

    Args:
        rng: the source of randomness.
        places: at least two, each with its recordings.
        frames: number of frames of the clip.
        layout: where the part is drawn.

    Raises:
        InputError: no two of the places can be put together.
    """
    seen = _draw_footage(rng, places, frames)
    world, thing = seen
    least, most = SHARES
    share = least + (most - least) * rng.beta(*layout.share)
    kind = int(rng.choice(3, p=layout.outlines))
    outline = _draw_outline(rng, world.frames[0].camera.shape, kind, share)
    if rng.random() < layout.before:
        nearness = (0.02, rng.uniform(0.6, 0.95))
    else:
        nearness = (0.5, rng.uniform(0.9, 1.3))
    return TwoRecordings(world, thing, outline, nearness)


def _draw_footage(
    rng: np.random.Generator, places: Mapping[str, Sequence[Recording]], frames: int
) -> tuple[Footage, Footage]:
    """A scene and another recording, as one camera sees them."""
    names = list(places)
    if len(names) < 2:
        raise InputError(f"places: expected at least two, got {len(names)}.")
    for _ in range(MAX_DRAWS):
        chosen = rng.choice(names, 2, replace=False)
        walks = [_draw_walk(rng, name, places[name], frames) for name in chosen]
        if walks[0] is None or walks[1] is None:
            continue
        seen = _in_one_camera(walks[0], walks[1])
        if seen is not None:
            return seen
    raise InputError(
        f"places: in {MAX_DRAWS} draws no two of {', '.join(names)} have {frames} frames "
        f"in a row with known motions, and {MIN_SIZE[0]} x {MIN_SIZE[1]} pixels in common."
    )


def _draw_walk(
    rng: np.random.Generator,
    place: str,
    recordings: Sequence[Recording],
    frames: int,
) -> Footage | None:
    """Frames of a recording, forwards or backwards, some of them held.

    None where a motion is not known.
    """
    recording = recordings[int(rng.integers(len(recordings)))]
    known = {(pair.prev, pair.curr): pair.T_curr_prev for pair in recording.pairs}
    if not known:
        return None
    starts = list(known)
    at, following = starts[int(rng.integers(len(starts)))]
    stride = following - at
    if rng.random() < 0.5:
        at, stride = following, -stride
    indices = [at, at + stride]
    while len(indices) < frames:
        is_held = rng.random() < HOLD_PROBABILITY
        indices.append(indices[-1] + (0 if is_held else stride))
    motions = []
    for step in itertools.pairwise(indices):
        if step[0] == step[1]:
            motions.append(np.eye(4))
        elif step in known:
            motions.append(known[step])
        elif step[::-1] in known:
            motions.append(invert(known[step[::-1]]))
        else:
            return None
    return Footage([recording.frames[k] for k in indices], motions, place)


def _in_one_camera(
    scene: Footage, other: Footage
) -> tuple[Footage, Footage] | None:
    """The part of the scene's view that both fill, seen by the scene's camera.

    None where it is small. Only the other recording is resampled.
    """
    camera = scene.frames[0].camera
    source = other.frames[0].camera
    zoom = np.array([camera.fx / source.fx, camera.fy / source.fy])
    middle = np.array([camera.cx, camera.cy])
    low = middle - zoom * (source.cx, source.cy)
    high = low + zoom * (source.width - 1, source.height - 1)
    left, top = np.ceil(np.maximum(low, 0)).astype(int)
    last = np.floor(np.minimum(high, (camera.width - 1, camera.height - 1)))
    right, bottom = last.astype(int) + 1
    if bottom - top < MIN_SIZE[0] or right - left < MIN_SIZE[1]:
        return None
    cropped = Camera(
        camera.fx,
        camera.fy,
        camera.cx - left,
        camera.cy - top,
        height=int(bottom - top),
        width=int(right - left),
    )
    window = np.s_[top:bottom, left:right]
    own = [_cropped(frame, window, cropped) for frame in scene.frames]
    seen = [_resampled(frame, cropped) for frame in other.frames]
    return scene._replace(frames=own), other._replace(frames=seen)


def _cropped(frame: Frame, window: tuple[slice, slice], camera: Camera) -> Frame:
    """A window of a frame."""
    assert frame.rgb is not None and frame.depth is not None
    rgb = np.ascontiguousarray(frame.rgb[window])
    return Frame(rgb, np.ascontiguousarray(frame.depth[window]), camera)


def _resampled(frame: Frame, camera: Camera) -> Frame:
    """A frame as another camera at the same place sees it."""
    assert frame.rgb is not None and frame.depth is not None
    rays = backproject(np.ones(camera.shape), camera)
    u, v = cv2.split(image_points(rays, frame.camera))
    rgb = frame.rgb
    coarser = frame.camera.fx / camera.fx
    if coarser > SHARPNESS:
        rgb = cv2.GaussianBlur(rgb, (0, 0), 0.4 * coarser)
    rgb = cv2.remap(rgb, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return Frame(rgb, cv2.remap(frame.depth, u, v, cv2.INTER_NEAREST), camera)


def _draw_outline(
    rng: np.random.Generator, shape: tuple[int, int], kind: int, share: float
) -> np.ndarray:
    """A field (H, W) that is positive in a fraction of the image: in its middle (kind 0), on one
    side of it (1), or around its middle (2).
    """
    height, width = shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    x = u / width - rng.uniform(0.3, 0.7)
    y = v / height - rng.uniform(0.3, 0.7)
    angle = rng.uniform(0, 2 * np.pi)
    side = 2 * (np.cos(angle) * x + np.sin(angle) * y)
    distance = np.hypot(x, y)
    field = (-distance, side, distance)[kind]
    field = field + rng.uniform(0.02, 0.12) * smooth_field(rng, shape, 5)
    return (field - np.quantile(field, 1 - share)).astype(np.float32)


def compose(parts: TwoRecordings, flow: FlowProvider | None = None) -> Clip:
    """Put two recordings together, with flow between neighbouring frames.

    Args:
        parts: the two recordings, and the outline.
        flow: estimates the flow; None: DIS.
    """
    flow = flow or dis_flow()
    camera = parts.world.frames[0].camera
    scene_depth = [_filled(frame) for frame in parts.world.frames]
    thing_depth = [_filled(frame) for frame in parts.thing.frames]
    inside = parts.outline > 0
    quantile, factor = parts.nearness
    ratio = scene_depth[0][inside] / thing_depth[0][inside]
    scale = factor * float(np.quantile(ratio, quantile))
    thing_depth = [np.float32(scale) * depth for depth in thing_depth]
    T_thing = [_scaled(T, scale) for T in parts.thing.motions]

    frames = []
    drawn = []
    T_first = np.eye(4)  # from the thing's first frame to this one
    for k, frame in enumerate(parts.world.frames):
        if k:
            T_first = T_thing[k - 1] @ T_first
        cut = _followed(parts.outline, thing_depth[k], T_first, camera)
        drawn.append(cut & (thing_depth[k] < scene_depth[k]))
        frames.append(_together(frame, parts.thing.frames[k], scale, drawn[k]))

    pairs = []
    for k, T in enumerate(parts.world.motions):
        pair = with_flow(FramePair(frames[k], frames[k + 1], None), flow)
        apart = _apart_px(thing_depth[k], T, T_thing[k], camera)
        moving = drawn[k] & (apart > STATIC_PX * camera.width / 1024)
        pairs.append(
            KnownPair(pair, T, _measured(frames[k]), moving, parts.world.place)
        )
    border = _border(drawn[0])
    return Clip(pairs, T_thing, float(np.mean(~border)) >= SURROUNDS)


def _measured(frame: Frame) -> np.ndarray:
    """The depth (H, W) of a frame, metres; 0 where it was not measured."""
    assert frame.depth is not None
    return np.where(np.isfinite(frame.depth), frame.depth, 0)


def _filled(frame: Frame) -> np.ndarray:
    """The depth (H, W) of a frame without holes, metres."""
    assert frame.depth is not None
    return filled_depth(frame.depth).depth


def _scaled(T: np.ndarray, scale: float) -> np.ndarray:
    """A motion (4, 4) whose lengths are in other units."""
    out = T.copy()
    out[:3, 3] *= scale
    return out


def _followed(
    outline: np.ndarray, depth: np.ndarray, T_now_first: np.ndarray, camera: Camera
) -> np.ndarray:
    """Which pixels (H, W) of a frame lie inside an outline that was drawn in the first one."""
    points = backproject(depth, camera).astype(np.float32)
    u, v = cv2.split(image_points(transformed(points, invert(T_now_first)), camera))
    there = cv2.remap(
        outline, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return there > 0


def _together(scene: Frame, thing: Frame, scale: float, drawn: np.ndarray) -> Frame:
    """A frame of the scene in which a thing is drawn over some pixels (H, W)."""
    assert scene.rgb is not None and thing.rgb is not None
    assert scene.depth is not None and thing.depth is not None
    over = drawn.astype(np.float32)
    # pixels at a silhouette mix both surfaces
    alpha = (cv2.GaussianBlur(over, (3, 3), 0.7) * over)[..., None]
    image = scene.rgb + alpha * (thing.rgb.astype(np.float32) - scene.rgb)
    depth = np.where(drawn, np.float32(scale) * thing.depth, scene.depth)
    return replace(scene, rgb=np.round(image).astype(np.uint8), depth=depth)


def _apart_px(
    depth: np.ndarray, T: np.ndarray, other: np.ndarray, camera: Camera
) -> np.ndarray:
    """Distance (H, W) between the ego flows of two motions, px."""
    points = backproject(depth, camera).astype(np.float32)
    flows = [image_points(transformed(points, each), camera) for each in (T, other)]
    return np.linalg.norm(flows[0] - flows[1], axis=2)


def _border(mask: np.ndarray) -> np.ndarray:
    """The values of a mask (H, W) along the border of the image."""
    return np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]])
