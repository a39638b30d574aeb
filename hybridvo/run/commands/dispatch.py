"""The way from the command line to the code: one function for each command.

:mod:`hybridvo.run.commands.arguments` names one of these functions for every command. It takes the
parsed arguments, calls the function that does the work, and returns what is printed. Heavy
modules are imported inside of the functions, so that ``--help`` is instant, and after all that can
be checked without them, so that a typo is answered at once.
"""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hybridvo.run.commands.early import (
    check_camera,
    check_config,
    check_methods,
    check_view,
)
from hybridvo.run.commands.next_step import command_that_shows

if TYPE_CHECKING:
    from hybridvo.core.cluster import Workers
    from hybridvo.core.options import Options
    from hybridvo.io.data.sequence import Sequence as FrameSequence
    from hybridvo.network.models import Models

CHOICES = (
    *("topic_rgb", "topic_depth", "topic_info", "topic_truth"),
    *("depth_dir", "stereo", "readout_ms", "depth_lag_ms", "fps", "trust"),
)
"""What only some recordings need: further arguments of ``open_sequence``."""
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


class Outcome(NamedTuple):
    """What a command returns."""

    content: dict[str, Any]  # JSON-ready
    exit_code: int = 0


def run(args: Namespace) -> Outcome:
    """``hybridvo run``: track a sequence."""
    _check_sequence(args.sequence, args.trust)
    _check_output(args.out)
    check_view(args.view)
    options = _options(args)
    check_methods([options.run.method])
    models = _models(args.weights, options.run.device)
    sequence = _open(args, options)
    from hybridvo.run.commands.run import run

    summary, exit_code = run(
        sequence,
        args.out,
        options,
        models=models,
        mode=args.mode,
        command=args.words,
        quiet=args.quiet,
        rrd=args.rrd,
        view=args.view,
        export=tuple(args.export),
    )
    worst = summary.get("least_sure")
    if worst is not None:
        summary["next"] = command_that_shows(args, worst["frame"])
    return Outcome(summary, exit_code)


def live(args: Namespace) -> Outcome:
    """``hybridvo live``: track a camera."""
    _check_output(args.out)
    check_camera(args.camera, args.preset)
    check_view(args.view)
    options = _options(args)
    check_methods([options.run.method])
    models = _models(args.weights, options.run.device)
    from hybridvo.io.cameras.choose import choose_camera

    camera = choose_camera(
        args.camera,
        args.preset,
        options.depth.source,
        args.mask,
        args.readout_ms,
        args.trust,
        depth_lag_ms=args.depth_lag_ms,
        imu=args.imu,
    )
    from hybridvo.run.commands.live import live

    summary, exit_code = live(
        camera,
        args.out,
        options,
        models=models,
        seconds=args.seconds,
        max_frames=args.max_frames,
        udp=args.udp,
        rrd=args.rrd,
        view=args.view,
        size=args.size,
        rate=args.rate,
        overwrite=args.overwrite,
        command=args.words,
        quiet=args.quiet,
    )
    return Outcome(summary, exit_code)


def compare(args: Namespace) -> Outcome:
    """``hybridvo compare``: run methods side by side."""
    for sequence in args.sequences:
        _check_sequence(sequence, args.trust)
    _check_output(args.out)
    check_methods([args.methods] if isinstance(args.methods, str) else args.methods)
    options = _options(args)
    models = _models(args.weights, options.run.device)
    from hybridvo.run.commands.compare import compare

    summary = compare(
        args.sequences,
        args.out,
        methods=args.methods,
        options=options,
        dataset=args.dataset,
        camera=args.camera,
        depth_scale=args.depth_scale,
        mask=args.mask,
        chosen={**_chosen(args), "depth": _network_depth(options)},
        protocol=args.protocol,
        models=models,
        mode=args.mode,
        command=args.words,
        quiet=args.quiet,
        workers=_workers(args),
    )
    return Outcome(summary)


def show(args: Namespace) -> Outcome:
    """``hybridvo show``: draw the maps of one pair."""
    _check_sequence(args.sequence, args.trust)
    _check_output(args.out)
    check_methods([args.method])
    models = _models(args.weights, "cpu")
    sequence = _open(args)
    from hybridvo.run.commands.show import draw_pair

    picture = draw_pair(
        sequence,
        args.pair if args.frame is None else args.frame - 1,
        args.out,
        flow=args.flow,
        method=args.method,
        models=models,
        everything=args.everything,
        overwrite=args.overwrite,
    )
    return _written(picture)


def convert(args: Namespace) -> Outcome:
    """``hybridvo convert``: write a sequence in another layout."""
    _check_sequence(args.sequence, args.trust)
    _check_output(args.out)
    sequence = _open(args)
    from hybridvo.run.commands.convert import convert as write

    summary = write(
        sequence,
        args.out,
        args.to,
        args.units,
        args.start,
        args.stop,
        args.stride,
        quiet=args.quiet,
    )
    return Outcome(summary)


def evaluate(args: Namespace) -> Outcome:
    """``hybridvo evaluate``: compute the errors of a trajectory."""
    _check_output(args.estimate)
    _check_output(args.gt)
    if args.protocol is not None:
        return _evaluate_by_protocol(args)
    from hybridvo.core.errors import InputError
    from hybridvo.lab.evaluation.metrics import evaluate

    report = evaluate(
        args.estimate,
        args.gt,
        alignment=args.alignment,
        delta=args.delta,
        delta_unit=args.delta_unit,
        max_diff=args.max_diff,
    )
    if report["matched"] == 0:
        reason = report["reasons"]["ate_rmse_unaligned"]
        raise InputError(f"nothing could be compared: {reason}.")
    return Outcome(report)


def _evaluate_by_protocol(args: Namespace) -> Outcome:
    """``hybridvo evaluate --protocol``: the errors of one path as papers define them."""
    from hybridvo.core.errors import InputError
    from hybridvo.lab.evaluation.path_scores import evaluate_path

    report = evaluate_path(args.protocol, args.estimate, args.gt)
    if report["matched"] == 0:
        reason = "; ".join(dict.fromkeys(report["reasons"].values()))
        raise InputError(f"nothing could be compared: {reason}.")
    return Outcome(report)


def doctor(args: Namespace) -> Outcome:
    """``hybridvo doctor``: check what is installed, a sequence, or a camera."""
    _check_sequence(args.sequence, args.trust)
    if args.speed:
        return _doctor_speed(args)
    if args.sequence is not None:
        sequence = _open(args)
    elif args.camera is not None or args.preset is not None:
        check_camera(args.camera, args.preset)
    from hybridvo.run.commands.doctor import diagnose, diagnose_camera, installation

    if args.sequence is not None:
        report = diagnose(sequence, args.pairs)
    elif args.camera is not None or args.preset is not None:
        report = diagnose_camera(
            args.camera,
            args.preset,
            args.seconds,
            args.pairs,
            readout_ms=args.readout_ms,
            depth_lag_ms=args.depth_lag_ms,
            trust=args.trust,
            quiet=args.quiet,
        )
    else:
        return Outcome(installation())
    return Outcome(report, 0 if report["ok"] else 1)


def _doctor_speed(args: Namespace) -> Outcome:
    """``hybridvo doctor --speed``: how fast a sequence, or the demo, is tracked."""
    from hybridvo.core.errors import InputError

    is_live = args.camera is not None or args.preset is not None
    if args.sequence is None and is_live:
        raise InputError(
            "--speed: expected DIR, or nothing for the demo, got a live camera; "
            "'hybridvo live --rate auto' measures at the camera."
        )
    sequence = None if args.sequence is None else _open(args)
    from hybridvo.run.commands.diagnosis.speed import speed

    return Outcome(speed(sequence))


def topics(args: Namespace) -> Outcome:
    """``hybridvo topics``: list the topics of a bag."""
    _check_sequence(args.file, args.trust)
    from hybridvo.run.commands.diagnosis.topics import topics

    return Outcome(topics(args.file, args.trust))


def demo(args: Namespace) -> Outcome:
    """``hybridvo demo``: render a scene and compare methods on it."""
    _check_output(args.out)
    from hybridvo.run.commands.demo import demo

    summary = demo(
        args.out,
        frames=args.frames,
        seed=args.seed,
        overwrite=args.overwrite,
        command=args.words,
        quiet=args.quiet,
    )
    return Outcome(summary)


def generate(args: Namespace) -> Outcome:
    """``hybridvo generate``: draw training samples."""
    _check_output(args.out)
    from hybridvo.run.commands.train import generate

    sheet = generate(
        args.preset,
        args.count,
        args.out,
        seed=args.seed,
        size=args.size,
        workers=_workers(args),
        quiet=args.quiet,
    )
    return _written(sheet)


def init(args: Namespace) -> Outcome:
    """``hybridvo init``: write a camera.yaml to fill in."""
    _check_output(args.directory)
    from hybridvo.io.data.camera_file import write_camera_template

    return _written(write_camera_template(args.directory))


def train(args: Namespace) -> Outcome:
    """``hybridvo train pwvo`` and ``train paper``: train a network."""
    _check_output(args.out)
    check_config(args.config)
    from hybridvo.run.commands.train import train_network

    result = train_network(
        args.training,
        args.config,
        args.out,
        data=args.data,
        init=args.init,
        time_limit=args.time_limit,
        seed=args.seed,
        device=args.device,
        workers=args.workers,
        command=args.words,
    )
    return Outcome(result)


def export_weights(args: Namespace) -> Outcome:
    """``hybridvo train export``: write the weights of a training run for users."""
    from hybridvo.lab.training.trainer import export_run

    return Outcome(export_run(args.folder, args.path, args.count))


def draw_training_samples(args: Namespace) -> Outcome:
    """``hybridvo train samples``: draw samples for PWVO."""
    from hybridvo.run.commands.train import draw_training_samples

    result = draw_training_samples(
        args.data,
        args.first_seed,
        args.seeds,
        recordings=args.recordings,
        shares=args.shares,
        workers=_workers(args),
    )
    return Outcome(result)


# -- what commands share -----------------------------------------------------------------


def _written(path: Path) -> Outcome:
    """Return the outcome of a command that has written one file."""
    return Outcome({"files": [str(path)]})


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


def _open(args: Namespace, options: Options | None = None) -> FrameSequence:
    """Open the sequence that the arguments name, with the depth that the options select."""
    from hybridvo.io.data.open import open_sequence

    depth = args.depth if options is None else _network_depth(options)
    return open_sequence(
        args.sequence,
        dataset=args.dataset,
        camera=args.camera,
        depth_scale=args.depth_scale,
        mask=args.mask,
        depth=depth,
        **_chosen(args),
    )


def _network_depth(options: Options) -> str | None:
    """Return the network that predicts depth; None: the sequence has its own."""
    source = options.depth.source
    return None if source == "auto" else source


def _chosen(args: Namespace) -> dict[str, Any]:
    """Return what only some recordings need: topics of a bag, the depth of a video."""
    return {name: getattr(args, name) for name in CHOICES}


def _workers(args: Namespace) -> Workers:
    """Return where independent tasks run."""
    from hybridvo.core.cluster import Workers

    return Workers(args.jobs, args.cluster)


def _options(args: Namespace) -> Options:
    """Read the options: arguments of their own win over ``--set``, which wins over the file."""
    from hybridvo.core.options import load_options

    own_arguments = {
        "flow.source": args.flow,
        "depth.source": args.depth,
        "run.start": args.start,
        "run.stop": args.stop,
        "run.stride": args.stride,
        "run.seed": args.seed,
        "run.device": args.device,
    }
    if args.command in ("run", "live"):
        own_arguments |= {
            "run.method": args.method,
            "run.max_failed": args.max_failed,
            "run.strict": args.strict,
        }
    if args.command == "run":
        own_arguments["run.passes"] = args.passes
    return load_options(args.config, args.assignments, own_arguments)


def _models(weights: Sequence[str], device: str) -> Models:
    """Make the networks, some of which have weights that are given as NAME=FILE."""
    from hybridvo.core.errors import InputError
    from hybridvo.network.models import SELECTION, Models

    known = ("pwvo", *SELECTION)
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
