"""Training pairs by the paper's five steps (section 3.4; samplers as published).

1. intrinsics; 2. depth: a constant background and five constant objects; 3. camera and object
motions; 4. the rigid flow of each; 5. composition, nearest in front, **adding** the flow of an
object's own motion to the flow of the camera. Motions are drawn from distributions with a narrow
core and a heavy tail. Depth of t+1 is that of the moved point, on the pixel grid of t.

Deliberate differences from the published generator: silhouettes are procedural (its photographs
are a download of a third party), and a sample depends on nothing but its generator.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import euler_deg_to_matrix, make_transform
from hybridvo.synthetic.layered import Layers, Sample
from hybridvo.synthetic.silhouettes import silhouette_mask

MAX_REJECTIONS = 10_000


@dataclass(frozen=True)
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
    tail_std: float
    power: float
    tail_probability: float
    low: float
    high: float
    core_std: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InputError(f"TailSampler: expected low < high, got {self.low} and {self.high}.")
        if not (self.tail_std > 0 and self.core_std > 0 and self.power > 0):
            raise InputError("TailSampler: expected positive tail_std, core_std and power.")
        if not 0 <= self.tail_probability <= 1:
            raise InputError(
                f"TailSampler: expected a tail_probability in [0, 1], got {self.tail_probability}."
            )

    def draw(self, rng: np.random.Generator, low: float | None = None) -> float:
        """One value; ``low`` replaces the lower limit where the scene demands it.

        Raises:
            InputError: limits that the distribution practically never meets.
        """
        low = self.low if low is None else low
        tail = rng.random() < self.tail_probability
        spread = self.tail_std if tail else self.core_std
        for _ in range(MAX_REJECTIONS):
            value = self.mean + spread * rng.standard_normal()
            if tail:
                value = np.sign(value) * abs(value) ** self.power
            if low <= value <= self.high:
                return float(value)
        raise InputError(
            f"TailSampler: no draw of {self} fell into [{low}, {self.high}] in {MAX_REJECTIONS}."
        )


def _rotation() -> tuple[TailSampler, TailSampler, TailSampler]:
    return (
        TailSampler(0.0, 1.5, 2.5, 0.15, -9.0, 9.0, 0.2),
        TailSampler(0.0, 2.0, 2.0, 0.15, -9.0, 9.0, 0.2),
        TailSampler(0.0, 1.5, 2.5, 0.15, -8.0, 8.0, 0.2),
    )


def _translation() -> tuple[TailSampler, TailSampler, TailSampler]:
    return (
        TailSampler(0.0, 0.4, 2.5, 0.15, -0.7, 0.7, 0.03),
        TailSampler(0.0, 0.25, 2.0, 0.2, -0.4, 0.4, 0.025),
        TailSampler(0.0, 1.8, 2.5, 0.15, -5.0, 5.0, 0.02),
    )


@dataclass(frozen=True)
class MotionSamplers:
    """Samplers of one rigid motion (step 3): the same for the camera and the objects.

    Args:
        rotation_deg: Euler angles X, Y, Z in degrees, R = Rx Ry Rz.
        translation: X, Y, Z in metres.
        backward_share: the Z translation is at least minus this share of the depth that moves, so
            that nothing is carried through the image plane.
    """

    rotation_deg: tuple[TailSampler, TailSampler, TailSampler] = field(default_factory=_rotation)
    translation: tuple[TailSampler, TailSampler, TailSampler] = field(default_factory=_translation)
    backward_share: float = 0.2

    def draw(self, rng: np.random.Generator, depth: float) -> tuple[np.ndarray, np.ndarray]:
        """Euler angles (3,) in degrees and translation (3,) in metres of a thing at this depth."""
        angles = np.array([sampler.draw(rng) for sampler in self.rotation_deg])
        x, y, z = self.translation
        low = max(z.low, -self.backward_share * depth)
        return angles, np.array([x.draw(rng), y.draw(rng), z.draw(rng, low)])


@dataclass(frozen=True)
class PaperOptions:
    """Options of the five steps; the defaults are the published ones.

    Args:
        height, width: size of the sample in pixels.
        full_height, full_width: image size that focal lengths refer to.
        focal: sampler of the position between ``focal_low`` and ``focal_high``.
        focal_low, focal_high: focal length in pixels of the full image.
        background_depth: sampler of the position between ``background_low`` and
            ``background_high`` metres.
        background_far_probability: share of backgrounds drawn uniformly between
            ``background_high`` and ``background_far`` metres instead.
        object_depth: sampler of the position between f / ``object_near_divisor`` metres and the
            background.
        objects: number of objects.
        move_probability: share of the objects that move; the others are static occluders.
        object_size: mean, spread, least and largest side of an object's square, as a share of the
            width.
        canvas_margin: objects are placed uniformly on a canvas that is larger by this share of the
            picture on every side.
        motion: samplers of camera and object motions.

    Raises:
        InputError: sizes, limits or probabilities that cannot be meant.
    """

    height: int = 128
    width: int = 256
    full_height: int = 436
    full_width: int = 1024
    focal: TailSampler = TailSampler(0.03, 0.5, 2.0, 0.4, 0.0, 1.0, 0.08)
    focal_low: float = 576.0
    focal_high: float = 3200.0
    background_depth: TailSampler = TailSampler(0.6, 0.2, 2.0, 0.5, 0.0, 1.0, 0.1)
    background_low: float = 1.0
    background_high: float = 80.0
    background_far_probability: float = 0.1
    background_far: float = 3200.0
    object_depth: TailSampler = TailSampler(0.6, 0.6, 1.5, 0.4, 0.0, 1.0, 0.2)
    object_near_divisor: float = 5200.0
    objects: int = 5
    move_probability: float = 0.6
    object_size: tuple[float, float, float, float] = (0.55, 0.2, 0.25, 0.7)
    canvas_margin: float = 0.25
    motion: MotionSamplers = MotionSamplers()

    def __post_init__(self) -> None:
        for name in ("height", "width", "full_height", "full_width"):
            if getattr(self, name) < 2:
                raise InputError(f"PaperOptions.{name}: expected at least 2 pixels.")
        for name in ("background_far_probability", "move_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"PaperOptions.{name}: expected a probability in [0, 1].")
        if not 0 < self.focal_low <= self.focal_high:
            raise InputError("PaperOptions: expected 0 < focal_low <= focal_high.")
        if not 0 < self.background_low < self.background_high <= self.background_far:
            raise InputError(
                "PaperOptions: expected 0 < background_low < background_high <= background_far."
            )
        if not (0 <= self.objects <= 64 and 0 <= self.canvas_margin <= 4):
            raise InputError("PaperOptions: expected 0..64 objects and a canvas_margin in 0..4.")
        mean, spread, low, high = self.object_size
        if not (0 < low < high <= 1 and spread > 0 and low - 3 * spread < mean < high + 3 * spread):
            raise InputError(
                "PaperOptions.object_size: expected (mean, spread, low, high) with 0 < low < high "
                f"<= 1, got {self.object_size}."
            )

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair: :func:`paper_sample`."""
        return paper_sample(rng, self)


def paper_sample(rng: np.random.Generator, options: PaperOptions = PaperOptions()) -> Sample:
    """One pair by the paper's five steps.

    Args:
        rng: source of randomness; the sample depends on nothing else.
        options: defaults to the published configuration.
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
