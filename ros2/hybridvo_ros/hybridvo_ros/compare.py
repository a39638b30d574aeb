"""Plays a bag through the node, and compares its poses with those of ``hybridvo run``.

With ``--heard`` it compares what was recorded before, and needs no ROS.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml

from hybridvo.core.errors import HybridVOError, InputError
from hybridvo.core.trajectory import read_trajectory
from hybridvo.io.ros.comparison import (
    Used,
    difference,
    node_parameters,
    play_qos,
    recorded_odometry,
    used_topics,
)
from hybridvo.run.cli import main as hybridvo

QUEUE = 1000
"""Poses that wait until they are taken."""
DISCOVERY_S = 5
"""Between the player's start and its first message: until node and player know each other."""
START_S = 600.0
"""Time that the node has to load its network, and to compile its kernels at the first start."""
SILENCE_S = 60.0
"""Time without a pose, once the bag has been played, after which no more are expected."""
STOP_S = 30.0
"""Time that a program has to end."""
DONE = (0, 3)
"""Exit codes of ``hybridvo run`` with a path: 3 where many motions failed."""
OFF = 1
"""Exit code where the poses differ."""


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="compare", description=__doc__)
    add = parser.add_argument
    add("bag", type=Path, help="folder of a ROS 2 bag with colour and depth")
    add("--out", type=Path, default=Path("runs/compare_ros2"), help="for the run")
    add("--heard", type=Path, help="compare this recording of the node's odometry")
    add("--topic", default="/odom", help="of the odometry (default: %(default)s)")
    add("--set", action="append", default=[], metavar="GROUP.KEY=VALUE")
    add("--max-m", type=float, default=1e-6, help="default: %(default)s")
    add("--max-deg", type=float, default=1e-4, help="default: %(default)s")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Compare; returns 0 where the poses are the same, else 1, 2 for what is of no use."""
    given = build_parser().parse_args(argv)
    try:
        return compare(given)
    except HybridVOError as error:
        print(error, file=sys.stderr)
        return error.exit_code


def compare(given: argparse.Namespace) -> int:
    """Compare by the arguments of the command line; returns its exit code."""
    if given.heard is None and find_spec("rclpy") is None:
        raise InputError(
            "ROS 2 is needed to play a bag, and is not there; --heard compares a recording "
            "without it."
        )
    used = used_topics(given.bag)
    parameters = node_parameters(used, given.set)
    run = given.out / "run"
    assignments = [text for each in given.set for text in ("--set", each)]
    code = hybridvo(
        ["run", str(given.bag), "--out", str(run), "--overwrite", *assignments]
    )
    if code not in DONE:
        return code
    if given.heard is None:
        messages = played(given.bag, used, parameters, given.out, given.topic)
    else:
        messages = recorded_odometry(given.heard, given.topic)
    found = difference(messages, read_trajectory(run / "trajectory.tum"))
    print(found)
    return 0 if found.is_within(given.max_m, given.max_deg) else OFF


# -- the node and the player -------------------------------------------------------------


def node_command(parameters: dict[str, str]) -> list[str]:
    """Return the command that starts the node."""
    assigned = [f"{name}:={value}" for name, value in parameters.items()]
    options = [text for each in assigned for text in ("-p", each)]
    return [sys.executable, "-m", "hybridvo_ros.odometry", "--ros-args", *options]


def play_command(bag: Path, used: Used, qos: Path) -> list[str]:
    """Return the command that plays what the node needs of a bag."""
    return [
        *("ros2", "bag", "play", str(bag)),
        *("--clock", "100"),
        *("--delay", str(DISCOVERY_S)),
        *("--qos-profile-overrides-path", str(qos)),
        *("--topics", *used.played),
    ]


def start(command: list[str]) -> subprocess.Popen[bytes]:
    """Start a program, which writes where this one does."""
    return subprocess.Popen(command)


def played(
    bag: Path, used: Used, parameters: dict[str, str], out: Path, topic: str
) -> list[Any]:
    """Play a bag to the node; returns the odometry that it publishes.

    Raises:
        InputError: The node or the player ended with an error.
    """
    import rclpy
    from nav_msgs.msg import Odometry

    qos = out / "qos.yaml"
    qos.write_text(yaml.safe_dump(play_qos(used)), encoding="utf-8")
    heard = list[Any]()
    programs = dict[str, subprocess.Popen[bytes]]()
    rclpy.init()
    listener = rclpy.create_node("hybridvo_compare")
    listener.create_subscription(Odometry, topic, heard.append, QUEUE)

    def listen_until(is_so: Callable[[], bool]) -> None:
        while not is_so():
            rclpy.spin_once(listener, timeout_sec=0.1)
            _check(programs)

    try:
        programs["node"] = start(node_command(parameters))
        deadline = Deadline(START_S, "the node to start")
        listen_until(
            lambda: listener.count_subscribers(used.rgb) > 0 or deadline.is_over()
        )
        player = start(play_command(bag, used, qos))
        programs["player"] = player
        listen_until(lambda: len(heard) >= used.frames or player.poll() is not None)
        silence = Silence(heard)
        listen_until(lambda: len(heard) >= used.frames or silence.is_over())
    finally:
        for program in reversed(programs.values()):
            _stop(program)
        listener.destroy_node()
        rclpy.try_shutdown()
    return heard


class Deadline:
    """A time after which something that has not happened is an error."""

    def __init__(self, seconds: float, what: str) -> None:
        self._what = what
        self._seconds = seconds
        self._end = time.monotonic() + seconds

    def is_over(self) -> bool:
        """Return False; raises an InputError once the time is over."""
        if time.monotonic() > self._end:
            raise InputError(f"waited {self._seconds:g} s for {self._what}.")
        return False


class Silence:
    """How long nothing has been added to a list."""

    def __init__(self, heard: list[Any]) -> None:
        self._heard = heard
        self._count = len(heard)
        self._since = time.monotonic()

    def is_over(self) -> bool:
        """Return whether nothing has come for so long that no more is expected."""
        if len(self._heard) > self._count:
            self._count = len(self._heard)
            self._since = time.monotonic()
        return time.monotonic() - self._since > SILENCE_S


def _check(programs: dict[str, subprocess.Popen[bytes]]) -> None:
    """Refuse to go on without the node, or without a player that has played the bag."""
    for name, program in programs.items():
        code = program.poll()
        has_ended = code is not None
        if has_ended and (code != 0 or name == "node"):
            raise InputError(f"the {name} ended with code {code}: see above.")


def _stop(program: subprocess.Popen[bytes]) -> None:
    """End a program as Ctrl-C does, or by force."""
    if program.poll() is not None:
        return
    program.send_signal(signal.SIGINT)
    try:
        program.wait(STOP_S)
    except subprocess.TimeoutExpired:
        program.kill()
        program.wait()


if __name__ == "__main__":
    sys.exit(main())
