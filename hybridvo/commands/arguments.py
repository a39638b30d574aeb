"""Arguments of the commands, and options from them. Loads nothing heavy: help must be instant.

The docstring of a command is its help.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybridvo.options import Options

FLOWS = ("auto", "file", "dis")


def _sequence(command: argparse.ArgumentParser, required: bool = True) -> None:
    """Which sequence, and what its folder does not say."""
    where = command.add_mutually_exclusive_group(required=required)
    folder = "folder of the sequence"
    where.add_argument("path", nargs="?", default=argparse.SUPPRESS, metavar="DIR", help=folder)
    where.add_argument("--sequence", dest="path", metavar="DIR", help="the same, by name")
    add = command.add_argument
    kinds = "sintel, tartanair, 7scenes, folder, kitti or tum (default: detected)"
    add("--dataset", metavar="KIND", help=kinds)
    camera = "camera.yaml, ROS camera_info, or numbers"
    add("--camera", metavar="FILE|fx,fy,cx,cy", help=camera)
    scale = "depth units per metre, 1000: millimetres"
    add("--depth-scale", type=float, metavar="N", help=scale)
    add("--mask", metavar="DIR", help="images that are 0 where pixels do not count")


def _weights(command: argparse.ArgumentParser) -> None:
    own = "network weights instead of the pretrained ones, as in pwvo=mine.safetensors"
    command.add_argument("--weights", action="append", default=[], metavar="NAME=FILE", help=own)


def _options(command: argparse.ArgumentParser) -> None:
    """What ``run`` and ``compare`` share."""
    add = command.add_argument
    add("--flow", choices=FLOWS, help="default auto: the sequence's files, else DIS")
    add("--start", type=int, metavar="N", help="first frame (default 0)")
    add("--stop", type=int, metavar="N", help="the one after the last frame")
    add("--stride", type=int, metavar="N", help="step between frames (default 1)")
    add("--seed", type=int, metavar="N", help="of everything drawn at random")
    add("--device", choices=("auto", "cpu", "cuda"), help="of the networks (default auto)")
    _weights(command)
    add("--config", metavar="FILE", help="YAML file of options")
    keys = "one option, as in refine.cutoff=2.5; may be repeated; --set help lists the keys"
    add("--set", action="append", default=[], dest="given", metavar="KEY=VALUE", help=keys)
    exists = command.add_mutually_exclusive_group()
    for name, help in (("resume", "go on where it was cut off"), ("overwrite", "start anew")):
        kind: dict[str, Any] = {"action": "store_const", "const": name, "default": "new"}
        exists.add_argument(f"--{name}", dest="mode", help=help, **kind)


def run(command: argparse.ArgumentParser) -> None:
    """Estimate the camera motion of a sequence."""
    _sequence(command)
    add = command.add_argument
    add("--out", metavar="DIR", help="output folder (default: runs/NAME)")
    add("--method", metavar="NAME", help="default: hybrid; `hybridvo doctor` lists all")
    _options(command)
    add("--max-failed", type=float, metavar="X", help="fraction of failed motions (default 0.2)")
    add("--strict", action="store_true", default=None, help="a broken frame ends the run")
    recording = "Rerun recording (extra 'viz'; default: recording.rrd in the output folder)"
    add("--rrd", nargs="?", const="", metavar="FILE", help=recording)


def compare(command: argparse.ArgumentParser) -> None:
    """Run methods side by side and write a report."""
    add = command.add_argument
    named: dict[str, Any] = {"action": "extend", "nargs": "+", "default": [], "metavar": "DIR"}
    add("--sequence", dest="sequences", help="the same as DIR, by name; repeatable", **named)
    many = "sequences, or folders of sequences (MPI Sintel as it was unpacked)"
    add("sequences", **named | {"nargs": "*", "default": argparse.SUPPRESS}, help=many)
    add("--dataset", help="kind of the sequences (default: detected)")
    add("--out", default="runs/compare", metavar="DIR", help="default: runs/compare")
    names = "comma-separated; default: all that run here"
    add("--methods", default="all", type=lambda text: text.replace(" ", "").split(","), help=names)
    _options(command)
    add("--protocol", choices=("paper",), help="MPI Sintel as PWVO's paper scores it: 992 pairs")


def show(command: argparse.ArgumentParser) -> None:
    """Draw the maps of one pair of a sequence."""
    _sequence(command)
    add = command.add_argument
    add("--pair", type=int, default=0, metavar="N", help="first frame (default 0)")
    add("--out", default="pair.png", metavar="FILE", help="default: pair.png")
    add("--method", default="hybrid", metavar="NAME", help="estimator (default: hybrid)")
    add("--flow", choices=FLOWS, default="auto")
    _weights(command)
    add("--overwrite", action="store_true", help="replace the image")


def evaluate(command: argparse.ArgumentParser) -> None:
    """Errors of a trajectory against the truth."""
    add = command.add_argument
    add("estimate", metavar="EST", help="estimated trajectory")
    add("gt", metavar="GT", help="true trajectory")
    kinds = ("se3", "sim3", "origin", "none")
    add("--alignment", choices=kinds, default="se3", help="of the ATE")
    add("--delta", type=float, default=1, metavar="X", help="span of the RPE (default 1)")
    add("--delta-unit", choices=("frames", "s"), default="frames", help="unit of --delta")
    matched = "seconds between matches (default 0.02)"
    add("--max-diff", type=float, default=argparse.SUPPRESS, metavar="S", help=matched)


def doctor(command: argparse.ArgumentParser) -> None:
    """What is missing here, or wrong with a sequence."""
    _sequence(command, required=False)
    command.add_argument("--pairs", type=int, default=40, metavar="N", help="pairs (default 40)")


def demo(command: argparse.ArgumentParser) -> None:
    """Render a scene with moving objects and run on it."""
    add = command.add_argument
    add("--out", default="runs/demo", metavar="DIR", help="default: runs/demo")
    add("--overwrite", action="store_true", help="replace the results in --out")
    add("--frames", type=int, default=20, metavar="N", help="default: 20")
    add("--seed", type=int, default=0, metavar="N", help="of the scene")


def generate(command: argparse.ArgumentParser) -> None:
    """Draw training samples into a folder."""
    add = command.add_argument
    add("--preset", default="paper", help="paper, diverse or a YAML file; default: %(default)s")
    add("--out", required=True, metavar="DIR", help="folder of the samples")
    add("--count", type=int, default=1000, metavar="N", help="default: 1000")
    add("--seed", type=int, default=0, metavar="N")
    add("--size", type=int, nargs=2, metavar=("H", "W"), help="pixels")
    add("--workers", type=int, default=1, metavar="N", help="processes")


def init(command: argparse.ArgumentParser) -> None:
    """Write a camera.yaml to fill in for your recording."""
    command.add_argument("directory", metavar="DIR", help="folder with rgb/ and depth/")


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
    """Options from a YAML file, then from ``group.key=value`` texts, then from named values."""
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
            raise InputError(f"--set: expected group.key=value, as refine.cutoff=3, got {text!r}.")
        values[key.strip()] = parse_yaml(value, f"--set {key}")
    values |= {key: value for key, value in (given or {}).items() if value is not None}
    for key, value in values.items():
        group, _, name = key.partition(".")
        if isinstance(entries := groups.setdefault(group, {}), dict):
            entries[name] = value
    try:
        return Options(**groups)
    except InputError as error:
        where = " and ".join(str(x) for x in (path, assignments and "--set") if x)
        raise InputError(f"{where or 'options'}: {error} --set help lists the keys.") from None


def weight_files(weights: Iterable[str]) -> dict[str, str]:
    """Network -> file of the ``NAME=FILE`` that ``--weights`` was given."""
    from hybridvo.errors import InputError
    from hybridvo.network.models import SELECTION

    known = ("selector", *SELECTION)
    files = dict(text.partition("=")[::2] for text in weights)
    for name, path in files.items():
        if name not in known or not Path(path).is_file():
            expected = f"NAME=FILE with {' or '.join(known)} and a file that exists"
            raise InputError(f"--weights: expected {expected}, got {name}={path}.")
    return files
