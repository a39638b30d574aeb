"""Make changes that the quick golden must notice, one by one.

    python tools/golden_mutations.py --list
    python tools/golden_mutations.py --numbers CHOICE_RIGHT --cases network

The first prints every change; the second makes those of one number and prints which of
some cases notice. A change is undone before the next one is made.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from golden_cases.figures import Row, compare
from golden_cases.quick import cases, measure_quick
from measuring import ROOT, parser_of

FROZEN = ROOT / "docs/golden_quick.json"
POSE_ERROR_RAD = 3e-4
COVARIANCE_FACTOR = 4.0
UP = 4.0 / 3.0
DOWN = 2.0 / 3.0
ROOMS = (
    *("hybridvo.core", "hybridvo.flow", "hybridvo.solver", "hybridvo.judge"),
    *("hybridvo.hypotheses", "hybridvo.evidence", "hybridvo.tracking"),
    *("hybridvo.io", "hybridvo.run", "hybridvo_lab", "hybridvo_lab.baselines"),
)
"""Rooms with numbers that decide."""
OPTION_DEFAULTS = {"MIN_PROBABILITY": ("select", "min_probability")}
"""Numbers that the code takes from the options: group and name of the option."""

BEHAVIOUR_NOTICED_BY = {
    "photometric refinement off": "heavy_ten/hybrid",
    "selection of the largest motion": "heavy_ten/hybrid-flow",
    "poses off by 0.3 mrad": "scenario_low_noise/classical",
    "covariance times 4": "scenario_low_noise/classical",
}
"""Change -> the case that must notice it."""
NOTICED_BY: dict[str, tuple[float, str]] = {
    # probabilities of being right
    "CUES_RIGHT[0]": (DOWN, "heavy_ten/classical"),
    "CUES_RIGHT[1]": (DOWN, "scenario_low_noise/classical"),
    "NO_MOTION": (DOWN, "scenario_moving50/hybrid-flow"),
    "CHOICE_RIGHT[0]": (DOWN, "scenario_moving50/hybrid-flow"),
    "DIRECT_EXACT[0]": (DOWN, "static/hybrid"),
    "DIRECT_OF_SCENE[0]": (DOWN, "static/hybrid"),
    "CONTRADICTED_RIGHT": (DOWN, "contradicting_halved_flow/classical"),
    # which motion is the camera's
    "CUE_WEIGHTS[inlier_ratio]": (DOWN, "ladder_prior_of_an_object/classical"),
    "CUE_WEIGHTS[flow_noise]": (DOWN, "heavy_ten/classical"),
    "CUE_WEIGHTS[prior]": (DOWN, "ladder_prior_of_an_object/classical"),
    "MIN_PROBABILITY": (UP, "heavy_rigid/hybrid"),
    "DIRECT_PROBABILITY": (DOWN, "ladder_moving_patch/hybrid"),
    "INLIER_REMOVAL_CUTOFF": (UP, "heavy_deforming/hybrid-flow"),
    # flow
    "DIS_NOISE[0]": (DOWN, "ladder_dis_flow/small_low"),
    "DIS_NOISE[1]": (DOWN, "ladder_dis_flow/small_high"),
    "FULL_RESOLUTION_MAX_PIXELS": (DOWN, "ladder_dis_flow/small_low"),
    "MIN_TEXTURED": (DOWN, "ladder_little_texture/flow"),
    "FLOW_CONTRADICTION[0]": (DOWN, "ladder_scaled_flow/classical"),
    "FLOW_CONTRADICTION[1]": (DOWN, "ladder_noisy_negated_flow/classical"),
    # inputs that contradict a motion
    "MIN_LEAD": (DOWN, "ladder_turned_flow/slow"),
    "IMAGE_LEAD": (UP, "ladder_turned_flow/fast"),
    "IMAGE_LEAD_GAIN": (UP, "ladder_turned_flow/noisy"),
    "DEPTH_LEAD": (DOWN, "ladder_late_depth/noisy"),
    "DEPTH_LEAD_STD": (DOWN, "ladder_frozen_images/noisy_depth"),
    "DOUBTFUL_SPREAD": (DOWN, "ladder_two_depths/spread"),
    "NO_SPREAD": (DOWN, "ladder_two_depths/spread"),
    # the tracker
    "MIN_DEPTH_SHARE": (DOWN, "ladder_little_depth/classical"),
    "KEYFRAME_FLOW": (DOWN, "walk_0/hybrid"),
    "KEYFRAME_AGE": (DOWN, "walk_1/hybrid"),
    "KEYFRAME_CORRELATION": (DOWN, "walk_0/hybrid"),
    # covariance
    "LONG_GROWTH[0]": (UP, "ladder_two_depths/scale"),
    "LONG_GROWTH[1]": (UP, "ladder_two_depths/scale"),
    "ABSORBED": (DOWN, "scenario_moving70/classical"),
    "SHARED_BLOCK": (UP, "ladder_coherent_flow/medium"),
    "MIN_TILES": (DOWN, "ladder_covered_tiles/classical"),
    "WEAK_RATIO": (DOWN, "ladder_narrow_view/classical"),
    # estimators of other libraries
    "INLIER_STDS": (DOWN, "ladder_baseline_noise/half"),
    "MIN_INLIER_PX": (DOWN, "ladder_baseline_noise/tiny"),
    "UNSTATED_FLOW_STD_PX": (DOWN, "ladder_baseline_noise/unstated"),
    # evaluation
    "WRONG_PX": (DOWN, "ladder_evaluation/wrong"),
    "TRUTH_NOISE[tum][0]": (DOWN, "ladder_evaluation/tum_at_20m"),
    "TRUTH_NOISE[tum][1]": (DOWN, "ladder_evaluation/tum_at_0.2m"),
    "TRUTH_NOISE[7scenes][0]": (DOWN, "ladder_evaluation/7scenes_at_20m"),
    "TRUTH_NOISE[7scenes][1]": (DOWN, "ladder_evaluation/7scenes_at_0.2m"),
    "TRUTH_NOISE[folder][0]": (DOWN, "ladder_evaluation/folder_at_20m"),
    "TRUTH_NOISE[folder][1]": (DOWN, "ladder_evaluation/folder_at_0.2m"),
    "TRUTH_NOISE[kitti][0]": (DOWN, "ladder_evaluation/kitti_at_20m"),
    "TRUTH_NOISE[kitti][1]": (DOWN, "ladder_evaluation/kitti_at_0.2m"),
    # the doctor
    "MIN_VALID_DEPTH": (DOWN, "ladder_doctor/little_depth"),
    "EMPTY_DEPTH": (DOWN, "ladder_doctor/empty_frames"),
    "MIN_TEXTURE": (DOWN, "ladder_doctor/little_texture"),
    "MIN_FOCUS": (UP, "ladder_doctor/blur"),
    "NORMAL_REGISTRATION_SHIFT": (DOWN, "ladder_doctor/shifted_depth"),
    "CERTAIN_REGISTRATION_STDS": (DOWN, "ladder_doctor/textured_surfaces"),
    "NEEDED_REGISTRATION_GAIN": (UP, "ladder_doctor/partly_shifted"),
    "STAMP_GAP_FACTOR": (DOWN, "ladder_doctor/late_by"),
    "MAX_LATE_SHARE": (DOWN, "ladder_doctor/late_shares"),
}
"""Fitted number -> the factor by which it is changed, the case that must notice it."""
UNNOTICED: dict[str, str] = {
    "CUE_WEIGHTS[border_coverage]": "the selection changes on none of the pairs",
    "CUE_WEIGHTS[depth_extent]": "the selection changes on none of the pairs",
    "CUE_WEIGHTS[mean_log_depth]": "the selection changes on none of the pairs",
    "AGREEMENT_RIGHT": "a third of it moves log odds by less than what counts as moved",
    "CLUSTERED": "what parts of the view share outweighs what neighbouring tiles do",
    "COHERENT_STDS": "independent errors have less, those of DIS flow many times as much",
    "NO_MOTION_PROBABILITY": "no answer has a probability between .03 and .07",
    "MIN_EQUAL_DEPTHS": "rendered depth is not rounded: tests/solver/test_plane_factor.py",
    "SHARED_SHIFT": "frozen into a kernel: docs/results/sigmas.json",
    "SHARED_DEPTH_ERROR": "frozen into a kernel: docs/results/sigmas.json",
    "EVEN_PARTS": "frozen into a kernel: docs/results/sigmas.json",
    "QUANTUM_PERCENTILE": "rendered depth is not rounded: tests/solver/test_plane_factor.py",
}
"""Fitted number that may change by a third -> why no case notices."""


class Change(NamedTuple):
    """A change of the package, which is in force inside a context."""

    name: str
    make: Callable[[], contextlib.AbstractContextManager[None]]


# -- changes of behaviour ------------------------------------------------------


def changes_of_behaviour() -> list[Change]:
    """Return the changes that no number makes."""
    return [
        Change("photometric refinement off", without_photometric),
        Change("selection of the largest motion", of_largest_motion),
        Change("poses off by 0.3 mrad", lambda: answers_changed(turned)),
        Change("covariance times 4", lambda: answers_changed(widened)),
    ]


@contextlib.contextmanager
def without_photometric() -> Iterator[None]:
    """Hand the motion of the flow out as it is."""
    from hybridvo.solver.refine_images import refine_photometric

    def as_it_is(pair: Any, pose: Any, *args: Any, **options: Any) -> Any:
        return pose

    import hybridvo.pipeline

    with attribute(hybridvo.pipeline, refine_photometric.__name__, as_it_is):
        yield


@contextlib.contextmanager
def of_largest_motion() -> Iterator[None]:
    """Select the motion that most pixels follow, whatever its score."""
    from hybridvo import pipeline

    select = pipeline.select_from

    def largest(rankings: Any) -> Any:
        chosen = select(rankings)
        best = max(chosen.hypotheses, key=lambda motion: motion.inlier_ratio)
        return replace(
            chosen,
            T_curr_prev=best.T_curr_prev,
            noise=None,
            mask=None,
            coverage=1.0,
        )

    with attribute(pipeline, "select_from", largest):
        yield


@contextlib.contextmanager
def answers_changed(change: Callable[[Any], Any]) -> Iterator[None]:
    """Change every answer that is usable, of single pairs and of the tracker."""
    from hybridvo.pipeline import first_sure

    def changed(*args: Any, **options: Any) -> Any:
        answer = first_sure(*args, **options)
        if not answer.motion.usable:
            return answer
        return answer._replace(motion=change(answer.motion))

    with everywhere("first_sure", first_sure, changed):
        yield


def turned(answer: Any) -> Any:
    """Return a motion that is turned by :data:`POSE_ERROR_RAD` about a fixed axis."""
    from hybridvo.core.geometry import se3_exp

    axis = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    turn = se3_exp(np.concatenate([np.zeros(3), POSE_ERROR_RAD * axis]))
    return answer.replace(T_curr_prev=turn @ answer.T_curr_prev)


def widened(answer: Any) -> Any:
    """Return a motion with a covariance that is too large."""
    return answer.replace(covariance=COVARIANCE_FACTOR * answer.covariance)


# -- changes of numbers --------------------------------------------------------


def fitted_numbers() -> dict[str, tuple[str, tuple[Any, ...]]]:
    """Return every number of the calibrations: its name -> that of the constant, the keys."""
    found: dict[str, tuple[str, tuple[Any, ...]]] = {}
    for constant, value in calibrated().items():
        for keys in leaves(value):
            name = constant + "".join(f"[{key}]" for key in keys)
            found[name] = constant, keys
    return found


def calibrated() -> dict[str, Any]:
    """Return the constants of the ``calibration.py`` of every room."""
    found: dict[str, Any] = {}
    for room in ROOMS:
        module = importlib.import_module(f"{room}.calibration")
        found |= {
            name: value for name, value in vars(module).items() if name.isupper()
        }
    return found


def unchecked_numbers() -> list[str]:
    """Return the numbers for which nobody has said which case must notice them."""
    return [
        name
        for name in fitted_numbers()
        if name not in NOTICED_BY and name not in UNNOTICED
    ]


def leaves(value: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the keys that lead to every number inside a constant."""
    if isinstance(value, bool | str):
        return
    if isinstance(value, int | float):
        yield ()
        return
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items:
        for rest in leaves(inner):
            yield (key, *rest)


def with_leaf(value: Any, keys: tuple[Any, ...], factor: float) -> Any:
    """Return a constant in which one number is multiplied; whole numbers stay whole."""
    if not keys:
        changed = factor * value
        return round(changed) if isinstance(value, int) else changed
    first, *rest = keys
    inner = with_leaf(value[first], tuple(rest), factor)
    if isinstance(value, dict):
        return value | {first: inner}
    items = list(value)
    items[first] = inner
    if hasattr(value, "_make"):
        return value._make(items)
    return type(value)(items)


def change_of_number(name: str, factor: float) -> Change:
    """Return the change of one number of the calibration."""
    constant, keys = fitted_numbers()[name]
    return Change(
        f"{name} times {factor:.2f}", lambda: number_changed(constant, keys, factor)
    )


@contextlib.contextmanager
def number_changed(
    constant: str, keys: tuple[Any, ...], factor: float
) -> Iterator[None]:
    """Change a number of a calibration wherever a module has taken it from there.

    Raises:
        ValueError: A compiled kernel has frozen the number, so that a change does nothing.
    """
    if constant in compiled_constants():
        raise ValueError(f"{constant} is frozen into a compiled kernel")
    old = calibrated()[constant]
    new = with_leaf(old, keys, factor)
    with contextlib.ExitStack() as stack:
        stack.enter_context(everywhere(constant, old, new))
        if constant in OPTION_DEFAULTS:
            stack.enter_context(option_default(*OPTION_DEFAULTS[constant], new))
        yield


def compiled_constants() -> set[str]:
    """Return names of the globals that compiled kernels have frozen."""
    names: set[str] = set()
    for module in own_modules():
        for value in vars(module).values():
            code = getattr(getattr(value, "py_func", None), "__code__", None)
            if code is not None:
                names.update(code.co_names)
    return names


@contextlib.contextmanager
def option_default(group: str, option: str, value: Any) -> Iterator[None]:
    """Change the default of an option."""
    from hybridvo.core.options import Options

    fill: Callable[..., None] = Options.__init__

    def filled(self: Any, *args: Any, **values: Any) -> None:
        fill(self, *args, **values)
        changed = replace(getattr(self, group))
        # a default may be out of the option's range: a probability above one
        object.__setattr__(changed, option, value)
        object.__setattr__(self, group, changed)

    with attribute(Options, "__init__", filled):
        yield


# -- how they are made ---------------------------------------------------------


def own_modules() -> list[Any]:
    """Return every module of the package that is loaded."""
    return [
        module
        for name, module in list(sys.modules.items())
        if name.split(".")[0] in ("hybridvo", "hybridvo_lab") and module is not None
    ]


@contextlib.contextmanager
def everywhere(name: str, old: Any, new: Any) -> Iterator[None]:
    """Put a value in the place of another in every module that has it under a name."""
    with contextlib.ExitStack() as stack:
        for module in own_modules():
            if vars(module).get(name, not old) is old:
                stack.enter_context(attribute(module, name, new))
        yield


@contextlib.contextmanager
def attribute(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Give an attribute another value for a while."""
    old = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, old)


# -- who notices ---------------------------------------------------------------


def noticed_by(change: Change, names: Sequence[str]) -> list[str]:
    """Return what the comparison of some cases finds while a change is in force."""
    frozen = json.loads(FROZEN.read_text(encoding="utf-8"))
    # modules that are imported late have to be there before a number is changed in them
    load_all()
    with change.make():
        rows: dict[str, Row] = measure_quick(names, 1, 1)
    # what is noticed within the wider bounds of another processor is noticed on this one
    new = {"processor": "another", "cases": rows}
    findings = compare(frozen, new)
    return [line for line in findings if not line.startswith("better")]


def load_all() -> None:
    """Import what the methods import when they run, and compile the kernels."""
    import pkgutil

    import hybridvo
    import hybridvo_lab
    from hybridvo.tracking.odometry import warm_up

    # what finds motions, and what the cases of doctor and evaluation measure
    wanted = ("pipeline", "network", "solver", "hypotheses", "judge", "flow", "run")
    for package in (hybridvo, hybridvo_lab):
        name = package.__name__
        for each in pkgutil.walk_packages(package.__path__, f"{name}."):
            room = each.name.split(".")[1]
            is_of_lab = package is hybridvo_lab and room != "training"
            if room in wanted or is_of_lab:
                importlib.import_module(each.name)
    warm_up()


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--list", action="store_true", help="print every change")
    parser.add_argument(
        "--unchecked",
        action="store_true",
        help="print numbers that have no case yet",
    )
    parser.add_argument(
        "--numbers",
        default="",
        metavar="A,B",
        help="numbers with this in their name",
    )
    parser.add_argument(
        "--behaviour", default="", metavar="A,B", help="or other changes with this"
    )
    parser.add_argument(
        "--cases", default="", metavar="A,B", help="cases with this in their name"
    )
    args = parser.parse_args(argv)
    if args.unchecked:
        print(*unchecked_numbers(), sep="\n")
        return 0
    chosen = [
        change_of_number(name, factor)
        for name in fitted_numbers()
        for factor in (DOWN, UP)
        if args.list or named(name, args.numbers)
    ]
    chosen += [
        change
        for change in changes_of_behaviour()
        if args.list or named(change.name, args.behaviour)
    ]
    names = [name for name in cases() if named(name, args.cases) or not args.cases]
    for change in chosen:
        if args.list:
            print(change.name)
            continue
        findings = noticed_by(change, names)
        print(f"{change.name}: {len(findings)} findings")
        for line in findings:
            print(f"    {line}", flush=True)
    return 0


def named(name: str, words: str) -> bool:
    """Return whether a name holds one of the words between commas."""
    return any(word and word in name for word in words.split(","))


if __name__ == "__main__":
    sys.exit(main())
