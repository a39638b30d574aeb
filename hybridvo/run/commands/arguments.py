"""The commands: a record for each, with its arguments and what it calls.

An argument has the name of the parameter that it sets, or of an option, see
:mod:`hybridvo.run.commands.dispatch`. Help must be instant: nothing here imports a heavy module.
"""

from __future__ import annotations

import re
from argparse import SUPPRESS, Action, ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hybridvo import __version__
from hybridvo.core.errors import did_you_mean, printable
from hybridvo.core.pages import page
from hybridvo.io.calibration import MAX_STAMP_DIFFERENCE_S
from hybridvo.run.commands import dispatch
from hybridvo.run.commands.dispatch import CommandResult, calling, from_laboratory

# s that the doctor looks at a live camera: 150 frames, two turns to and fro
DOCTOR_SECONDS = 5.0

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
CAMERA_HELP = "camera.yaml, ROS camera_info, or numbers"
"""What ``--camera`` is of a sequence."""
OPTIONS_FILE = Path(__file__).parents[1] / "odometry.yaml"
"""The file that explains every option, with its default."""
KEY_WIDTH = 32
"""Width of the keys in what ``--set help`` prints, characters."""


def with_negative_lists(words: Sequence[str]) -> list[str]:
    """Return words with each list that begins with a minus joined to its option.

    argparse takes such a list for an option.

    Example:
        >>> with_negative_lists(["run", "x", "--imu-rotation", "-0.5,0.5,-0.5,0.5"])
        ['run', 'x', '--imu-rotation=-0.5,0.5,-0.5,0.5']
    """
    joined = list[str]()
    for word in words:
        is_of_option = bool(joined) and joined[-1].startswith("--")
        if is_of_option and re.fullmatch(r"-[\d.e+-]+(,[\d.e+-]+)+", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


class Parser(ArgumentParser):
    """A parser whose errors quote arguments without the characters that steer a terminal.

    What it does not know is an error of its own command, and names the option that is near.
    """

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments, and refuse those that are left over."""
        words = None if args is None else with_negative_lists(args)
        parsed, unknown = super().parse_known_args(words, namespace)
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
            message = printable(message.rstrip("\n")) + "\n"
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
    for line in OPTIONS_FILE.read_text(encoding="utf-8").splitlines():
        if heading := re.fullmatch(r"(\w+):", line):
            group = heading[1]
        elif option := re.fullmatch(r"  (\w+): (\S+) +# (.*)", line):
            name, default, meaning = option.groups()
            key = f"{group}.{name}={default}"
            lines.append(f"{key:{KEY_WIDTH}}  {meaning}")
    return "\n".join(lines)


# -- the types of arguments --------------------------------------------------------------


def flow_source(text: str) -> str:
    """Return the name of a flow source; a ValueError for others."""
    if text in FLOWS or text.removeprefix(NETWORK) not in ("", text):
        return text
    raise ValueError(text)


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


def frame_before(text: str) -> int:
    """Return the index of the frame before one, which is that of their pair."""
    try:
        return int(text) - 1
    except ValueError:
        raise ArgumentTypeError(f"invalid int value: {text!r}") from None


def names(text: str) -> tuple[str, ...]:
    """Split names at commas."""
    return tuple(text.replace(" ", "").split(","))


# -- the kinds of arguments --------------------------------------------------------------


class Argument(NamedTuple):
    """An argument as argparse takes it."""

    names: tuple[str, ...]
    settings: dict[str, Any]


class Either(NamedTuple):
    """Arguments of which one at most is given; one at least where it is required."""

    arguments: tuple[Argument, ...]
    required: bool = False


def word(usage: str, about: str | None = None, **settings: Any) -> Argument:
    """An argument that takes a text; ``usage`` is as in ``--camera FILE``."""
    name, _, metavar = usage.partition(" ")
    return Argument((name,), {"metavar": metavar or None, "help": about} | settings)


def number(usage: str, about: str, **settings: Any) -> Argument:
    """An argument that takes a number."""
    return word(usage, about, type=float, **settings)


def count(usage: str, about: str | None = None, **settings: Any) -> Argument:
    """An argument that takes a whole number."""
    return word(usage, about, **{"type": int} | settings)


def switch(names: str, about: str, **settings: Any) -> Argument:
    """An argument that takes nothing."""
    settings = {"action": "store_true", "help": about} | settings
    return Argument(tuple(names.split()), settings)


# -- arguments that commands share -------------------------------------------------------

LOUDNESS = (
    switch("--json", "print the result as JSON on stdout"),
    Either(
        (
            switch("-v --verbose", "tracebacks of errors"),
            switch("-q --quiet", "errors only"),
        )
    ),
)
"""What all commands have."""
TIMES = (
    number(
        "--readout-ms MS",
        "rolling shutter: time from the first row to the last, ms (else camera.yaml)",
    ),
    number(
        "--depth-lag-ms MS",
        "how much later than the image depth is measured, ms (else camera.yaml)",
    ),
)
"""At which times a camera measures."""
TRUST = switch(
    "--trust",
    "read recordings of foreign formats here, not in a child process with limits",
)
DEPTH = word(
    "--depth onnx:FILE",
    "a network predicts depth (extra 'onnx'); onnx:FILE@NAME names its description",
)
FLOW = word(
    f"--flow {{{','.join(FLOWS)},onnx:FILE}}",
    "default auto: the sequence's files, else DIS; onnx:FILE: a network (extra 'onnx')",
    type=flow_source,
)
KINDS = (
    "sintel, tartanair, 7scenes, folder, stereo, kitti, kitti-raw, vkitti2, tum, openloris, "
    "rgbd-scenes, bag, euroc, arrays, strayscanner, record3d, scannet, sens, recorder, kinect, "
    "replica, transforms or video"
)
"""What ``--dataset`` may be."""


def reading(camera: str = CAMERA_HELP) -> tuple[Argument, ...]:
    """Return the arguments that state what the files of a sequence do not."""
    return (
        word("--dataset KIND", f"{KINDS} (default: detected)"),
        word("--camera FILE|fx,fy,cx,cy", camera),
        number("--depth-scale N", "depth units per metre, 1000: millimetres"),
        *TIMES,
        number(
            "--fps N", "frames a second, in place of the time stamps of the files"
        ),
        word(
            "--mask DIR|onnx:FILE",
            "images that are 0 where pixels do not count, or a network that finds people",
        ),
        DEPTH,
        word("--topic-rgb TOPIC", "of colour, in a bag (default: guessed)"),
        word("--topic-depth TOPIC", "of depth, in a bag (default: guessed)"),
        word("--topic-info TOPIC", "of colour's CameraInfo (default: guessed)"),
        word("--topic-truth TOPIC", "of true poses (default: by its name)"),
        word("--topic-imu TOPIC", "of the IMU, in a bag (default: guessed)"),
        word(
            "--imu-rotation x,y,z,w",
            "quaternion from the axes of the IMU to the camera's (else /tf_static)",
        ),
        number(
            "--depth-offset-ms MS",
            "by how much the stamps of depth are late: subtracted before matching",
        ),
        word("--depth-dir DIR", "depth of a video (default: depth beside)"),
        word(
            "--stereo METRES",
            "depth from left/ and right/; baseline of rectified images (else camera.yaml)",
            nargs="?",
            const="",
            type=metres,
        ),
        TRUST,
    )


def sequence(
    required: bool = True, camera: str = CAMERA_HELP
) -> tuple[Argument | Either, ...]:
    """Return the folder of a sequence, by place or by name, and how it is read."""
    by_place = word(
        "sequence DIR",
        "folder of the sequence, or file of a recording",
        nargs="?",
        default=SUPPRESS,
    )
    by_name = word("--sequence DIR", "the same, by name")
    return Either((by_place, by_name), required), *reading(camera)


FRAMES = (
    count("--start N", "first frame (default 0)"),
    count("--stop N", "the one after the last frame"),
    count("--stride N", "step between frames (default 1)"),
)
SETTINGS = (
    count("--seed N", "of everything drawn at random"),
    word("--device", "of the networks (default auto)", choices=DEVICES),
    word("--config FILE", "YAML file of options"),
    word(
        "--set KEY=VALUE",
        "one option, as in refine.cutoff=2.5; may be repeated; --set help explains the keys",
        action=SetOption,
        default=[],
        dest="assignments",
    ),
)
"""Options of :mod:`hybridvo.core.options` that are no matter of frames on disk."""
OPTIONS = (FLOW, *FRAMES, *SETTINGS)
"""Options of :mod:`hybridvo.core.options`: some by name, all by ``--set``."""
KEPT = {"dest": "mode", "action": "store_const", "default": "new"}
MODE = Either(
    (
        switch("--resume", "go on where it was cut off", const="resume", **KEPT),
        switch("--overwrite", "start anew", const="overwrite", **KEPT),
    )
)
"""What happens to results that are there already."""
OVERWRITE = switch("--overwrite", "replace the results in --out")
WEIGHTS = word(
    "--weights NAME=FILE",
    "network weights instead of the pretrained ones, as in pwvo=mine.safetensors",
    action="append",
    default=[],
)
METHOD = word("--method NAME", "default: hybrid; hybridvo doctor lists all")
MAX_FAILED = number(
    "--max-failed X",
    "exit code 3 where a larger fraction of motions fails (default 0.2)",
)
VIEW = word(
    "--view WHERE",
    "show it in Rerun (extra 'viz'): spawn (default) opens a window, connect[:HOST:PORT] takes "
    "one that is open, serve makes a page for a browser",
    nargs="?",
    const="spawn",
)
JOBS = count("--jobs N", "processes on this machine (default 1)", default=1)
CLUSTER = word(
    "--cluster SCHEDULER",
    "tcp://HOST:PORT or JSON file of a scheduler of dask.distributed, extra 'cluster'",
)
TRAINING = (
    word(
        "--out",
        "folder of the run; goes on where it was",
        type=Path,
        required=True,
    ),
    number("--time-limit MIN", "minutes in all", default=float("inf")),
    word("--init FILE", "start from these weights: a file, or a pretrained name"),
    count("--seed", "instead of the configuration's"),
)
"""What all training runs have."""
SHARDS = word("--data", "folder of the shards", type=Path, required=True)

# -- the commands, with their arguments in the order of --help ---------------------------


class Command(NamedTuple):
    """A command of the program."""

    name: str
    about: str
    call: Callable[[Namespace], CommandResult]
    arguments: tuple[Argument | Either, ...]
    # those of shared arguments, where the command has its own
    defaults: dict[str, Any]


def command(
    name: str,
    about: str,
    call: Callable[[Namespace], CommandResult],
    *arguments: Argument | Either,
    **defaults: Any,
) -> Command:
    """Return the record of a command."""
    return Command(name, about, call, arguments, defaults)


RUN = command(
    "run",
    "Estimate the camera motion of a sequence.",
    dispatch.run,
    *sequence(),
    *OPTIONS,
    MODE,
    WEIGHTS,
    word("--out DIR", "output folder (default: runs/NAME)"),
    word(
        "--frame NAME",
        "write the path of this frame, fixed to the camera by /tf_static, as base_link",
    ),
    METHOD,
    MAX_FAILED,
    switch("--strict", "a broken frame ends the run", default=None),
    count(
        "--passes N",
        "times the sequence is tracked (default 1); 3 for a rolling shutter in quick turns",
    ),
    word(
        "--rrd FILE",
        "Rerun recording (extra 'viz'; default: recording.rrd in the output folder)",
        nargs="?",
        const="",
    ),
    VIEW,
    word(
        "--export KINDS",
        "images, masks and poses for colmap, transforms, euroc, g2o (comma-separated)",
        type=names,
        default=(),
    ),
)
LIVE = command(
    "live",
    "Estimate the motion of a camera while it moves; Ctrl-C ends it.",
    dispatch.live,
    WEIGHTS,
    word(
        "--camera NAME|DIR",
        "realsense, oak, orbbec (each with :SERIAL), opencv:0, or a recording",
    ),
    word("--preset NAME|FILE", "settings, as d435 or d435.yaml"),
    *TIMES,
    TRUST,
    FLOW,
    DEPTH,
    word("--mask onnx:FILE", "a network finds people (extra 'onnx')"),
    switch(
        "--no-imu",
        "leave the camera's IMU alone (default: used where there is one)",
        dest="imu",
        action="store_false",
    ),
    word("--out DIR", "output folder (default: runs/live-DATE-TIME)"),
    OVERWRITE,
    number("--seconds S", "end after so long"),
    count("--max-frames N", "end after so many frames"),
    word(
        "--size WxH",
        "make images and depth smaller, as 320x240 (default: the camera's)",
        type=image_size,
    ),
    word(
        "--rate",
        "auto: measure, then choose size, flow and budget that keep up",
        choices=("camera", "auto"),
        default="camera",
    ),
    word("--udp HOST:PORT", "send each step as a line of JSON"),
    word("--rrd FILE", "Rerun recording (extra 'viz')"),
    VIEW,
    METHOD,
    MAX_FAILED,
    *SETTINGS,
)
COMPARE = command(
    "compare",
    "Run methods side by side and write a report.",
    from_laboratory("compare"),
    *reading(),
    *OPTIONS,
    MODE,
    WEIGHTS,
    word(
        "--sequence DIR",
        "the same as DIR, by name; repeatable",
        dest="sequences",
        action="extend",
        nargs="+",
        default=[],
    ),
    word(
        "sequences DIR",
        "sequences, or folders of sequences (MPI Sintel as it was unpacked)",
        action="extend",
        nargs="*",
        default=SUPPRESS,
    ),
    word("--out DIR", "default: %(default)s", default="runs/compare"),
    word(
        "--methods",
        "comma-separated; default: all that run here",
        type=names,
        default="all",
    ),
    word(
        "--protocol",
        f"score a data set as papers do: {page('protocols')}",
        choices=PROTOCOLS,
    ),
    JOBS,
    CLUSTER,
)
SHOW = command(
    "show",
    "Draw the maps of one pair of a sequence.",
    from_laboratory("show"),
    *sequence(),
    WEIGHTS,
    Either(
        (
            count("--pair N", "first frame (default 0)", default=0),
            word(
                "--frame N",
                "the second frame, as 'run' names it",
                dest="pair",
                type=frame_before,
            ),
        )
    ),
    word("--out FILE", "default: %(default)s", default="pair.png"),
    word("--method NAME", "estimator (default: hybrid)", default="hybrid"),
    FLOW,
    switch(
        "--all",
        "also the other image, the ego flow and its error, and what PWVO looks at: slow",
        dest="everything",
    ),
    switch("--overwrite", "replace the image"),
    flow="auto",
)
EVALUATE = command(
    "evaluate",
    "Errors of a trajectory against the ground truth.",
    dispatch.evaluate,
    word("estimate EST", "estimated trajectory"),
    word("gt GT", "true trajectory (with --protocol also: DIR)"),
    word("--alignment", "of the ATE", choices=ALIGNMENTS, default="se3"),
    number("--delta X", "span of the RPE (default 1)", default=1),
    word(
        "--delta-unit",
        "unit of --delta",
        choices=("frames", "s"),
        default="frames",
    ),
    number(
        "--max-diff S",
        "seconds between matches (default %(default)s)",
        default=MAX_STAMP_DIFFERENCE_S,
    ),
    word(
        "--protocol",
        "errors as papers define them; GT is a sequence, or its file as published",
        choices=[name for name in PROTOCOLS if name != "paper"],
    ),
)
DOCTOR = command(
    "doctor",
    "What is missing here, or wrong with a sequence or a live camera.",
    dispatch.doctor,
    *sequence(
        required=False,
        camera=f"{CAMERA_HELP}: of DIR; without DIR a live camera, as for 'live'",
    ),
    count("--pairs N", "pairs (default 40)", default=40),
    switch(
        "--speed",
        "how fast DIR, or the demo, is tracked here, and what a frame's time goes to",
    ),
    word("--preset NAME|FILE", "settings of a live camera, as d435"),
    number(
        "--seconds S",
        "of a live camera (default %(default)s)",
        default=DOCTOR_SECONDS,
    ),
)
TOPICS = command(
    "topics",
    "List the topics of a bag, and which of them are taken.",
    calling("hybridvo.run.commands.diagnosis.topics:topics"),
    word("file FILE", "a bag of ROS 1, or file or folder of ROS 2"),
    TRUST,
)
CONVERT = command(
    "convert",
    "Write a sequence as a plain folder, in TUM's layout, or as a bag.",
    calling("hybridvo.run.commands.convert:convert"),
    *sequence(),
    word("out OUT", "new folder, or file that ends in .bag"),
    word(
        "--to",
        "layout (default: ros1 for a .bag, else folder)",
        choices=("folder", "tum", "ros1", "ros2"),
    ),
    number(
        "--units N",
        "of written depth in a metre (default 1000; tum 5000; bags: 1000 or 1)",
    ),
    *FRAMES,
    start=0,
    stride=1,
)
DEMO = command(
    "demo",
    "Render a scene with moving objects and run on it.",
    from_laboratory("demo"),
    word("--out DIR", "default: %(default)s", default="runs/demo"),
    OVERWRITE,
    count("--frames N", "default: 20", default=20),
    count("--seed N", "of the scene", default=0),
)
GENERATE = command(
    "generate",
    "Draw training samples into a folder.",
    from_laboratory("generate"),
    word(
        "--preset",
        "paper, diverse or a YAML file; default: %(default)s",
        default="paper",
    ),
    word("--out DIR", "folder of the samples", required=True),
    count("--count N", "default: 1000", default=1000),
    count("--seed N", default=0),
    count("--size", "pixels", nargs=2, metavar=("H", "W")),
    JOBS._replace(names=("--jobs", "--workers")),
    CLUSTER,
)
INIT = command(
    "init",
    "Write a camera.yaml to fill in.",
    calling("hybridvo.io.data.camera_file:write_camera_template"),
    word("directory DIR", "folder with rgb/ and depth/"),
)
TRAIN_PWVO = command(
    "pwvo",
    "train PWVO",
    dispatch.train,
    *TRAINING,
    word("--config", type=Path, default=Path("configs/train_pwvo.yaml")),
    SHARDS,
)
TRAIN_PAPER = command(
    "paper",
    "train a network of the paper",
    dispatch.train,
    *TRAINING,
    word("--config", "configs/train_*.yaml", type=Path, required=True),
    count("--workers", "processes that draw samples", default=0),
    word("--device", choices=DEVICES, default="auto"),
)
TRAIN_EXPORT = command(
    "export",
    "write a network's weights for users (int8)",
    from_laboratory("train-export"),
    word("--out", "folder of the run", dest="folder", type=Path, required=True),
    word("--export FILE", "*.safetensors", dest="path", type=Path, required=True),
    count("--count", "held-out pairs of each preset", default=1000),
)
TRAIN_SAMPLES = command(
    "samples",
    "draw samples for PWVO",
    from_laboratory("train-samples"),
    SHARDS,
    count("--first-seed", "below 1000: held out", default=1000000),
    count("--seeds", "about as many samples", default=0),
    word(
        "--recordings DIR",
        "folder of recordings, from which most of the pairs are made then",
        type=Path,
    ),
    number(
        "--shares SHARE",
        "of tripod recordings, semi-real pairs, objects of a kind in these, and two "
        "recordings in one view",
        nargs="+",
        default=(),
    ),
    JOBS,
    CLUSTER,
)
COMMANDS = (
    *(RUN, LIVE, COMPARE, SHOW, EVALUATE, DOCTOR, TOPICS, CONVERT, DEMO, GENERATE),
    INIT,
)
TRAINING_COMMANDS = (TRAIN_PWVO, TRAIN_PAPER, TRAIN_EXPORT, TRAIN_SAMPLES)
"""The commands of ``train``."""
TRAIN = (
    "Train a network; started again with the same --out it goes on where it was."
)
"""What ``train`` does, for ``--help``."""


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
    for command in COMMANDS:
        _add(commands, command)
    train = commands.add_parser(
        "train", help=TRAIN, description=f"{TRAIN} See {page('training')}."
    )
    tasks = train.add_subparsers(dest="training", required=True, metavar="COMMAND")
    for command in TRAINING_COMMANDS:
        _add(tasks, command)
    return parser


def _add(commands: Any, command: Command) -> None:
    """Add the parser of a command to those of the others."""
    parser = commands.add_parser(
        command.name, help=command.about, description=command.about
    )
    for argument in (*LOUDNESS, *command.arguments):
        if isinstance(argument, Argument):
            parser.add_argument(*argument.names, **argument.settings)
            continue
        group = parser.add_mutually_exclusive_group(required=argument.required)
        for names, settings in argument.arguments:
            group.add_argument(*names, **settings)
    parser.set_defaults(call=command.call, **command.defaults)
