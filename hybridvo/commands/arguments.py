"""The arguments of every command, and the function it calls; help loads nothing heavy.

A ``dest`` with a dot, such as ``run.stride``, is the place of an option in :mod:`hybridvo.options`;
the others have the names of parameters of the function.
"""

from __future__ import annotations

import re
from argparse import SUPPRESS, Action, ArgumentParser
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from hybridvo import __version__
from hybridvo.errors import printable

CHOICES = ("topic_rgb", "topic_depth", "topic_info", "topic_truth", "depth_dir")
"""What only some recordings take: further arguments of ``open_sequence``."""
FLOWS = ("auto", "file", "dis")
DEVICES = ("auto", "cpu", "cuda")
COUNT: dict[str, Any] = {"type": int, "metavar": "N"}
FLAG: dict[str, Any] = {"action": "store_true"}


OPTIONS = Path(__file__).parents[1] / "odometry.yaml"
"""Every option with its default and its meaning."""


class Parser(ArgumentParser):
    """A parser whose errors show what was given without letting it steer the terminal."""

    def exit(self, status: int = 0, message: str | None = None) -> Any:
        """End the program; ``message`` goes to stderr."""
        super().exit(status, message and printable(message))


class SetOption(Action):
    """``--set KEY=VALUE``; ``--set help`` lists the keys and ends, whatever else is missing."""

    def __call__(
        self,
        parser: ArgumentParser,
        namespace: Any,
        values: Any,
        option: str | None = None,
    ) -> None:
        """Add an assignment to those given before, or show what there is to set."""
        if values == "help":
            print(options_for_people())
            parser.exit()
        before = getattr(namespace, self.dest)
        setattr(namespace, self.dest, [*before, values])


def options_for_people() -> str:
    """Return a line for each option: what ``--set`` takes, with its default, and the meaning."""
    lines = []
    group = ""
    for line in OPTIONS.read_text(encoding="utf-8").splitlines():
        if found := re.fullmatch(r"(\w+):", line):
            group = found[1]
        elif found := re.fullmatch(r"  (\w+): (\S+) +# (.*)", line):
            name, default, meaning = found.groups()
            lines.append(f"{f'{group}.{name}={default}':32}  {meaning}")
    return "\n".join(lines)


def build_parser() -> ArgumentParser:
    """Make the parser of the command line, whose ``call`` names the module and the function."""
    about = "Metric camera motion with covariance from optical flow, depth and intrinsics."
    parser = Parser(prog="hybridvo", description=about)
    parser.add_argument(
        "--version", action="version", version=f"hybridvo {__version__}"
    )
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND"
    )
    for add in (_on_sequences, _others, _train):
        add(commands)
    return parser


def _command(
    commands: Any,
    call: str,
    name: str,
    about: str,
    *groups: Callable[[ArgumentParser], None],
) -> Callable[..., Any]:
    """Add a command with groups of arguments; returns the function that adds its own."""
    made: ArgumentParser = commands.add_parser(name, help=about, description=about)
    made.set_defaults(call=call)
    made.add_argument("--json", help="print the result as JSON on stdout", **FLAG)
    loudness = made.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", help="tracebacks of errors", **FLAG)
    loudness.add_argument("-q", "--quiet", help="errors only", **FLAG)
    for add_group in groups:
        add_group(made)
    return made.add_argument


# -- groups of arguments that commands share -------------------------------------------------------


def _sequence(command: ArgumentParser, required: bool = True) -> None:
    folder = command.add_mutually_exclusive_group(required=required).add_argument
    folder(
        "sequence",
        nargs="?",
        default=SUPPRESS,
        metavar="DIR",
        help="folder of the sequence, or file of a recording",
    )
    folder("--sequence", metavar="DIR", help="the same, by name")
    _recording(command)


def _recording(command: ArgumentParser) -> None:
    """What a data set does not say of itself."""
    add = command.add_argument
    kinds = "sintel, tartanair, 7scenes, folder, stereo, kitti, tum, bag, euroc, "
    kinds += "arrays, strayscanner or video"
    add("--dataset", metavar="KIND", help=f"{kinds} (default: detected)")
    add(
        "--camera",
        metavar="FILE|fx,fy,cx,cy",
        help="camera.yaml, ROS camera_info, or numbers",
    )
    add(
        "--depth-scale",
        type=float,
        metavar="N",
        help="depth units per metre, 1000: millimetres",
    )
    add("--mask", metavar="DIR", help="images that are 0 where pixels do not count")
    topic: dict[str, Any] = {"metavar": "TOPIC"}
    add("--topic-rgb", help="of colour, in a bag (default: guessed)", **topic)
    add("--topic-depth", help="of depth, in a bag (default: guessed)", **topic)
    add("--topic-info", help="of colour's CameraInfo (default: guessed)", **topic)
    add("--topic-truth", help="of true poses (default: by its name)", **topic)
    add(
        "--depth-dir",
        metavar="DIR",
        help="depth of a video (default: depth beside)",
    )


def _option_tree(command: ArgumentParser) -> None:
    flow = "default auto: the sequence's files, else DIS"
    keys = "one option, as in refine.cutoff=2.5; may be repeated; --set help explains the keys"
    add = command.add_argument
    add("--flow", dest="flow.source", choices=FLOWS, help=flow)
    add("--start", dest="run.start", help="first frame (default 0)", **COUNT)
    add("--stop", dest="run.stop", help="the one after the last frame", **COUNT)
    add(
        "--stride",
        dest="run.stride",
        help="step between frames (default 1)",
        **COUNT,
    )
    add("--seed", dest="run.seed", help="of everything drawn at random", **COUNT)
    add(
        "--device",
        dest="run.device",
        choices=DEVICES,
        help="of the networks (default auto)",
    )
    add("--config", metavar="FILE", help="YAML file of options")
    add(
        "--set",
        action=SetOption,
        default=[],
        dest="given",
        metavar="KEY=VALUE",
        help=keys,
    )
    exists = command.add_mutually_exclusive_group().add_argument
    mode: dict[str, Any] = {
        "dest": "mode",
        "action": "store_const",
        "default": "new",
    }
    exists("--resume", const="resume", help="go on where it was cut off", **mode)
    exists("--overwrite", const="overwrite", help="start anew", **mode)


def _weights(command: ArgumentParser) -> None:
    own = "network weights instead of the pretrained ones, as in pwvo=mine.safetensors"
    command.add_argument(
        "--weights", action="append", default=[], metavar="NAME=FILE", help=own
    )


def _training(command: ArgumentParser) -> None:
    add = command.add_argument
    add(
        "--out",
        type=Path,
        required=True,
        help="folder of the run; goes on where it was",
    )
    add(
        "--time-limit",
        type=float,
        default=float("inf"),
        metavar="MIN",
        help="minutes in all",
    )
    add(
        "--init",
        metavar="FILE",
        help="start from these weights: a file, or a pretrained name",
    )


# -- commands --------------------------------------------------------------------------------------


def _on_sequences(commands: Any) -> None:
    call = "commands.run:run"
    about = "Estimate the camera motion of a sequence."
    add = _command(commands, call, "run", about, _sequence, _option_tree, _weights)
    failed = "fraction of failed motions (default 0.2)"
    recording = (
        "Rerun recording (extra 'viz'; default: recording.rrd in the output folder)"
    )
    add("--out", metavar="DIR", help="output folder (default: runs/NAME)")
    add(
        "--method",
        dest="run.method",
        metavar="NAME",
        help="default: hybrid; all: hybridvo doctor",
    )
    add("--max-failed", dest="run.max_failed", type=float, metavar="X", help=failed)
    add(
        "--strict",
        dest="run.strict",
        default=None,
        help="a broken frame ends the run",
        **FLAG,
    )
    add("--rrd", nargs="?", const="", metavar="FILE", help=recording)

    call = "commands.compare:compare"
    about = "Run methods side by side and write a report."
    add = _command(
        commands, call, "compare", about, _recording, _option_tree, _weights
    )
    several: dict[str, Any] = {"action": "extend", "metavar": "DIR"}
    name = "the same as DIR, by name; repeatable"
    many = "sequences, or folders of sequences (MPI Sintel as it was unpacked)"
    add("--sequence", dest="sequences", nargs="+", default=[], help=name, **several)
    add("sequences", nargs="*", default=SUPPRESS, help=many, **several)
    add("--out", default="runs/compare", metavar="DIR", help="default: %(default)s")
    methods: dict[str, Any] = {
        "type": lambda text: text.replace(" ", "").split(",")
    }
    listed = "comma-separated; default: all that run here"
    add("--methods", default="all", help=listed, **methods)
    add(
        "--protocol",
        choices=["paper"],
        help="MPI Sintel as PWVO's paper scores it: 992 pairs",
    )

    call = "evaluation.drawing:draw"
    about = "Draw the maps of one pair of a sequence."
    add = _command(commands, call, "show", about, _sequence, _weights)
    add("--pair", default=0, help="first frame (default 0)", **COUNT)
    add("--out", default="pair.png", metavar="FILE", help="default: %(default)s")
    add(
        "--method",
        default="hybrid",
        metavar="NAME",
        help="estimator (default: hybrid)",
    )
    add("--flow", choices=FLOWS, default="auto")
    add("--overwrite", help="replace the image", **FLAG)


def _others(commands: Any) -> None:
    call = "evaluation.metrics:evaluate"
    about = "Errors of a trajectory against the truth."
    add = _command(commands, call, "evaluate", about)
    kinds = ("se3", "sim3", "origin", "none")
    matched = "seconds between matches (default 0.02)"
    add("estimate", metavar="EST", help="estimated trajectory")
    add("gt", metavar="GT", help="true trajectory")
    add("--alignment", choices=kinds, default="se3", help="of the ATE")
    add(
        "--delta",
        type=float,
        default=1,
        metavar="X",
        help="span of the RPE (default 1)",
    )
    add(
        "--delta-unit",
        choices=("frames", "s"),
        default="frames",
        help="unit of --delta",
    )
    add("--max-diff", type=float, default=0.02, metavar="S", help=matched)

    call = "commands.doctor:doctor"
    about = "What is missing here, or wrong with a sequence."
    add = _command(
        commands, call, "doctor", about, partial(_sequence, required=False)
    )
    add("--pairs", default=40, help="pairs (default 40)", **COUNT)

    call = "commands.convert:convert"
    about = "Write a sequence as a plain folder, or in TUM's layout."
    add = _command(commands, call, "convert", about, _sequence)
    add("out", metavar="OUT", help="new folder")
    add("--to", choices=("folder", "tum"), default="folder", help="layout")
    add(
        "--units",
        type=float,
        metavar="N",
        help="of written depth in a metre (default 1000; tum 5000)",
    )
    add("--start", default=0, help="first frame (default 0)", **COUNT)
    add("--stop", help="the one after the last frame", **COUNT)
    add("--stride", default=1, help="step between frames (default 1)", **COUNT)

    call = "commands.compare:demo"
    about = "Render a scene with moving objects and run on it."
    add = _command(commands, call, "demo", about)
    add("--out", default="runs/demo", metavar="DIR", help="default: %(default)s")
    add("--overwrite", help="replace the results in --out", **FLAG)
    add("--frames", default=20, help="default: 20", **COUNT)
    add("--seed", default=0, help="of the scene", **COUNT)

    call = "commands.train:generate"
    about = "Draw training samples into a folder."
    add = _command(commands, call, "generate", about)
    add(
        "--preset",
        default="paper",
        help="paper, diverse or a YAML file; default: %(default)s",
    )
    add("--out", required=True, metavar="DIR", help="folder of the samples")
    add("--count", default=1000, help="default: 1000", **COUNT)
    add("--seed", default=0, **COUNT)
    add("--size", type=int, nargs=2, metavar=("H", "W"), help="pixels")
    add("--workers", default=1, help="processes", **COUNT)

    call = "data.camera_file:write_camera_template"
    about = "Write a camera.yaml to fill in."
    add = _command(commands, call, "init", about)
    add("directory", metavar="DIR", help="folder with rgb/ and depth/")


def _train(commands: Any) -> None:
    about = "Train a network; started again with the same --out it goes on where it was."
    train = commands.add_parser(
        "train", help=about, description=f"{about} See docs/training.md."
    )
    below = train.add_subparsers(dest="training", required=True, metavar="COMMAND")

    call = "commands.train:train_network"
    about = "train a network of the paper"
    add = _command(below, call, "pwvo", about, _training)
    add("--config", type=Path, required=True, help="configs/train_*.yaml")
    add("--workers", type=int, default=0, help="processes that draw samples")
    add("--device", choices=DEVICES, default="auto")
    add("--seed", type=int, help="instead of the configuration's")

    add = _command(below, call, "selector", "train the selector", _training)
    add("--config", type=Path, default=Path("configs/train_selector.yaml"))
    add("--data", type=Path, required=True, help="folder of the shards")

    call = "training.trainer:export_run"
    about = "write a network's weights for users (int8)"
    add = _command(below, call, "export", about)
    add("--out", dest="folder", type=Path, required=True, help="folder of the run")
    add(
        "--export",
        dest="path",
        type=Path,
        required=True,
        metavar="FILE",
        help="*.safetensors",
    )
    add("--count", type=int, default=1000, help="held-out pairs of each preset")

    call = "commands.train:draw_selector_data"
    about = "draw samples for the selector"
    add = _command(below, call, "selector-data", about)
    add("--data", type=Path, required=True, help="folder of the shards")
    add("--first-seed", type=int, default=1000000, help="below 1000: held out")
    add("--seeds", type=int, default=0, help="about as many samples")
    add(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="semi-real pairs, of recordings below it",
    )
