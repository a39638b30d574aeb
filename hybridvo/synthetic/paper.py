"""Training pairs by the paper's five steps (section 3.4; samplers as published).

1. intrinsics; 2. depth: a constant background and five constant objects; 3. camera and object
motions; 4. the rigid flow of each; 5. composition, nearest in front, **adding** the flow of an
object's own motion to the flow of the camera. Motions are drawn from distributions with a narrow
core and a heavy tail. Depth of t+1 is that of the moved point, on the pixel grid of t.

Deliberate differences from the published generator: silhouettes are procedural (its photographs
are a download of a third party), and a sample depends on nothing but its generator.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from hybridvo.errors import InputError
from hybridvo.geometry import euler_deg_to_matrix, make_transform
from hybridvo.options import Positive, Share, option_group
from hybridvo.synthetic.layered import Layers, Sample
from hybridvo.synthetic.silhouettes import silhouette_mask


@option_group
class TailSampler:
    """Normal core with a heavy tail, truncated to an interval by rejection.

    With ``tail_probability`` the value is sign(g) |g|^power, g ~ N(mean, tail_std), otherwise
    N(mean, core_std); the branch is chosen once, then values outside [low, high] are drawn again.

    Args:
        mean: mean of both normals.
        tail_std, power: spread of the tail's normal and the power that stretches it.
        tail_probability: share of the draws that come from the tail.
        low, high: limits of the value.
        core_std: spread of the core.

    Raises:
        InputError: limits in the wrong order, a negative spread or a probability outside [0, 1].
    """

    mean: float
    tail_std: Positive
    power: Positive
    tail_probability: Share
    low: float
    high: float
    core_std: Positive

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InputError(f"expected low < high, got {self.low} and {self.high}")

    def draw(self, rng: np.random.Generator, low: float | None = None) -> float:
        """One value; ``low`` replaces the lower limit where the scene demands it.

        Raises:
            InputError: limits that the distribution practically never meets.
        """
        low = self.low if low is None else low
        tail = rng.random() < self.tail_probability
        spread = self.tail_std if tail else self.core_std
        for _ in range(10_000):
            value = self.mean + spread * rng.standard_normal()
            if tail:
                value = np.sign(value) * abs(value) ** self.power
            if low <= value <= self.high:
                return float(value)
        raise InputError(
            f"TailSampler: none of 10 000 draws of {self} fell into [{low}, {self.high}]."
        )


ThreeSamplers = tuple[TailSampler, TailSampler, TailSampler]
ROTATION: ThreeSamplers = (
    TailSampler(0.0, 1.5, 2.5, 0.15, -9.0, 9.0, 0.2),
    TailSampler(0.0, 2.0, 2.0, 0.15, -9.0, 9.0, 0.2),
    TailSampler(0.0, 1.5, 2.5, 0.15, -8.0, 8.0, 0.2),
)
TRANSLATION: ThreeSamplers = (
    TailSampler(0.0, 0.4, 2.5, 0.15, -0.7, 0.7, 0.03),
    TailSampler(0.0, 0.25, 2.0, 0.2, -0.4, 0.4, 0.025),
    TailSampler(0.0, 1.8, 2.5, 0.15, -5.0, 5.0, 0.02),
)


@option_group
class MotionSamplers:
    """Samplers of one rigid motion (step 3): the same for the camera and the objects.

    Args:
        rotation_deg: Euler angles X, Y, Z in degrees, R = Rx Ry Rz.
        translation: X, Y, Z in metres.
        backward_share: the Z translation is at least minus this share of the depth that moves, so
            that nothing is carried through the image plane.
    """

    rotation_deg: ThreeSamplers = ROTATION
    translation: ThreeSamplers = TRANSLATION
    backward_share: Share = 0.2

    def draw(self, rng: np.random.Generator, depth: float) -> tuple[np.ndarray, np.ndarray]:
        """Euler angles (3,) in degrees and translation (3,) in metres of a thing at this depth."""
        angles = np.array([sampler.draw(rng) for sampler in self.rotation_deg])
        x, y, z = self.translation
        low = max(z.low, -self.backward_share * depth)
        return angles, np.array([x.draw(rng), y.draw(rng), z.draw(rng, low)])


Pixels = Annotated[int, Field(ge=2)]


@option_group
class PaperOptions:
    """Options of the five steps; the defaults are the published ones.

    Units and reasons stand in ``configs/data_paper.yaml``.

    Raises:
        InputError: sizes, limits or probabilities that cannot be meant.
    """

    height: Pixels = 128
    width: Pixels = 256
    full_height: Pixels = 436
    full_width: Pixels = 1024
    focal: TailSampler = TailSampler(0.03, 0.5, 2.0, 0.4, 0.0, 1.0, 0.08)
    focal_low: Positive = 576.0
    focal_high: Positive = 3200.0
    background_depth: TailSampler = TailSampler(0.6, 0.2, 2.0, 0.5, 0.0, 1.0, 0.1)
    background_low: Positive = 1.0
    background_high: Positive = 80.0
    background_far_probability: Share = 0.1
    background_far: Positive = 3200.0
    object_depth: TailSampler = TailSampler(0.6, 0.6, 1.5, 0.4, 0.0, 1.0, 0.2)
    object_near_divisor: Positive = 5200.0
    objects: Annotated[int, Field(ge=0, le=64)] = 5
    move_probability: Share = 0.6
    object_size: tuple[float, Positive, Positive, Share] = (0.55, 0.2, 0.25, 0.7)
    canvas_margin: Annotated[float, Field(ge=0, le=4)] = 0.25
    motion: MotionSamplers = MotionSamplers()

    def __post_init__(self) -> None:
        if not self.focal_low <= self.focal_high:
            raise InputError("expected focal_low <= focal_high")
        if not self.background_low < self.background_high <= self.background_far:
            raise InputError("expected background_low < background_high <= background_far")
        mean, spread, low, high = self.object_size
        if not (low < high and low - 3 * spread < mean < high + 3 * spread):
            raise InputError(
                f"object_size: expected (mean, spread, low, high) with low < high, got "
                f"{self.object_size}"
            )

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair: :func:`paper_sample`."""
        return paper_sample(rng, self)


def paper_sample(rng: np.random.Generator, options: PaperOptions) -> Sample:
    """One pair by the paper's five steps.

    Args:
        rng: source of randomness; the sample depends on nothing else.
        options: sizes and distributions.
    """
    o = options
    # Step 1. The published code resizes corner to corner, hence fx != fy at 128x256.
    f = o.focal_low + o.focal.draw(rng) * (o.focal_high - o.focal_low)
    fx = f * (o.width - 1) / (o.full_width - 1)
    fy = f * (o.height - 1) / (o.full_height - 1)
    K = np.array([[fx, 0, (o.width - 1) / 2], [0, fy, (o.height - 1) / 2], [0, 0, 1]])

    # Step 2.
    if rng.random() < o.background_far_probability:
        background = rng.uniform(o.background_high, o.background_far)
    else:
        span = o.background_high - o.background_low
        background = o.background_low + o.background_depth.draw(rng) * span
    near = f / o.object_near_divisor
    depths = [
        near + o.object_depth.draw(rng) * (background - near) if background > near else background
        for _ in range(o.objects)
    ]
    layers = Layers(K, np.full((o.height, o.width), 1.0 / background, np.float32))
    for depth in depths:
        box, mask = _place(rng, o)
        layers.lay(box, mask, float(np.float32(1.0 / depth)))

    # Step 3.
    angles, t = o.motion.draw(rng, min(depths, default=background))
    T = make_transform(euler_deg_to_matrix(angles), t)
    for number, depth in enumerate(depths):
        if rng.random() < o.move_probability:
            own_angles, own_t = o.motion.draw(rng, depth)
            layers.motions[number] = make_transform(euler_deg_to_matrix(own_angles), own_t)

    # Steps 4 and 5.
    ego_flow, _, flow, ratio = layers.flows(T, added=True)
    moving = [number for number, motion in enumerate(layers.motions) if motion is not None]
    depth_prev = 1.0 / layers.rho
    depth_curr = np.maximum(depth_prev * ratio, 0.0)
    return Sample(
        flow=flow,
        ego_flow=ego_flow,
        depth_prev=depth_prev,
        depth_curr=depth_curr,
        depth_true=depth_prev,
        depth_target=depth_curr,
        K=K.astype(np.float32),
        T_curr_prev=T.astype(np.float32),
        rotation_deg=angles.astype(np.float32),
        translation=t.astype(np.float32),
        moving=np.isin(layers.owner, moving),
    )


def _place(rng: np.random.Generator, o: PaperOptions) -> tuple[tuple[slice, slice], np.ndarray]:
    """A silhouette at a uniform position of the canvas: its box in the picture and its mask."""
    mean, spread, low, high = o.object_size
    share = low - 1.0
    while not low <= share <= high:
        share = mean + spread * rng.standard_normal()
    mask = silhouette_mask(rng, max(int(o.width * share), 2))
    if rng.random() < 0.5:
        mask = mask[:, ::-1]
    margins = int(o.height * o.canvas_margin), int(o.width * o.canvas_margin)
    box = []
    crop = []
    for size, margin, extent in zip((o.height, o.width), margins, mask.shape, strict=True):
        start = int(rng.integers(0, max(size + 2 * margin - extent, 0) + 1)) - margin
        first, last = max(start, 0), min(start + extent, size)
        last = max(first, last)
        box.append(slice(first, last))
        crop.append(slice(first - start, last - start))
    return (box[0], box[1]), mask[crop[0], crop[1]]
