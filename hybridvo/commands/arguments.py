"""Arguments of the commands, and options from them. Loads nothing heavy: help must be instant."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridvo import __version__
from hybridvo.commands.train import add_train

if TYPE_CHECKING:
    from hybridvo.options import Options

METHODS = (
    *("hybrid", "hybrid-flow", "refine", "pwvo-refine"),
    *("pwvo", "pwvo-paper", "pwvo-uncertain", "pwvo-naive", "pixelwise"),
    *("vonet", "vonet-attention", "pnp-ransac", "pnp-ransac-tuned", "usac-magsac", "poselib"),
    *("opencv-rgbd", "open3d-rgbd", "identity"),
)
"""For the help alone, which must not load what the methods need."""
KINDS = ("sintel", "tartanair", "7scenes", "folder", "kitti", "tum")


def build_parser(calls: Mapping[str, Any]) -> argparse.ArgumentParser:
    """Parser of the whole command line; ``calls`` has the function of every command."""
    parser = argparse.ArgumentParser(
        prog="hybridvo",
        description="Metric camera motion with covariance from optical flow, depth and intrinsics.",
    )
    parser.add_argument("--version", action="version", version=f"hybridvo {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, help: str, *parents: argparse.ArgumentParser) -> argparse.ArgumentParser:
        described: dict[str, Any] = {"help": help, "description": help[0].upper() + help[1:] + "."}
        made = commands.add_parser(name, parents=[_common(), *parents], **described)
        made.set_defaults(call=calls[name])
        return made

    sequence = _input()
    _add_run(command("run", "estimate the camera motion of a sequence", sequence))
    _add_compare(command("compare", "run methods side by side and write a report"))
    _add_show(command("show", "draw the maps of one pair of a sequence", sequence))
    _add_evaluate(command("evaluate", "errors of a trajectory file against ground truth"))
    wrong = "what is missing here, or wrong with a sequence"
    add = command("doctor", wrong, _input(required=False)).add_argument
    add("--pairs", type=int, default=40, metavar="N", help="pairs (default 40)")
    add = command("demo", "render a scene with moving objects and run on it").add_argument
    add("--out", default="runs/demo", metavar="DIR", help="default: runs/demo")
    add("--overwrite", action="store_true", help="replace the results in --out")
    add("--frames", type=int, default=20, metavar="N", help="default: 20")
    add("--seed", type=int, default=0, metavar="N", help="of the scene")
    generate = command("generate", "draw training samples into a folder")
    which = generate.add_mutually_exclusive_group(required=True)
    which.add_argument("path", nargs="?", metavar="PRESET", help="paper, diverse or a YAML file")
    which.add_argument("--preset", metavar="PRESET", help="the same, by name")
    add = generate.add_argument
    add("--out", required=True, metavar="DIR", help="folder of the samples")
    add("--count", type=int, default=1000, metavar="N", help="default: 1000")
    add("--seed", type=int, default=0, metavar="N")
    add("--size", type=int, nargs=2, metavar=("H", "W"), help="pixels")
    add("--workers", type=int, default=1, metavar="N", help="processes")
    add_train(commands.add_parser("train", help="train a network"), _common(), calls["train"])
    init = command("init", "write a camera.yaml to fill in, for a recording of your own")
    init.add_argument("directory", metavar="DIR", help="folder with rgb/ and depth/")
    return parser


def _common() -> argparse.ArgumentParser:
    """Options of every command."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    loudness = common.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", action="store_true", help="more, and tracebacks")
    loudness.add_argument("-q", "--quiet", action="store_true", help="errors only")
    return common


def _input(required: bool = True) -> argparse.ArgumentParser:
    """Which sequence, and what its folder does not say."""
    given = argparse.ArgumentParser(add_help=False)
    where = given.add_mutually_exclusive_group(required=required)
    where.add_argument("path", nargs="?", metavar="DIR", help="folder of the sequence")
    where.add_argument("--sequence", metavar="DIR", help="the same, by name")
    add = given.add_argument
    add("--dataset", metavar="KIND", help=f"one of {', '.join(KINDS)} (default: detected)")
    camera = "camera.yaml, ROS camera_info, or numbers"
    add("--camera", metavar="FILE|fx,fy,cx,cy", help=camera)
    scale = "depth units per metre, 1000: millimetres"
    add("--depth-scale", type=float, metavar="N", help=scale)
    add("--mask", metavar="DIR", help="images that are 0 where pixels do not count")
    return given


def _add_selection(command: argparse.ArgumentParser) -> None:
    """What ``run`` and ``compare`` share."""
    add = command.add_argument
    flow = "default auto: the sequence's files, else DIS; compare: side by side"
    add("--flow", choices=("auto", "file", "dis"), help=flow)
    add("--start", type=int, metavar="N", help="first frame (default 0)")
    add("--stop", type=int, metavar="N", help="the one after the last frame")
    add("--stride", type=int, metavar="N", help="step between frames (default 1)")
    add("--seed", type=int, metavar="N", help="of everything drawn at random")
    add("--device", choices=("auto", "cpu", "cuda"), help="of the networks (default auto)")
    own = "network weights instead of the pretrained ones, as in pwvo=mine.safetensors"
    add("--weights", action="append", default=[], metavar="NAME=FILE", help=own)
    add("--config", metavar="FILE", help="YAML file of options")
    keys = "one option, as in refine.cutoff=2.5; may be repeated; --set help lists the keys"
    add("--set", action="append", default=[], dest="given", metavar="KEY=VALUE", help=keys)
    exists = command.add_mutually_exclusive_group()
    for name, help in (("resume", "go on where it was cut off"), ("overwrite", "start anew")):
        kind: dict[str, Any] = {"action": "store_const", "const": name, "default": "new"}
        exists.add_argument(f"--{name}", dest="mode", help=help, **kind)


def _add_run(run: argparse.ArgumentParser) -> None:
    add = run.add_argument
    add("--out", metavar="DIR", help="output folder (default: runs/NAME)")
    add("--method", metavar="NAME", help=f"one of {', '.join(METHODS)} (default: hybrid)")
    _add_selection(run)
    add("--max-failed", type=float, metavar="X", help="fraction of failed motions (default 0.2)")
    add("--strict", action="store_true", default=None, help="a broken frame ends the run")
    recording = "Rerun recording (extra 'viz'; default: recording.rrd in the output folder)"
    add("--rrd", nargs="?", const="", metavar="FILE", help=recording)


def _add_compare(compare: argparse.ArgumentParser) -> None:
    add = compare.add_argument
    many = "sequences, or folders of sequences (MPI Sintel as it was unpacked)"
    add("paths", nargs="*", metavar="DIR", help=many)
    named = "the same, by name; repeatable"
    add("--sequence", action="extend", nargs="+", default=[], metavar="DIR", help=named)
    add("--dataset", help="kind of the sequences (default: detected)")
    add("--out", default="runs/compare", metavar="DIR", help="default: runs/compare")
    add("--methods", default="all", help="comma-separated; default: all that run here")
    _add_selection(compare)
    add("--protocol", choices=("paper",), help="MPI Sintel as PWVO's paper scores it: 992 pairs")
    add("--worst", type=int, default=3, help="worst pairs shown for each method")


def _add_show(show: argparse.ArgumentParser) -> None:
    add = show.add_argument
    add("--pair", type=int, default=0, metavar="N", help="first frame (default 0)")
    add("--out", default="pair.png", metavar="FILE", help="default: pair.png")
    add("--method", default="hybrid", metavar="NAME", help="estimator (default: hybrid)")
    add("--flow", choices=("auto", "file", "dis"), default="auto")
    add("--weights", action="append", default=[], metavar="FILE", help="a network")
    add("--steps", type=int, default=32, help="of the integrated gradients")
    add("--overwrite", action="store_true", help="replace the image")


def _add_evaluate(evaluate: argparse.ArgumentParser) -> None:
    add = evaluate.add_argument
    add("estimate", metavar="EST", help="estimated trajectory")
    add("gt", metavar="GT", help="true trajectory")
    kinds = ("se3", "sim3", "origin", "none")
    add("--alignment", choices=kinds, default="se3", help="of the ATE")
    add("--delta", type=float, default=1, metavar="X", help="span of the RPE (default 1)")
    add("--delta-unit", choices=("frames", "s"), default="frames", help="unit of --delta")
    add("--max-diff", type=float, metavar="S", help="seconds between matches")
    for name in ("est", "gt"):
        add(f"--format-{name}", choices=("auto", "tum", "kitti", "tartanair"), default="auto")
        add(f"--axes-{name}", choices=("auto", "camera", "ned"), default="auto")


# -- options --------------------------------------------------------------------------------------


def option_defaults() -> dict[str, Any]:
    """Every key that ``--set`` knows, such as ``refine.cutoff``, with its default."""
    from hybridvo.options import Options

    return {
        f"{group}.{name}": value
        for group, options in dataclasses.asdict(Options()).items()
        for name, value in options.items()
    }


def run_options(args: argparse.Namespace) -> Options:
    """Options from the arguments of ``run`` or ``compare``."""
    names = ("method", "start", "stop", "stride", "device", "max_failed", "strict", "seed")
    named = {f"run.{name}": getattr(args, name, None) for name in names}
    return load_options(args.config, args.given, named | {"flow.source": args.flow})


def load_options(
    path: str | Path | None = None,
    assignments: Iterable[str] = (),
    given: Mapping[str, Any] | None = None,
) -> Options:
    """Options from a YAML file, then from ``group.key=value`` texts, then from named values.

    The values of ``assignments`` are YAML; those of ``given``, such as ``{"run.method":
    "refine"}``, are left out where they are None.

    Example:
        >>> load_options(assignments=["refine.cutoff=2.5"]).refine.cutoff
        2.5
    """
    from hybridvo.errors import FormatError, InputError
    from hybridvo.files import parse_yaml, read_text
    from hybridvo.options import Options

    groups: dict[str, Any] = {}
    if path is not None:
        try:
            groups = parse_yaml(read_text(path), str(path)) or {}
        except FileNotFoundError:
            raise InputError(f"{path}: no such file.") from None
        if not isinstance(groups, dict):
            raise FormatError(f"{path}: expected 'group:' lines, got a {type(groups).__name__}.")
    values: dict[str, Any] = {}
    for text in assignments:
        key, sign, value = text.partition("=")
        if not sign or "." not in key:
            raise InputError(
                f"--set: expected group.key=value, as in refine.cutoff=3, got {text!r}."
            )
        values[key.strip()] = parse_yaml(value, f"--set {key}")
    values |= {key: value for key, value in (given or {}).items() if value is not None}
    for key, value in values.items():
        group, _, name = key.partition(".")
        if isinstance(entries := groups.setdefault(group, {}), dict):
            entries[name] = value
    try:
        return Options(**groups)
    except InputError as error:
        found = re.match(r"Options\.([\w.]+): unexpected", str(error))
        near = difflib.get_close_matches(found[1], option_defaults(), n=1) if found else []
        hint = f" Did you mean '{near[0]}'?" if near else ""
        where = " and ".join(str(x) for x in (path, assignments and "--set") if x)
        raise InputError(f"{where or 'options'}: {error}{hint}") from None


def weight_files(weights: Iterable[str], methods: Iterable[str]) -> dict[str, str]:
    """Network -> file of the ``NAME=FILE`` that ``--weights`` was given."""
    from hybridvo.errors import InputError
    from hybridvo.pipeline import networks_of

    files = {}
    known = sorted({name for method in methods for name in networks_of(method)})
    for text in weights:
        name, sign, path = text.partition("=")
        if not sign or name not in known:
            raise InputError(
                f"--weights: expected NAME=FILE with {' or '.join(known) or 'no name'} for these "
                f"methods, got {text!r}."
            )
        if not Path(path).is_file():
            raise InputError(f"--weights {name}: {path}: no such file.")
        files[name] = path
    return files
