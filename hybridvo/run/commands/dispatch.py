"""The way from the command line to the code: arguments are passed by name.

:mod:`hybridvo.run.commands.arguments` states which function a command calls. The function gets the
arguments that have the names of its parameters, and what :func:`prepared` makes of others. Heavy
modules are imported inside of functions, so that ``--help`` is instant, and after all that can be
checked without them, so that a typo is answered at once.
"""

from __future__ import annotations

import dataclasses
import inspect
import os
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hybridvo.core import laboratory
from hybridvo.run.commands.early import (
    check_camera,
    check_config,
    check_methods,
    check_view,
)
from hybridvo.run.commands.next_step import command_that_shows

if TYPE_CHECKING:
    from hybridvo.core.options import Options
    from hybridvo.network.models import Models

OUTPUTS = ("out", "estimate", "gt", "directory")
"""Arguments that name files or folders which need not be there."""
SCENE_FOLDERS = (
    "final",
    "clean",
    "albedo",
    "flow",
    "depth",
    "camdata_left",
    "invalid",
    "occlusions",
)
"""Folders of MPI Sintel. A scene may be named in any of them, even if it is not there."""


class CommandResult(NamedTuple):
    """What a command returns."""

    content: dict[str, Any]  # JSON-ready
    exit_code: int = 0


def calling(place: str) -> Callable[[Namespace], CommandResult]:
    """Return a command that calls a function, which returns a report or the file it wrote.

    Args:
        place: ``MODULE:FUNCTION``.
    """
    return partial(_call_place, place)


def from_laboratory(name: str) -> Callable[[Namespace], CommandResult]:
    """Return a command that calls a function of hybridvo-lab, likewise."""
    return partial(_call_laboratory, name)


def _call_place(place: str, args: Namespace) -> CommandResult:
    """Call ``MODULE:FUNCTION`` with the arguments that it takes."""
    given = prepared(args)
    module, _, name = place.partition(":")
    return _outcome_of(getattr(import_module(module), name), given)


def _call_laboratory(name: str, args: Namespace) -> CommandResult:
    """Call a function of hybridvo-lab with the arguments that it takes."""
    laboratory.check_there(laboratory.COMMANDS, name, _as_typed(name))
    given = prepared(args)
    return _outcome_of(_command_of_laboratory(name), given)


def _command_of_laboratory(name: str) -> Callable[..., Any]:
    """The function of hybridvo-lab that a command calls."""
    found: Callable[..., Any] = laboratory.wanted(
        laboratory.COMMANDS, name, _as_typed(name)
    )
    return found


def _as_typed(name: str) -> str:
    """A command as it is typed."""
    return f"'hybridvo {name.replace('-', ' ')}'"


def _outcome_of(
    function: Callable[..., Any], given: Mapping[str, Any]
) -> CommandResult:
    """The outcome of a function that returns a report or the file it wrote."""
    result = call(function, given)
    if isinstance(result, Path):
        result = {"files": [str(result)]}
    return CommandResult(result)


def taken_by(
    function: Callable[..., Any], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the arguments that have the names of a function's parameters."""
    names = inspect.signature(function).parameters
    return {name: value for name, value in given.items() if name in names}


def call(function: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """Call a function with those of the arguments that it takes."""
    return function(**taken_by(function, given))


# -- commands that are more than a call --------------------------------------------------


def run(args: Namespace) -> CommandResult:
    """``hybridvo run``: track a sequence, and name the command that shows its least sure step."""
    given = prepared(args)
    from hybridvo.run.commands.run import run

    summary, exit_code = call(run, given)
    worst = summary.get("least_sure")
    if worst is not None:
        summary["next"] = command_that_shows(args, worst["frame"])
    return CommandResult(summary, exit_code)


def live(args: Namespace) -> CommandResult:
    """``hybridvo live``: track a camera."""
    check_camera(args.camera, args.preset)
    given = prepared(args)
    from hybridvo.io.cameras.choose import choose_camera

    source = given["options"].depth.source
    camera = call(choose_camera, given | {"name": args.camera, "depth": source})
    from hybridvo.run.commands.live import live

    return CommandResult(*call(live, given | {"camera": camera}))


def evaluate(args: Namespace) -> CommandResult:
    """``hybridvo evaluate``: compute the errors of a trajectory."""
    given = prepared(args)
    from hybridvo.core.errors import InputError

    if args.protocol is None:
        report = call(_command_of_laboratory("evaluate"), given)
        reasons = [report["reasons"].get("ate_rmse_unaligned")]
    else:
        report = call(_command_of_laboratory("evaluate-path"), given)
        reasons = list(dict.fromkeys(report["reasons"].values()))
    if report["matched"] == 0:
        raise InputError(f"nothing could be compared: {'; '.join(reasons)}.")
    return CommandResult(report)


def doctor(args: Namespace) -> CommandResult:
    """``hybridvo doctor``: check what is installed, a sequence, or a camera."""
    from hybridvo.core.errors import InputError

    names_camera = args.camera is not None or args.preset is not None
    is_live = names_camera and args.sequence is None
    if args.speed and is_live:
        raise InputError(
            "--speed: expected DIR, or nothing for the demo, got a live camera; "
            "'hybridvo live --rate auto' measures at the camera."
        )
    if is_live:
        check_camera(args.camera, args.preset)
    given = prepared(args)
    if args.speed:
        from hybridvo.run.commands.diagnosis.speed import speed

        return CommandResult(call(speed, given))
    from hybridvo.run.commands.doctor import diagnose, diagnose_camera, installation

    if is_live:
        report = call(diagnose_camera, given | {"name": args.camera})
    elif args.sequence is not None:
        report = call(diagnose, given)
    else:
        return CommandResult(installation())
    return CommandResult(report, 0 if report["ok"] else 1)


def train(args: Namespace) -> CommandResult:
    """``hybridvo train pwvo`` and ``train paper``: train a network."""
    check_config(args.config)
    given = prepared(args)
    return CommandResult(call(_command_of_laboratory("train"), given))


# -- what commands share -----------------------------------------------------------------


def prepared(args: Namespace) -> dict[str, Any]:
    """Check the arguments of a command, and return them with what is made of them.

    Returns:
        The arguments by name, and for commands that have arguments for these: ``options``,
        ``models``, ``workers``, ``opened_with`` (how sequences are read), ``sequence``, which is
        open then, and ``command``, the words of the command line.
    """
    given = vars(args) | {"command": args.words}
    sequence = given.get("sequence", given.get("file"))
    for path in given.get("sequences", [sequence]):
        _check_sequence(path, given.get("trust", False))
    for name in OUTPUTS:
        _check_output(given.get(name))
    check_view(given.get("view"))
    options = None
    if "assignments" in args:
        options = given["options"] = _options(given)
    if "method" in args:
        check_methods([options.run.method if options else args.method])
    check_methods(given.get("methods", ()))
    if "weights" in args:
        device = options.run.device if options else "cpu"
        given["models"] = _models(args.weights, device)
    if "jobs" in args:
        workers = laboratory.wanted(laboratory.FUNCTIONS, "workers", "--jobs")
        given["workers"] = workers(args.jobs, args.cluster)
    if "dataset" in args:
        from hybridvo.io.data.open import open_sequence

        reading = taken_by(open_sequence, given)
        if options is not None:
            source = options.depth.source
            reading["depth"] = None if source == "auto" else source
        given["opened_with"] = reading
        if sequence is not None:
            given["sequence"] = open_sequence(args.sequence, **reading)
    return given


def _check_output(path: str | Path | None) -> None:
    """Refuse a name that no file can have, before heavy imports."""
    from hybridvo.core.files import check_name

    if path:
        check_name(Path(path))


def _check_sequence(path: str | None, trust: bool = False) -> None:
    """Refuse the folder of a sequence that is not there, before heavy imports.

    The process that will read it, without --trust, imports its libraries meanwhile.
    """
    from hybridvo.core.errors import InputError, missing_sequence
    from hybridvo.io.data.confined.fork_server import prepare

    if path is None:
        return
    if os.path.exists(path):
        if not trust:
            prepare(Path(path))
        return
    is_scene = Path(path).parent.name in SCENE_FOLDERS
    if not is_scene:
        raise InputError(missing_sequence(path))


def _options(given: Mapping[str, Any]) -> Options:
    """Read the options: arguments of their own win over ``--set``, which wins over the file.

    An argument with the name of an option of the group ``run`` sets that option.
    """
    from hybridvo.core.options import RunOptions, load_options

    named = {
        f"run.{option.name}": given.get(option.name)
        for option in dataclasses.fields(RunOptions)
    }
    named |= {"flow.source": given["flow"], "depth.source": given["depth"]}
    return load_options(given["config"], given["assignments"], named)


def _models(weights: Sequence[str], device: str) -> Models:
    """Make the networks, some of which have weights that are given as NAME=FILE."""
    from hybridvo.core.errors import InputError
    from hybridvo.network.models import Models, network_names

    known = network_names()
    files: dict[str, str | Path] = {}
    for text in weights:
        name, _, path = text.partition("=")
        if name not in known or not Path(path).is_file():
            expected = f"NAME=FILE with {' or '.join(known)} and a file that exists"
            example = "as in pwvo=mine.safetensors"
            raise InputError(
                f"--weights: expected {expected}, {example}; got {text}."
            )
        files[name] = path
    return Models(device, files)
