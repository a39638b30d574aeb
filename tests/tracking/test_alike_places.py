"""A path that is lost before one of two places that look alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert
from hybridvo.core.types import Camera
from hybridvo_lab.synthetic.bodies import draw_texture
from hybridvo_lab.synthetic.draws import affine, random_rotation
from hybridvo_lab.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo_lab.synthetic.render import Scene, Solid
from hybridvo_lab.synthetic.slow_scenes import noisy_image
from tests.scripts import load_script

SIZE = (120, 160)
SEED = 1
ELSEWHERE = -0.05
"""The first bay, before which the tracker has never been."""
BORDER = 1.5
"""Between the two that are alike: no other view shows this."""


BAY_WIDTH = 6.0
"""Distance from the middle of one bay to that of the next, metres."""
BAYS = (0, 1, 1, 2)
"""What the bays show, from left to right: two are alike."""
ALIKE = (1, 2)
"""Places of these two in the row."""
WALL_DISTANCE = 5.0
"""Of the wall behind a bay from the camera, metres."""
HALF_HEIGHT = 2.0
THICKNESS = 0.1
"""Of walls, metres."""
THINGS = 9
"""Solids that stand in a bay."""


def row_of_bays(seed: int, positions: np.ndarray, size: tuple[int, int]) -> Scene:
    """Make the bays, and a camera that looks at the wall from N places along the row, in bays."""
    height, width = size
    focal = float(width)
    camera = Camera(
        focal, focal, (width - 1) / 2, (height - 1) / 2, height=height, width=width
    )
    T_world_cam = np.tile(np.eye(4), (len(positions), 1, 1))
    T_world_cam[:, 0, 3] = BAY_WIDTH * np.asarray(positions)
    solids = [
        _moved(solid, BAY_WIDTH * place)
        for place, kind in enumerate(BAYS)
        for solid in _bay(np.random.default_rng([seed, kind]), 100 * kind)
    ]
    return Scene(camera, T_world_cam, tuple(solids), seed=seed)


def _bay(rng: np.random.Generator, pattern: int) -> list[Solid]:
    """A bay at the origin: wall, floor and ceiling, and what stands in it."""
    depth = WALL_DISTANCE / 2
    half_width = BAY_WIDTH / 2
    slabs = [
        ((half_width, HALF_HEIGHT, THICKNESS), (0.0, 0.0, WALL_DISTANCE)),
        ((half_width, THICKNESS, depth), (0.0, HALF_HEIGHT, depth)),
        ((half_width, THICKNESS, depth), (0.0, -HALF_HEIGHT, depth)),
    ]
    solids = [
        Solid(BOX, affine(half, centre), pattern=pattern + k, **draw_texture(rng))
        for k, (half, centre) in enumerate(slabs)
    ]
    for k in range(len(slabs), len(slabs) + THINGS):
        shape = (BOX, ELLIPSOID, CYLINDER)[k % 3]
        half = rng.uniform(0.15, 0.5, 3)
        # none reaches into the next bay
        low = np.array([0.7 - half_width, -1.5, 2.5])
        high = np.array([half_width - 0.7, 1.5, 4.6])
        A = affine(half, rng.uniform(low, high), random_rotation(rng))
        solids.append(Solid(shape, A, pattern=pattern + k, **draw_texture(rng)))
    return solids


def _moved(solid: Solid, x: float) -> Solid:
    """A solid, moved along the row by some metres."""
    A = solid.A_world_body.copy()
    A[0, 3] += x
    return replace(solid, A_world_body=A)


class Walk:
    """A camera along the row of bays."""

    def __init__(self, along: np.ndarray) -> None:
        later = [ALIKE[0] + 0.03, ALIKE[1] + 0.03, BORDER, ELSEWHERE]
        self.positions = np.concatenate([along, later])
        self.scene = row_of_bays(SEED, self.positions, SIZE)
        self.rng = np.random.default_rng(SEED)

    def frame(self, position: float, seconds: float) -> hvo.Frame:
        """What a sensor delivers at a position of the walk, in bays."""
        index = int(np.argmin(np.abs(self.positions - position)))
        seen = self.scene.render(index)
        noise = 0.002 * self.rng.standard_normal(SIZE)
        return replace(
            seen,
            rgb=noisy_image(seen.rgb, self.rng),
            depth=(seen.depth * (1 + noise)).astype(np.float32),
            timestamp=seconds,
            index=None,
        )


@pytest.fixture(scope="module")
def walk() -> Walk:
    return Walk(np.arange(ALIKE[0], ALIKE[1] + 0.4, 0.07))


@pytest.fixture(scope="module")
def state(walk: Walk) -> hvo.odometry.TrackerState:
    """Of a tracker that walked past both, and was then lost before another bay."""
    vo = hvo.Odometry()
    along = walk.positions[:-4]
    for k, position in enumerate(along):
        assert vo.track(walk.frame(position, 0.03 * k)).ok
    step = vo.track(walk.frame(ELSEWHERE, 1.0))
    assert not step.ok
    for seconds in (1.1, 1.2):
        vo.track(walk.frame(ELSEWHERE, seconds))
    return vo.state


@pytest.mark.parametrize("bay", ALIKE)
def test_of_two_places_that_look_alike_none_is_believed(walk, state, bay):
    vo = hvo.Odometry()
    vo.resume(state)
    step = vo.track(walk.frame(bay + 0.03, 2.0))
    assert not step.usable


def test_a_place_that_looks_like_no_other_is_found(walk, state):
    vo = hvo.Odometry()
    vo.resume(state)
    step = vo.track(walk.frame(BORDER, 2.0))
    assert step.ok
    true = BAY_WIDTH * (BORDER - ALIKE[0])
    assert step.T_world_cam[0, 3] == pytest.approx(true, abs=0.05)
    # the factor is from the place that was seen before, not from where the path was lost
    assert step.prev_index < len(walk.positions) - 4
    before = BAY_WIDTH * (walk.positions[step.prev_index] - ALIKE[0])
    assert invert(step.T_curr_prev)[0, 3] == pytest.approx(true - before, abs=0.05)


def there_and_back(walk: Walk) -> list[hvo.Frame]:
    """The frames of a walk past both, and back."""
    along = walk.positions[:-4]
    both_ways = [*along, *along[:-1][::-1]]
    return [walk.frame(each, 0.03 * k) for k, each in enumerate(both_ways)]


def test_a_loop_is_measured_to_each_of_two_places_that_look_alike(walk):
    """The images do not tell them apart; the path does, which loops are not asked about."""
    vo = hvo.Odometry()
    for frame in there_and_back(walk):
        step = vo.track(frame)
        assert step.ok
    x = BAY_WIDTH * walk.positions
    off = [
        x[0] - x[edge.start] - edge.T_start_curr[0, 3]
        for edge in vo.loops(step, apart=8)
    ]
    true = [each for each in off if abs(each) < 0.01]
    elsewhere = [each for each in off if abs(abs(each) - BAY_WIDTH) < 0.01]
    assert true and elsewhere and len(true) + len(elsewhere) == len(off)


@pytest.mark.slow
def test_a_robust_kernel_leaves_out_loops_to_what_only_looks_alike(walk):
    gtsam = pytest.importorskip("gtsam")
    example = load_script("examples/pose_graph_gtsam.py")
    graph, tracked = example.build(there_and_back(walk), hvo.Odometry(), apart=18)
    assert graph.size() > tracked.size()
    found = gtsam.LevenbergMarquardtOptimizer(graph, tracked).optimize()
    moved = [
        found.atPose3(key).translation() - tracked.atPose3(key).translation()
        for key in tracked.keys()
    ]
    assert np.linalg.norm(moved, axis=1).max() < 0.01
