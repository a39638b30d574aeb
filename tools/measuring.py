"""What the measuring tools share: errors of an answer,
statistics, origin of figures.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from hybridvo import Odometry, Options, pipeline
from hybridvo.core import geometry
from hybridvo.core.errors import FormatError
from hybridvo.core.files import Journal, make_folder
from hybridvo.core.geometry import se3_log
from hybridvo.core.options import TrackOptions
from hybridvo_lab.calibration import WRONG_PX
from hybridvo_lab.cluster import Workers

ROOT = Path(__file__).resolve().parents[1]
"""The repository."""
OUTSIDE = 20.062
"""Quantile 0.9973 of chi-square with six degrees of freedom:
the ellipsoid of 3 sigma."""


def parser_of(file: str, doc: str | None) -> argparse.ArgumentParser:
    """Make a parser that the first paragraph of a docstring describes."""
    paragraph = (doc or "").split("\n\n")[0]
    description = " ".join(paragraph.split())
    path = Path(file)
    name = path.name
    if path.parent.name == "bench":
        name = f"benchmark.py {path.stem}"
    return argparse.ArgumentParser(prog=name, description=description)


def ready_tracker(
    track: TrackOptions, method: str = pipeline.DEFAULT_METHOD
) -> Odometry:
    """Return a tracker that has compiled and loaded everything."""
    odometry = Odometry(method=method, options=Options(track=track))
    odometry.warm_up()
    return odometry


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add where independent items are measured or made."""
    add = parser.add_argument
    add(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="processes on this machine (default 1)",
    )
    add(
        "--cluster",
        metavar="SCHEDULER",
        help="tcp://HOST:PORT or JSON file of a scheduler of dask.distributed, extra 'cluster'",
    )


def workers_of(args: argparse.Namespace) -> Workers:
    """Return where the items are measured or made."""
    return Workers(args.jobs, args.cluster)


def measured(
    args: argparse.Namespace,
    part: str,
    work: Callable[[Any], Any],
    items: Mapping[str, Any],
) -> dict[str, Any]:
    """Measure items by workers, and show the progress.

    The results so far are kept beside ``--out``: a run that was stopped goes on. They are
    of the same arguments and commit, else they are measured again.

    Args:
        args: of the tool.
        part: of what is measured, for the name of the file.
        work: a function of a module, or a partial of one; its result is JSON-ready.
        items: its arguments by a name.

    Returns:
        The results by name, in the order of the items.
    """
    from rich.console import Console
    from rich.progress import track

    out = args.out or ROOT / "runs" / "measured.json"
    make_folder(out.parent)
    free = ("jobs", "cluster", "overwrite", "out", "parts")
    decisive = {
        name: str(value) for name, value in vars(args).items() if name not in free
    }
    seed = json.dumps([revision(), decisive, sorted(items)])
    unfinished = out.with_suffix(f".{part}.unfinished.jsonl")
    try:
        kept = Journal(unfinished, seed)
    except FormatError:
        print(f"{unfinished}: of another run, begun anew.", file=sys.stderr)
        unfinished.unlink()
        kept = Journal(unfinished, seed)
    found = dict(kept.values)
    left = [name for name in items if name not in found]
    coming = workers_of(args).each(work, [items[name] for name in left])
    console = Console(stderr=True)
    with contextlib.closing(kept):
        for done in track(coming, part, len(left), console=console):
            name = left[done.number]
            if done.lost:
                raise RuntimeError(f"{name}: {done.lost}")
            kept.add([name, done.result])
            found[name] = done.result
    unfinished.unlink()
    return {name: found[name] for name in items}


# --- errors of an answer ----------------------------------------------------------


def score(
    motion: Any, T_true: np.ndarray, depth: np.ndarray, pair: Any
) -> dict[str, Any]:
    """Score one answer about a pair.

    A failed answer counts as the identity that it carries.

    Args:
        motion: the :class:`~hybridvo.core.results.RelativePose`.
        T_true: (4, 4) the true motion.
        depth: (H, W) metres, the best known depth of the previous frame.
        pair: the pair.

    Returns:
        ``error`` px, ``rotation_deg``, ``translation_cm``, ``status``, ``failed``
        (no answer, or wrong by more than a pixel), ``unflagged`` (wrong, but
        ``ok``), ``overconfident`` (``ok``, but beyond 3 sigma) and ``nees`` (None
        where the answer failed).
    """
    state = motion.status.state.value
    reason = motion.status.reason.value
    error = ego_flow_error(motion.T_curr_prev, T_true, depth, pair)
    delta = motion_error(motion.T_curr_prev, T_true)
    nees = None
    if state != "failed":
        information = np.linalg.pinv(motion.covariance, hermitian=True)
        nees = float(delta @ information @ delta)
    distance = np.linalg.norm(motion.T_curr_prev[:3, 3] - T_true[:3, 3])
    is_wrong = error > WRONG_PX
    is_ok = state == "ok"
    return {
        "error": error,
        "rotation_deg": float(np.rad2deg(np.linalg.norm(delta[3:]))),
        "translation_cm": 100 * float(distance),
        "status": f"{state}({reason})" if reason else state,
        "failed": state == "failed" or is_wrong,
        "unflagged": is_ok and is_wrong,
        "overconfident": is_ok and nees is not None and nees > OUTSIDE,
        "nees": nees,
    }


def ego_flow_error(
    T: np.ndarray, T_true: np.ndarray, depth: np.ndarray, pair: Any
) -> float:
    """Mean distance, px, of the ego flows of two motions (4, 4)
    over a depth map (H, W); 0 where none of it is known.
    """
    cameras = (pair.prev.camera, pair.curr.camera)
    return float(np.nan_to_num(geometry.ego_flow_error(T, T_true, depth, *cameras)))


def motion_error(T: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """(6,) left perturbation between two motions, translation first, m and rad."""
    return se3_log(T @ np.linalg.inv(T_true))


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures over the scores of one method: medians, failures with
    their interval, NEES, ms.
    """
    count = len(records)
    errors = [record["error"] for record in records]
    nees = [record["nees"] for record in records if record["nees"] is not None]
    q25, median, q75, worst = map(digits, np.percentile(errors, [25, 50, 75, 100]))
    row: dict[str, Any] = {"pairs": count}
    row["epe_px"] = {"q25": q25, "median": median, "q75": q75, "worst": worst}
    for key in ("rotation_deg", "translation_cm", "ms"):
        row[key] = digits(np.median([record[key] for record in records]))
    row["failures"] = proportion(sum(r["failed"] for r in records), count)
    for key in ("unflagged", "overconfident"):
        row[key] = sum(record[key] for record in records)
    row["nees_median"] = digits(np.median(nees)) if nees else None
    return row


def proportion(count: int, trials: int) -> dict[str, Any]:
    """A fraction with its 95 % interval, score method (Wilson, JASA 22, 1927)."""
    low = 0.0
    high = 1.0
    if trials:
        low, high = binomtest(count, trials).proportion_ci(method="wilson")
    return {"count": count, "of": trials, "low": digits(low), "high": digits(high)}


def digits(value: Any) -> float:
    """The value with four significant digits."""
    return float(f"{float(value):.4g}")


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """The result of a call, and its wall time in ms."""
    begin = time.perf_counter()
    result = work()
    return result, 1e3 * (time.perf_counter() - begin)


class Methods(NamedTuple):
    """Methods by whether they can run here."""

    ready: list[str]
    missing: dict[str, str]  # reason and remedy by method


def methods_here(wanted: Iterable[str]) -> Methods:
    """Sort methods by whether they can run here."""
    from hybridvo.run.commands.ready_methods import methods_to_run
    from hybridvo_lab.methods import in_order

    ready, missing = methods_to_run(("all",), every=in_order())
    names = list(wanted)
    return Methods(
        [name for name in names if name in ready],
        {name: missing[name] for name in names if name in missing},
    )


# --- files of figures -------------------------------------------------------------


def store(out: Path | None, result: Any) -> None:
    """Write the figures of a tool as JSON, if a file was named for them."""
    from hybridvo.core.files import make_folder, write_json

    if out is None:
        return
    make_folder(out.parent)
    write_json(out, result)


def write_result(
    tool: str, out: Path, overwrite: bool, measure: Callable[[], Any]
) -> int:
    """Measure and write the figures as JSON.

    Args:
        tool: the tool's name, for messages.
        out: the file to write.
        overwrite: whether the file may exist.
        measure: returns the figures.

    Returns:
        The exit code of the tool: 0 done, 2 bad input, 5
        the file cannot be written.
    """
    from hybridvo.core.errors import HybridVOError, InputError, OutputError
    from hybridvo.core.files import make_folder, write_json

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


def provenance(tool: str, argv: list[str] | None) -> dict[str, Any]:
    """Command, commit, machine and versions, with which
    every file of figures begins.
    """
    from hybridvo.core.files import versions

    given = sys.argv[1:] if argv is None else argv
    words = [str(without_folders(word)) for word in given]
    load = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    return {
        "command": shlex.join(["python", *f"tools/{tool}".split(), *words]),
        "commit": revision(),
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "load": load,
            "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
        },
        "versions": versions(),
    }


def without_folders(value: Any) -> Any:
    """Replace every absolute path in a value by its last part: folders
    of a machine state nothing.
    """
    if isinstance(value, dict):
        return {key: without_folders(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_folders(item) for item in value]
    if isinstance(value, str) and Path(value).is_absolute():
        return Path(value).name
    return value


def revision() -> str:
    """Commit of the package that is measured, with a plus
    where files differ from it.
    """
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
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.machine()
    for line in text.splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()
