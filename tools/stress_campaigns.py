"""The campaigns of ``stress.py``: each takes a folder to work in and a count, and returns figures.

A campaign never decides what is acceptable: it counts. The tests, and whoever reads the figures,
say which of them must be zero.
"""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from stress_parts import (
    FILES,
    ONE_THREAD,
    REFINE,
    Fork,
    command,
    content,
    hybridvo,
    rows_kept,
    state,
    write_rendered_walk,
    write_walk,
)

FRAMES = 36
DELETED = 6
"""Frames that vanish from a walk."""

Figures = dict[str, Any]


class Lab:
    """A folder to work in, a walk, and the results of a run on it that nothing disturbed.

    The undisturbed run has a fresh process; this one runs once as well, so that forks find
    everything imported and every kernel loaded.
    """

    def __init__(self, where: Path) -> None:
        self.where = where
        self.walk = write_walk(where / "walk", FRAMES)
        self.whole = where / "whole"
        done = hybridvo(command(self.walk, self.whole, *REFINE), ONE_THREAD)
        if done.returncode != 0:
            raise RuntimeError(done.stderr.decode())
        self.expected = content(self.whole)
        from hybridvo.cli import main

        with open(os.devnull, "w") as null, contextlib.redirect_stdout(null):
            main(command(self.walk, where / "warm", *REFINE))
        self.seconds = Fork(command(self.walk, where / "timed", *REFINE)).end().seconds

    def arguments(self, out: Path, *options: str) -> list[str]:
        """Of ``hybridvo`` for a run on the walk."""
        return command(self.walk, out, *REFINE, *options)


def kills(lab: Lab, count: int, seed: int = 0) -> Figures:
    """``kill -9`` at random moments, from the first instruction to the last, and ``--resume``.

    A run is killed again and again until a resumed one happens to reach its end; a kill that comes
    too late is not counted.
    """
    rng = np.random.default_rng(seed)
    figures = dict.fromkeys(("kills", "runs", "identical", "frames_lost", "refused", "failed"), 0)
    complaints: list[str] = []
    places = dict.fromkeys(("before_first_frame", "between_frames", "after_last_frame"), 0)
    while figures["kills"] < count:
        out = lab.where / "kills"
        finished = 0
        for attempt in range(50):
            fork = Fork(lab.arguments(out, *(["--resume"] if attempt else [])))
            if attempt < 5 and figures["kills"] < count:
                fork.leave(rng.uniform(0, 1.05 * lab.seconds))
                fork.signal(signal.SIGKILL)
            end = fork.end()
            finished += end.seen
            if end.code == -signal.SIGKILL:
                figures["kills"] += 1
                kept = rows_kept(out)
                # one more on the disk than it came to say is no loss
                figures["frames_lost"] += max(0, finished - kept)
                finished = kept
                place = "between_frames" if 0 < kept < FRAMES else "before_first_frame"
                places["after_last_frame" if kept >= FRAMES else place] += 1
                continue
            if attempt == 0:  # how long a run takes changes with what else the machine does
                lab.seconds = end.seconds
            figures["refused"] += end.code == 2
            figures["failed"] += end.code != 0
            if end.code:
                complaints.append(end.stderr[-500:])
            break
        figures["runs"] += 1
        figures["identical"] += content(out) == lab.expected
        shutil.rmtree(out)
    return figures | places | {"frames": FRAMES, "complaints": complaints[:5]}


def signals(lab: Lab, count: int, seed: int = 0) -> Figures:
    """SIGTERM, SIGINT, SIGHUP at random frames: exit 130, finished frames kept, resume identical.

    Every fourth time a second signal follows at once.
    """
    rng = np.random.default_rng(seed)
    names = ("signals", "exit_130", "aborted_by_second", "frames_lost", "locks_left", "identical")
    figures: Figures = dict.fromkeys((*names, "tracebacks"), 0) | {"slowest_stop_s": 0.0}
    for i in range(count):
        out = lab.where / "signals"
        fork = Fork(lab.arguments(out), slow=0.003)
        fork.wait_for(int(rng.integers(1, FRAMES - 10)))
        asked = time.monotonic()
        fork.signal((signal.SIGTERM, signal.SIGINT, signal.SIGHUP)[i % 3])
        if i % 4 == 0:
            fork.signal(signal.SIGINT)
        end = fork.end()
        figures["signals"] += 1
        figures["slowest_stop_s"] = max(figures["slowest_stop_s"], time.monotonic() - asked)
        figures["exit_130"] += end.code == 130
        figures["tracebacks"] += "Traceback" in end.stderr
        figures["frames_lost"] += max(0, end.seen - rows_kept(out))
        figures["locks_left"] += (out / "run.lock").exists()
        figures["aborted_by_second"] += state(out)["state"] == "running"
        again = Fork(lab.arguments(out, "--resume")).end()
        figures["identical"] += again.code == 0 and content(out) == lab.expected
        shutil.rmtree(out)
    return figures


def full_disk(lab: Lab, count: int, seed: int = 0) -> Figures:
    """Files may not grow beyond a random size (``RLIMIT_FSIZE``), so that each of them fails once.

    Exit code 5, no file half written, the frames kept, and the same results once there is room.
    """
    rng = np.random.default_rng(seed)
    names = ("runs", "exit_5", "exit_0", "half_written", "frames_lost", "tracebacks", "identical")
    figures: Figures = dict.fromkeys(names, 0)
    largest = max((lab.whole / name).stat().st_size for name in FILES)
    for i in range(count):
        limit = int(np.exp(rng.uniform(np.log(200), np.log(1.2 * largest))))
        _until_full(
            lab,
            lab.where / f"full{i}",
            lambda limit=limit: resource.setrlimit(
                resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY)
            ),
            figures,
        )
    return figures


def small_disk(lab: Lab, count: int, seed: int = 0) -> Figures:
    """The same on a real file system that is too small; needs the right to mount one."""
    rng = np.random.default_rng(seed)
    names = ("runs", "exit_5", "exit_0", "half_written", "frames_lost", "tracebacks", "identical")
    figures: Figures = dict.fromkeys(names, 0)
    disk = lab.where / "disk"
    disk.mkdir()
    for _ in range(count):
        size = int(rng.integers(2, 120)) * 4096
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(disk)], capture_output=True
        )
        if mounted.returncode:
            return {"skipped": f"mount: {mounted.stderr.decode().strip()}"}
        try:
            _until_full(lab, disk / "out", None, figures, room=disk)
        finally:
            subprocess.run(["umount", str(disk)], check=True)
    return figures


def _until_full(
    lab: Lab,
    out: Path,
    before: Any,
    figures: Figures,
    room: Path | None = None,
) -> None:
    end = Fork(lab.arguments(out), before=before).end()
    figures["runs"] += 1
    figures["exit_5"] += end.code == 5
    figures["exit_0"] += end.code == 0
    figures["tracebacks"] += "Traceback" in end.stderr
    for name in FILES:
        if (out / name).exists() and (out / name).read_bytes() != lab.expected[name]:
            figures["half_written"] += 1
    if out.exists():
        figures["frames_lost"] += max(0, end.seen - rows_kept(out))
    if room is not None:
        subprocess.run(["mount", "-o", "remount,size=64m", str(room)], check=True)
    # a run that could not even write its state is not known: it starts anew
    again = Fork(lab.arguments(out, "--resume")).end()
    figures["identical"] += again.code == 0 and content(out) == lab.expected


def two_runs(lab: Lab, count: int, seed: int = 0) -> Figures:
    """Runs that start at the same moment in one folder: one works, the others say why not."""
    figures: Figures = dict.fromkeys(("rounds", "one_winner", "identical", "tracebacks"), 0)
    for i in range(count):
        out = lab.where / f"two{i}"
        if i % 2:  # a dead run's lock is there, and all see it
            dead = Fork(lab.arguments(out), slow=0.01)
            dead.wait_for(3)
            dead.signal(signal.SIGKILL)
            dead.end()
        mode = ["--resume"] if i % 2 else []
        ready = time.monotonic() + 0.05

        def together(ready: float = ready) -> None:
            while time.monotonic() < ready:
                pass

        forks = [Fork(lab.arguments(out, *mode), before=together, slow=0.002) for _ in range(3)]
        ends = [fork.end() for fork in forks]
        codes = sorted(end.code for end in ends)
        figures["rounds"] += 1
        # 4: held; 2 or 0: came when the first was done (refused, or resumed to no effect)
        figures["one_winner"] += sum(end.seen > 0 for end in ends) == 1 and set(codes) <= {0, 2, 4}
        figures["tracebacks"] += any("Traceback" in end.stderr for end in ends)
        figures["identical"] += content(out) == lab.expected
    return figures


def deleted_input(lab: Lab, count: int, seed: int = 0) -> Figures:
    """Frames, flow files or everything deleted while the run goes on."""
    rng = np.random.default_rng(seed)
    names = ("runs", "rows_missing", "not_finite", "tracebacks", "lost_frames_said", "resumed")
    figures: Figures = dict.fromkeys(names, 0)
    for i in range(count):
        copy, out = lab.where / f"walk{i}", lab.where / f"deleted{i}"
        shutil.copytree(lab.walk, copy)
        fork = Fork(command(copy, out, *REFINE, "--max-failed", "1"), slow=0.005)
        fork.wait_for(5)
        if i % 3 == 2:
            shutil.rmtree(copy)
        else:
            kind = ("depth", "flow")[i % 3]
            for k in rng.choice(np.arange(FRAMES // 2, FRAMES - 1), DELETED, replace=False):
                (copy / kind / f"{k:06d}.npy").unlink()
        end = fork.end()
        figures["runs"] += 1
        figures["tracebacks"] += "Traceback" in end.stderr or end.code != 0
        with np.load(out / "steps.npz") as steps:
            figures["rows_missing"] += FRAMES - len(steps["T_curr_prev"])
            figures["not_finite"] += sum(not np.isfinite(steps[name]).all() for name in steps)
        figures["lost_frames_said"] += state(out)["summary"]["failed"] >= DELETED
        # what was run on is not there any more: going on would mix two inputs
        figures["resumed"] += Fork(command(copy, out, *REFINE, "--resume")).end().code == 0
        shutil.rmtree(copy, ignore_errors=True)
    return figures


def long_run(where: Path, frames: int, seed: int = 0, kind: str = "run") -> Figures:
    """Memory and open files of one run over many frames, sampled from outside.

    ``run``: the classical method on flow from files; ``recording``: the same with ``--rrd``;
    ``default``: all that ``hybridvo run`` does where nothing is said (judge, DIS, polish, window).
    """
    import psutil

    out = where / "out"
    if kind == "default":
        arguments = command(write_rendered_walk(where / "walk", frames), out, "-q")
    else:
        walk = write_walk(where / "walk", frames, pictures=kind == "recording")
        arguments = command(walk, out, *REFINE, *(["--rrd"] if kind == "recording" else []))
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": str(Path(__file__).parents[1])}
    child = subprocess.Popen(
        [sys.executable, "-m", "hybridvo.cli", *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    process = psutil.Process(child.pid)
    partial = out / "steps.partial.jsonl"
    samples: list[tuple[int, float, int]] = []
    last, size = 0, 0
    while child.poll() is None:
        time.sleep(0.1)
        with contextlib.suppress(OSError, psutil.Error):
            with partial.open("rb") as file:
                file.seek(size)
                text = file.read()
            size += len(text)
            last += text.count(b"\n")
            if text:
                samples.append((last, process.memory_info().rss / 1e6, process.num_fds()))
    assert child.stderr is not None
    stderr = child.stderr.read().decode()
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    table = np.array(samples)
    warm = table[table[:, 0] >= min(2000, frames // 4)]
    slope = np.polyfit(warm[:, 0], warm[:, 1], 1)[0] if len(warm) > 2 else float("nan")
    with np.load(out / "steps.npz") as steps:
        finite = all(np.isfinite(steps[name]).all() for name in steps)
        spectrum = np.linalg.eigvalsh(steps["covariance"])
        count = len(steps["T_curr_prev"])
    poses = np.loadtxt(out / "trajectory.tum")
    return {
        "frames": frames,
        "rows": count,
        "exit_code": child.returncode,
        "stderr": stderr[-500:],
        "samples": len(warm),
        "mb_after_warm_up": float(np.median(warm[: max(1, len(warm) // 20), 1])),
        "mb_at_the_end_of_the_frames": float(np.median(warm[-max(1, len(warm) // 20) :, 1])),
        "growth_mb_per_10000_frames": float(1e4 * slope),
        "peak_mb_while_results_are_written": usage.ru_maxrss / 1e3,
        "open_files": [int(warm[:, 2].min()), int(warm[:, 2].max())],
        "finite": bool(finite and np.isfinite(poses).all()),
        "covariance_positive": bool((spectrum > 0).all()),
        "ms_per_pair_median": state(out)["summary"]["ms_per_pair_median"],
        "failed": state(out)["summary"]["failed"],
    }
