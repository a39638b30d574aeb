"""The arguments of every command, and the function in ``dispatch`` that it calls.

Help must be instant: nothing here imports a heavy module.
"""

from __future__ import annotations

import re
from argparse import SUPPRESS, Action, ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hybridvo import __version__
from hybridvo.core.errors import did_you_mean, printable
from hybridvo.io.calibration import MAX_STAMP_DIFFERENCE_S
from hybridvo.run.calibration import DOCTOR_SECONDS
from hybridvo.run.commands import dispatch

FLOWS = ("auto", "file", "dis")
NETWORK = "onnx:"
"""What stands before the file of a network, as in :mod:`hybridvo.core.options`."""
DEVICES = ("auto", "cpu", "cuda")
ALIGNMENTS = ("se3", "sim3", "origin", "none")
PROTOCOLS = (
    *("paper", "sintel14", "sintel14-relative", "sintel18"),
    *("tum-dynamics", "tum-walking", "bonn8", "bonn9"),
)
"""Names in ``evaluation/protocols.yaml``."""
COUNT: dict[str, Any] = {"type": int, "metavar": "N"}
"""How a whole number is given."""
FLAG: dict[str, Any] = {"action": "store_true"}
"""How a switch is given."""
CAMERA_HELP = "camera.yaml, ROS camera_info, or numbers"
"""What ``--camera`` is of a sequence."""
OPTIONS = Path(__file__).parents[1] / "odometry.yaml"
"""The file that explains every option, with its default."""
KEY_WIDTH = 32
"""Width of the keys in what ``--set help`` prints, characters."""


class Parser(ArgumentParser):
    """A parser whose errors quote arguments without the characters that steer a terminal.

    What it does not know is an error of its own command, and names the option that is near.
    """

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments, and refuse those that are left over."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(
                f"unrecognized arguments: {' '.join(unknown)}{self._near(unknown)}"
            )
        return parsed, unknown

    def _near(self, unknown: list[str]) -> str:
        """Return a question about the option that the first unknown one may stand for."""
        written = unknown[0].partition("=")[0]
        known = re.findall(r"--[a-z][a-z-]*", self.format_usage())
        return did_you_mean(written, known)

    def exit(self, status: int = 0, message: str | None = None) -> Any:
        """End the program; ``message`` goes to stderr."""
        if message:
            message = printable(message)
        super().exit(status, message)


class SetOption(Action):
    """``--set KEY=VALUE``. With ``--set help`` it lists the keys and ends the program."""

    def __call__(
        self,
        parser: ArgumentParser,
        namespace: Any,
        values: Any,
        option: str | None = None,
    ) -> None:
        """Add an assignment to those given before."""
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
        if heading := re.fullmatch(r"(\w+):", line):
            group = heading[1]
        elif option := re.fullmatch(r"  (\w+): (\S+) +# (.*)", line):
            name, default, meaning = option.groups()
            key = f"{group}.{name}={default}"
            lines.append(f"{key:{KEY_WIDTH}}  {meaning}")
    return "\n".join(lines)


def build_parser() -> ArgumentParser:
    """Make the parser of the command line.

    The parsed arguments have the function to call in ``call``.
    """
    about = "Metric camera motion with covariance from optical flow, depth and intrinsics."
    parser = Parser(prog="hybridvo", description=about)
    parser.add_argument(
        "--version", action="version", version=f"hybridvo {__version__}"
    )
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND"
    )
    _add_run(commands)
    _add_live(commands)
    _add_compare(commands)
    _add_show(commands)
    _add_evaluate(commands)
    _add_doctor(commands)
    _add_topics(commands)
    _add_convert(commands)
    _add_demo(commands)
    _add_generate(commands)
    _add_init(commands)
    _add_train(commands)
    return parser


def _command(
    commands: Any,
    name: str,
    about: str,
    call: Callable[[Namespace], dispatch.Outcome],
) -> ArgumentParser:
    """Add a command with the arguments that all commands have."""
    command: ArgumentParser = commands.add_parser(
        name, help=about, description=about
    )
    command.set_defaults(call=call)
    command.add_argument(
        "--json", help="print the result as JSON on stdout", **FLAG
    )
    loudness = command.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", help="tracebacks of errors", **FLAG)
    loudness.add_argument("-q", "--quiet", help="errors only", **FLAG)
    return command


# -- groups of arguments that commands share ---------------------------------------------


def _add_sequence(
    command: ArgumentParser, required: bool = True, camera: str = CAMERA_HELP
) -> None:
    """Add the folder of a sequence, by place or by name."""
    folder = command.add_mutually_exclusive_group(required=required)
    folder.add_argument(
        "sequence",
        nargs="?",
        default=SUPPRESS,
        metavar="DIR",
        help="folder of the sequence, or file of a recording",
    )
    folder.add_argument("--sequence", metavar="DIR", help="the same, by name")
    _add_reading(command, camera)


def _add_reading(command: ArgumentParser, camera: str = CAMERA_HELP) -> None:
    """Add what the files of a sequence do not state."""
    add = command.add_argument
    kinds = (
        "sintel, tartanair, 7scenes, folder, stereo, kitti, kitti-raw, vkitti2, "
    )
    kinds += (
        "tum, openloris, rgbd-scenes, bag, euroc, arrays, strayscanner, record3d, "
    )
    kinds += "scannet, sens, recorder, kinect, replica, transforms or video"
    add("--dataset", metavar="KIND", help=f"{kinds} (default: detected)")
    add(
        "--camera",
        metavar="FILE|fx,fy,cx,cy",
        help=camera,
    )
    add(
        "--depth-scale",
        type=float,
        metavar="N",
        help="depth units per metre, 1000: millimetres",
    )
    _add_times(command)
    add(
        "--fps",
        type=float,
        metavar="N",
        help="frames a second, in place of the time stamps of the files",
    )
    add(
        "--mask",
        metavar="DIR|onnx:FILE",
        help="images that are 0 where pixels do not count, or a network that finds people",
    )
    _add_depth(command)
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
    add(
        "--stereo",
        nargs="?",
        const="",
        type=metres,
        metavar="METRES",
        help="depth from left/ and right/; baseline of rectified images (else camera.yaml)",
    )
    _add_trust(command)


def _add_trust(command: ArgumentParser) -> None:
    """Add the way to read recordings without limits."""
    command.add_argument(
        "--trust",
        help="read recordings of foreign formats here, not in a child process with limits",
        **FLAG,
    )


def _add_depth(command: ArgumentParser) -> None:
    """Add the network that predicts depth."""
    command.add_argument(
        "--depth",
        metavar="onnx:FILE",
        help="a network predicts depth (extra 'onnx'); onnx:FILE@NAME names its description",
    )


def _add_times(command: ArgumentParser) -> None:
    """Add at which times a camera measures."""
    command.add_argument(
        "--readout-ms",
        type=float,
        metavar="MS",
        help="rolling shutter: time from the first row to the last, ms (else camera.yaml)",
    )
    command.add_argument(
        "--depth-lag-ms",
        type=float,
        metavar="MS",
        help="how much later than the image depth is measured, ms (else camera.yaml)",
    )


def flow_source(text: str) -> str:
    """Return the name of a flow source; a ValueError for others."""
    if text in FLOWS or text.removeprefix(NETWORK) not in ("", text):
        return text
    raise ValueError(text)


def _add_flow(command: ArgumentParser, default: str | None = None) -> None:
    """Add the source of the flow."""
    command.add_argument(
        "--flow",
        type=flow_source,
        default=default,
        metavar=f"{{{','.join(FLOWS)},onnx:FILE}}",
        help="default auto: the sequence's files, else DIS; onnx:FILE: a network (extra 'onnx')",
    )


def image_size(text: str) -> tuple[int, int]:
    """Return the columns and rows of WxH; a ValueError for other texts."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) * int(height)):
        raise ValueError(text)
    return int(width), int(height)


def metres(text: str) -> str:
    """Return a text that is a number, or empty; a ValueError for others."""
    if text:
        float(text)
    return text


def _add_options(command: ArgumentParser) -> None:
    """Add the options of :mod:`hybridvo.core.options`: some by name, all by ``--set``."""
    add = command.add_argument
    _add_flow(command)
    add("--start", help="first frame (default 0)", **COUNT)
    add("--stop", help="the one after the last frame", **COUNT)
    add("--stride", help="step between frames (default 1)", **COUNT)
    _add_settings(command)


def _add_settings(command: ArgumentParser) -> None:
    """Add the options that are no matter of frames on disk."""
    add = command.add_argument
    add("--seed", help="of everything drawn at random", **COUNT)
    add("--device", choices=DEVICES, help="of the networks (default auto)")
    add("--config", metavar="FILE", help="YAML file of options")
    add(
        "--set",
        action=SetOption,
        default=[],
        dest="assignments",
        metavar="KEY=VALUE",
        help=(
            "one option, as in refine.cutoff=2.5; may be repeated; "
            "--set help explains the keys"
        ),
    )


def _add_mode(command: ArgumentParser) -> None:
    """Add what happens to results that are there already."""
    exists = command.add_mutually_exclusive_group()
    exists.add_argument(
        "--resume",
        dest="mode",
        action="store_const",
        const="resume",
        default="new",
        help="go on where it was cut off",
    )
    exists.add_argument(
        "--overwrite",
        dest="mode",
        action="store_const",
        const="overwrite",
        default="new",
        help="start anew",
    )


def _add_weights(command: ArgumentParser) -> None:
    """Add the weights of networks."""
    command.add_argument(
        "--weights",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="network weights instead of the pretrained ones, as in pwvo=mine.safetensors",
    )


def _add_workers(command: ArgumentParser, *other_names: str) -> None:
    """Add where independent tasks run."""
    command.add_argument(
        "--jobs",
        *other_names,
        default=1,
        help="processes on this machine (default 1)",
        **COUNT,
    )
    command.add_argument(
        "--cluster",
        metavar="SCHEDULER",
        help="tcp://HOST:PORT or JSON file of a scheduler of dask.distributed, extra 'cluster'",
    )


def _add_training(command: ArgumentParser) -> None:
    """Add what all training runs have."""
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
    add("--seed", type=int, help="instead of the configuration's")


# -- commands on sequences ---------------------------------------------------------------


def _add_run(commands: Any) -> None:
    about = "Estimate the camera motion of a sequence."
    command = _command(commands, "run", about, dispatch.run)
    _add_sequence(command)
    _add_options(command)
    _add_mode(command)
    _add_weights(command)
    add = command.add_argument
    add("--out", metavar="DIR", help="output folder (default: runs/NAME)")
    add(
        "--method",
        metavar="NAME",
        help="default: hybrid; hybridvo doctor lists all",
    )
    add(
        "--max-failed",
        type=float,
        metavar="X",
        help="exit code 3 where a larger fraction of motions fails (default 0.2)",
    )
    add("--strict", default=None, help="a broken frame ends the run", **FLAG)
    add(
        "--passes",
        help="times the sequence is tracked (default 1); 3 for a rolling shutter in quick turns",
        **COUNT,
    )
    add(
        "--rrd",
        nargs="?",
        const="",
        metavar="FILE",
        help=(
            "Rerun recording (extra 'viz'; default: recording.rrd in the output folder)"
        ),
    )
    _add_view(command)
    add(
        "--export",
        type=_names,
        default=[],
        metavar="KINDS",
        help="images, masks and poses for colmap, transforms, euroc (comma-separated)",
    )


def _add_view(command: ArgumentParser) -> None:
    """Add the viewer that shows a run while it goes on."""
    command.add_argument(
        "--view",
        nargs="?",
        const="spawn",
        metavar="WHERE",
        help=(
            "show it in Rerun (extra 'viz'): spawn (default) opens a window, "
            "connect[:HOST:PORT] takes one that is open, serve makes a page for a browser"
        ),
    )


def _add_live(commands: Any) -> None:
    about = "Estimate the motion of a camera while it moves; Ctrl-C ends it."
    command = _command(commands, "live", about, dispatch.live)
    command.set_defaults(start=None, stop=None, stride=None, strict=None)
    _add_weights(command)
    add = command.add_argument
    add(
        "--camera",
        metavar="NAME|DIR",
        help="realsense, oak, orbbec (each with :SERIAL), opencv:0, or a recording",
    )
    add("--preset", metavar="NAME|FILE", help="settings, as d435 or d435.yaml")
    _add_times(command)
    _add_trust(command)
    _add_flow(command)
    _add_depth(command)
    add("--mask", metavar="onnx:FILE", help="a network finds people (extra 'onnx')")
    add(
        "--no-imu",
        dest="imu",
        action="store_false",
        help="leave the camera's IMU alone (default: used where there is one)",
    )
    add("--out", metavar="DIR", help="output folder (default: runs/live-DATE-TIME)")
    add("--overwrite", help="replace the results in --out", **FLAG)
    add("--seconds", type=float, metavar="S", help="end after so long")
    add("--max-frames", help="end after so many frames", **COUNT)
    add(
        "--size",
        type=image_size,
        metavar="WxH",
        help="make images and depth smaller, as 320x240 (default: the camera's)",
    )
    add(
        "--rate",
        choices=("camera", "auto"),
        default="camera",
        help="auto: measure, then choose size, flow and budget that keep up",
    )
    add("--udp", metavar="HOST:PORT", help="send each step as a line of JSON")
    add("--rrd", metavar="FILE", help="Rerun recording (extra 'viz')")
    _add_view(command)
    add(
        "--method",
        metavar="NAME",
        help="default: hybrid; hybridvo doctor lists all",
    )
    add(
        "--max-failed",
        type=float,
        metavar="X",
        help="exit code 3 where a larger fraction of motions fails (default 0.2)",
    )
    _add_settings(command)


def _add_compare(commands: Any) -> None:
    about = "Run methods side by side and write a report."
    command = _command(commands, "compare", about, dispatch.compare)
    _add_reading(command)
    _add_options(command)
    _add_mode(command)
    _add_weights(command)
    add = command.add_argument
    add(
        "--sequence",
        dest="sequences",
        action="extend",
        nargs="+",
        default=[],
        metavar="DIR",
        help="the same as DIR, by name; repeatable",
    )
    add(
        "sequences",
        action="extend",
        nargs="*",
        default=SUPPRESS,
        metavar="DIR",
        help="sequences, or folders of sequences (MPI Sintel as it was unpacked)",
    )
    add("--out", default="runs/compare", metavar="DIR", help="default: %(default)s")
    add(
        "--methods",
        type=_names,
        default="all",
        help="comma-separated; default: all that run here",
    )
    add(
        "--protocol",
        choices=PROTOCOLS,
        help="score a data set as papers do: docs/protocols.md",
    )
    _add_workers(command)


def _names(text: str) -> list[str]:
    """Split names at commas."""
    return text.replace(" ", "").split(",")


def _add_show(commands: Any) -> None:
    about = "Draw the maps of one pair of a sequence."
    command = _command(commands, "show", about, dispatch.show)
    _add_sequence(command)
    _add_weights(command)
    add = command.add_argument
    pair = command.add_mutually_exclusive_group()
    pair.add_argument("--pair", default=0, help="first frame (default 0)", **COUNT)
    pair.add_argument(
        "--frame", help="the second frame, as 'run' names it", **COUNT
    )
    add("--out", default="pair.png", metavar="FILE", help="default: %(default)s")
    add(
        "--method",
        default="hybrid",
        metavar="NAME",
        help="estimator (default: hybrid)",
    )
    _add_flow(command, "auto")
    add(
        "--all",
        dest="everything",
        help="also the other image, the ego flow and its error, and what PWVO looks at: slow",
        **FLAG,
    )
    add("--overwrite", help="replace the image", **FLAG)


def _add_doctor(commands: Any) -> None:
    about = "What is missing here, or wrong with a sequence or a live camera."
    command = _command(commands, "doctor", about, dispatch.doctor)
    what = "of DIR; without DIR a live camera, as for 'live'"
    _add_sequence(command, required=False, camera=f"{CAMERA_HELP}: {what}")
    add = command.add_argument
    add("--pairs", default=40, help="pairs (default 40)", **COUNT)
    add(
        "--speed",
        help="how fast DIR, or the demo, is tracked here, and what a frame's time goes to",
        **FLAG,
    )
    add("--preset", metavar="NAME|FILE", help="settings of a live camera, as d435")
    add(
        "--seconds",
        type=float,
        default=DOCTOR_SECONDS,
        metavar="S",
        help="of a live camera (default %(default)s)",
    )


def _add_topics(commands: Any) -> None:
    about = "List the topics of a bag, and which of them are taken."
    command = _command(commands, "topics", about, dispatch.topics)
    command.add_argument(
        "file", metavar="FILE", help="a bag of ROS 1, or file or folder of ROS 2"
    )
    _add_trust(command)


# -- other commands ----------------------------------------------------------------------


def _add_evaluate(commands: Any) -> None:
    about = "Errors of a trajectory against the ground truth."
    command = _command(commands, "evaluate", about, dispatch.evaluate)
    add = command.add_argument
    add("estimate", metavar="EST", help="estimated trajectory")
    add("gt", metavar="GT", help="true trajectory (with --protocol also: DIR)")
    add("--alignment", choices=ALIGNMENTS, default="se3", help="of the ATE")
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
    add(
        "--max-diff",
        type=float,
        default=MAX_STAMP_DIFFERENCE_S,
        metavar="S",
        help="seconds between matches (default %(default)s)",
    )
    add(
        "--protocol",
        choices=[name for name in PROTOCOLS if name != "paper"],
        help="errors as papers define them; GT is a sequence, or its file as published",
    )


def _add_convert(commands: Any) -> None:
    about = "Write a sequence as a plain folder, in TUM's layout, or as a bag."
    command = _command(commands, "convert", about, dispatch.convert)
    _add_sequence(command)
    add = command.add_argument
    add("out", metavar="OUT", help="new folder, or file that ends in .bag")
    add(
        "--to",
        choices=("folder", "tum", "ros1", "ros2"),
        help="layout (default: ros1 for a .bag, else folder)",
    )
    add(
        "--units",
        type=float,
        metavar="N",
        help="of written depth in a metre (default 1000; tum 5000; bags: 1000 or 1)",
    )
    add("--start", default=0, help="first frame (default 0)", **COUNT)
    add("--stop", help="the one after the last frame", **COUNT)
    add("--stride", default=1, help="step between frames (default 1)", **COUNT)


def _add_demo(commands: Any) -> None:
    about = "Render a scene with moving objects and run on it."
    command = _command(commands, "demo", about, dispatch.demo)
    add = command.add_argument
    add("--out", default="runs/demo", metavar="DIR", help="default: %(default)s")
    add("--overwrite", help="replace the results in --out", **FLAG)
    add("--frames", default=20, help="default: 20", **COUNT)
    add("--seed", default=0, help="of the scene", **COUNT)


def _add_generate(commands: Any) -> None:
    about = "Draw training samples into a folder."
    command = _command(commands, "generate", about, dispatch.generate)
    add = command.add_argument
    add(
        "--preset",
        default="paper",
        help="paper, diverse or a YAML file; default: %(default)s",
    )
    add("--out", required=True, metavar="DIR", help="folder of the samples")
    add("--count", default=1000, help="default: 1000", **COUNT)
    add("--seed", default=0, **COUNT)
    add("--size", type=int, nargs=2, metavar=("H", "W"), help="pixels")
    _add_workers(command, "--workers")


def _add_init(commands: Any) -> None:
    about = "Write a camera.yaml to fill in."
    command = _command(commands, "init", about, dispatch.init)
    command.add_argument(
        "directory", metavar="DIR", help="folder with rgb/ and depth/"
    )


def _add_train(commands: Any) -> None:
    """Add ``train`` with its own commands."""
    about = "Train a network; started again with the same --out it goes on where it was."
    train = commands.add_parser(
        "train", help=about, description=f"{about} See docs/training.md."
    )
    tasks = train.add_subparsers(dest="training", required=True, metavar="COMMAND")

    about = "train PWVO"
    command = _command(tasks, "pwvo", about, dispatch.train)
    _add_training(command)
    add = command.add_argument
    add("--config", type=Path, default=Path("configs/train_pwvo.yaml"))
    add("--data", type=Path, required=True, help="folder of the shards")
    command.set_defaults(workers=0, device="cpu")

    about = "train a network of the paper"
    command = _command(tasks, "paper", about, dispatch.train)
    _add_training(command)
    add = command.add_argument
    add("--config", type=Path, required=True, help="configs/train_*.yaml")
    add("--workers", type=int, default=0, help="processes that draw samples")
    add("--device", choices=DEVICES, default="auto")
    command.set_defaults(data=Path())

    about = "write a network's weights for users (int8)"
    command = _command(tasks, "export", about, dispatch.export_weights)
    add = command.add_argument
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

    about = "draw samples for PWVO"
    command = _command(tasks, "samples", about, dispatch.draw_training_samples)
    add = command.add_argument
    add("--data", type=Path, required=True, help="folder of the shards")
    add("--first-seed", type=int, default=1000000, help="below 1000: held out")
    add("--seeds", type=int, default=0, help="about as many samples")
    add(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="folder of recordings, from which most of the pairs are made then",
    )
    add(
        "--shares",
        type=float,
        nargs="+",
        default=(),
        metavar="SHARE",
        help="of tripod recordings, semi-real pairs, and objects of a kind in these",
    )
    _add_workers(command)
