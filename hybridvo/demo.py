"""``hybridvo demo``: a rendered scene in which objects move, and the methods on it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hybridvo.checks import make_folder
from hybridvo.configuration import RunOptions
from hybridvo.errors import InputError, OutputError
from hybridvo.evaluation.plots import plot_trajectories
from hybridvo.evaluation.report import table_text, to_json, write_json
from hybridvo.run import EXIT_INTERRUPTED, RunResult, run
from hybridvo.synthetic.render import make_scene, write_sintel

__all__ = ["METHODS", "demo"]

METHODS = {
    "hybrid": "hybridvo (hybrid)",
    "refine": "hybridvo (refine)",
    "pnp-ransac": "OpenCV PnP-RANSAC",
    "pnp-ransac-tuned": "OpenCV PnP-RANSAC, tuned",
    "identity": "identity (no motion)",
}
"""Methods of the demo and what its table calls them."""
MARK = "hybridvo_demo.json"
"""File by which a folder is known as a demo's own, and may be replaced."""
SCENE = "light"
HEIGHT, WIDTH = 218, 512

_COLUMNS = {
    "method": ("method", ""),
    "ate_cm": ("ATE [cm]*", ".3f"),
    "rpe_cm": ("RPE [cm/pair]", ".3f"),
    "rotation_deg": ("rotation [deg/pair]", ".4f"),
    "epe_px": ("EPE [px]", ".3f"),
    "failed": ("failed", ""),
    "ms": ("ms/pair", ".1f"),
}


def demo(
    out: str | os.PathLike[str],
    *,
    frames: int = 20,
    seed: int = 0,
    overwrite: bool = False,
    command: Iterable[str] = (),
    quiet: bool = False,
    as_json: bool = False,
) -> tuple[str, int]:
    """Render, run and compare.

    The scene is written in Sintel's layout under ``out/data``; flow comes from OpenCV DIS, never
    from the true flow that is written beside it. Depth is the renderer's.

    Args:
        out: folder to write.
        frames: of the scene, at least 2.
        seed: of the scene.
        overwrite: replace an earlier demo.
        command: for ``run.json``.
        quiet: no progress.
        as_json: result as JSON instead of a table.

    Returns:
        What to print, and the exit code.

    Raises:
        InputError: too few frames, or a folder that holds something already.
        OutputError: a file that cannot be written.
    """
    if frames < 2:
        raise InputError(f"demo: expected at least 2 frames, got {frames}.")
    out = Path(out)
    _prepare(out, overwrite)
    scene = make_scene(SCENE, seed, height=HEIGHT, width=WIDTH, frames=frames)
    write_sintel(scene, out / "data", SCENE)
    sequence = out / "data" / "training" / "clean" / SCENE
    results: dict[str, RunResult] = {}
    for method in METHODS:
        options = RunOptions(method=method, flow="dis", max_failed=1.0)
        results[method] = run(
            sequence,
            out / method,
            options,
            dataset="sintel",
            mode="overwrite" if overwrite else "new",
            command=command,
            quiet=quiet,
        )
        if results[method].exit_code == EXIT_INTERRUPTED:
            return "interrupted", EXIT_INTERRUPTED
    rows = [_row(method, result.summary) for method, result in results.items()]
    moving = _moving_share(scene)
    picture = out / "trajectory.png"
    plot_trajectories(
        {METHODS[method]: result.trajectory for method, result in results.items()},
        picture,
        truth=results["hybrid"].truth,
        title=f"Rendered scene, {100 * moving:.0f} % of the pixels moving; flow: OpenCV DIS",
    )
    content: dict[str, Any] = {
        "command": list(command),
        "scene": {"kind": SCENE, "seed": seed, "frames": frames, "height": HEIGHT, "width": WIDTH},
        "moving_fraction": moving,
        "flow_source": "dis",
        "depth_source": "true",
        "rows": rows,
        "picture": picture,
    }
    write_json(out / MARK, content)
    if as_json:
        return to_json(content), 0
    table = table_text(
        rows,
        list(_COLUMNS),
        headers={name: header for name, (header, _) in _COLUMNS.items()},
        formats={name: spec for name, (_, spec) in _COLUMNS.items() if spec},
    )
    note = (
        f"{frames} rendered frames of {WIDTH}x{HEIGHT}, {100 * moving:.0f} % of the pixels moving; "
        f"flow: OpenCV DIS on the images; depth: the renderer's (true)."
    )
    star = (
        "* paths put on each other by their first pose: a path that stands still has no other fit."
    )
    return f"{note}\n\n{table}{star}\n\n{picture}\n", 0


def _prepare(out: Path, overwrite: bool) -> None:
    """An empty folder, or one that an earlier demo left and that may be replaced."""
    try:
        if out.exists() and any(out.iterdir()):
            if not (out / MARK).is_file():
                raise InputError(
                    f"{out}: is not empty and holds no finished demo. Choose another --out, or "
                    f"remove the folder."
                )
            if not overwrite:
                raise InputError(f"{out}: holds a demo already. Pass --overwrite to replace it.")
            shutil.rmtree(out / "data", ignore_errors=True)
        make_folder(out)
        (out / MARK).write_text("{}\n", encoding="utf-8")
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{out}: cannot be written: {error.strerror or error}.") from error


def _row(method: str, summary: dict[str, Any]) -> dict[str, Any]:
    """Line of the table; what is unknown stays None."""
    metrics = summary["metrics"]

    def scaled(name: str, factor: float) -> float | None:
        return None if metrics[name] is None else factor * metrics[name]

    return {
        "method": METHODS[method],
        "ate_cm": scaled("ate_rmse_origin", 100.0),
        "rpe_cm": scaled("rpe_trans_rmse", 100.0),
        "rotation_deg": scaled("rot_err_deg_mean", 1.0),
        "epe_px": scaled("epe_l2_px", 1.0),
        "failed": summary["failed"],
        "ms": summary["ms_per_pair_median"],
    }


def _moving_share(scene: Any) -> float:
    """Median over frames of the share of pixels on moving objects."""
    shares = sorted(float((scene.object_id(i) > 0).mean()) for i in range(scene.frames))
    return shares[len(shares) // 2]
