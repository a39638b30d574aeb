"""Make changes that the quick golden must notice, one by one.

    python tools/golden_mutations.py --list
    python tools/golden_mutations.py --numbers CHOICE_RIGHT --cases network
    python tools/golden_mutations.py --find

The first prints every change; the second makes those of one number and prints which of
some cases notice; the third finds a case for each number that has none. A change is undone
before the next one is made.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from golden_cases.figures import Row, compare
from golden_cases.quick import cases, measure_quick
from measuring import ROOT, parser_of

from hybridvo.core.errors import InputError

FROZEN = ROOT / "docs/golden_quick.json"
POSE_ERROR_RAD = 3e-4
COVARIANCE_FACTOR = 4.0
UP = 4.0 / 3.0
DOWN = 2.0 / 3.0
ROOMS = (
    *("hybridvo.core", "hybridvo.flow", "hybridvo.solver", "hybridvo.judge"),
    *("hybridvo.hypotheses", "hybridvo.evidence", "hybridvo.tracking"),
    "hybridvo.objects",
    *("hybridvo.io", "hybridvo.run", "hybridvo_lab", "hybridvo_lab.baselines"),
)
"""Rooms with numbers that decide."""
OPTION_DEFAULTS = {
    "MIN_PROBABILITY": ("select", "min_probability"),
    "KERNEL_CUTOFF": ("refine", "cutoff"),
}
"""Numbers that the code takes from the options: group and name of the option."""

BEHAVIOUR_NOTICED_BY = {
    "photometric refinement off": "heavy_ten/hybrid",
    "selection of the largest motion": "heavy_ten/hybrid-flow",
    "poses off by 0.3 mrad": "scenario_low_noise/classical",
    "covariance times 4": "scenario_low_noise/classical",
}
"""Change -> the case that must notice it."""
NOTICED = ROOT / "docs/golden_noticed.json"
"""Number -> what :class:`Noticed` says; ``--find`` writes it."""
FACTORS = {"down": DOWN, "up": UP}


class Noticed(NamedTuple):
    """How a number is changed, and who notices."""

    direction: str  # down or up by a third
    case: str
    in_a_copy: bool  # of the sources: it is frozen into kernels or other numbers


NOTICED_BY = {
    name: Noticed(*noticed)
    for name, noticed in json.loads(NOTICED.read_text(encoding="utf-8")).items()
}
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
        number, motion = first_sure(*args, **options)
        return number, change(motion) if motion.usable else motion

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


def fitted_numbers(
    rooms: Sequence[str] = ROOMS,
) -> dict[str, tuple[str, tuple[Any, ...]]]:
    """Return every number of the calibrations: its name -> that of the constant, the keys."""
    found: dict[str, tuple[str, tuple[Any, ...]]] = {}
    for constant, value in calibrated(rooms).items():
        for keys in leaves(value):
            name = constant + "".join(f"[{key}]" for key in keys)
            found[name] = constant, keys
    return found


def calibrated(rooms: Sequence[str] = ROOMS) -> dict[str, Any]:
    """Return the constants of the ``calibration.py`` of every room."""
    found: dict[str, Any] = {}
    for room in rooms:
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
    """Return the change of one number of the calibrations."""
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


LIKELY: dict[str, tuple[str, ...]] = {
    "hybridvo.solver.torch": ("scenario_moving50/pwvo-refine",),
    "hybridvo.tracking.object": (
        *("objects_heavy_ten_fast/hybrid", "objects_heavy_ten_slow/hybrid"),
        "objects_light_fast/hybrid",
    ),
    "hybridvo.tracking.gyroscope": ("gyroscope/hybrid",),
    "hybridvo.tracking.accelerometer": ("gravity/hybrid",),
    "hybridvo.tracking.inertial": ("gyroscope/hybrid",),
    "hybridvo.tracking.depth_scale": ("network_depth/hybrid",),
    "hybridvo.tracking.relocalization": ("kidnapped/hybrid",),
    "hybridvo.tracking": (
        *("movers_heavy_two_slow/hybrid", "kidnapped/hybrid"),
        "movers_heavy_ten_fast/hybrid",
    ),
    "hybridvo.run": ("ladder_doctor",),
    "hybridvo_lab": ("ladder_evaluation", "ladder_baseline"),
    "hybridvo": (
        *("heavy_ten/hybrid", "scenario_moving70/classical"),
        *("movers_heavy_two_slow/hybrid", "movers_heavy_ten_fast/hybrid"),
    ),
}
"""Module -> words in the names of the cases that may notice its numbers."""


def find_who_notices(words: str, in_a_copy: bool) -> None:
    """Change numbers that nobody has said anything of, and keep which case notices each.

    Args:
        words: in the names of the numbers, between commas; empty: all.
        in_a_copy: whether the sources of a copy are changed, so that all that rests on a number is
            made anew: kernels, and other numbers.
    """
    load_all()
    for name in unchecked_numbers():
        if words and not named(name, words):
            continue
        likely = likely_to_notice(fitted_numbers()[name][0])
        wanted = [case for case in cases() if any(word in case for word in likely)]
        found = first_that_notices(name, wanted, in_a_copy)
        print(f"{name}: {found or 'not noticed'}", flush=True)
        if found is not None:
            keep_noticed(name, found)


def first_that_notices(
    name: str, wanted: Sequence[str], in_a_copy: bool
) -> Noticed | None:
    """The direction in which a change of a number is noticed first, and the case."""
    for direction in FACTORS:
        for some in [wanted] if in_a_copy else [[case] for case in wanted]:
            found = who_notices(name, direction, some, in_a_copy)
            if found:
                return Noticed(
                    direction, found[0].split()[1].rstrip(":"), in_a_copy
                )
    return None


def who_notices(
    name: str, direction: str, wanted: Sequence[str], in_a_copy: bool
) -> list[str]:
    """What some cases find while a number is changed; nothing where it has no such value."""
    factor = FACTORS[direction]
    if in_a_copy:
        with tempfile.TemporaryDirectory() as folder:
            return noticed_in(copied(Path(folder)), name, factor, wanted)
    try:
        return noticed_by(change_of_number(name, factor), wanted)
    # no valid value, or frozen into a kernel
    except (InputError, ValueError):
        return []


def copied(folder: Path) -> Path:
    """Copy what the quick golden needs into a folder, with its compiled kernels."""
    for part in ("hybridvo", "hybridvo_lab", "tools"):
        shutil.copytree(ROOT / part, folder / part)
    (folder / "docs").mkdir()
    for path in (FROZEN, NOTICED):
        shutil.copy(path, folder / "docs")
    return folder


def noticed_in(
    copy: Path, name: str, factor: float, wanted: Sequence[str]
) -> list[str]:
    """What some cases find of a number that is changed in the sources of a copy."""
    constant, keys = fitted_numbers()[name]
    path = next(
        path
        for path in sorted(copy.rglob("calibration.py"))
        if re.search(rf"^{constant} = ", path.read_text("utf-8"), re.MULTILINE)
    )
    path.write_text(
        edited(path.read_text("utf-8"), constant, keys, factor), "utf-8"
    )
    tool = ["tools/golden.py", "--quick", "--only", ",".join(wanted)]
    done = subprocess.run(
        [sys.executable, *tool],
        cwd=copy,
        env=os.environ | {"PYTHONPATH": str(copy)},
        capture_output=True,
        text=True,
        check=False,
    )
    *found, last = done.stdout.splitlines() or [""]
    if not last.startswith("golden:"):
        return []
    return [line for line in found if not line.startswith("better")]


def edited(text: str, constant: str, keys: tuple[Any, ...], factor: float) -> str:
    """A source in which one number of a constant is multiplied.

    >>> edited("A = (1, -2.0)", "A", (1,), 3.0)
    'A = (1, -6.0)'
    """
    for node in ast.parse(text).body:
        is_it = (
            isinstance(node, ast.Assign)
            and ast.unparse(node.targets[0]) == constant
        )
        if not is_it:
            continue
        value: Any = node.value
        for key in keys:
            if isinstance(value, ast.Dict):
                names = [ast.literal_eval(each) for each in value.keys if each]
                value = value.values[names.index(key)]
            else:
                value = value.elts[key]
        old = ast.get_source_segment(text, value) or ""
        lines = text.splitlines(keepends=True)
        start = sum(map(len, lines[: value.lineno - 1])) + value.col_offset
        new = with_leaf(ast.literal_eval(value), (), factor)
        return f"{text[:start]}{new!r}{text[start + len(old) :]}"
    raise ValueError(constant)


def keep_noticed(name: str, found: Noticed) -> None:
    """Write down which case notices a number."""
    noticed = json.loads(NOTICED.read_text(encoding="utf-8"))
    noticed[name] = found
    lines = [f" {json.dumps(n)}: {json.dumps(each)}" for n, each in noticed.items()]
    NOTICED.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def likely_to_notice(constant: str) -> set[str]:
    """Words in the names of the cases that may notice a number, by the modules that use it."""
    users = [
        module.__name__
        for module in own_modules()
        if constant in vars(module) and not module.__name__.endswith("calibration")
    ]
    words: set[str] = set()
    for user in users:
        most = max((name for name in LIKELY if user.startswith(name)), key=len)
        words.update(LIKELY[most])
    return words


def load_all() -> None:
    """Import what the methods import when they run, and compile the kernels."""
    import pkgutil

    import hybridvo
    import hybridvo_lab
    from hybridvo.tracking.tracker import warm_up

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
        "--find",
        action="store_true",
        help="find the case that notices each number without one, and keep it",
    )
    parser.add_argument(
        "--in-a-copy",
        action="store_true",
        help="with --find: change the sources of a copy, for numbers that are frozen into others",
    )
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
    if args.find:
        find_who_notices(args.numbers, args.in_a_copy)
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
