"""What the measuring tools share: errors of an answer, statistics, where figures come from."""

from __future__ import annotations

import argparse
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

ROOT = Path(__file__).resolve().parents[1]
FAILURE_PX = 1.0
"""An answer whose ego flow is wrong by more is a failure."""
OUTSIDE = 20.062
"""Quantile 0.9973 of chi-square with six degrees of freedom: the ellipsoid of 3 sigma."""


def parser_of(file: str, doc: str | None) -> argparse.ArgumentParser:
    """Parser of a tool, described by the first line of its docstring."""
    return argparse.ArgumentParser(
        prog=Path(file).name, description=(doc or "").splitlines()[0]
    )


def score(
    motion: Any, T_true: np.ndarray, depth: np.ndarray, pair: Any
) -> dict[str, Any]:
    """Errors of one answer about a pair, its status, and its error in standard deviations.

    A failed answer is the identity that it carries; ``depth``: (H, W) the best that is known.
    """
    state = motion.status.state.value
    reason = motion.status.reason.value
    error = ego_flow_error(motion.T_curr_prev, T_true, depth, pair)
    delta = motion_error(motion.T_curr_prev, T_true)
    nees = None
    if state != "failed":
        nees = float(
            delta @ np.linalg.pinv(motion.covariance, hermitian=True) @ delta
        )
    return {
        "error": error,
        "rotation_deg": float(np.rad2deg(np.linalg.norm(delta[3:]))),
        "translation_cm": 100
        * float(np.linalg.norm(motion.T_curr_prev[:3, 3] - T_true[:3, 3])),
        "status": f"{state}({reason})" if reason else state,
        "failed": state == "failed" or error > FAILURE_PX,
        "unflagged": state == "ok" and error > FAILURE_PX,
        "overconfident": state == "ok" and nees is not None and nees > OUTSIDE,
        "nees": nees,
    }


def ego_flow_error(
    T: np.ndarray, T_true: np.ndarray, depth: np.ndarray, pair: Any
) -> float:
    """Mean distance in px of where two motions bring the points seen, every second pixel."""
    camera, height, width = pair.prev.camera, *pair.prev.camera.shape
    z = depth[::2, ::2].astype(np.float64)
    x = (np.arange(0, width, 2) - camera.cx) / camera.fx * z
    y = (np.arange(0, height, 2)[:, None] - camera.cy) / camera.fy * z
    points = np.stack([x, y, z, np.ones_like(z)])[:, np.isfinite(z) & (z > 0)]

    def seen(M: np.ndarray) -> np.ndarray:
        X, Y, Z = M[:3] @ points
        Z = np.where(Z > 1e-6, Z, np.nan)
        return np.stack([pair.curr.camera.fx * X / Z, pair.curr.camera.fy * Y / Z])

    true = seen(T_true)
    error = np.hypot(*(seen(T) - true))[np.isfinite(true[0])]
    # a point that a wrong motion puts behind the camera counts as one width of the image
    return (
        float(np.minimum(np.nan_to_num(error, nan=width), width).mean())
        if len(error)
        else 0.0
    )


def motion_error(T: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """(6,) left perturbation between two motions, translation first, m and rad."""
    from hybridvo.geometry import se3_log

    return se3_log(T @ np.linalg.inv(T_true))


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures over the answers of one method: medians, failures with their interval, NEES, ms."""
    nees = [record["nees"] for record in records if record["nees"] is not None]
    errors = [record["error"] for record in records]
    quartiles = map(digits, np.percentile(errors, [25, 50, 75, 100]))
    row: dict[str, Any] = {"pairs": len(records)}
    row["epe_px"] = dict(
        zip(("q25", "median", "q75", "worst"), quartiles, strict=True)
    )
    for key in ("rotation_deg", "translation_cm", "ms"):
        row[key] = digits(np.median([record[key] for record in records]))
    row["failures"] = proportion(
        sum(record["failed"] for record in records), len(records)
    )
    for key in ("unflagged", "overconfident"):
        row[key] = sum(record[key] for record in records)
    row["nees_median"] = digits(np.median(nees)) if nees else None
    return row


def proportion(count: int, trials: int) -> dict[str, Any]:
    """A share with its 95 % interval, score method (Wilson, JASA 22, 1927)."""
    low = 0.0
    high = 1.0
    if trials:
        low, high = binomtest(count, trials).proportion_ci(method="wilson")
    return {"count": count, "of": trials, "low": digits(low), "high": digits(high)}


def write_result(
    tool: str, out: Path, overwrite: bool, measure: Callable[[], Any]
) -> int:
    """Measure and write the figures as JSON; returns the exit code of the tool."""
    from hybridvo.errors import HybridVOError, InputError, OutputError
    from hybridvo.files import make_folder, write_json

    try:
        if out.exists() and not overwrite:
            raise InputError(f"{out} exists; pass --overwrite to replace it.")
        make_folder(out.parent)
        write_json(out, measure())
    except HybridVOError as error:
        print(f"{tool}: {error}", file=sys.stderr)
        return 5 if isinstance(error, OutputError) else 2
    print(out)
    return 0


def digits(value: Any) -> float:
    """Four significant digits."""
    return float(f"{float(value):.4g}")


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What a call returns, and its wall time in ms."""
    begin = time.perf_counter()
    result = work()
    return result, 1e3 * (time.perf_counter() - begin)


def able(methods: Iterable[str]) -> tuple[list[str], dict[str, str]]:
    """The methods that can run here, and the reason for each other one."""
    from hybridvo.commands.compare import methods_to_run

    ready, missing = methods_to_run(("all",))
    wanted = list(methods)
    return [m for m in wanted if m in ready], {
        m: missing[m] for m in wanted if m in missing
    }


def provenance(tool: str, argv: list[str] | None) -> dict[str, Any]:
    """Command, commit, machine and versions: what every file of figures begins with."""
    from hybridvo.files import versions

    words = [
        str(without_folders(w)) for w in (sys.argv[1:] if argv is None else argv)
    ]
    return {
        "command": shlex.join(["python", f"tools/{tool}", *words]),
        "commit": revision(),
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "load": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
            "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
        },
        "versions": versions(),
    }


def without_folders(value: Any) -> Any:
    """The value with the last part of every absolute path in it: where a run stood says nothing."""
    if isinstance(value, dict):
        return {key: without_folders(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_folders(item) for item in value]
    return (
        Path(value).name
        if isinstance(value, str) and Path(value).is_absolute()
        else value
    )


def revision() -> str:
    """Commit of the package that is measured, with a plus where files differ from it."""
    import hybridvo

    git = ["git", "-C", str(Path(hybridvo.__file__).parent)]
    commit = subprocess.run(
        [*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    )
    changed = subprocess.run(
        [*git, "diff", "--quiet", "HEAD", "--", "."], capture_output=True
    )
    return commit.stdout.strip() + ("+" if changed.returncode else "")


def processor() -> str:
    """Model of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(
            line.split(":", 1)[1].strip()
            for line in lines
            if line[:10] == "model name"
        )
    except (OSError, StopIteration):
        return platform.machine()
