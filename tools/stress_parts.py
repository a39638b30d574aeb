"""What the campaigns of ``stress.py`` share: tiny walks, runs in forks, comparison of results.

A run costs a tenth of a second here and its process seven times as much (imports, compiled kernels
read from their cache). So one process imports everything, makes the walk once, and forks for every
run that is to die: the fork has the memory of a fresh process that has just finished its imports.
It has one thread (``ONE_THREAD``): forks of several threads may wait for locks that nobody holds.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

FILES = ("trajectory.tum", "trajectory.kitti", "steps.npz", "metrics.json", "trajectory.png")
"""Results that must be equal to the byte; ``steps.csv`` but for its column of times."""

REFINE = ("--method", "refine", "--flow", "file", "-q")


def write_walk(
    root: Path,
    frames: int,
    *,
    height: int = 32,
    width: int = 48,
    distinct: int = 40,
    pictures: bool = False,
) -> Path:
    """A sequence in the ``folder`` layout: depth, noisy flow that fits it, true poses.

    Beyond ``distinct`` frames the files are links to the first ones: a walk in place of any length.
    """
    import cv2

    from hybridvo.geometry import ego_flow, se3_exp
    from hybridvo.trajectory import Trajectory, chain, write_tum
    from hybridvo.types import Camera

    camera = Camera(width, width, (width - 1) / 2, (height - 1) / 2, height, width)
    lines = [f"{name}: {getattr(camera, name)}\n" for name in ("fx", "fy", "cx", "cy")]
    kinds = {"depth": "npy", "flow": "npy"} | ({"rgb": "png"} if pictures else {})
    for kind in kinds:
        (root / kind).mkdir(parents=True, exist_ok=True)
    (root / "camera.yaml").write_text(f"{''.join(lines)}width: {width}\nheight: {height}\n")
    v, u = np.mgrid[:height, :width] / width
    T, poses = np.eye(4), []
    for i in range(frames):
        k = i % distinct
        xi = np.array([0.02 * np.cos(k), 0.01 * np.sin(k), 0.015, 0.002 * np.sin(k), 0.003, 0.001])
        T_curr_prev = se3_exp(xi)
        poses.append(T)
        T = chain(T, T_curr_prev)
        if i >= distinct:
            for kind, suffix in kinds.items():
                if kind != "flow" or i < frames - 1:
                    os.link(root / kind / f"{k:06d}.{suffix}", root / kind / f"{i:06d}.{suffix}")
            continue
        rng = np.random.default_rng(k)
        depth = (2 + 0.5 * np.sin(9 * u + k) + 0.3 * np.cos(11 * v)).astype(np.float32)
        flow = ego_flow(depth, T_curr_prev, camera, camera) + rng.normal(0, 0.1, (height, width, 2))
        np.save(root / "depth" / f"{i:06d}.npy", depth)
        if i < frames - 1:
            np.save(root / "flow" / f"{i:06d}.npy", flow.astype(np.float32))
        if pictures:
            grey = 128 + 50 * np.sin(40 * u + k / 3) + 50 * np.cos(33 * v)
            cv2.imwrite(
                str(root / "rgb" / f"{i:06d}.png"), grey.astype(np.uint8)[..., None].repeat(3, 2)
            )
    write_tum(Trajectory(np.arange(frames) / 30, np.stack(poses)), root / "poses.txt")
    return root


def write_rendered_walk(
    root: Path, frames: int, *, height: int = 96, width: int = 128, distinct: int = 30
) -> Path:
    """The same with rendered pictures and depth, and no flow: the camera goes to and fro.

    Beyond ``distinct`` frames the files are links to the first ones, in the order of the way back
    and forth, so that neighbours always are neighbours.
    """
    import cv2

    from hybridvo.synthetic.render import make_scene
    from hybridvo.trajectory import Trajectory, write_tum

    distinct = min(distinct, frames)
    scene = make_scene("light", 404, height=height, width=width, frames=distinct)
    for kind in ("rgb", "depth"):
        (root / kind).mkdir(parents=True, exist_ok=True)
    camera = scene.camera(0)
    lines = [f"{name}: {getattr(camera, name)}\n" for name in ("fx", "fy", "cx", "cy")]
    (root / "camera.yaml").write_text(f"{''.join(lines)}width: {width}\nheight: {height}\n")
    poses = []
    for i in range(frames):
        k = distinct - 1 - abs(i % max(2 * distinct - 2, 1) - (distinct - 1))
        poses.append(scene.T_world_cam[k])
        picture, depth = (root / "rgb" / f"{i:06d}.png", root / "depth" / f"{i:06d}.npy")
        if i < distinct:
            found = scene.render(i)
            cv2.imwrite(str(picture), np.ascontiguousarray(found.rgb[..., ::-1]))
            np.save(depth, found.depth)
            continue
        os.link(root / "rgb" / f"{k:06d}.png", picture)
        os.link(root / "depth" / f"{k:06d}.npy", depth)
    T = np.linalg.inv(poses[0]) @ np.stack(poses)
    write_tum(Trajectory(np.arange(frames) / 30, T), root / "poses.txt")
    return root


def content(out: Path) -> dict[str, Any]:
    """Results of a run but for the times in them; names of all its files."""
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    if not {*FILES, "steps.csv"} <= {*names}:
        return {"names": names}
    found: dict[str, Any] = {name: (out / name).read_bytes() for name in FILES}
    with (out / "steps.csv").open() as file:
        rows = [{k: v for k, v in row.items() if k != "ms"} for row in csv.DictReader(file)]
    return found | {"steps.csv": rows, "names": names}


def state(out: Path) -> dict[str, Any]:
    """``run.json``."""
    return json.loads((out / "run.json").read_text())


def rows_kept(out: Path) -> int:
    """Finished frames on the disk: whole lines, or all of a run that is done."""
    partial = out / "steps.partial.jsonl"
    if partial.exists():
        return partial.read_bytes().count(b"\n")
    return state(out)["frames_done"] if (out / "run.json").exists() else 0


def command(sequence: Path, out: Path, *options: str) -> list[str]:
    """Arguments of ``hybridvo`` for a run."""
    return ["run", "--sequence", str(sequence), "--out", str(out), *options]


def hybridvo(
    arguments: list[str], environment: dict[str, str] | None = None, **options: Any
) -> subprocess.CompletedProcess:
    """``hybridvo ...`` in a fresh process."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)} | (environment or {})
    command = [sys.executable, "-m", "hybridvo.cli", *arguments]
    options = {"capture_output": True, "timeout": 900} | options
    return subprocess.run(command, env=env, check=False, **options)


@dataclass
class Ended:
    """How a fork ended: exit code (negative: signal), frames it saw finished, seconds."""

    code: int
    seen: int
    stderr: str
    seconds: float


class Fork:
    """``hybridvo ...`` in a fork of this process; counts the frames that it says it finished.

    Args:
        arguments: of ``hybridvo``.
        before: called in the fork first, to take something away from it.
        slow: seconds that every frame is made to take longer.
    """

    def __init__(
        self, arguments: list[str], before: Callable[[], None] | None = None, slow: float = 0.0
    ) -> None:
        self._seen, seen = os.pipe()
        self._stderr, stderr = os.pipe()
        self.started = time.monotonic()
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if self.pid == 0:
            _be_a_run(arguments, before, slow, seen, stderr)
        os.close(seen)
        os.close(stderr)
        os.set_blocking(self._seen, False)
        self.seen = 0

    def count(self) -> int:
        """Frames that the fork has finished so far."""
        with contextlib.suppress(BlockingIOError):
            self.seen += len(os.read(self._seen, 1_000_000))
        return self.seen

    def wait_for(self, frames: int, timeout: float = 60.0) -> None:
        """Return when so many frames are finished, or the fork has ended."""
        until = time.monotonic() + timeout
        while self.count() < frames and time.monotonic() < until:
            if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                return
            time.sleep(0.001)

    def leave(self, seconds: float) -> None:
        """Let it run so long, or to its end."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                return
            time.sleep(0.002)

    def signal(self, number: int) -> None:
        """Send a signal, if the fork still runs."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def end(self) -> Ended:
        """Wait for the end."""
        text = b""
        while chunk := os.read(self._stderr, 65536):
            text += chunk
        _, status = os.waitpid(self.pid, 0)
        seconds = time.monotonic() - self.started
        self.count()
        os.close(self._seen)
        os.close(self._stderr)
        return Ended(os.waitstatus_to_exitcode(status), self.seen, text.decode(), seconds)


def _be_a_run(
    arguments: list[str], before: Callable[[], None] | None, slow: float, seen: int, stderr: int
) -> None:
    """What the fork does, from its first instruction to its last."""
    code = 99
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also under nohup
        null = os.open(os.devnull, os.O_RDWR)
        os.dup2(null, 1)
        os.dup2(stderr, 2)
        from hybridvo.cli import main
        from hybridvo.run_folder import RunFolder

        append = RunFolder.append

        def say(self: RunFolder, row: Any) -> None:
            append(self, row)
            os.write(seen, b".")  # the frame is finished: from here on it must not be lost
            if slow:
                time.sleep(slow)

        RunFolder.append = say  # type: ignore[method-assign]
        if before is not None:
            before()
        code = main(arguments)
        sys.stdout.flush()
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)
