"""Training pairs of rendered scenes, of other families than those that
methods are measured on.

In streets, halls, hills, before walls and tables, the objects of
:mod:`hybridvo_lab.synthetic.bodies` move alone or together, freely
or along with the camera.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field
from scipy.spatial.transform import Rotation

from hybridvo.core.geometry import invert, make_transform, se3_exp
from hybridvo.core.options import Fraction, option_group
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.providers import dis_flow
from hybridvo_lab.synthetic.bodies import (
    OBJECTS,
    SHAPES,
    MovingObject,
    draw_texture,
    moving_object,
    stairs,
)
from hybridvo_lab.synthetic.draws import (
    affine,
    compose,
    log_uniform,
    random_rotation,
    rotation_about,
    rotation_by,
    smooth_field,
)
from hybridvo_lab.synthetic.flow_sources import draw_noisy_flow
from hybridvo_lab.synthetic.paper_samples import KnownPair, Sample, camera_flow
from hybridvo_lab.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo_lab.synthetic.render import Scene, Solid
from hybridvo_lab.synthetic.scenes import populate
from hybridvo_lab.synthetic.sensors import degrade_depth, sample_at

AT_CAMERA = np.eye(4)
"""The frame of the first camera, which is the world frame."""
SIZE_LIMITS = (0.15, 6.0)
"""Smallest and largest factor on the size of the moving objects."""
NEAREST_OBJECT = 0.4
"""Depth below which parts of moving objects are left out, metres."""
MOVING_PX = 0.5
"""Difference from the ego flow from which a pixel counts as
moving, px at a width of 1024."""


# --- the static scene -------------------------------------------------------------


class _Surroundings:
    """What stands still, metres. ``view``: tangents of half
    the fields of view, (x, y).
    """

    def __init__(self, rng: np.random.Generator, view: np.ndarray) -> None:
        self.rng = rng
        self.view = view
        self.solids: list[Solid] = []
        kinds = (
            self.add_street,
            self.add_street,
            self.add_hall,
            self.add_hills,
            self.add_wall,
            self.add_table,
        )
        chosen = int(rng.integers(len(kinds)))
        add_kind = kinds[chosen]
        self.is_street = add_kind == self.add_street
        add_kind()
        # things close to the camera, of which one can fill half of the image
        self.scatter(4 * rng.random() ** 2, SHAPES, 0.04, 1.0, (1.3, 4.0))

    def add_box(
        self,
        half: ArrayLike,
        centre: ArrayLike,
        T: np.ndarray = AT_CAMERA,
        contrast: float = 1.0,
    ) -> None:
        """Add a box.

        Args:
            half: (3,) half axes, metres.
            centre: (3,) metres, in the frame ``T``.
            T: (4, 4) from this frame to the world frame.
            contrast: factor on the contrast of the texture.
        """
        texture = draw_texture(self.rng)
        base, other = texture["colours"]
        texture["colours"] = base, base + contrast * (other - base)
        self.solids.append(Solid(BOX, compose(T, affine(half, centre)), **texture))

    def scatter(
        self,
        count: float,
        shapes: tuple[int, ...],
        min_half: ArrayLike,
        max_half: ArrayLike,
        depths: tuple[float, float],
        floor: float | None = None,
        reach: tuple[float, float] | np.ndarray | None = None,
        T: np.ndarray = AT_CAMERA,
    ) -> None:
        """Add solids at random places.

        Args:
            count: how many, rounded.
            shapes: the unit shapes to choose from.
            min_half: (3,) smallest half axes, metres, or one number for all.
            max_half: (3,) largest half axes.
            depths: limits of their near side along z of the frame ``T``, metres.
            floor: y of the floor on which they stand upright; None: they
                float, turned at random.
            reach: (x, y) limits of their centres; None: the view at their depth.
            T: (4, 4) from their frame to the world frame.
        """
        rng = self.rng
        for _ in range(round(count)):
            half = np.exp(rng.uniform(np.log(min_half), np.log(max_half), 3))
            z = rng.uniform(*depths) + half.max()
            R = random_rotation(rng)
            limits = np.asarray(self.view * z if reach is None else reach)
            x, y = rng.uniform(-1.1, 1.1, 2) * limits
            if floor is not None:
                y = floor - half[1]
                R = Rotation.from_euler("y", rng.uniform(0, 1.5)).as_matrix()
            A = compose(T, affine(half, (x, y, z), R))
            shape = int(rng.choice(shapes))
            self.solids.append(Solid(shape, A, **draw_texture(rng)))

    def add_street(self) -> None:
        """Add the ground, rows of houses and poles, open to the sky."""
        rng = self.rng
        floor = rng.uniform(1.2, 2.2)
        side = rng.uniform(8, 13)
        # flow estimators fail on roads of little contrast
        contrast = log_uniform(rng, (0.03, 1.0))
        self.add_box((80, 0.5, 80), (0, floor + 0.5, 60), contrast=contrast)
        for x in (-side, side):
            self.scatter(
                12,
                (BOX,),
                min_half=(1.5, 1.5, 1),
                max_half=(3.5, 7, 4),
                depths=(0, 45),
                floor=floor,
                reach=(1.5, 0),
                T=make_transform(np.eye(3), np.array([x, 0, 0])),
            )
        self.scatter(
            rng.uniform(0, 7),
            (CYLINDER,),
            min_half=(0.05, 1.5, 0.05),
            max_half=(0.12, 3.5, 0.12),
            depths=(0, 25),
            floor=floor,
        )

    def add_hall(self) -> None:
        """Add a closed room with columns and benches, and lamps in the air."""
        rng = self.rng
        low = -rng.uniform((3, 2, 4), (9, 5, 4.1))
        high = rng.uniform((3, 1, 7), (9, 2.2, 26))
        self.add_box((high - low) / 2, (high + low) / 2)
        tall = (high[1] - low[1]) / 2
        far = high[2] - tall
        floor = high[1]
        reach = (0.8 * min(high[0], -low[0]), 0.7 * low[1])
        self.scatter(
            rng.uniform(0, 16),
            (BOX, CYLINDER),
            min_half=(0.1, tall, 0.1),
            max_half=(0.35, tall, 0.35),
            depths=(0, far),
            floor=floor,
            reach=reach,
        )
        benches = rng.uniform(2, 12)
        self.scatter(benches, (BOX,), 0.15, 0.7, (2.0, far), floor, reach)
        lamps = rng.uniform(0, 6)
        self.scatter(lamps, (BOX, ELLIPSOID), 0.1, 0.5, (2.5, far), reach=reach)

    def add_hills(self) -> None:
        """Add mounds under the sky, with stems and crowns of trees."""
        rng = self.rng
        floor = rng.uniform(0.8, 2.5)
        self.add_box((90, 0.5, 90), (0, floor + 0.5, 70))
        self.scatter(
            rng.uniform(4, 11),
            (ELLIPSOID,),
            min_half=(2, 0.5, 2),
            max_half=(9, 4, 6),
            depths=(4, 45),
            floor=floor + 1,
        )
        self.scatter(
            rng.uniform(0, 10),
            (CYLINDER,),
            min_half=(0.1, 1, 0.1),
            max_half=(0.15, 2, 0.15),
            depths=(2, 25),
            floor=floor,
        )
        crowns = rng.uniform(0, 10)
        self.scatter(crowns, (ELLIPSOID,), 0.5, 1.4, (3, 25), floor - 1.5)

    def add_wall(self) -> None:
        """Add one slanted wall with relief, which fills the view."""
        rng = self.rng
        z = rng.uniform(3, 12)
        angles_deg = rng.normal(0, (15, 25, 90))
        R = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
        T = make_transform(R, np.array([0, 0, z]))
        self.add_box((25, 25, 0.3), (0, 0, 0.3), T)
        count = rng.uniform(2, 16)
        reach = self.view * z
        self.scatter(count, SHAPES, 0.1, 0.8, (-0.8, 0.0), reach=reach, T=T)

    def add_table(self) -> None:
        """Add a table with things on it, viewed from above, and a wall behind it."""
        rng = self.rng
        z = rng.uniform(2, 5)
        tilt_deg = rng.uniform(15, 50)
        R = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
        T = make_transform(R, np.array([0, 0.35 * z, z]))
        self.add_box((12, 0.1, 3), (0, 0.1, 0), T)
        self.add_box((20, 12, 0.3), (0, 0, z + rng.uniform(3, 7)))
        count = rng.uniform(4, 18)
        reach = (self.view[0] * z, 0)
        self.scatter(count, SHAPES, 0.08, 0.4, (-1.5, 2.2), 0.0, reach, T)


# --- moving objects and the camera ------------------------------------------------


def _draw_objects(
    rng: np.random.Generator,
    view: np.ndarray,
    T_world_cam: np.ndarray,
    many_objects_fraction: float,
) -> list[MovingObject]:
    """Draw objects, each with a motion of its own or all with one.

    Args:
        rng: the source of randomness.
        view: tangents of half the fields of view, (x, y).
        T_world_cam: (4, 4) the second camera pose; the first is the identity.
        many_objects_fraction: probability of four to ten objects instead of one to three.
    """
    has_many = rng.random() < many_objects_fraction
    count = int(rng.integers(4, 11)) if has_many else int(rng.integers(1, 4))
    follow, together, alike = rng.random(3) < (0.45, 0.3, 0.5)
    kinds = rng.integers(len(OBJECTS), size=1 if alike else count)
    motion = np.eye(4)
    objects = []
    for number in range(count):
        z = rng.uniform(1.8, 7.0)
        # the first object is large where there are few
        min_size = 0.08 if has_many or number else 0.3
        radius = log_uniform(rng, (min_size, 0.7)) * np.sqrt(view.prod()) * z
        centre = np.array([*(rng.uniform(-0.95, 0.95, 2) * view * z), z])
        # flat enough for a large object not to reach the camera
        thickness = min(rng.uniform(0.4, 1.0) * radius, 0.5 * z)
        flat = np.diag([radius, radius, thickness])
        place = make_transform(flat @ random_rotation(rng), centre)
        has_own_motion = number == 0 or not together
        if has_own_motion:
            motion = _draw_object_motion(rng, centre, bool(follow))
            motion = T_world_cam @ motion if follow else motion
        draw_parts = OBJECTS[int(kinds[number % len(kinds)])]
        parts = draw_parts(rng)
        path = np.stack([place, motion @ place])
        objects.append(moving_object(rng, parts, path, nearest=NEAREST_OBJECT))
    return objects


def _draw_conveyor(
    rng: np.random.Generator, view: np.ndarray
) -> list[MovingObject]:
    """Draw steps that move along their row, all with one motion."""
    z = rng.uniform(1.8, 6.0)
    radius = log_uniform(rng, (0.5, 1.3)) * np.sqrt(view.prod()) * z
    centre = np.array([*(rng.uniform(-0.5, 0.5, 2) * view * z), z])
    tilt_deg = rng.uniform((-25, -60, -60), (40, 60, 60))
    R = Rotation.from_euler("xyz", tilt_deg, degrees=True).as_matrix()
    place = make_transform(R @ np.diag([radius, radius, 0.4 * radius]), centre)
    length = log_uniform(rng, (0.003, 0.07)) * z
    along = R[:, 0] * rng.choice([-1.0, 1.0])
    motion = make_transform(np.eye(3), length * along)
    path = np.stack([place, motion @ place])
    return [moving_object(rng, stairs(rng), path, nearest=NEAREST_OBJECT)]


def _draw_object_motion(
    rng: np.random.Generator, centre: np.ndarray, is_relative: bool
) -> np.ndarray:
    """Draw the motion (4, 4) of an object at ``centre`` (3,), metres.

    ``is_relative``: beside the camera's motion; then little of
    it is left in the image.
    """
    z = centre[2]
    strength = log_uniform(rng, (0.03, 1.0)) if is_relative else 1.0
    length = log_uniform(rng, (0.003, 0.07)) * z
    t = length * rng.standard_normal(3) * (1, 0.7, 0.7)
    angle_deg = strength * log_uniform(rng, (0.15, 6.0))
    return rotation_about(rotation_by(rng, angle_deg), centre, strength * t)


class _CameraView(NamedTuple):
    """A camera and its view."""

    camera: Camera
    view: np.ndarray  # tangents of half the fields of view, (x, y)


def _draw_camera(rng: np.random.Generator, height: int, width: int) -> _CameraView:
    """Draw a camera of 34 to 100 degrees."""
    tan_x = np.tan(np.radians(rng.uniform(34, 100) / 2))
    aspect = log_uniform(rng, (0.8, 1.25)) if rng.random() < 0.3 else 1.0
    centre = np.array([width - 1, height - 1]) / 2
    u, v = centre + rng.normal(0, 0.03, 2) * width
    fx = width / 2 / tan_x
    fy = aspect * width / 2 / tan_x
    view = np.array([tan_x, tan_x * height / width / aspect])
    return _CameraView(Camera(fx, fy, u, v, height=height, width=width), view)


def _draw_camera_motion(rng: np.random.Generator, is_street: bool) -> np.ndarray:
    """Draw the camera's motion (4, 4) T_world_cam of the second frame."""
    # some cameras do not turn, some do not translate, a third moves along its axis
    moves, turns, ahead = rng.random(3) < (0.95, 0.95, 0.3)
    angle = np.radians(log_uniform(rng, (0.1, 6.0)))
    length = log_uniform(rng, (0.005, 0.25))
    sizes = np.repeat([length * moves, 0.6 * angle * turns], 3)
    step = sizes * rng.standard_normal(6)
    if is_street and rng.random() < 0.7:
        # driven along the street, by up to the camera's height
        step = 0.05 * rng.standard_normal(6) * (0.3, 0.3, 0, 0.1, 0.4, 0.1)
        step[2] = log_uniform(rng, (0.05, 1.6))
        ahead = False
    return se3_exp(step * (0.3, 0.2, 1, 1, 1, 1) if ahead else step)


def training_scene(
    rng: np.random.Generator,
    height: int,
    width: int,
    many_objects_fraction: float = 0.25,
    conveyor_fraction: float = 0.0,
) -> Scene:
    """Draw a scene of two frames.

    Args:
        rng: the source of randomness.
        height: rows of the images.
        width: columns of the images.
        many_objects_fraction: fraction of the scenes with moving objects in
            which there are four to ten.
        conveyor_fraction: fraction of the scenes with an escalator or a conveyor in place of
            the usual objects.
    """
    camera, view = _draw_camera(rng, height, width)
    surroundings = _Surroundings(rng, view)
    T = _draw_camera_motion(rng, surroundings.is_street)
    light = rng.standard_normal(3) * (1, 0.5, 1) - (0, 0.8, 0)
    noise = float(rng.choice([0.0, rng.uniform(0, 4)]))
    path = np.stack([np.eye(4), T])
    solids = tuple(surroundings.solids)
    texture_seed = int(rng.integers(2**31))
    scene = Scene(camera, path, solids, texture_seed, tuple(light.tolist()), noise)

    if conveyor_fraction and rng.random() < conveyor_fraction:
        fraction = rng.uniform(0.25, 0.7)
        scene = populate(
            scene, _draw_conveyor(rng, view), fraction, SIZE_LIMITS
        ).scene
        return _scaled(scene, log_uniform(rng, (0.2, 3.0)))
    small = rng.uniform(0, 0.3)
    large = rng.uniform(0.3, 0.87)
    fraction = float(rng.choice([0.0, small, large], p=[0.06, 0.3, 0.64]))
    if fraction:
        objects = _draw_objects(rng, view, T, many_objects_fraction)
        scene = populate(scene, objects, fraction, SIZE_LIMITS).scene
    # from a desk to a street
    return _scaled(scene, log_uniform(rng, (0.2, 3.0)))


def _scaled(scene: Scene, scale: float) -> Scene:
    """The scene with all lengths times ``scale``."""
    path = scene.T_world_cam.copy()
    path[:, :3, 3] *= scale
    solids = []
    for solid in scene.solids:
        A = scale * solid.A_world_body
        wavelength = scale * solid.wavelength
        solids.append(replace(solid, A_world_body=A, wavelength=wavelength))
    return replace(scene, T_world_cam=path, solids=tuple(solids))


# --- pairs ------------------------------------------------------------------------


class RenderedPair(NamedTuple):
    """A rendered pair: two images without depth, and the ground truth."""

    images: list[Frame]
    depth: list[np.ndarray]  # (H, W) metres, of both frames
    flow: np.ndarray  # (H, W, 2) px, of everything
    T_curr_prev: np.ndarray
    moving: np.ndarray  # (H, W) bool


def render_pair(scene: Scene, images: bool = True) -> RenderedPair:
    """Render the two frames of a scene, with images where these are wanted."""
    camera = scene.camera
    T = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
    rgb = [scene.render(k).rgb if images else None for k in (0, 1)]
    depth = [scene.depth(k) for k in (0, 1)]
    flow, on_object = scene.flow(0)
    # only pixels whose flow the camera alone does not explain count as moving
    ego_flow = camera_flow(camera.K, depth[0], T).flow
    difference = np.square(np.nan_to_num(flow) - ego_flow).sum(axis=2)
    moving = on_object & (difference > (MOVING_PX * camera.width / 1024) ** 2)
    frames = [Frame(image, None, camera) for image in rgb]
    return RenderedPair(frames, depth, flow, T, moving)


def scene_pairs(
    rng: np.random.Generator,
    height: int,
    width: int,
    images: bool = True,
) -> dict[str, KnownPair]:
    """Draw a scene as pairs by the name of their flow.

    Args:
        rng: the source of randomness.
        height: rows of the images.
        width: columns of the images.
        images: whether images are rendered and DIS flow is computed.

    Returns:
        ``rendered``, with true or noisy flow, and with images also ``dis``.
    """
    rendered = render_pair(training_scene(rng, height, width), images)
    T = rendered.T_curr_prev
    true_depth = rendered.depth
    flow = rendered.flow
    moving = rendered.moving

    depth = true_depth
    if rng.random() < 0.5:
        depth = degrade_depth(rng, true_depth)
    has_second_depth = rng.random() > 0.1
    if rng.random() < 0.3:
        outliers = rng.uniform(0, 0.3) if rng.random() < 0.5 else 0.0
        flow = draw_noisy_flow(rng, flow, outliers)

    prev = replace(rendered.images[0], depth=depth[0])
    curr = replace(rendered.images[1], depth=depth[1] if has_second_depth else None)
    pairs = {}
    if images:
        field = dis_flow()(prev, curr)
        estimated = FramePair(prev, curr, field.flow, field.variance, field.valid)
        pairs["dis"] = KnownPair(estimated, T, true_depth[0], moving)
    if rng.random() < 0.4:
        # as for users who have flow and depth, but no images
        prev = replace(prev, rgb=None)
        curr = replace(curr, rgb=None)
    exact = FramePair(prev, curr, np.ascontiguousarray(flow))
    return {"rendered": KnownPair(exact, T, true_depth[0], moving)} | pairs


def undetermined_pair(
    rng: np.random.Generator, height: int, width: int
) -> KnownPair:
    """Draw a pair without a right answer: every part of the
    image moves in its own way.
    """
    scene = training_scene(rng, height, width)
    camera = scene.camera
    depth = scene.depth(0)

    # parts by a quantile of the column, the row or a smooth field
    count = int(rng.integers(2, 9))
    v, u = np.indices(camera.shape)
    smooth = smooth_field(rng, camera.shape, int(rng.integers(2, 8)))
    field = (u, v, smooth)[int(rng.integers(3))]
    edges = np.quantile(field, np.linspace(0, 1, count + 1)[1:-1])
    part = np.digitize(field, edges)

    has_depth = depth > 0
    middle = float(np.median(depth[has_depth])) if has_depth.any() else 1.0
    length = log_uniform(rng, (0.003, 0.1)) * middle
    angle = log_uniform(rng, (0.002, 0.05))
    limit = np.repeat([length, angle], 3)
    flow = np.full((*camera.shape, 2), np.nan, np.float32)
    for k in range(count):
        size = rng.uniform(0.5, 1.0, 6)
        motion = se3_exp(size * rng.choice([-1.0, 1.0], 6) * limit)
        flow[part == k] = camera_flow(camera.K, depth, motion).flow[part == k]
    if rng.random() < 0.5:
        flow = draw_noisy_flow(rng, flow, 0.0)
    pair = FramePair(Frame(None, depth, camera), Frame(None, None, camera), flow)
    return KnownPair(pair, np.eye(4), depth, np.ones(camera.shape, bool))


@option_group
class DiverseOptions:
    """Options of the diverse preset, which draws training pairs of rendered scenes.

    A fraction ``dis_share`` of the pairs is rendered and gets OpenCV's DIS flow. The
    others have true or noisy flow and are drawn about ten times as fast.
    """

    height: Annotated[int, Field(ge=32)] = 128
    width: Annotated[int, Field(ge=32)] = 256
    dis_share: Fraction = 0.0
    preset: Literal["diverse"] = "diverse"

    def sample(self, rng: np.random.Generator) -> Sample:
        """Draw one pair, whose flow is NaN where it is unknown."""
        images = rng.random() < self.dis_share
        pairs = scene_pairs(rng, self.height, self.width, images)
        known = pairs["dis" if images else "rendered"]
        pair = known.pair
        assert pair.flow is not None and pair.prev.depth is not None
        K = pair.prev.camera.K
        T = known.T_curr_prev

        valid = np.isfinite(pair.flow).all(axis=-1)
        if pair.flow_valid is not None:
            valid &= pair.flow_valid
        flow = np.where(valid[..., None], pair.flow, np.nan).astype(np.float32)
        ego_flow, depth_ratio = camera_flow(K, known.depth, T)
        depth_curr = pair.curr.depth
        if depth_curr is None:
            depth_curr = np.zeros_like(known.depth)
        return Sample(
            flow=flow,
            ego_flow=ego_flow,
            depth_prev=pair.prev.depth,
            depth_curr=sample_at(depth_curr, np.nan_to_num(flow)),
            depth_true=known.depth,
            depth_target=np.maximum(known.depth * depth_ratio, 0),
            K=K.astype(np.float32),
            T_curr_prev=T.astype(np.float32),
            moving=known.moving,
        )
