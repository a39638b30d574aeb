"""Every option of the program, in one tree, which ``hybridvo/run/odometry.yaml`` explains."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, dataclass_transform

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
)
from pydantic.dataclasses import dataclass

from hybridvo.core.calibration import (
    KERNEL_CUTOFF,
    MIN_PROBABILITY,
)
from hybridvo.core.errors import FormatError, InputError, did_you_mean

T = TypeVar("T")
Positive = Annotated[float, Field(gt=0)]
"""A number above 0."""
NonNegative = Annotated[float, Field(ge=0)]
"""A number from 0 on."""
Count = Annotated[int, Field(ge=1, lt=2**31)]
"""A whole number from 1 on."""
Places = Annotated[int, Field(ge=1, le=200)]
"""A number of places: more would fill a gigabyte with frames of 640x480."""
Natural = Annotated[int, Field(ge=0, lt=2**31)]
"""A whole number from 0 on."""
Fraction = Annotated[float, Field(ge=0, le=1)]
"""A number from 0 to 1."""


def _word(value: Any) -> Any:
    """Return the word of a switch: YAML 1.1 reads on and off as true and false."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return value


def _source(*names: str) -> AfterValidator:
    """Return a check that a text is one of some names, or names a network."""

    def check(text: str) -> str:
        if text in names or text.removeprefix(NETWORK) not in ("", text):
            return text
        raise ValueError(f"expected {', '.join(names)} or {NETWORK}FILE")

    return AfterValidator(check)


NETWORK = "onnx:"
"""What stands before the file of a network."""
FlowSource = Annotated[str, _source("auto", "file", "dis")]
DepthSource = Annotated[str, _source("auto")]
AutoOff = Annotated[Literal["auto", "off"], BeforeValidator(_word)]
AutoOnOff = Annotated[Literal["auto", "on", "off"], BeforeValidator(_word)]


@dataclass_transform(frozen_default=True)
def option_group(cls: type[T]) -> type[T]:
    """Make a frozen pydantic dataclass whose errors are :class:`InputError`.

    Unknown names and numbers that are not finite are errors.
    """
    config = ConfigDict(extra="forbid", allow_inf_nan=False)
    group: Any = dataclass(frozen=True, config=config)(cls)
    validate: Callable[..., None] = group.__init__

    def __init__(self: Any, *args: Any, **values: Any) -> None:
        try:
            validate(self, *args, **values)
        except ValidationError as error:
            raise _input_error(cls, error) from None

    group.__init__ = __init__
    return group


def _near_name(group: type, place: tuple[int | str, ...]) -> str:
    """Return a question about the name that an unknown one may stand for.

    Args:
        group: The outermost group of options.
        place: The names that lead to the unknown one, which is the last.
    """
    inner: Any = group
    for name in place[:-1]:
        inner = inner.__pydantic_fields__[name].annotation
    return did_you_mean(place[-1], inner.__pydantic_fields__)


def _input_error(group: type, error: ValidationError) -> InputError:
    """Return the first mistake that pydantic found in a group of options."""
    first = error.errors()[0]
    place = ".".join([group.__name__, *(str(part) for part in first["loc"])])
    if first["type"] == "unexpected_keyword_argument":
        return InputError(f"{place}: unknown{_near_name(group, first['loc'])}.")
    message = first["msg"]
    expected = message.removeprefix("Value error, ")
    expected = expected[:1].lower() + expected[1:]
    return InputError(f"{place}: {expected}, got {first['input']!r}.")


@option_group
class FlowOptions:
    """Where the optical flow comes from.

    Attributes:
        source: ``file``, ``dis``, ``onnx:FILE`` (a network, see docs/networks.md), or ``auto``:
            files where there are some, else DIS.
        dis_preset: effort of DIS: ``ultrafast``, ``fast`` or ``medium``.
    """

    source: FlowSource = "auto"
    dis_preset: Literal["ultrafast", "fast", "medium"] = "medium"


@option_group
class DepthOptions:
    """Where depth comes from.

    Attributes:
        source: ``auto``: the sequence's own; ``onnx:FILE``: predicted by a network, see
            docs/networks.md.
        scale_per_frame: whether each frame's depth is brought to the scale of the trajectory:
            ``on``, ``off``, or ``auto``: where depth comes from a network.
    """

    source: DepthSource = "auto"
    scale_per_frame: AutoOnOff = "auto"


@option_group
class DirectOptions:
    """The motion from images and depth maps alone, before any flow is computed.

    Attributes:
        mode: ``on``, ``off``, or ``auto``: with the method hybrid, where the flow would be
            computed from the same images (dis).
    """

    mode: AutoOnOff = "auto"


@option_group
class SearchOptions:
    """The search for every strong motion of a pair.

    Attributes:
        grid_pixels: pixels of the grid on which motions are sought.
        max_hypotheses: largest number of motions.
        min_inlier_ratio: smallest fraction of the usable pixels that a further motion must explain.
        unambiguous_ratio: fraction of the usable pixels above which the only motion found is
            certain where there are no images to look at.
        matches: ``auto``: where an answer is not sure, sparse matches of the images are one more
            start, for flow and search; ``off``.
    """

    grid_pixels: Count = 1800
    max_hypotheses: Annotated[int, Field(ge=1, le=16)] = 8
    min_inlier_ratio: Fraction = 0.08
    unambiguous_ratio: Fraction = 0.85
    matches: AutoOff = "auto"


@option_group
class SelectOptions:
    """Which of the motions is the camera's.

    Attributes:
        refits: motions that are fitted again inside their masks. With none, four slow walks among
            large movers end 31, .3, 3.6 and 4.8 cm off instead of .7, 1.0, 1.9 and .9.
        min_probability: probability of being right below which a motion is degraded.
    """

    refits: Annotated[int, Field(ge=0, le=16)] = 2
    min_probability: Fraction = MIN_PROBABILITY


@option_group
class RefineOptions:
    """The refinement on flow and depth.

    Attributes:
        cutoff: c of the Geman-McClure kernel, in standard deviations.
        coarse_pixels: of the grid on which motions are fitted before the full one.
        current_depth: whether the current frame's depth is compared with the previous one's, and
            limits its noise: ``auto`` or ``off``.
        min_pixels: number of usable pixels below which a motion fails.
        tiles: number of tiles, of 8 to 64 px, for the covariance: errors may be correlated over
            two of them.
    """

    cutoff: Positive = KERNEL_CUTOFF
    coarse_pixels: Count = 7500
    current_depth: AutoOff = "auto"
    min_pixels: Count = 24
    tiles: Count = 110


@option_group
class PhotometricOptions:
    """The refinement on the two images, which follows that on the flow.

    Attributes:
        mode: ``off``, or ``auto``: with the methods hybrid and pwvo-refine.
    """

    mode: AutoOff = "auto"


@option_group
class TrackOptions:
    """The tracker.

    Attributes:
        motion_prior: whether the motion predicted by constant velocity takes part.
        keyframes: ``off``, or ``auto``: motions span some frames where flow is computed from the
            images.
        memory: ``off``, or ``auto``: what was static is remembered, with the method hybrid and
            keyframes.
        objects: ``off``, or ``auto``: what moves by itself is told apart, with its motion, where
            frames have images and depth.
        places: earlier frames, far apart, that are kept at most, 200 or fewer: from them a lost
            path is found again, and :meth:`hybridvo.Odometry.loops` measures loops. At 640x480
            each takes 6 MB, and 0.07 ms a frame.
        on_failure: the pose after a motion that failed: ``hold`` or ``constant_velocity``.
        lag: with 1, a step is given at once, and again one frame later, when it is known how the
            camera moved while the rows of the image were exposed; the readout is sought where the
            camera states none. With 0 a step stays as it is. It serves live cameras with a rolling
            shutter or late depth; of a recording the frame after each one is known.
        budget_ms: time after which a usable motion is not improved any more: not sought from
            the frame before, not refined on the images; and after which no motion is sought by
            sparse matches. None: the period of a live camera, else no limit; 0: no limit.
    """

    motion_prior: bool = True
    keyframes: AutoOff = "auto"
    memory: AutoOff = "auto"
    objects: AutoOff = "off"
    places: Places = 10
    on_failure: Literal["hold", "constant_velocity"] = "hold"
    lag: Literal[0, 1] = 0
    budget_ms: NonNegative | None = None


@option_group
class RunOptions:
    """A run over a sequence.

    Attributes:
        method: one of ``hybridvo.pipeline.METHODS``.
        start: the first frame.
        stop: the frame after the last; None: all.
        stride: frames between the two of a pair; above 1 flow files do not fit.
        passes: how often the sequence is tracked. From the second pass on it is known how the
            camera moved while each row of an image was exposed.
        device: of the networks: ``auto``, ``cpu`` or ``cuda``.
        max_failed: fraction of the motions that may fail before the exit code is 3.
        strict: whether a broken frame ends the run.
        alignment: of the absolute trajectory error: ``se3``, ``sim3``, ``origin`` or ``none``.
        seed: of everything drawn at random.
    """

    method: str = "hybrid"
    start: Natural = 0
    stop: Count | None = None
    stride: Count = 1
    passes: Count = 1
    device: Literal["auto", "cpu", "cuda"] = "auto"
    max_failed: Fraction = 0.2
    strict: bool = False
    alignment: Literal["se3", "sim3", "origin", "none"] = "se3"
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0


@option_group
class Options:
    """The option tree, as in ``Options(refine=RefineOptions(cutoff=2.5)).refine.cutoff``.

    Attributes:
        flow: where the optical flow comes from.
        depth: where depth comes from.
        direct: the motion from images and depth maps alone.
        search: the search for every strong motion of a pair.
        select: which of the motions is the camera's.
        refine: the refinement on flow and depth.
        photometric: the refinement on the two images.
        track: the tracker.
        run: a run over a sequence.

    Raises:
        InputError: A value is of another type, or outside its limits.

    >>> options = Options(refine=RefineOptions(cutoff=2.5))
    >>> options.refine.cutoff
    2.5
    """

    flow: FlowOptions = FlowOptions()
    depth: DepthOptions = DepthOptions()
    direct: DirectOptions = DirectOptions()
    search: SearchOptions = SearchOptions()
    select: SelectOptions = SelectOptions()
    refine: RefineOptions = RefineOptions()
    photometric: PhotometricOptions = PhotometricOptions()
    track: TrackOptions = TrackOptions()
    run: RunOptions = RunOptions()


def option_defaults() -> dict[str, Any]:
    """Return every key that ``--set`` knows, such as ``refine.cutoff``, with its default.

    Example:
        >>> option_defaults()["run.stride"]
        1
    """
    return {
        f"{group}.{name}": value
        for group, options in dataclasses.asdict(Options()).items()
        for name, value in options.items()
    }


def load_options(
    path: str | Path | None = None,
    assignments: Iterable[str] = (),
    named: Mapping[str, Any] | None = None,
) -> Options:
    """Read options. Named values win over assignments, which win over a file.

    Args:
        path: A YAML file of groups, as ``hybridvo/run/odometry.yaml``.
        assignments: Texts ``group.key=value``.
        named: Values by ``group.key``; None leaves an option as it is.

    Raises:
        InputError: A key is unknown, or a value is of no use.
        FormatError: The file or an assignment is no YAML.

    Example:
        >>> load_options(assignments=["refine.cutoff=2.5"]).refine.cutoff
        2.5
    """
    groups = {} if path is None else _read_groups(path)
    values = [_assignment(text) for text in assignments]
    for key, value in (named or {}).items():
        if value is not None:
            values.append((key, value))
    for key, value in values:
        group, _, name = key.partition(".")
        entries = groups.setdefault(group, {})
        # A group that is no mapping is an error of the file, which Options reports.
        if isinstance(entries, dict):
            entries[name] = value
    try:
        return Options(**groups)
    except InputError as error:
        sources = [str(path)] if path is not None else []
        if assignments:
            sources.append("--set")
        where = " and ".join(sources) or "options"
        raise InputError(f"{where}: {error} --set help lists the keys.") from None


def _read_groups(path: str | Path) -> dict[str, Any]:
    """Read the groups of a YAML file of options."""
    # a tracker needs no reader
    from hybridvo.core.files import parse_yaml, read_text

    try:
        text = read_text(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file.") from None
    groups = parse_yaml(text, str(path)) or {}
    if not isinstance(groups, dict):
        raise FormatError(
            f"{path}: expected 'group:' lines, got a {type(groups).__name__}."
        )
    return groups


def _assignment(text: str) -> tuple[str, Any]:
    """Split ``group.key=value`` and read the value as YAML."""
    from hybridvo.core.files import parse_yaml

    key, sign, value = text.partition("=")
    if not sign or "." not in key:
        raise InputError(
            f"--set: expected group.key=value, as refine.cutoff=3, got {text!r}."
        )
    return key.strip(), parse_yaml(value, f"--set {key}")
