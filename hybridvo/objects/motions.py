"""What does not follow the camera in a frame, told apart by the rigid motions it follows.

Everything stands on a grid over the *current* frame, whose points are sought in the frame before:
what an object uncovers was hidden there, and speaks for nothing. Each point has a price under each
motion, by the flow back to the frame before and by the depth there. The camera's motion is one of
them, those of the objects known are others, and a search in what none of them explains finds more.
A motion is taken where it saves more than it costs; each point then belongs to the cheapest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from hybridvo.core.geometry import (
    adjoint,
    backproject,
    invert,
    pose_matrix,
    project,
    squared_distance,
    transform_points,
    valid_depth,
)
from hybridvo.core.options import Options
from hybridvo.core.results import (
    Motion,
    Reason,
    RelativePose,
    StageFailed,
    Status,
    Step,
)
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.frame_images import blurred
from hybridvo.flow.providers import dis_flow, with_flow
from hybridvo.hypotheses.refit import fit_in_mask
from hybridvo.hypotheses.search import find_motions
from hybridvo.objects.calibration import (
    BEND,
    BY_DEPTH,
    CONTACT,
    CONTACT_STEP,
    COST_LIMIT,
    DEPTH_STEP,
    FLOW_STD,
    FLOW_STD_OF_LENGTH,
    IMAGES_PRIOR_INFLATION,
    KNOWN_PRICE,
    LATTICE,
    LEAST_OF_SEARCHED,
    MIN_MOVING_COST,
    MIN_OBJECT,
    NEW_PRICE,
    OBJECT_FLOW_INFLATION,
    PARTS_OF_ONE,
    PREDICTED_BONUS,
    RIGID_FRACTION,
    SAME_FRACTION,
    SAME_OBJECT,
    SHADOW,
    SMALL_PART,
    STANDING_BONUS,
    SUSPECTED,
)
from hybridvo.solver.calibration import HIDDEN_SIGMAS
from hybridvo.solver.pixels import PixelGrid
from hybridvo.solver.points import Points, grid_index
from hybridvo.solver.refine_flow import Selection, refine_pair
from hybridvo.solver.refine_images import refine_photometric
from hybridvo.solver.visibility import visibility
from hybridvo.tracking.depth_scale import divided
from hybridvo.tracking.memory import AVERAGED_SIDE, likelihood_ratios
from hybridvo.tracking.tracker_state import TrackerState

# Fraction above which a point is as those around it, a part belongs to an object, and a pixel to
# a mask: more than half.
MOST = 0.5

# px around what is looked at: flow needs the surroundings
MARGIN_PX = 24
# motions beside the camera's at most
MAX_MOTIONS = 12
# times at most that a search is made in what is left
SEARCHES = 3
# square of the grid: parts that are so near may be of one object, with something before it
TOUCHING = np.ones((9, 9), np.uint8)
# parts that are so near touch
BESIDE = np.ones((5, 5), np.uint8)
# a point and its neighbours
SQUARE = np.ones((3, 3), np.uint8)
CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
# rows and columns, px, from the middle of a cell at which its depth is sought, in this order
OFFSETS = ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (1, 2), (2, 1), (2, 2))
# m; farther than anything
FAR = 1e6
# guards divisions
TINY = 1e-6


class Earlier(NamedTuple):
    """An earlier frame, and the camera's motion from it."""

    frame: Frame
    T_curr_prev: np.ndarray  # (4, 4)


@dataclass(frozen=True, eq=False)
class GridView:
    """A frame on the grid of a belief, and the frames before that show what moves.

    Attributes:
        frame: the current one, with image and depth.
        before: the frame before.
        far: one farther back, in which slow things were elsewhere; None: there is none.
        depth_noise: standard deviation of log depth.
    """

    frame: Frame
    before: Earlier
    far: Earlier | None = None
    depth_noise: float = 0.0

    @classmethod
    def after(
        cls, before: TrackerState, after: TrackerState, step: Step
    ) -> GridView | None:
        """The view of a frame that was tracked; None where it cannot show what moves.

        Args:
            before: the state of the tracker before the frame.
            after: its state after it.
            step: the frame's, with its motion.
        """
        reference = before.reference
        leads = after.reference is not None and after.gap == 0
        is_found = step.usable and not step.motion.is_by_depth_alone
        if reference is None or not (leads and is_found):
            return None
        # as it was before all lengths grew
        frame = divided(after.known_reference.frame, step.scale_change)
        starts = [*before.keyframes, reference]
        is_relocalized = step.prev_index not in [
            each.frame.index for each in starts
        ]
        if is_relocalized or not (frame.is_rgbd and reference.frame.is_rgbd):
            return None
        T_cam_world = invert(step.T_world_cam)
        kept = {each.count for each in after.keyframes}
        older = [
            each
            for each in before.keyframes
            if each.count in kept and each.count < reference.count
        ]
        far = None
        if older and older[0].frame.depth is not None:
            far = Earlier(older[0].frame, T_cam_world @ older[0].T_world_cam)
        near = Earlier(reference.frame, T_cam_world @ reference.T_world_cam)
        return cls(frame, near, far, step.motion.depth_noise)

    @cached_property
    def points(self) -> Points:
        """The points of the current frame, each where its cell has depth."""
        depth = self.frame.depth
        assert depth is not None
        grid = grid_index(self.frame.camera.shape)
        chosen = grid.copy()
        has_depth = np.zeros(grid.shape[:2], bool)
        last = np.array(depth.shape) - 1
        at_middle = valid_depth(depth[grid[..., 0], grid[..., 1]])
        # depth that was brought to the view of another camera has it on a lattice
        is_lattice = np.mean(at_middle) < LATTICE
        for offset in OFFSETS if is_lattice else OFFSETS[:1]:
            index = np.minimum(grid + offset, last)
            valid = valid_depth(depth[index[..., 0], index[..., 1]]) & ~has_depth
            chosen[valid] = index[valid]
            has_depth |= valid
        cells = np.nonzero(has_depth)
        index = chosen[cells]
        xyz = backproject(depth, self.frame.camera, index)
        return Points(grid.shape[:2], cells, index, xyz)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        return self.points.shape

    @property
    def size(self) -> int:
        """Number of the cells of the grid."""
        return int(np.prod(self.shape))

    @property
    def step(self) -> int:
        """Distance of the cells, px."""
        rows = grid_index(self.frame.camera.shape)[:, 0, 0]
        return int(rows[1] - rows[0]) if len(rows) > 1 else 1

    @cached_property
    def stillness(self) -> np.ndarray:
        """(N,) log ratios by which earlier frames speak for standing still, the least of each."""
        ratios = [
            likelihood_ratios(
                self.points,
                self.frame,
                earlier.frame,
                RelativePose(
                    T_curr_prev=invert(earlier.T_curr_prev),
                    depth_noise=self.depth_noise,
                ),
            )
            for earlier in (self.before, self.far)
            if earlier is not None
        ]
        return np.minimum.reduce(ratios)

    def cells_of(self, points: np.ndarray) -> np.ndarray:
        """(h, w) cells in which points (N, 3), in the current camera, are seen."""
        there = visibility(points, self.frame, self.depth_noise)
        seen = there.is_measured & (np.abs(there.distance) < HIDDEN_SIGMAS)
        depth = np.zeros(self.shape, np.float32)
        column, row = (there.uv[seen] / self.step).astype(int).T
        rows, columns = self.shape
        at = np.minimum(row, rows - 1), np.minimum(column, columns - 1)
        depth[at] = points[seen, 2]
        # what comes nearer spreads, and leaves holes
        closed = cv2.morphologyEx(depth, cv2.MORPH_CLOSE, SQUARE)
        here = self.points.on_grid(self.points.xyz[:, 2])
        is_surface = (here < DEPTH_STEP * closed) & (closed < DEPTH_STEP * here)
        return np.asarray((depth > 0) | ((closed > 0) & is_surface))

    def mask_of(self, cells: np.ndarray) -> np.ndarray:
        """(H, W) float32 pixels of cells (h, w), from 0 to 1 at their border."""
        height, width = self.frame.camera.shape
        rows, columns = self.shape
        fine = cv2.resize(
            cells.astype(np.float32),
            (columns * self.step, rows * self.step),
            interpolation=cv2.INTER_LINEAR,
        )
        missing = (
            (0, max(0, height - fine.shape[0])),
            (0, max(0, width - fine.shape[1])),
        )
        return np.pad(fine, missing, mode="edge")[:height, :width]


class Expected(NamedTuple):
    """An object that is known, as it is expected in the current frame."""

    T_curr_prev: np.ndarray  # (4, 4)
    cells: np.ndarray  # (h, w) bool
    # whether it is so new that it may be a part of another one
    is_new: bool = False


class Fit(NamedTuple):
    """The motion of some cells."""

    T_curr_prev: np.ndarray  # (4, 4)
    covariance: np.ndarray  # (6, 6) of it
    status: Status
    inlier_ratio: float


class Region(NamedTuple):
    """Cells that follow one motion which is not the camera's.

    Attributes:
        cells: (h, w) bool.
        fit: their motion.
        gain: nats a cell by which it is likelier than the camera's.
        trace: nats a cell by which the images alone speak against standing still.
    """

    cells: np.ndarray
    fit: Fit
    gain: float
    trace: float


def moving_regions(
    view: GridView, expected: Sequence[Expected], options: Options, seed: int = 0
) -> list[Region]:
    """Find what moves by itself in a frame.

    Args:
        view: the frame.
        expected: the objects that are known.
        options: the option tree.
        seed: of the search.

    Returns:
        The things found, each with the motion that most of it follows.
    """
    suspected = _suspected(view)
    for each in expected:
        suspected |= each.cells
    if np.count_nonzero(suspected) < MIN_OBJECT * view.size:
        return []
    scene = _FlowedPart.around(view, suspected)
    if scene is None:
        return []
    return _Segmentation(view, scene, expected, options, seed).regions()


def _suspected(view: GridView) -> np.ndarray:
    """(h, w) cells that may move, by images and depth without flow."""
    points = view.points
    cells = points.on_grid(view.stillness < -SUSPECTED) > 0
    return _majority(cells, points.on_grid(np.ones(len(points.xyz))) > 0)


def _majority(cells: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(h, w) cells, those that count, around which most of those that count are so."""
    side = (AVERAGED_SIDE, AVERAGED_SIDE)
    share = cv2.blur((cells & counts).astype(np.float32), side)
    of = cv2.blur(counts.astype(np.float32), side)
    return np.asarray(counts & (share > MOST * np.maximum(of, TINY)))


# -- the flow of a part of the image --------------------------------------------------


class Box(NamedTuple):
    """A part of an image: the first row and column, and those after the last."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Its pixels in an image (H, W)."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def part(self, image: np.ndarray | None) -> np.ndarray | None:
        """This part of an image (H, W, ...), in one piece; None where there is none."""
        return None if image is None else np.ascontiguousarray(image[self.pixels])


def box_of(mask: np.ndarray, margin: int) -> Box:
    """The box around the pixels of a mask (H, W), which are some, and a margin in px.

    >>> mask = np.zeros((60, 80), bool)
    >>> mask[20:30, 5:9] = True
    >>> box_of(mask, 10)
    Box(top=10, left=0, bottom=40, right=19)
    """
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    height, width = mask.shape
    return Box(
        max(0, int(rows[0]) - margin),
        max(0, int(columns[0]) - margin),
        min(height, int(rows[-1]) + 1 + margin),
        min(width, int(columns[-1]) + 1 + margin),
    )


def widened(box: Box, camera: Camera) -> Box:
    """The box, wide enough that its camera's centre lies no farther outside than it is large.

    >>> camera = Camera(300, 300, 159.5, 119.5, height=240, width=320)
    >>> widened(Box(100, 280, 140, 320), camera)
    Box(top=100, left=239, bottom=140, right=320)
    """
    if not (0 <= camera.cy < camera.height and 0 <= camera.cx < camera.width):
        return Box(0, 0, camera.height, camera.width)
    top, bottom = _widened(box.top, box.bottom, camera.cy)
    left, right = _widened(box.left, box.right, camera.cx)
    return Box(top, left, bottom, right)


def with_centre(box: Box, camera: Camera) -> Box:
    """The box, grown to the camera's centre: so every part of it can be widened inside of it.

    >>> camera = Camera(300, 300, 159.5, 119.5, height=240, width=320)
    >>> with_centre(Box(100, 280, 110, 320), camera)
    Box(top=100, left=159, bottom=120, right=320)
    """
    box = widened(box, camera)
    row = min(max(int(camera.cy), 0), camera.height - 1)
    column = min(max(int(camera.cx), 0), camera.width - 1)
    return Box(
        min(box.top, row),
        min(box.left, column),
        max(box.bottom, row + 1),
        max(box.right, column + 1),
    )


def _widened(first: int, last: int, centre: float) -> tuple[int, int]:
    """A range from which a centre is no farther away than it is long, towards the centre."""
    middle = round(centre)
    if centre < first:
        return min(first, (last + middle) // 2 - 1), last
    if centre > last:
        return first, max(last, (first + middle + 1) // 2 + 1)
    return first, last


def cropped(frame: Frame, box: Box) -> Frame:
    """A part of a frame, with the camera of that part."""
    camera = replace(
        frame.camera,
        cx=frame.camera.cx - box.left,
        cy=frame.camera.cy - box.top,
        height=box.bottom - box.top,
        width=box.right - box.left,
    )
    return replace(
        frame,
        rgb=box.part(frame.rgb),
        depth=box.part(frame.depth),
        camera=camera,
        depth_variance=box.part(frame.depth_variance),
        mask=box.part(frame.mask),
    )


def cropped_pair(pair: FramePair, box: Box) -> FramePair:
    """A part of a pair with its flow: the same part of both frames."""
    assert pair.flow is not None
    return replace(
        pair,
        prev=cropped(pair.prev, box),
        curr=cropped(pair.curr, box),
        flow=box.part(pair.flow),
        flow_variance=box.part(pair.flow_variance),
        flow_valid=box.part(pair.flow_valid),
    )


@dataclass(frozen=True, eq=False)
class _FlowedPart:
    """A part of the view with the flow back to the frame before.

    Attributes:
        box: the part.
        pair: from the current frame back to the one before; both are parts.
        inside: (N,) which points of the view lie in the part.
        to: (N, 2) px where the flow leads, in the whole image.
        variance: (N,) px^2; infinite where the flow is not known.
    """

    box: Box
    pair: FramePair
    inside: np.ndarray
    to: np.ndarray
    variance: np.ndarray

    @classmethod
    def around(cls, view: GridView, cells: np.ndarray) -> _FlowedPart | None:
        """The part around some cells; None where it has no flow."""
        box = box_of(view.mask_of(cells) > 0, MARGIN_PX)
        box = with_centre(box, view.frame.camera)
        back = FramePair(
            cropped(view.frame, box), cropped(view.before.frame, box), None
        )
        pair = with_flow(back, dis_flow())
        if pair.flow is None:
            return None
        rows, columns = view.points.pixels.T
        inside = (rows >= box.top) & (rows < box.bottom)
        inside &= (columns >= box.left) & (columns < box.right)
        at = (rows[inside] - box.top, columns[inside] - box.left)
        to = np.zeros((len(rows), 2), np.float32)
        to[inside] = view.points.pixels[inside][:, ::-1] + pair.flow[at]
        variance = np.full(len(rows), np.inf, np.float32)
        known = np.ones(len(at[0]), np.float32)
        if pair.flow_variance is not None:
            known = pair.flow_variance[at]
        if pair.flow_valid is not None:
            known = np.where(pair.flow_valid[at], known, np.inf)
        variance[inside] = known
        return cls(box, pair, inside, to, variance)


# -- which motion a cell follows ------------------------------------------------------


class _Label(NamedTuple):
    """A motion that some cells may follow: what they are labelled with."""

    T_curr_prev: np.ndarray  # (4, 4)
    costs: np.ndarray  # (N,) nats of each point
    expected: np.ndarray | None  # (N,) bool: where the object is expected

    @property
    def price(self) -> float:
        """Nats that it must save, for each cell of the view."""
        return NEW_PRICE if self.expected is None else KNOWN_PRICE

    @property
    def bonus(self) -> np.ndarray | float:
        """(N,) nats in favour of this motion."""
        return 0.0 if self.expected is None else PREDICTED_BONUS * self.expected


class _Piece(NamedTuple):
    """Cells that follow one motion."""

    cells: np.ndarray  # (h, w) bool
    fit: Fit
    owner: int | None  # number of the known object that is expected there


class _Segmentation:
    """The segmentation of a view: its points, each labelled by the motion that it follows."""

    def __init__(
        self,
        view: GridView,
        scene: _FlowedPart,
        expected: Sequence[Expected],
        options: Options,
        seed: int,
    ) -> None:
        self.view = view
        self.scene = scene
        self.options = options
        self.seed = seed
        self.points = view.points
        self.grid = PixelGrid(scene.pair, None, options.refine.coarse_pixels)
        self.counts = self.points.on_grid(scene.inside) > 0
        self.depth = self.points.on_grid(self.points.xyz[:, 2])
        self.stillness = self.points.on_grid(view.stillness)
        width = view.frame.camera.width
        length2 = np.sum((scene.to - self.points.pixels[:, ::-1]) ** 2, axis=1)
        self.flow_variance = (
            FLOW_STD * width
        ) ** 2 + FLOW_STD_OF_LENGTH**2 * length2
        self.camera = self._label(view.before.T_curr_prev)
        self.camera = self.camera._replace(
            costs=self.camera.costs
            - STANDING_BONUS
            - self._averaged(view.stillness)
        )
        self.are_new = [each.is_new for each in expected]
        self.expected = [
            self._label(each.T_curr_prev, each.cells[self.points.cells])
            for each in expected
        ]

    def regions(self) -> list[Region]:
        """The things that move, each with its motion."""
        labels = self._motions()
        pieces = [
            piece
            for label, cells in zip(labels, self._cells(labels), strict=True)
            for piece in self._pieces(label, cells)
        ]
        things = self._whole(self._joined(pieces))
        return [self._region(thing) for thing in things]

    def _motions(self) -> list[_Label]:
        """The motions that the points follow, beside the camera's.

        One motion at first may be a compromise of several. What it does not explain gives further
        ones, and each is fitted again to what it explains best, until nothing is left.
        """
        known = [self._followed(label) for label in self.expected]
        labels = self._worth_it(known)
        for _ in range(SEARCHES):
            found = [self._label(T) for T in self._searched(self._rest(labels))]
            together = self._worth_it([*labels, *found])
            is_new = [any(label is each for each in found) for label in together]
            if not any(is_new):
                break
            refitted = [
                self._refitted(label, cells)
                for label, cells in zip(
                    together, self._followers(together), strict=True
                )
            ]
            labels = self._worth_it(refitted)
        return labels

    # -- what a motion costs ----------------------------------------------------------

    def _label(
        self, T_curr_prev: np.ndarray, expected: np.ndarray | None = None
    ) -> _Label:
        """A motion with what it costs at each point."""
        moved = transform_points(invert(T_curr_prev), self.points.xyz)
        before = self.view.before.frame
        there = visibility(moved, before, self.view.depth_noise)
        apart2 = np.sum((there.uv - self.scene.to) ** 2, axis=1)
        variance = self.scene.variance + self.flow_variance
        by_flow = np.minimum(apart2 / (2 * variance), COST_LIMIT)
        compared = there.is_measured & ~there.is_hidden
        by_depth = np.minimum(there.distance**2 / 2, COST_LIMIT)
        costs = by_flow + np.where(compared, by_depth, 0.0)
        return _Label(T_curr_prev, self._averaged(costs), expected)

    def _averaged(self, values: np.ndarray) -> np.ndarray:
        """(N,) averages over neighbouring points."""
        return self.points.averaged(values, AVERAGED_SIDE, self.scene.inside)

    def _worth_it(self, candidates: Sequence[_Label]) -> list[_Label]:
        """Those of some motions that save more than they cost, the one that saves most first."""
        taken: list[_Label] = []
        left = list(candidates)
        inside = self.scene.inside
        while left:
            least = self._least(taken)
            saved = [
                np.sum(np.maximum(least - each.costs + each.bonus, 0)[inside])
                - each.price * self.view.size
                for each in left
            ]
            best = int(np.argmax(saved))
            if saved[best] < 0 or len(taken) == MAX_MOTIONS:
                break
            taken.append(left.pop(best))
        return taken

    def _least(self, labels: Sequence[_Label]) -> np.ndarray:
        """(N,) least cost of each point under the camera's motion and some others."""
        return np.minimum.reduce(self._costs(labels))

    def _costs(self, labels: Sequence[_Label]) -> list[np.ndarray]:
        """(N,) costs of each point under the camera's motion, then under each of some others."""
        others = [label.costs - label.bonus for label in labels]
        return [self.camera.costs, *others]

    def _cells(self, labels: Sequence[_Label]) -> list[np.ndarray]:
        """(h, w) cells that follow each motion."""
        owner = np.argmin(np.stack(self._costs(labels)), axis=0)
        owner = np.where(self.scene.inside, owner, 0)
        return [
            _majority(self.points.on_grid(owner == number + 1) > 0, self.counts)
            for number in range(len(labels))
        ]

    def _followers(self, labels: Sequence[_Label]) -> list[np.ndarray]:
        """(h, w) cells that each motion explains, and better than the others."""
        return [
            cells & (self.points.on_grid(label.costs < MIN_MOVING_COST) > 0)
            for label, cells in zip(labels, self._cells(labels), strict=True)
        ]

    # -- where motions come from ------------------------------------------------------

    def _rest(self, labels: Sequence[_Label]) -> np.ndarray:
        """(h, w) cells that no motion so far explains."""
        cells = self.points.on_grid(self._least(labels) > MIN_MOVING_COST) > 0
        return _majority(cells, self.counts)

    def _searched(self, cells: np.ndarray) -> list[np.ndarray]:
        """Motions (4, 4) of some cells, from the frame before to the current one."""
        size = self.view.size
        if np.count_nonzero(cells) < MIN_OBJECT * size:
            return []
        grid = PixelGrid(self.scene.pair, self._weights(cells))
        fraction = MIN_OBJECT * size / np.count_nonzero(cells)
        search = replace(
            self.options.search,
            min_inlier_ratio=float(np.clip(fraction, LEAST_OF_SEARCHED, 1.0)),
        )
        options = replace(self.options, search=search)
        starts = np.stack([np.eye(4), invert(self.view.before.T_curr_prev)])
        motions = find_motions(
            grid, np.ascontiguousarray(starts[:, :3]), options, self.seed
        )
        return [invert(pose_matrix(motion.pose)) for motion in motions]

    def _weights(self, cells: np.ndarray) -> np.ndarray:
        """(H, W) weights of the pixels of some cells, in the part of the view with flow."""
        return np.ascontiguousarray(self.view.mask_of(cells)[self.scene.box.pixels])

    def _fitted(self, cells: np.ndarray, T_curr_prev: np.ndarray) -> np.ndarray:
        """The motion (4, 4) that some cells follow, from a start; the start where there is none."""
        mask = self._weights(cells)[self.grid.places]
        pose = invert(T_curr_prev)[:3]
        fit = fit_in_mask(
            self.grid.samples,
            mask,
            self.grid.K,
            np.ascontiguousarray(pose),
            self.options.refine.cutoff,
        )
        if not np.isfinite(fit.pose).all() or fit.inlier_ratio <= 0:
            return T_curr_prev
        return invert(pose_matrix(fit.pose))

    def _followed(self, label: _Label) -> _Label:
        """An object's motion, fitted anew where it is expected."""
        assert label.expected is not None
        cells = self.points.on_grid(label.expected) > 0
        refitted = self._refitted(label, cells)
        there = label.expected
        falls = refitted.costs[there].sum() < label.costs[there].sum()
        return refitted if falls else label

    def _refitted(self, label: _Label, cells: np.ndarray) -> _Label:
        """A motion fitted anew to some cells."""
        T_curr_prev = self._fitted(cells, label.T_curr_prev)
        return self._label(T_curr_prev, label.expected)

    # -- things ------------------------------------------------------------------------

    def _pieces(self, label: _Label, cells: np.ndarray) -> list[_Piece]:
        """The parts of the cells of one motion, apart at steps of depth."""
        surface = self._without_edges(cells)
        _, part = cv2.connectedComponents(surface.astype(np.uint8), connectivity=4)
        parts = [surface & (part == k) for k in range(1, int(part.max()) + 1)]
        parts = [self._grown(each, cells) for each in parts]
        least = MIN_OBJECT * self.view.size
        pieces = [
            self._piece(part, label.T_curr_prev)
            for part in parts
            if np.count_nonzero(part) >= least
        ]
        return [piece for piece in pieces if self._is_no_shadow(piece)]

    def _piece(self, cells: np.ndarray, T_curr_prev: np.ndarray) -> _Piece:
        """Some cells with their motion, refined from a start."""
        inside = cells[self.points.cells]
        shares = [
            float(np.mean(each.expected[inside]))
            for each in self.expected
            if each.expected is not None
        ]
        is_owned = max(shares, default=0.0) > MOST
        owner = int(np.argmax(shares)) if is_owned else None
        return _Piece(cells, self._fit(cells, T_curr_prev), owner)

    def _is_no_shadow(self, piece: _Piece) -> bool:
        """Whether images or depth speak for the motion of a piece; of what is known they need not.

        Beside what moves flow is drawn along.
        """
        if piece.owner is not None:
            return True
        T_camera = self.view.before.T_curr_prev
        by_images, by_depth = self._residuals(piece, piece.fit.T_curr_prev)
        as_camera, depth_as_camera = self._residuals(piece, T_camera)
        return (
            by_images < SHADOW * as_camera or by_depth + BY_DEPTH < depth_as_camera
        )

    def _residuals(
        self, piece: _Piece, T_curr_prev: np.ndarray
    ) -> tuple[float, float]:
        """Mean difference of the images at the cells of a piece, and mean cost of their depth."""
        inside = piece.cells[self.points.cells]
        before = self.view.before.frame
        moved = transform_points(invert(T_curr_prev), self.points.xyz[inside])
        there = visibility(moved, before, self.view.depth_noise)
        seen = there.inside & ~there.is_hidden
        if not seen.any():
            return np.inf, np.inf
        u, v = there.uv[seen].T
        then = cv2.remap(blurred(before), u, v, cv2.INTER_LINEAR).reshape(-1)
        rows, columns = self.points.pixels[inside][seen].T
        residual = then - blurred(self.view.frame)[rows, columns]
        residual -= np.median(residual)
        by_depth = np.minimum(there.distance[seen] ** 2 / 2, COST_LIMIT)
        return float(np.mean(np.abs(residual))), float(np.mean(by_depth))

    def _without_edges(self, cells: np.ndarray) -> np.ndarray:
        """(h, w) cells without those at a step of depth to a neighbour of them that is nearer."""
        known = np.where(cells & (self.depth > 0), self.depth, FAR)
        nearest = cv2.erode(known.astype(np.float32), CROSS)
        return np.asarray(cells & (self.depth < DEPTH_STEP * nearest))

    def _grown(self, part: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """(h, w) a part with the edges around it."""
        wide = cv2.dilate(part.astype(np.uint8), CROSS) > 0
        behind = cv2.dilate(np.where(part, self.depth, 0), CROSS)
        return np.asarray(
            part | (cells & wide & (self.depth < DEPTH_STEP * behind))
        )

    def _joined(self, pieces: list[_Piece]) -> list[_Piece]:
        """Pieces, those that are near and move as one made one.

        Its motion is that of the largest: a small part far from it, taken for its own by mistake,
        would turn it, and make that look sure.
        """
        left = sorted(pieces, key=lambda piece: np.count_nonzero(piece.cells))
        whole: list[_Piece] = []
        while left:
            piece = left.pop(0)
            alike = [
                k for k, other in enumerate(left) if self._are_one(piece, other)
            ]
            if alike:
                other = left[alike[-1]]
                both = other.cells | piece.cells
                owner = piece.owner if other.owner is None else other.owner
                left[alike[-1]] = other._replace(cells=both, owner=owner)
            else:
                whole.append(piece)
        return whole

    def _whole(self, pieces: list[_Piece]) -> list[_Piece]:
        """Pieces, those made one that touch and move apart: what bends, and small parts.

        Two that touch may be two things. Three and more are one that is not rigid.
        """
        count = len(pieces)
        links = np.zeros((count, count), bool)
        for k, one in enumerate(pieces):
            for m in range(k):
                links[k, m] = self._belong_together(one, pieces[m])
        groups, group = connected_components(links, directed=False)
        whole = []
        for g in range(groups):
            parts = [pieces[k] for k in np.flatnonzero(group == g)]
            parts.sort(key=lambda piece: -np.count_nonzero(piece.cells))
            large = [part for part in parts if self._is_of_its_own(part, parts[0])]
            small = [
                part.cells
                for part in parts
                if not self._is_of_its_own(part, parts[0])
            ]
            if len(large) >= PARTS_OF_ONE:
                whole.append(_bent(large, small))
                continue
            cells = np.logical_or.reduce([large[0].cells, *small])
            owner = next((p.owner for p in parts if p.owner is not None), None)
            first = large[0]
            if first.owner is None:
                first = first._replace(owner=owner)
            whole += [first._replace(cells=cells), *large[1:]]
        return whole

    def _is_of_its_own(self, part: _Piece, largest: _Piece) -> bool:
        """Whether a part is too large to be the border of another one."""
        count = int(np.count_nonzero(part.cells))
        return part is largest or count > SMALL_PART * self.view.size

    def _are_one(self, small: _Piece, large: _Piece) -> bool:
        """Whether two pieces belong to one object: they are near, and move as one."""
        owners = {k for k in (small.owner, large.owner) if k is not None}
        are_two = len(owners) > 1 and not any(self.are_new[k] for k in owners)
        near = cv2.dilate(small.cells.astype(np.uint8), TOUCHING) > 0
        if are_two or not np.any(near & large.cells):
            return False
        if not (small.fit.status.usable and large.fit.status.usable):
            return self._touch(small.cells, large.cells)
        own_px = self._apart_px(
            small.fit.T_curr_prev, self.view.before.T_curr_prev, small.cells
        )
        apart_px = self._apart_px(
            small.fit.T_curr_prev, large.fit.T_curr_prev, small.cells
        )
        # a rolling shutter bends what is rigid
        if apart_px < SAME_FRACTION * own_px:
            return True
        covariance = small.fit.covariance + large.fit.covariance
        apart = squared_distance(
            small.fit.T_curr_prev, large.fit.T_curr_prev, covariance
        )
        return apart < SAME_OBJECT

    def _belong_together(self, one: _Piece, other: _Piece) -> bool:
        """Whether two parts touch, and one is small, or their motions meet at the border.

        Where a thing bends its parts move alike at the border, and apart farther away.
        """
        small, large = sorted(
            (one, other), key=lambda piece: np.count_nonzero(piece.cells)
        )
        border = self._border(small.cells, large.cells)
        if not border.any():
            return False
        if not self._is_of_its_own(small, large):
            return True
        motions = small.fit.T_curr_prev, large.fit.T_curr_prev
        all_over = self._apart_px(*motions, small.cells | large.cells)
        return self._apart_px(*motions, border) < BEND * all_over

    def _apart_px(
        self, one: np.ndarray, other: np.ndarray, cells: np.ndarray
    ) -> float:
        """Mean distance, px, of where two motions (4, 4) have some cells come from."""
        inside = cells[self.points.cells]
        xyz = self.points.xyz[inside]
        places = [
            project(
                transform_points(invert(T_curr_prev), xyz),
                self.view.before.frame.camera,
            )
            for T_curr_prev in (one, other)
        ]
        return float(np.nanmean(np.linalg.norm(places[0] - places[1], axis=1)))

    def _touch(self, one: np.ndarray, other: np.ndarray) -> bool:
        """Whether two parts touch along a border, without a step of depth in between."""
        return bool(self._border(one, other).any())

    def _border(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """(h, w) cells of a part at its border with another one; none where they do not touch."""
        near = cv2.dilate(np.where(one, self.depth, 0), BESIDE)
        both = other & (near > 0) & (self.depth > 0)
        is_level = (self.depth < CONTACT_STEP * near) & (
            near < CONTACT_STEP * self.depth
        )
        contact = both & is_level
        smaller = min(np.count_nonzero(one), np.count_nonzero(other))
        is_long = np.count_nonzero(contact) > CONTACT * np.sqrt(smaller)
        return contact if is_long else np.zeros_like(contact)

    def _region(self, piece: _Piece) -> Region:
        """A piece with what its motion is likelier than the camera's."""
        own = self._label(piece.fit.T_curr_prev)
        inside = piece.cells[self.points.cells]
        gain = float(np.mean((self.camera.costs - own.costs)[inside]))
        trace = -float(np.mean(self.stillness[piece.cells]))
        return Region(piece.cells, piece.fit, gain, trace)

    def _fit(self, cells: np.ndarray, T_curr_prev: np.ndarray) -> Fit:
        """The motion of some cells, refined from a start."""
        weights = self._weights(cells)
        box = widened(box_of(weights > 0, 0), self.scene.pair.prev.camera)
        pair = cropped_pair(self.scene.pair, box)
        start = Selection(invert(T_curr_prev))
        own = np.ascontiguousarray(weights[box.pixels])
        refine = self.options.refine
        motion: Motion
        try:
            grid = PixelGrid(pair, own, refine.coarse_pixels)
            motion = refine_pair(pair, start, grid, options=refine)
            motion = _on_images(pair, motion, own, self.options)
        except StageFailed as error:
            motion = RelativePose.failed(error.reason, str(error))
        return _turned_round(motion, T_curr_prev)


def _bent(parts: Sequence[_Piece], small: Sequence[np.ndarray]) -> _Piece:
    """Parts that move apart as one thing, the largest first; its motion is that of the largest."""
    cells = np.logical_or.reduce([*(part.cells for part in parts), *small])
    first = parts[0]
    followers = np.count_nonzero(first.cells) / np.count_nonzero(cells)
    text = f"{100 * followers:.0f} % of it follow one motion"
    status = first.fit.status
    if status.usable:
        status = Status.degraded(Reason.NOT_RIGID, text)
    owners = [part.owner for part in parts if part.owner is not None]
    fit = first.fit._replace(status=status, inlier_ratio=followers)
    return _Piece(cells, fit, owners[0] if owners else None)


def _on_images(
    pair: FramePair, motion: Motion, weights: np.ndarray, options: Options
) -> Motion:
    """A motion by flow, refined on the images and depth maps inside its mask (H, W).

    Flow is drawn along by what moves beside an object, and not as precise there as it states: it
    only leads to where the images take over.
    """
    if not motion.usable or motion.weights is None:
        return motion
    inside = motion.replace(
        weights=motion.weights * weights,
        covariance=OBJECT_FLOW_INFLATION * motion.covariance,
    )
    return refine_photometric(
        pair, inside, IMAGES_PRIOR_INFLATION, options.refine
    ).replace(weights=None)


def _turned_round(motion: Motion, T_expected: np.ndarray) -> Fit:
    """The fit of a motion that leads from the current frame back to the one before."""
    status = motion.status
    if not status.usable:
        return Fit(T_expected, motion.covariance, status, motion.inlier_ratio)
    T_curr_prev = invert(motion.T_curr_prev)
    A = adjoint(T_curr_prev)
    if motion.inlier_ratio < RIGID_FRACTION:
        percent = 100 * motion.inlier_ratio
        status = Status.degraded(
            Reason.NOT_RIGID, f"{percent:.0f} % of its pixels follow one motion"
        )
    return Fit(
        T_curr_prev, A @ motion.covariance @ A.T, status, motion.inlier_ratio
    )
