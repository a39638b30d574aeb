"""Campaigns of ``stress.py`` on what a run is given and denied, and on who runs it."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from stress_campaigns import Figures, Lab
from stress_parts import ONE_THREAD, ROOT, Fork, command, content, hybridvo, write_walk

CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, PR_CAPBSET_DROP = 1, 2, 24

CLOSE = "import os, sys; os.close(int(sys.argv[1])); os.execv(sys.argv[2], sys.argv[2:])"
"""A program that closes one of its streams and becomes another program."""


def obey_permissions() -> None:
    """Called in a fork: root may write anywhere, unless it gives that right up."""
    if os.geteuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            if libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0):
                raise OSError(ctypes.get_errno(), "prctl")
        header = (ctypes.c_uint32 * 2)(0x20080522, 0)
        data = (ctypes.c_uint32 * 6)()
        libc.capget(header, data)
        mask = ~((1 << CAP_DAC_OVERRIDE) | (1 << CAP_DAC_READ_SEARCH)) & 0xFFFFFFFF
        data[0] &= mask
        data[1] &= mask
        if libc.capset(header, data):
            raise OSError(ctypes.get_errno(), "capset")


def denied(lab: Lab, count: int, seed: int = 0) -> Figures:
    """Output folders and homes that cannot be written, in forks that obey permissions."""
    figures: Figures = {}
    closed = lab.where / "closed"
    closed.mkdir()
    closed.chmod(0o555)
    end = Fork(lab.arguments(closed / "out"), before=obey_permissions).end()
    figures["read_only_output"] = {
        "exit_code": end.code,
        "frames_computed": end.seen,
        "one_line": end.stderr.count("\n") == 1 and end.stderr.startswith("hybridvo: "),
    }
    before = snapshot(lab.where)

    def homeless() -> None:
        obey_permissions()
        os.environ.update(HOME=str(closed), XDG_CONFIG_HOME=str(closed), XDG_CACHE_HOME=str(closed))

    out = lab.where / "homeless"
    end = Fork(lab.arguments(out), before=homeless).end()
    new = {path for path in snapshot(lab.where) - before if out not in (path, *path.parents)}
    figures["read_only_home"] = {
        "exit_code": end.code,
        "identical": content(out) == lab.expected,
        "files_elsewhere": sorted(map(str, new)),
    }
    end = Fork(lab.arguments(out, "--resume"), before=lambda: _without_home()).end()
    figures["no_home_at_all"] = {"exit_code": end.code, "identical": content(out) == lab.expected}
    return figures


def _without_home() -> None:
    """A user id without an entry in the list of users, as containers have it."""
    import pwd

    def unknown(*_: Any) -> None:
        raise KeyError("getpwuid(): uid not found")

    os.environ.pop("HOME", None)
    pwd.getpwuid = unknown  # type: ignore[assignment]


def snapshot(root: Path) -> set[Path]:
    """Every path below a folder."""
    return set(root.rglob("*"))


def streams(lab: Lab, count: int, seed: int = 0) -> Figures:
    """Readers that go away, full and closed streams."""
    figures: Figures = {}
    run = [sys.executable, "-m", "hybridvo.cli"]
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": str(ROOT)}

    def start(name: str, arguments: Iterable[str], **options: Any) -> subprocess.CompletedProcess:
        done = subprocess.run([*arguments], env=environment, timeout=900, check=False, **options)
        figures[name] = {
            "exit_code": done.returncode,
            "stderr": (done.stderr or b"").decode()[-300:],
        }
        out = lab.where / name
        if out.exists():
            figures[name]["identical"] = content(out) == lab.expected
        return done

    PIPE = subprocess.PIPE
    read, write = os.pipe()
    os.close(read)  # whoever was to read has gone before the first byte
    arguments = [*run, *lab.arguments(lab.where / "reader_gone", "--json")]
    start("reader_gone", arguments, stdout=write, stderr=PIPE)
    os.close(write)
    with open("/dev/full", "wb") as full:
        arguments = [*run, *lab.arguments(lab.where / "stdout_full", "--json")]
        start("stdout_full", arguments, stdout=full, stderr=PIPE)
        arguments = [*run, *lab.arguments(lab.where / "stderr_full")[:-1]]  # not quiet
        start("stderr_full", arguments, stdout=PIPE, stderr=full)
    for number in (1, 2):
        name = f"stream_{number}_closed"
        arguments = [*run, *lab.arguments(lab.where / name)[: -1 if number == 2 else None]]
        arguments = [sys.executable, "-c", CLOSE, str(number), *arguments]
        start(name, arguments, stdout=PIPE, stderr=PIPE)
    return figures


THREADS = {
    "again": {},
    "two_threads": {name: "2" for name in ONE_THREAD},
    "opencv_one_thread": {"OPENCV_FOR_THREADS_NUM": "1"},
}


def determinism(lab: Lab, count: int, seed: int = 0, cold: bool = True) -> Figures:
    """The same run in fresh processes: again, with two threads, with a cold cache of numba."""
    figures: Figures = {}
    small = write_walk(lab.where / "small", 12, height=64, width=96, pictures=True)
    # above 100 000 pixels the kernels use two threads of their own
    large = write_walk(lab.where / "large", 4, height=320, width=400, pictures=True)
    for name, walk, options in (
        ("refine_small", small, ("--method", "refine", "--flow", "file")),
        ("hybrid_small", small, ("--method", "hybrid", "--flow", "dis")),
        ("hybrid_large", large, ("--method", "hybrid", "--flow", "dis")),
    ):
        base = _steps(walk, lab.where / f"{name}_base", options, {})
        figures[name] = {
            variant: difference(base, _steps(walk, lab.where / f"{name}_{variant}", options, env))
            for variant, env in THREADS.items()
        }
    if cold:
        options = ("--method", "refine", "--flow", "file")
        base = _steps(small, lab.where / "warm_cache", options, {})
        env = {"NUMBA_CACHE_DIR": str(lab.where / "numba")}
        first = _steps(small, lab.where / "cold", options, env)
        second = _steps(small, lab.where / "cold_again", options, env)
        figures["cache"] = {
            "cold_against_warm": difference(base, first),
            "second_against_first": difference(first, second),
        }
    return figures


def _steps(walk: Path, out: Path, options: tuple[str, ...], env: dict[str, str]) -> Path:
    done = hybridvo(command(walk, out, *options, "-q"), ONE_THREAD | env)
    if done.returncode != 0:
        raise RuntimeError(f"{out.name}: {done.stderr.decode()}")
    return out


def difference(a: Path, b: Path) -> dict[str, Any]:
    """Whether two runs left the same bytes; if not, by how much they differ."""
    one, two = content(a), content(b)
    with np.load(a / "steps.npz") as x, np.load(b / "steps.npz") as y:
        shift = x["T_curr_prev"][:, :3, 3] - y["T_curr_prev"][:, :3, 3]
        turn = x["T_curr_prev"][:, :3, :3] - y["T_curr_prev"][:, :3, :3]
        sigma = np.sqrt(np.diagonal(x["covariance"], axis1=1, axis2=2))[:, :3]
    return {
        "identical": one == two,
        "translation_m": float(np.abs(shift).max()),
        "rotation": float(np.abs(turn).max()),
        "sigmas": float((np.abs(shift) / sigma)[1:].max()),
    }
