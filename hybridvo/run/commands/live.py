"""``hybridvo live``: a camera goes in; poses come out as they are found."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import signal
import socket
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.live import Live
from rich.text import Text
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError, printable
from hybridvo.core.files import (
    LineFile,
    check_name,
    locked_folder,
    provenance,
    remove,
    write_json,
)
from hybridvo.core.options import NETWORK, Options
from hybridvo.core.results import Step
from hybridvo.flow.providers import FlowProvider, MeasuredFlow, dis_flow
from hybridvo.io.cameras.base import LiveCamera, warnings_of
from hybridvo.io.cameras.settings import LIVE_RATE_HZ
from hybridvo.io.live import RATE_STEPS, LiveStep, LiveStream, stream
from hybridvo.io.live_rate import AutoRate
from hybridvo.io.onnx.flow import FlowNetwork
from hybridvo.io.viewer.address import parse_address
from hybridvo.io.viewer.recording import RecordingWriter, check_recording
from hybridvo.io.viewer.scene import Sink
from hybridvo.io.viewer.viewer import Viewer
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
from hybridvo.pipeline import check_method
from hybridvo.run.commands.advice import advice_on
from hybridvo.run.commands.run_folder import (
    ALL_RESULTS,
    LIVE_STEPS,
    STATE,
    weights_hash,
)
from hybridvo.run.commands.stopping import StopRequest, stop_requested
from hybridvo.run.commands.terminal import STYLES

# s over which the images of a Rerun recording are spread where a run has no end:
# ten minutes, with an image every second
LIVE_RECORDING_S = 600.0

TRAJECTORY = "trajectory.tum"
STEPS = LIVE_STEPS
"""One line of JSON a step: what ``--udp`` sends."""
RESULTS = (STATE, TRAJECTORY, STEPS)


def live(
    camera: LiveCamera,
    out: str | Path | None = None,
    options: Options | None = None,
    *,
    models: Models | None = None,
    seconds: float | None = None,
    max_frames: int | None = None,
    udp: str | None = None,
    rrd: str | Path | None = None,
    view: str | None = None,
    size: tuple[int, int] | None = None,
    rate: Literal["camera", "auto"] = "camera",
    overwrite: bool = False,
    command: Iterable[str] = (),
    quiet: bool = False,
) -> tuple[dict[str, Any], int]:
    """Track a camera until it is stopped, and write what was found.

    Args:
        camera: the camera.
        out: the output folder; by default ``runs/live-DATE-TIME``.
        options: the options.
        models: the networks; by default the pretrained ones.
        seconds: how long, from the first frame on.
        max_frames: how many frames.
        udp: HOST:PORT to which every step is sent as a line of JSON.
        rrd: the file of a Rerun recording.
        view: ``spawn`` shows the run in a viewer while it goes on, ``connect:HOST:PORT`` in one
            that runs already, ``serve`` in a browser.
        size: columns and rows to which images and depth are made smaller; None: as they are.
        rate: ``auto`` chooses size, flow and budget by the first frames of the camera.
        overwrite: whether results in the folder are replaced.
        command: the words of the command line, which are kept with the results.
        quiet: whether nothing is shown.

    Returns:
        A summary, JSON-ready, and the exit code: 3 where too many motions failed, or the camera
        was gone at the end.

    Raises:
        InputError: the camera gave no frame, or an argument is of no use.
        LockedError: another run holds the folder.
        OutputError: a result cannot be written.

    Example:
        >>> from hybridvo.io.cameras.folder import FolderCamera
        >>> live(FolderCamera("drive.bag"), max_frames=100)  # doctest: +SKIP
    """
    options = options or Options()
    method = check_method(options.run.method)
    models = models or Models(options.run.device)
    _check_limits(seconds, max_frames)
    _check_passes(options.run.passes)
    address = None if udp is None else _address(udp)
    _check_places(rrd, view)
    folder = Path(out or f"runs/live-{time.strftime('%Y%m%d-%H%M%S')}")
    check_name(folder)
    trackers = _Trackers(models, method)
    # else the first frames would be dropped
    tracker = trackers.make(options)
    header = {
        "command": list(command),
        **provenance(),
        "weights": weights_hash(method, models),
        "options": dataclasses.asdict(options),
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(locked_folder(folder))
        sinks: list[Any] = [stack.enter_context(_Files(folder, header, overwrite))]
        if address is not None:
            sinks.append(stack.enter_context(_Datagrams(address)))
        screen = stack.enter_context(_Screen(quiet))
        warnings = warnings_of(camera)
        for warning in warnings:
            screen.say(warning)
        stop = stack.enter_context(stop_requested())
        steps = stream(
            camera,
            tracker if rate == "camera" else None,
            size=size,
            rate=rate if rate == "camera" else AutoRate(options, trackers.make),
            seconds=seconds,
            max_frames=max_frames,
            stop=lambda: bool(stop.number),
            say=screen.say,
        )
        viewer = Viewer(view, camera.name, say=screen.say) if view else None
        shown: list[Sink] = [viewer] if viewer else []
        if rrd is not None:
            count = max_frames or int(LIVE_RATE_HZ * (seconds or LIVE_RECORDING_S))
            shown.append(RecordingWriter(rrd, camera.name, count))
        sinks += [stack.enter_context(_Rerun(shown, trackers)), screen]
        _pump(steps, sinks)
        summary = _summarise(steps, stop, folder, screen.messages, rrd)
        summary["page"] = viewer.served() if viewer else ""
        sinks[0].finish(summary)
    if not summary["tracked"]:
        # what was chosen is no reason
        happened = [
            text
            for text in screen.messages[len(warnings) :]
            if text != summary["chosen"]
        ]
        reason = happened[-1] if happened else _why_nothing(camera.name, summary)
        raise InputError(f"{reason} ({summary['ended']}).")
    too_many = summary["failed_fraction"] > options.run.max_failed
    return summary, 3 if too_many or steps.is_gone else 0


class _Trackers:
    """Makes trackers that have compiled everything.

    Attributes:
        flow: the provider of the last one, which keeps its last field.
    """

    def __init__(self, models: Models, method: str) -> None:
        self.flow = MeasuredFlow(dis_flow())
        self._models = models
        self._method = method

    def make(self, options: Options) -> Odometry:
        """A tracker with some options."""
        self.flow = MeasuredFlow(_flow_provider(options))
        tracker = Odometry(
            self._models,
            flow=self.flow,
            method=self._method,
            options=options,
            seed=options.run.seed,
        )
        tracker.warm_up()
        return tracker


def _why_nothing(name: str, summary: dict[str, Any]) -> str:
    """State why no frame was tracked, although nothing was reported."""
    old = summary["old"]
    if summary["tried"]:
        return (
            f"{name}: {summary['tried']} frames, too few for --rate auto, which measures by the "
            "first ones: pass --rate camera"
        )
    if not old:
        return f"{name}: no frames"
    remedy = "the computer is too slow, or its clock is another than the camera's"
    return f"{name}: {old} frames, all too old when their turn came: {remedy}"


def _flow_provider(options: Options) -> FlowProvider:
    """The provider of the flow that the options select: a camera has no files."""
    source = options.flow.source
    if source == "file":
        raise InputError(
            "--flow file: a camera has no flow files; use dis or onnx:FILE."
        )
    if source.startswith(NETWORK):
        return FlowNetwork(source)
    return dis_flow(options.flow.dis_preset)


def _check_limits(seconds: float | None, max_frames: int | None) -> None:
    """Refuse limits that no run can keep."""
    if seconds is not None and not seconds > 0:
        raise InputError(f"--seconds {seconds}: expected more than 0.")
    if max_frames is not None and max_frames < 1:
        raise InputError(f"--max-frames {max_frames}: expected 1 or more.")


def _check_passes(passes: int) -> None:
    """Refuse more than one pass: a camera shows each frame once."""
    if passes > 1:
        raise InputError(
            f"run.passes: expected 1 of a camera, which shows each frame once; got {passes}. "
            f"Record it, and pass the recording to hybridvo run."
        )


def _check_places(rrd: str | Path | None, view: str | None) -> None:
    """Refuse a recording that cannot be written, and a place where no viewer can be."""
    if rrd is not None:
        check_recording(rrd)
    if view is not None:
        parse_address(view)


def _pump(steps: LiveStream, sinks: list[Any]) -> None:
    """Hand every step to all that want it."""
    for step in steps:
        for sink in sinks:
            sink.add(step, steps)


def _summarise(
    steps: LiveStream,
    stop: StopRequest,
    folder: Path,
    messages: list[str],
    rrd: str | Path | None,
) -> dict[str, Any]:
    """The summary of a run that has ended."""
    summary = steps.summary()
    if stop.number:
        summary["ended"] = signal.Signals(stop.number).name
    motions = max(summary["tracked"] - 1, 1)
    messages = [text for text in messages if text != summary["chosen"]]
    outcomes = [
        (row["state"], row["reason"])
        for row in summary["outcomes"]
        for _ in range(row["steps"])
    ]
    files = [folder / name for name in RESULTS]
    return summary | {
        "failed_fraction": summary["failed"] / motions,
        "doubts": advice_on(outcomes),
        "warnings": messages,
        "warnings_shown": len(messages),
        "state": "done",
        "out": str(folder),
        "files": [str(path) for path in files],
        "recording": None if rrd is None else str(rrd),
    }


# -- where steps go ----------------------------------------------------------------------


class _Files(contextlib.AbstractContextManager):
    """The files of a run, which grow with every step."""

    def __init__(
        self, folder: Path, header: dict[str, Any], overwrite: bool
    ) -> None:
        present = [name for name in ALL_RESULTS if os.path.lexists(folder / name)]
        if present and not overwrite:
            names = ", ".join(present[:3])
            raise InputError(
                f"{folder}: holds results ({names}). Pass another --out, or "
                "--overwrite to delete them first."
            )
        self._folder = folder
        self._header = header
        self._summary: dict[str, Any] | None = None
        self._last: Step | None = None
        self._lags = bool(header["options"]["track"]["lag"])
        remove(*(folder / name for name in present))
        self._save("running")
        self._trajectory = LineFile(folder / TRAJECTORY, ())
        self._steps = LineFile(folder / STEPS, ())

    def add(self, live: LiveStep, _: LiveStream) -> None:
        """Write a step."""
        step = live.step
        if self._last is not None:
            self._trajectory.add(tum_line(step.corrected or self._last))
            self._last = None
        if self._lags:
            # corrected when the next frame is there
            self._last = step
        else:
            self._trajectory.add(tum_line(step))
        self._steps.add(json_line(live))

    def finish(self, summary: dict[str, Any]) -> None:
        """Keep the summary of a complete run."""
        self._summary = summary

    def __exit__(self, *_: object) -> None:
        if self._last is not None:
            self._trajectory.add(tum_line(self._last))
        self._trajectory.close()
        self._steps.close()
        self._save("interrupted" if self._summary is None else "done")

    def _save(self, state: str) -> None:
        """Write ``run.json``."""
        content = self._header | {"summary": self._summary, "state": state}
        write_json(self._folder / STATE, content)


class _Datagrams(contextlib.AbstractContextManager):
    """Sends steps as lines of JSON by UDP; whether anybody listens does not matter."""

    def __init__(self, address: tuple[Any, Any]) -> None:
        family, self._address = address
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def add(self, live: LiveStep, _: LiveStream) -> None:
        """Send a step, or drop it where the network does not take it."""
        data = f"{json_line(live)}\n".encode()
        with contextlib.suppress(OSError):
            self._socket.sendto(data, self._address)

    def __exit__(self, *_: object) -> None:
        self._socket.close()


class _Rerun(contextlib.AbstractContextManager):
    """Shows steps in a viewer, and writes them into a recording for one."""

    def __init__(self, sinks: list[Sink], trackers: _Trackers) -> None:
        self._sinks = sinks
        self._trackers = trackers

    def add(self, live: LiveStep, _: LiveStream) -> None:
        """Show a step, and record it."""
        measured = self._trackers.flow
        flow = measured.last.flow
        # a frame that was tried in another size
        fits = flow is not None and flow.shape[:2] == live.frame.camera.shape
        seen = live.seen(flow if fits else None)
        for sink in self._sinks:
            sink.add(seen)
        measured.reset()

    def __exit__(self, *_: object) -> None:
        for sink in self._sinks:
            sink.close()


class _Screen(contextlib.AbstractContextManager):
    """A line for whatever happens, and on a terminal one that changes with every step.

    Attributes:
        messages: what has happened.
    """

    def __init__(self, quiet: bool) -> None:
        self.messages: list[str] = []
        self._console = Console(
            stderr=True, quiet=quiet, soft_wrap=True, markup=False, highlight=False
        )
        self._line = Live(Text("waiting for frames"), console=self._console)
        console = self._console
        # elsewhere lines cannot change: they would run into those that come after
        self._has_line = console.is_terminal and not console.is_dumb_terminal

    def __enter__(self) -> _Screen:
        if self._has_line:
            self._line.start()
        return self

    def __exit__(self, *_: object) -> None:
        # which ends the line; nothing where it was not started
        self._line.stop()

    def say(self, text: str) -> None:
        """Show a sentence above the line."""
        text = printable(text)
        self.messages.append(text)
        self._console.print(text)

    def add(self, live: LiveStep, steps: LiveStream) -> None:
        """Show a step."""
        if self._has_line:
            line = Text(screen_line(live, steps))
            status = live.step.status
            line.highlight_words([str(status)], STYLES[status.state.value])
            self._line.update(line)


def screen_line(live: LiveStep, steps: LiveStream) -> str:
    """Return pose, status, rate, dropped frames and age of the latest steps, on one line."""
    x, y, z = live.step.T_world_cam[:3, 3]
    median = steps.age_ms(50, RATE_STEPS) or 0.0
    late = steps.age_ms(95, RATE_STEPS) or 0.0
    parts = [
        f"x {x:+.3f} y {y:+.3f} z {z:+.3f} m",
        str(live.step.status),
        f"{live.frames_per_second:.1f} frames/s",
        f"{live.dropped} dropped",
        f"age {median:.0f} ms, p95 {late:.0f} ms",
    ]
    return "  ".join(parts)


def tum_line(step: Step) -> str:
    """Return a line of TUM's form: stamp, position, quaternion xyzw."""
    T = step.T_world_cam
    xyzw = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    numbers = " ".join(repr(float(value)) for value in (*T[:3, 3], *xyzw))
    return f"{step.timestamp:.9f} {numbers}"


def json_line(live: LiveStep) -> str:
    """Return a step as one line of JSON, short enough for one datagram."""
    step = live.step
    T = step.T_world_cam
    xyzw = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    probability = float(step.probability)
    content = {
        "index": step.index,
        "prev_index": step.prev_index,
        "timestamp": step.timestamp,
        "status": step.status.state.value,
        "reason": step.status.reason.value,
        "probability": None if math.isnan(probability) else _short(probability),
        "position": [_short(value) for value in T[:3, 3]],
        "orientation_xyzw": [_short(value) for value in xyzw],
        "T_prev_curr": [_short(value) for value in step.T_prev_curr[:3].ravel()],
        "covariance": [_short(value) for value in step.covariance.ravel()],
        "age_ms": _short(1000 * live.age_s),
        "frames_per_second": _short(live.frames_per_second),
        "dropped": live.dropped,
        "depth_scale": _short(step.depth_scale),
    }
    if step.gravity is not None:
        content["gravity"] = [_short(value) for value in step.gravity.direction]
        content["gravity_sigma_deg"] = _short(math.degrees(step.gravity.std))
    return json.dumps(content, allow_nan=False, separators=(",", ":"))


def _short(value: float) -> float:
    """A number with nine digits, which is a tenth of a millimetre at 10 km."""
    return float(f"{value:.9g}")


def _address(text: str) -> tuple[Any, Any]:
    """Return the family and the address of HOST:PORT."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    expected = "expected HOST:PORT, as 127.0.0.1:9000"
    if not host or not port.isdecimal():
        raise InputError(f"--udp {text}: {expected}.")
    try:
        found = socket.getaddrinfo(host, int(port), type=socket.SOCK_DGRAM)[0]
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(f"--udp {text}: {expected}: {error}.") from None
    family = found[0]
    address = found[4]
    if address[1] != int(port):
        # some systems take the rest of a port that is too large
        raise InputError(f"--udp {text}: {expected}.")
    return family, address
