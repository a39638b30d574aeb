"""What is shown in Rerun, and that no viewer slows or stops a run."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import se3_exp
from hybridvo.io.live import LiveStream, stream
from hybridvo.io.viewer import address, program, scene, viewer
from hybridvo.io.viewer.recording import RecordingWriter
from hybridvo.io.viewer.scene import Seen, ViewerScene
from tests.io.live.scripted import (
    CAMERA,
    QUICK,
    ScriptedCamera,
    Tracker,
    frame,
    reading,
)

pytest.importorskip("rerun", reason="Rerun is not installed (extra viz)")

FORWARD = se3_exp(np.array([0, 0, -0.1, 0, 0, 0]))
STD = np.array([0.01, 0.02, 0.03, 0.001, 0.001, 0.001])


class Wire:
    """A stream that keeps what is logged."""

    def __init__(self) -> None:
        self.logged: list[tuple[str, Any]] = []
        self.flushes = 0
        self.is_closed = False

    def set_time(self, *_: Any, **__: Any) -> None:
        """Time does not matter here."""

    def log(self, name: str, content: Any, static: bool = False) -> None:
        self.logged.append((name, content))

    def flush(self, timeout_sec: float) -> None:
        self.flushes += 1

    def disconnect(self) -> None:
        self.is_closed = True

    def last(self, name: str) -> Any:
        return [content for path, content in self.logged if path == name][-1]

    def count(self, name: str) -> int:
        return sum(path == name for path, _ in self.logged)


def step(index: int, status: hvo.Status | None = None) -> hvo.Step:
    """A step of ten centimetres ahead each, with the right half moving."""
    weights = np.ones(CAMERA.shape, np.float32)
    weights[:, 8:] = 0
    motion = hvo.RelativePose(
        FORWARD,
        np.diag(STD**2),
        status or hvo.Status(),
        weights=weights,
        probability=0.9,
    )
    T = np.eye(4)
    T[2, 3] = 0.1 * index
    before = index - 1 if index else None
    if not index:
        motion = hvo.RelativePose(np.eye(4), np.diag(np.full(6, 1e-12)))
    return hvo.Step(index, 0.1 * index, T, motion, before)


def seen(index: int, status: hvo.Status | None = None) -> Seen:
    start = frame(0.0) if index else None
    flow = np.ones((*CAMERA.shape, 2), np.float32)
    return Seen(frame(0.1), step(index, status), start, flow, 12.0)


def values(archetype: Any, name: str) -> Any:
    """The content of a field of what is logged."""
    return np.array(getattr(archetype, name).as_arrow_array().to_pylist())


@pytest.fixture
def wire() -> Wire:
    return Wire()


# --- what is shown --------------------------------------------------------------------------------


def test_everything_about_a_step_is_shown(wire: Wire) -> None:
    shown = ViewerScene(wire)
    for index in range(3):
        shown.add(seen(index))
    paths = {name for name, _ in wire.logged}
    assert paths >= {
        *(scene.IMAGE, scene.MOVING, scene.LAMP, scene.POINTS, scene.PATH),
        *(scene.UNCERTAINTY, scene.STATE, scene.FLOW, scene.WEIGHTS, *scene.CURVES),
    }
    assert wire.count(scene.PATH) == 2
    assert values(wire.last(scene.RATE), "scalars").tolist() == [12.0]
    assert values(wire.last(scene.PROBABILITY), "scalars").tolist() == [0.9]
    sigma = 1e3 * np.linalg.norm(STD[:3])
    np.testing.assert_allclose(
        values(wire.last(scene.TRANSLATION), "scalars"), sigma
    )


def test_a_failed_motion_turns_the_lamp_red_and_hides_its_numbers(
    wire: Wire,
) -> None:
    shown = ViewerScene(wire)
    shown.add(seen(0))
    shown.add(seen(1))
    green = values(wire.last(scene.LAMP), "colors")
    failed = hvo.RelativePose.failed(hvo.Reason.NO_FLOW, "dark")
    shown.add(Seen(frame(0.2), hvo.Step(2, 0.2, np.eye(4), failed, 1), frame(0.1)))
    assert values(wire.last(scene.LAMP), "colors") != green
    assert "failed(no_flow)" in str(values(wire.last(scene.LAMP), "labels"))
    assert "dark" in str(values(wire.last(scene.MESSAGES), "text"))
    for name in (scene.UNCERTAINTY, scene.TRANSLATION, scene.MOVING):
        assert type(wire.last(name)).__name__ == "Clear"
    # a motion from the frame before spans it
    known = hvo.Step(3, 0.3, np.eye(4), step(3).motion, 1)
    shown.add(Seen(frame(0.3), known, frame(0.1)))
    assert type(wire.last(scene.UNCERTAINTY)).__name__ == "Ellipsoids3D"


def test_what_moves_is_shown_where_the_camera_takes_it() -> None:
    mask = np.zeros(CAMERA.shape, bool)
    mask[5, 4] = True
    right = se3_exp(np.array([0.16, 0, 0, 0, 0, 0]))  # 4 pixels at 2 m
    found = scene.carried(mask, frame(0.0), right, CAMERA, 1)
    assert np.argwhere(found).tolist() == [[5, 8]]


def test_a_recording_opens_arranged(tmp_path: Path) -> None:
    path = tmp_path / "walk.rrd"
    recording = RecordingWriter(path, "walk", 3, np.zeros((2, 3)))
    for index in range(3):
        recording.add(seen(index))
    recording.close()
    content = path.read_bytes()
    assert content[:3] == b"RRF"
    for name in (*scene.CURVES, scene.TRUTH, "viewport"):
        assert name.encode() in content, name


# --- a viewer that is missing, closed or slow -----------------------------------------------------


def test_a_slow_viewer_gets_numbers_and_fewer_images(wire: Wire) -> None:
    is_free = threading.Event()
    wire.flush = lambda timeout_sec: is_free.wait() and None
    shown = viewer.Viewer("spawn", "walk", open_stream=lambda: wire)
    for index in range(50):
        shown.add(seen(index))
    is_free.set()
    shown.close()
    assert wire.count(scene.LAMP) == 50
    assert wire.count(scene.POINTS) <= viewer.MAX_WAITING_IMAGES + 1


def test_a_viewer_that_is_closed_is_reported_once(wire: Wire) -> None:
    def closed(timeout_sec: float) -> None:
        raise RuntimeError("gRPC connection severed")

    said: list[str] = []
    wire.flush = closed
    shown = viewer.Viewer(
        "spawn", "walk", say=said.append, open_stream=lambda: wire
    )
    for index in range(5):
        shown.add(seen(index))
    shown.close()
    assert len(said) == 1
    assert "severed" in said[0] and "the run goes on without it" in said[0]
    assert not wire.is_closed, "that would wait for the viewer"


def test_a_viewer_that_hangs_is_left_alone(wire: Wire, monkeypatch: Any) -> None:
    is_over = threading.Event()
    said: list[str] = []
    wire.flush = lambda timeout_sec: is_over.wait() and None
    monkeypatch.setattr(viewer, "VIEWER_CLOSING_S", 0.01)
    shown = viewer.Viewer(
        "spawn", "walk", say=said.append, open_stream=lambda: wire
    )
    shown.add(seen(0))
    shown.close()
    assert "for the rest" in said[0]
    is_over.set()


def test_an_address_where_nothing_listens_is_reported() -> None:
    said: list[str] = []
    port = program.free_port(0)
    shown = viewer.Viewer(f"connect:{port}", "walk", say=said.append)
    shown.add(seen(0))
    shown.close()
    assert len(said) == 1
    assert f"no viewer listens at 127.0.0.1:{port}" in said[0]
    assert "--rrd" in said[0]


DEAF = """
import socket, sys
from hybridvo.io.viewer import viewer
viewer.VIEWER_SILENCE_S = 0.05
from tests.io.live.test_viewer import seen
deaf = socket.socket()
deaf.bind(("127.0.0.1", 0))
deaf.listen()
shown = viewer.Viewer(f"connect:{deaf.getsockname()[1]}", "walk", say=print)
shown.add(seen(0))
shown.close()
print("the end")
"""


@pytest.mark.slow
def test_a_program_ends_although_its_viewer_does_not_answer() -> None:
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", DEAF], capture_output=True, text=True, cwd=root
    )
    assert done.returncode == 0, done.stderr
    first, last = done.stdout.splitlines()
    assert "the viewer is lost" in first and last == "the end"


# --- where a viewer is ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("spawn", ("spawn", "127.0.0.1", 9876)),
        ("serve", ("serve", "127.0.0.1", 9876)),
        ("connect", ("connect", "127.0.0.1", 9876)),
        ("connect:9000", ("connect", "127.0.0.1", 9000)),
        ("connect:robot", ("connect", "robot", 9876)),
        ("connect:robot:9000", ("connect", "robot", 9000)),
        ("connect:[::1]:9000", ("connect", "::1", 9000)),
        ("connect:[::1]", ("connect", "::1", 9876)),
    ],
)
def test_addresses(text: str, expected: tuple[str, str, int]) -> None:
    assert address.parse_address(text) == expected


@pytest.mark.parametrize(
    "text", ["runs/walk", "spawn:1", "connect:a:b", "connect:1:70000", ""]
)
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(hvo.InputError, match="--view"):
        address.parse_address(text)


# --- a stream of a camera -------------------------------------------------------------------------


def test_a_stream_shows_every_step(wire: Wire) -> None:
    camera = ScriptedCamera(*(reading(0.1 * i) for i in range(4)))
    shown = viewer.Viewer("spawn", "walk", open_stream=lambda: wire)
    steps = stream(camera, Tracker(), patience=QUICK, view=shown)
    assert isinstance(steps, LiveStream)
    camera.stream = steps
    assert sum(1 for _ in steps) == 4
    assert wire.count(scene.LAMP) == 4
    assert wire.is_closed


PAGE = """
import sys
from hybridvo.io.viewer import page
page.sys.executable = sys.argv[1]
sys.exit(page.main(["60"]))
"""


@pytest.mark.parametrize("ends_by_itself", [True, False])
def test_a_page_ends_with_the_run(tmp_path: Path, ends_by_itself: bool) -> None:
    """In place of Rerun a script, which ends at once or waits."""
    program_here = tmp_path / "rerun"
    wait = "" if ends_by_itself else "exec sleep $3"
    program_here.write_text(f"#!/bin/sh\n{wait}\n")
    program_here.chmod(0o755)
    page = subprocess.Popen(
        [sys.executable, "-c", PAGE, str(program_here)],
        stdin=subprocess.PIPE,
        cwd=Path(__file__).parents[3],
        start_new_session=True,
    )
    assert page.stdin is not None
    if not ends_by_itself:
        page.stdin.close()
    assert page.wait() == (0 if ends_by_itself else -15)
    page.stdin.close()


def test_a_library_that_is_missing_is_reported(monkeypatch: Any) -> None:
    said: list[str] = []
    monkeypatch.setattr(viewer, "find_spec", lambda name: None)
    viewer.Viewer("spawn", "walk", say=said.append).close()
    assert "pip install 'hybridvo[viz]'" in said[0]
