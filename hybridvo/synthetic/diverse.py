"""Training pairs of rendered scenes, of other families than those that methods are measured on.

In streets, halls, hills, before walls and tables, the bodies of :mod:`hybridvo.synthetic.bodies`
move alone or together, freely or followed by the camera.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field
from scipy.spatial.transform import Rotation

from hybridvo.flow import dis_flow
from hybridvo.geometry import invert, make_transform, se3_exp
from hybridvo.options import Share, option_group
from hybridvo.synthetic.bodies import BODIES, SHAPES, Mover, draw_look, mover
from hybridvo.synthetic.draws import (
    about,
    affine,
    any_turn,
    carried,
    log_uniform,
    smooth_field,
    turn,
)
from hybridvo.synthetic.layered import KnownPair, Sample, camera_flow
from hybridvo.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.synthetic.render import Scene, Solid
from hybridvo.synthetic.scenes import sized
from hybridvo.synthetic.sensors import degrade_depth, noisy_flow, sample_at
from hybridvo.types import Camera, Frame, FramePair

AT_CAMERA = np.eye(4)  # the frame of the first camera, which is the world


class _Surroundings:
    """What stands still, metres. ``view``: tangents of half the fields of view, (x, y)."""

    def __init__(self, rng: np.random.Generator, view: np.ndarray) -> None:
        self.rng = rng
        self.view = view
        self.solids: list[Solid] = []
        kinds = (
            self.street,
            self.street,
            self.hall,
            self.hills,
            self.wall,
            self.table,
        )
        chosen = int(rng.integers(len(kinds)))
        self.is_street = chosen < 2
        kinds[chosen]()
        # things close to the camera, of which one can fill half of the image
        self.scatter(4 * rng.random() ** 2, SHAPES, 0.04, 1.0, (1.3, 4.0))

    def add(
        self,
        half: ArrayLike,
        centre: ArrayLike,
        T: np.ndarray = AT_CAMERA,
        contrast: float = 1.0,
    ) -> None:
        """Add a box of half axes ``half`` about a centre, in the frame ``T``."""
        look = draw_look(self.rng)
        base, other = look["colours"]
        look["colours"] = base, base + contrast * (other - base)
        self.solids.append(Solid(BOX, carried(T, affine(half, centre)), **look))

    def scatter(
        self,
        count: float,
        shapes: tuple[int, ...],
        low: ArrayLike,
        high: ArrayLike,
        depths: tuple[float, float],
        floor: float | None = None,
        reach: tuple[float, float] | np.ndarray | None = None,
        T: np.ndarray = AT_CAMERA,
    ) -> None:
        """Add things of half axes ``low`` to ``high`` between two depths, in the frame ``T``.

        They lie within ``reach`` (x, y), by default the view; upright on a floor at this y, or
        turned anyhow in the air.
        """
        rng = self.rng
        for _ in range(round(count)):
            half = np.exp(rng.uniform(np.log(low), np.log(high), 3))
            z = rng.uniform(*depths) + half.max()
            R = any_turn(rng)
            x, y = rng.uniform(-1.1, 1.1, 2) * np.asarray(
                self.view * z if reach is None else reach
            )
            if floor is not None:
                y = floor - half[1]
                R = Rotation.from_euler("y", rng.uniform(0, 1.5)).as_matrix()
            A = carried(T, affine(half, (x, y, z), R))
            self.solids.append(Solid(int(rng.choice(shapes)), A, **draw_look(rng)))

    def street(self) -> None:
        """Add the ground, rows of houses and poles, open to the sky."""
        floor = self.rng.uniform(1.2, 2.2)
        side = self.rng.uniform(8, 13)
        # of the road: flow stops on bare ones
        contrast = log_uniform(self.rng, (0.03, 1.0))
        self.add((80, 0.5, 80), (0, floor + 0.5, 60), contrast=contrast)
        for x in (-side, side):
            row = make_transform(np.eye(3), np.array([x, 0, 0]))
            self.scatter(
                12,
                (BOX,),
                (1.5, 1.5, 1),
                (3.5, 7, 4),
                (0, 45),
                floor,
                (1.5, 0),
                row,
            )
        poles = (0.05, 1.5, 0.05), (0.12, 3.5, 0.12)
        self.scatter(self.rng.uniform(0, 7), (CYLINDER,), *poles, (0, 25), floor)

    def hall(self) -> None:
        """Add a closed room with columns and benches, and lamps in the air."""
        rng = self.rng
        low = -rng.uniform((3, 2, 4), (9, 5, 4.1))
        high = rng.uniform((3, 1, 7), (9, 2.2, 26))
        self.add((high - low) / 2, (high + low) / 2)
        tall = (high[1] - low[1]) / 2
        reach = (0.8 * min(high[0], -low[0]), 0.7 * low[1])
        far = high[2] - tall
        columns = ((0.1, tall, 0.1), (0.35, tall, 0.35))
        self.scatter(
            rng.uniform(0, 16), (BOX, CYLINDER), *columns, (0, far), high[1], reach
        )
        self.scatter(
            rng.uniform(2, 12), (BOX,), 0.15, 0.7, (2.0, far), high[1], reach
        )
        self.scatter(
            rng.uniform(0, 6), (BOX, ELLIPSOID), 0.1, 0.5, (2.5, far), reach=reach
        )

    def hills(self) -> None:
        """Add mounds under the sky, with stems and crowns of trees."""
        rng = self.rng
        floor = self.rng.uniform(0.8, 2.5)
        self.add((90, 0.5, 90), (0, floor + 0.5, 70))
        self.scatter(
            rng.uniform(4, 11),
            (ELLIPSOID,),
            (2, 0.5, 2),
            (9, 4, 6),
            (4, 45),
            floor + 1,
        )
        self.scatter(
            rng.uniform(0, 10),
            (CYLINDER,),
            (0.1, 1, 0.1),
            (0.15, 2, 0.15),
            (2, 25),
            floor,
        )
        self.scatter(
            rng.uniform(0, 10), (ELLIPSOID,), 0.5, 1.4, (3, 25), floor - 1.5
        )

    def wall(self) -> None:
        """Add one slanted wall with relief, which is all there is to see."""
        rng = self.rng
        z = self.rng.uniform(3, 12)
        angles = rng.normal(0, (15, 25, 90))
        R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        T = make_transform(R, np.array([0, 0, z]))
        self.add((25, 25, 0.3), (0, 0, 0.3), T)
        count = rng.uniform(2, 16)
        reach = self.view * z
        self.scatter(count, SHAPES, 0.1, 0.8, (-0.8, 0.0), reach=reach, T=T)

    def table(self) -> None:
        """Add a table with things on it, seen from above, and a wall behind it."""
        rng = self.rng
        z = self.rng.uniform(2, 5)
        R = Rotation.from_euler("x", rng.uniform(15, 50), degrees=True).as_matrix()
        T = make_transform(R, np.array([0, 0.35 * z, z]))
        self.add((12, 0.1, 3), (0, 0.1, 0), T)
        self.add((20, 12, 0.3), (0, 0, z + rng.uniform(3, 7)))
        count = rng.uniform(4, 18)
        reach = (self.view[0] * z, 0)
        self.scatter(count, SHAPES, 0.08, 0.4, (-1.5, 2.2), 0.0, reach, T)


def _movers(
    rng: np.random.Generator,
    view: np.ndarray,
    T_world_cam: np.ndarray,
    crowds: float,
) -> list[Mover]:
    """Bodies, each with a motion of its own or all with one; ``crowds``: share of four to ten."""
    many = rng.random() < crowds
    count = int(rng.integers(4, 11)) if many else int(rng.integers(1, 4))
    follow, together, alike = rng.random(3) < (0.45, 0.3, 0.5)
    kinds = rng.integers(len(BODIES), size=1 if alike else count)
    own = np.eye(4)
    movers = []
    for number in range(count):
        z = rng.uniform(1.8, 7.0)
        radius = (
            log_uniform(rng, (0.08 if many or number else 0.3, 0.7))
            * np.sqrt(view.prod())
            * z
        )
        centre = np.array([*(rng.uniform(-0.95, 0.95, 2) * view * z), z])
        # flat enough for a large body not to reach the camera
        flat = np.diag(
            [radius, radius, min(rng.uniform(0.4, 1.0) * radius, 0.5 * z)]
        )
        place = make_transform(flat @ any_turn(rng), centre)
        if not (together and number):
            # where the camera goes along, what is left of the motion in the image is small
            left = log_uniform(rng, (0.03, 1.0)) if follow else 1.0
            t = (
                log_uniform(rng, (0.003, 0.07))
                * z
                * rng.standard_normal(3)
                * (1, 0.7, 0.7)
            )
            own = about(
                turn(rng, left * log_uniform(rng, (0.15, 6.0))), centre, left * t
            )
            own = T_world_cam @ own if follow else own
        parts = BODIES[int(kinds[number % len(kinds)])](rng)
        movers.append(
            mover(rng, parts, np.stack([place, own @ place]), nearest=0.4)
        )
    return movers


def training_scene(
    rng: np.random.Generator, height: int, width: int, crowds: float = 0.25
) -> Scene:
    """Draw a scene of two frames; a share ``crowds`` of those with movers has four to ten."""
    spread = np.tan(np.radians(rng.uniform(34, 100) / 2))
    aspect = log_uniform(rng, (0.8, 1.25)) if rng.random() < 0.3 else 1.0
    u, v = np.array([width - 1, height - 1]) / 2 + rng.normal(0, 0.03, 2) * width
    camera = Camera(
        width / 2 / spread, aspect * width / 2 / spread, u, v, height, width
    )
    view = np.array([spread, spread * height / width / aspect])
    surroundings = _Surroundings(rng, view)
    # some cameras do not turn, some do not translate, a third moves along its axis
    moves, turns, ahead = rng.random(3) < (0.95, 0.95, 0.3)
    angle = np.radians(log_uniform(rng, (0.1, 6.0)))
    length = log_uniform(rng, (0.005, 0.25))
    step = np.repeat(
        [length * moves, 0.6 * angle * turns], 3
    ) * rng.standard_normal(6)
    # driven along, by up to its own height
    if surroundings.is_street and rng.random() < 0.7:
        step = 0.05 * rng.standard_normal(6) * (0.3, 0.3, 0, 0.1, 0.4, 0.1)
        step[2] = log_uniform(rng, (0.05, 1.6))
        ahead = False
    T = se3_exp(step * (0.3, 0.2, 1, 1, 1, 1) if ahead else step)
    light = rng.standard_normal(3) * (1, 0.5, 1) - (0, 0.8, 0)
    noise = float(rng.choice([0.0, rng.uniform(0, 4)]))
    path = np.stack([np.eye(4), T])
    solids = tuple(surroundings.solids)
    texture = int(rng.integers(2**31))
    scene = Scene(camera, path, solids, texture, tuple(light.tolist()), noise)
    share = rng.choice(
        [0.0, rng.uniform(0, 0.3), rng.uniform(0.3, 0.87)], p=[0.06, 0.3, 0.64]
    )
    if share:
        scene = sized(
            scene, _movers(rng, view, T, crowds), float(share), (0.15, 6.0)
        )[0]
    # scaled as a whole, from a desk to a street
    scale = log_uniform(rng, (0.2, 3.0))
    path[:, :3, 3] *= scale
    scaled = [
        replace(
            x, A_world_body=scale * x.A_world_body, wavelength=scale * x.wavelength
        )
        for x in scene.solids
    ]
    return replace(scene, solids=tuple(scaled))


def scene_pairs(
    rng: np.random.Generator,
    height: int,
    width: int,
    images: bool = True,
    crowds: float = 0.25,
) -> dict[str, KnownPair]:
    """Draw a pair with true or noisy flow (``rendered``) and, with images, DIS flow (``dis``)."""
    scene = training_scene(rng, height, width, crowds)
    camera = scene.camera
    T = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
    rgb = [scene.render(k).rgb if images else None for k in (0, 1)]
    depth = [scene.depth(k) for k in (0, 1)]
    flow, moving = scene.flow(0)
    # only pixels whose flow the camera alone does not explain count as moving
    own = np.nan_to_num(flow) - camera_flow(camera.K, depth[0], T)[0]
    moving &= np.square(own).sum(axis=2) > (0.5 * camera.width / 1024) ** 2
    truth = T, depth[0], moving
    if rng.random() < 0.5:
        depth = degrade_depth(rng, depth)
    second = rng.random() > 0.1
    # noise as in the benchmark's scenarios, but of any strength
    if rng.random() < 0.3:
        share = rng.uniform(0, 0.3) if rng.random() < 0.5 else 0.0
        flow = noisy_flow(
            rng, flow, log_uniform(rng, (0.02, 1.0)), share, 0.06 * width
        )[0]
    prev = Frame(rgb[0], depth[0], camera)
    curr = Frame(rgb[1], depth[1] if second else None, camera)
    pairs = {}
    if images:
        field = dis_flow()(prev, curr)
        estimated = FramePair(prev, curr, field.flow, field.variance, field.valid)
        pairs["dis"] = KnownPair(estimated, *truth)
    if rng.random() < 0.4:  # as for users who have flow and depth, but no images
        prev = replace(prev, rgb=None)
        curr = replace(curr, rgb=None)
    exact = FramePair(prev, curr, np.ascontiguousarray(flow))
    return {"rendered": KnownPair(exact, *truth)} | pairs


def undetermined_pair(
    rng: np.random.Generator, height: int, width: int
) -> KnownPair:
    """Draw a pair without a right answer: every part of the image moves in its own way."""
    scene = training_scene(rng, height, width)
    camera = scene.camera
    depth = scene.depth(0)
    parts = int(rng.integers(2, 9))
    v, u = np.indices(camera.shape)
    field = (u, v, smooth_field(rng, camera.shape, int(rng.integers(2, 8))))[
        int(rng.integers(3))
    ]
    part = np.digitize(
        field, np.quantile(field, np.linspace(0, 1, parts + 1)[1:-1])
    )
    near = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    limit = np.repeat(
        [log_uniform(rng, (0.003, 0.1)) * near, log_uniform(rng, (0.002, 0.05))], 3
    )
    flow = np.full((*camera.shape, 2), np.nan, np.float32)
    for k in range(parts):
        own = se3_exp(rng.uniform(0.5, 1.0, 6) * rng.choice([-1.0, 1.0], 6) * limit)
        flow[part == k] = camera_flow(camera.K, depth, own)[0][part == k]
    if rng.random() < 0.5:
        flow = noisy_flow(
            rng, flow, log_uniform(rng, (0.02, 1.0)), 0.0, 0.06 * width
        )[0]
    pair = FramePair(Frame(None, depth, camera), Frame(None, None, camera), flow)
    return KnownPair(pair, np.eye(4), depth, np.ones(camera.shape, bool))


@option_group
class DiverseOptions:
    """Options of the diverse preset.

    A share ``dis_share`` of the pairs is rendered and gets OpenCV's DIS flow. The others have true
    or noisy flow and are drawn about ten times as fast.
    """

    height: Annotated[int, Field(ge=32)] = 128
    width: Annotated[int, Field(ge=32)] = 256
    dis_share: Share = 0.0
    preset: Literal["diverse"] = "diverse"

    def sample(self, rng: np.random.Generator) -> Sample:
        """Draw one pair, whose flow is NaN where it is unknown."""
        images = rng.random() < self.dis_share
        known = scene_pairs(rng, self.height, self.width, images)[
            "dis" if images else "rendered"
        ]
        pair = known.pair
        T = known.T_curr_prev
        assert pair.flow is not None and pair.prev.depth is not None
        valid = np.isfinite(pair.flow).all(axis=-1)
        if pair.flow_valid is not None:
            valid &= pair.flow_valid
        flow = np.where(valid[..., None], pair.flow, np.nan).astype(np.float32)
        ego_flow, ratio = camera_flow(pair.prev.camera.K, known.depth, T)
        curr = (
            np.zeros_like(known.depth)
            if pair.curr.depth is None
            else pair.curr.depth
        )
        return Sample(
            flow=flow,
            ego_flow=ego_flow,
            depth_prev=pair.prev.depth,
            depth_curr=sample_at(curr, np.nan_to_num(flow)),
            depth_true=known.depth,
            depth_target=np.maximum(known.depth * ratio, 0),
            K=pair.prev.camera.K.astype(np.float32),
            T_curr_prev=T.astype(np.float32),
            moving=known.moving,
        )
