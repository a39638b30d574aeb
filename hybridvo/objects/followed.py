"""What else moves: the objects of a tracker, each under its number as long as it is followed.

After a step the camera's motion is known. What does not follow it is told apart by the motions that
it follows (:mod:`hybridvo.objects.motions`), and each part is given to the object of the
frame before that was expected there. An object that is hidden goes on at constant velocity for some
frames. Nothing here changes the camera's motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from hybridvo.core.geometry import (
    adjoint,
    invert,
    se3_exp,
    se3_log,
    transform_points,
)
from hybridvo.core.options import Options
from hybridvo.core.results import (
    MovingObject,
    Reason,
    Status,
)
from hybridvo.core.stages import stage
from hybridvo.objects.calibration import (
    FIRST_LOG_ODDS,
    HIDDEN_STEP,
    LARGE_OBJECT,
    MAX_OBJECT_LOG_ODDS,
    MIN_OBJECT_LOG_ODDS,
    MIN_OVERLAP,
    NEW_OBJECT_FRAMES,
    NO_GAIN,
    OBJECT_CHANGE_STD,
    SAME_DEPTH,
    TRACE_GAIN,
)
from hybridvo.objects.motions import (
    MOST,
    Expected,
    Fit,
    GridView,
    Region,
    moving_regions,
)

# objects that are followed at most, the surest
MAX_OBJECTS = 16


@dataclass(frozen=True, eq=False)
class Thing:
    """What is known of an object after a frame.

    Attributes:
        id: its number.
        points: (N, 3) float32 its surface as last seen, metres, in the camera of that frame;
            carried on while it is hidden.
        T_own: (4, 4) its motion in one frame beside the camera's, in the same axes.
        covariance: (6, 6) of delta in ``Exp(delta) T_own``.
        log_odds: that something moves by itself here.
        age: frames since it was first seen.
        hidden: frames since it was last seen.
    """

    id: int
    points: np.ndarray
    T_own: np.ndarray
    covariance: np.ndarray
    log_odds: float
    age: int = 0
    hidden: int = 0

    @property
    def centre(self) -> np.ndarray:
        """(3,) middle of its surface, metres."""
        return np.asarray(np.median(self.points, axis=0), np.float64)

    @property
    def size(self) -> np.ndarray:
        """(3,) extent of its surface, metres, without the tenth that lies outermost."""
        low, high = np.percentile(self.points, (5, 95), axis=0)
        return np.asarray(high - low, np.float64)


@dataclass(frozen=True, eq=False)
class Things:
    """The objects of a tracker after a frame: at most so many, each at most of one view.

    Attributes:
        known: the objects.
        next_id: the number that the next new one gets.
    """

    known: tuple[Thing, ...] = ()
    next_id: int = 1

    def rescaled(self, factor: float) -> Things:
        """Return the objects after all lengths grew by a factor."""

        def longer(thing: Thing) -> Thing:
            T_own = thing.T_own.copy()
            T_own[:3, 3] *= factor
            points = (factor * thing.points).astype(np.float32)
            scale = np.diag([factor] * 3 + [1.0] * 3)
            covariance = scale @ thing.covariance @ scale
            return replace(thing, points=points, T_own=T_own, covariance=covariance)

        return replace(self, known=tuple(map(longer, self.known)))


class _Ahead(NamedTuple):
    """An object as it is expected in the current frame."""

    thing: Thing
    T_curr_prev: np.ndarray  # (4, 4)
    points: np.ndarray  # (N, 3) metres, in the current camera
    T_own: np.ndarray  # (4, 4) in one frame, in the axes of the current camera
    covariance: np.ndarray  # (6, 6) of it
    cells: np.ndarray  # (h, w) bool


@stage("objects")
def after_step(
    things: Things,
    view: GridView,
    frames: int,
    options: Options,
    seed: int = 0,
) -> tuple[Things, tuple[MovingObject, ...]]:
    """Return the objects after a frame whose camera motion is known, and what its step states.

    Args:
        things: before the frame.
        view: the frame, and those before it.
        frames: number of frames since the frame before of the view.
        options: the option tree.
        seed: of the search.
    """
    ahead = [_ahead(thing, view, frames) for thing in things.known]
    expected = [
        Expected(each.T_curr_prev, each.cells, each.thing.age < NEW_OBJECT_FRAMES)
        for each in ahead
        if not each.thing.hidden
    ]
    regions = moving_regions(view, expected, options, seed)
    owner = _assigned(ahead, regions, view)
    known: list[Thing] = []
    shown: list[MovingObject] = []
    next_id = things.next_id
    for number, region in enumerate(regions):
        before = owner.get(number)
        number_of = next_id if before is None else before.thing.id
        thing = _seen(number_of, before, region, view, frames)
        if thing is None:
            continue
        if before is None:
            next_id += 1
        known.append(thing)
        shown.append(_stated(thing, region, view))
    taken = {thing.id for thing in known}
    for each in ahead:
        if each.thing.id in taken:
            continue
        hidden = _hidden(each, frames)
        if hidden is not None:
            known.append(hidden)
            shown.append(_stated_hidden(hidden, each, view))
    order = np.argsort([-thing.log_odds for thing in known], kind="stable")
    kept = sorted(order[:MAX_OBJECTS], key=lambda k: known[k].id)
    return (
        Things(tuple(known[k] for k in kept), next_id),
        tuple(shown[k] for k in kept if known[k].log_odds > 0),
    )


def _ahead(thing: Thing, view: GridView, frames: int) -> _Ahead:
    """An object at constant velocity."""
    T_camera = view.before.T_curr_prev
    T_own = se3_exp(frames * se3_log(thing.T_own))
    T_curr_prev = T_camera @ T_own
    points = transform_points(T_curr_prev, thing.points)
    A = adjoint(T_camera)
    grown = frames * np.diag(np.repeat(OBJECT_CHANGE_STD, 3) ** 2)
    return _Ahead(
        thing,
        T_curr_prev,
        points,
        T_camera @ thing.T_own @ invert(T_camera),
        A @ thing.covariance @ A.T + grown,
        view.cells_of(points),
    )


def _assigned(
    ahead: Sequence[_Ahead], regions: Sequence[Region], view: GridView
) -> dict[int, _Ahead]:
    """The object that each region is taken for, by the number of the region."""
    if not ahead or not regions:
        return {}
    likeness = np.array(
        [[_likeness(each, region, view) for region in regions] for each in ahead]
    )
    objects, numbers = linear_sum_assignment(likeness, maximize=True)
    return {
        int(number): ahead[k]
        for k, number in zip(objects, numbers, strict=True)
        if likeness[k, number] > 0
    }


def _likeness(ahead: _Ahead, region: Region, view: GridView) -> float:
    """How well a region fits an object, 0 to 1: by overlap, or by nearness after it was hidden."""
    points = _points_in(region.cells, view)
    if not len(points):
        return 0.0
    ratio = float(np.median(points[:, 2]) / np.median(ahead.points[:, 2]))
    if not 1 / SAME_DEPTH < ratio < SAME_DEPTH:
        return 0.0
    both = np.count_nonzero(ahead.cells & region.cells)
    either = np.count_nonzero(ahead.cells | region.cells)
    overlap = both / either if either else 0.0
    if overlap >= MIN_OVERLAP:
        return overlap
    if not ahead.thing.hidden:
        return 0.0
    apart = np.linalg.norm(np.median(points, 0) - np.median(ahead.points, 0))
    reach = float(np.linalg.norm(ahead.thing.size))
    if apart > reach:
        return 0.0
    return float(MIN_OVERLAP * (1 - apart / reach))


def _points_in(cells: np.ndarray, view: GridView) -> np.ndarray:
    """(N, 3) float32 points of some cells."""
    inside = cells[view.points.cells]
    return view.points.xyz[inside].astype(np.float32)


def first_log_odds(fraction: float) -> float:
    """Return the log odds of a new object before its first frame counts.

    What is small is more often an error of the flow.

    Args:
        fraction: of the view that it covers.

    >>> first_log_odds(0.1), round(first_log_odds(0.01), 1)
    (-1.0, -2.1)
    """
    smaller = max(np.log(LARGE_OBJECT / fraction), 0.0)
    return FIRST_LOG_ODDS - float(smaller)


def _seen(
    number: int, before: _Ahead | None, region: Region, view: GridView, frames: int
) -> Thing | None:
    """An object in a frame that shows it; None where too little is left of it."""
    points = _points_in(region.cells, view)
    if not len(points):
        return None
    fraction = float(np.mean(region.cells))
    gain = region.gain
    if fraction < LARGE_OBJECT:
        gain = min(gain, TRACE_GAIN * region.trace)
    log_odds = first_log_odds(fraction)
    if before is not None:
        log_odds = before.thing.log_odds
    log_odds = min(log_odds + (gain - NO_GAIN), MAX_OBJECT_LOG_ODDS)
    if log_odds < MIN_OBJECT_LOG_ODDS:
        return None
    T_own, covariance = _velocity(before, region.fit, view, frames)
    age = 0 if before is None else before.thing.age + frames
    return Thing(number, points, T_own, covariance, float(log_odds), age)


def _velocity(
    before: _Ahead | None, fit: Fit, view: GridView, frames: int
) -> tuple[np.ndarray, np.ndarray]:
    """The motion (4, 4) of an object in one frame, as measured and as before, with covariance."""
    T_camera = view.before.T_curr_prev
    measured = se3_exp(se3_log(fit.T_curr_prev @ invert(T_camera)) / frames)
    if before is None:
        return measured, fit.covariance
    if not fit.status.usable:
        return before.T_own, before.covariance
    gain = before.covariance @ np.linalg.inv(before.covariance + fit.covariance)
    change = gain @ se3_log(measured @ invert(before.T_own))
    covariance = (np.eye(6) - gain) @ before.covariance
    return se3_exp(change) @ before.T_own, (covariance + covariance.T) / 2


def _hidden(ahead: _Ahead, frames: int) -> Thing | None:
    """An object in a frame that does not show it; None where it is forgotten."""
    thing = ahead.thing
    if thing.log_odds <= 0:
        return None
    return replace(
        thing,
        points=ahead.points.astype(np.float32),
        T_own=ahead.T_own,
        covariance=ahead.covariance,
        log_odds=thing.log_odds - HIDDEN_STEP * frames,
        age=thing.age + frames,
        hidden=thing.hidden + frames,
    )


def _stated(thing: Thing, region: Region, view: GridView) -> MovingObject:
    """What a step states of an object that is seen."""
    mask = view.mask_of(region.cells) > MOST
    fit = region.fit
    return MovingObject(
        id=thing.id,
        mask=mask,
        T_curr_prev=fit.T_curr_prev,
        covariance=fit.covariance,
        status=fit.status,
        confidence=float(expit(thing.log_odds)),
        age=thing.age,
        fraction=float(np.mean(mask)),
        inlier_ratio=float(fit.inlier_ratio),
        centre=thing.centre,
        size=thing.size,
    )


def _stated_hidden(thing: Thing, ahead: _Ahead, view: GridView) -> MovingObject:
    """What a step states of an object that is hidden."""
    status = Status.failed(
        Reason.LOW_INLIERS, f"not seen for {thing.hidden} frames; motion expected"
    )
    return MovingObject(
        id=thing.id,
        mask=np.zeros(view.frame.camera.shape, bool),
        T_curr_prev=ahead.T_curr_prev,
        covariance=thing.covariance,
        status=status,
        confidence=float(expit(thing.log_odds)),
        age=thing.age,
        hidden=thing.hidden,
        centre=thing.centre,
        size=thing.size,
    )
