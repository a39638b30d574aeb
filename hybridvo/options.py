"""Every option of the program, in one tree: ``Options().refine.cutoff`` and the like.

The classes are frozen and check their values; ``configs/odometry.yaml`` shows the same tree.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar, dataclass_transform

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

from hybridvo.calibration import MIN_CONFIDENCE
from hybridvo.errors import InputError

T = TypeVar("T")
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Natural = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Blur = Annotated[float, Field(gt=0, lt=100)]


def describe(error: ValidationError, where: str) -> str:
    """One sentence for the first thing that pydantic found wrong, with its place."""
    first = error.errors()[0]
    place = ".".join([where, *(str(part) for part in first["loc"])])
    expected = first["msg"][:1].lower() + first["msg"][1:]
    return f"{place}: {expected}, got {first['input']!r}."


@dataclass_transform(frozen_default=True)
def option_group(cls: type[T]) -> type[T]:
    """A frozen pydantic dataclass whose errors are :class:`InputError`."""
    config = ConfigDict(extra="forbid", allow_inf_nan=False)
    made: Any = dataclass(frozen=True, config=config)(cls)
    fill: Callable[..., None] = made.__init__

    def __init__(self: Any, *args: Any, **values: Any) -> None:
        try:
            fill(self, *args, **values)
        except ValidationError as error:
            raise InputError(describe(error, cls.__name__)) from None

    made.__init__ = __init__
    return made


@option_group
class FlowOptions:
    """Where the optical flow comes from.

    Args:
        source: ``file``, ``dis``, or ``auto``: files where the sequence has them, else DIS.
        dis_preset: effort of OpenCV's DIS.
    """

    source: Literal["auto", "file", "dis"] = "auto"
    dis_preset: Literal["ultrafast", "fast", "medium"] = "medium"


@option_group
class DirectOptions:
    """The motion from images and depth maps alone, before any flow is computed.

    Args:
        mode: ``on``, ``off``, or ``auto``: with the method ``hybrid``, where the flow would be
            computed from the same images (``dis``).
    """

    mode: Literal["auto", "on", "off"] = "auto"


@option_group
class SearchOptions:
    """The search for every strong motion of a pair.

    Args:
        grid_pixels: pixels of the grid on which starts are made and scored.
        max_hypotheses: largest number of motions.
        min_inlier_ratio: smallest share of the usable pixels that a further motion must hold.
        unambiguous_ratio: share of the usable pixels above which the first motion stands alone.
    """

    grid_pixels: Count = 1800
    max_hypotheses: Annotated[int, Field(ge=1, le=16)] = 8
    min_inlier_ratio: Share = 0.08
    unambiguous_ratio: Share = 0.85


@option_group
class SelectOptions:
    """Which of the motions is the camera's.

    Args:
        consult_below: confidence of the selector (0 to 1) below which PWVO is asked as well; 1: in
            every ambiguous pair.
        refits: motions that are fitted again inside their masks, in each round.
        min_confidence: probability of being right (0 to 1) below which a motion is degraded.
    """

    consult_below: Share = 0.8
    refits: Annotated[int, Field(ge=0, le=16)] = 2
    min_confidence: Share = MIN_CONFIDENCE


@option_group
class RefineOptions:
    """The refinement on flow and depth.

    Args:
        cutoff: c of the Geman-McClure kernel, in standard deviations.
        coarse_pixels: pixels of the grid on which motions are fitted before the full one.
        current_depth: the current frame's depth as a third residual: ``on``, ``off``, or ``auto``,
            where it adds more than half of what the flow knows in some direction.
        min_pixels: fewer usable pixels are a failure.
        tiles: about how many (of 8 to 64 px) the covariance cuts the image into: errors may be
            correlated over two of them.
    """

    cutoff: Positive = 3.0
    coarse_pixels: Count = 7500
    current_depth: Literal["auto", "on", "off"] = "auto"
    min_pixels: Count = 24
    tiles: Count = 110


@option_group
class PhotometricOptions:
    """The refinement on the two images, which follows that on the flow.

    Args:
        mode: ``on``, ``off``, or ``auto``: with the method ``hybrid``.
        blur_px: standard deviations of the Gaussian blur, px, coarse to fine.
        iterations: most Gauss-Newton steps under each of them.
        pixels: about how many pixels are used: the strongest gradients of evenly spread cells.
        prior_inflation: factor on the covariance of the flow's motion: the errors of estimated flow
            are alike far beyond the tiles.
        image_inflation: the same for the images and the depth maps.
        min_correlation: of the two images over the pixels used; below it they do not match.
    """

    mode: Literal["auto", "on", "off"] = "auto"
    blur_px: Annotated[tuple[Blur, ...], Field(min_length=1)] = (2.0, 1.0)
    iterations: Count = 5
    pixels: Count = 16000
    prior_inflation: Positive = 8.0
    image_inflation: Positive = 4.0
    min_correlation: Annotated[float, Field(ge=-1, le=1)] = 0.5


@option_group
class TrackOptions:
    """The tracker: motion model, and the window of key frames.

    Args:
        window: most key frames that a frame is registered to, 1 for none; None: 3 where the images
            refine the motion, else 1.
        keyframe_overlap: share of a key frame's static pixels that are still seen, below which the
            frame becomes a key frame.
        keyframe_motion: median shift of these pixels, as a share of the image's width, above which
            the frame becomes a key frame.
        min_overlap: share below which no motion is sought between two key frames.
        inflation: factor on every covariance: errors are alike from frame to frame.
        motion_prior: let the motion predicted by constant velocity take part.
        on_failure: pose after a failed motion: ``hold``, or ``constant_velocity``.
    """

    window: Count | None = None
    keyframe_overlap: Annotated[float, Field(gt=0, lt=1)] = 0.85
    keyframe_motion: Positive = 0.08
    min_overlap: Annotated[float, Field(gt=0, lt=1)] = 0.5
    inflation: Positive = 4.0
    motion_prior: bool = True
    on_failure: Literal["hold", "constant_velocity"] = "hold"


@option_group
class RunOptions:
    """A run over a sequence.

    Args:
        method: one of :data:`hybridvo.pipeline.METHODS`.
        start: first frame. stop: the one after the last, None: all. stride: frames from one image
            of a pair to the other.
        device: where the networks run: ``auto`` (cuda where there is one), ``cpu`` or ``cuda``.
        max_failed: share of the motions that may fail before the exit code is 3.
        strict: a broken frame ends the run.
        alignment: of the absolute trajectory error.
        seed: of everything drawn at random.
    """

    method: str = "hybrid"
    start: Natural = 0
    stop: Count | None = None
    stride: Count = 1
    device: Literal["auto", "cpu", "cuda"] = "auto"
    max_failed: Share = 0.2
    strict: bool = False
    alignment: Literal["se3", "sim3", "origin", "none"] = "se3"
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0


@option_group
class Options:
    """The option tree.

    Raises:
        InputError: an unknown name or a value out of bounds, with its place.

    Example:
        >>> Options(refine=RefineOptions(cutoff=2.5)).refine.cutoff
        2.5
    """

    flow: FlowOptions = FlowOptions()
    direct: DirectOptions = DirectOptions()
    search: SearchOptions = SearchOptions()
    select: SelectOptions = SelectOptions()
    refine: RefineOptions = RefineOptions()
    photometric: PhotometricOptions = PhotometricOptions()
    track: TrackOptions = TrackOptions()
    run: RunOptions = RunOptions()
