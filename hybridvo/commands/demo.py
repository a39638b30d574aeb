"""``hybridvo demo``: a rendered scene in which objects move, and the methods on it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.commands.run import run
from hybridvo.data.sequence import open_sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.pair_errors import true_trajectory
from hybridvo.evaluation.plots import plot_trajectories
from hybridvo.files import Mode, make_folder, write_json
from hybridvo.options import FlowOptions, Options, RunOptions
from hybridvo.synthetic.render import write_sintel
from hybridvo.synthetic.scenes import make_scene
from hybridvo.trajectory import read_trajectory

METHODS = {
    "hybrid": "hybridvo (hybrid)",
    "refine": "hybridvo (refine)",
    "pnp-ransac": "OpenCV PnP-RANSAC",
    "pnp-ransac-tuned": "OpenCV PnP-RANSAC, tuned",
    "identity": "identity (no motion)",
}
"""Methods of the demo and what its table calls them."""
DRAWN = ("pnp-ransac-tuned", "hybrid")
MARK = "hybridvo_demo.json"
"""File by which a folder is known as a demo's own, and may be replaced."""
SCENE, HEIGHT, WIDTH = "light", 218, 512


def demo(
    out: str | os.PathLike[str],
    *,
    frames: int = 20,
    seed: int = 0,
    overwrite: bool = False,
    command: Iterable[str] = (),
    quiet: bool = False,
) -> dict[str, Any]:
    """Render, run and compare; JSON-ready.

    The scene is written in Sintel's layout under ``out/data``; flow comes from OpenCV DIS, never
    from the true flow that is written beside it. Depth is the renderer's.
    """
    if frames < 2:
        raise InputError(f"demo: expected at least 2 frames, got {frames}.")
    out = Path(out)
    make_folder(out)
    if any(out.iterdir()) and not (overwrite and (out / MARK).is_file()):
        raise InputError(f"{out}: is not empty. Pass --overwrite to replace a demo, or --out.")
    shutil.rmtree(out / "data", ignore_errors=True)
    write_json(out / MARK, {})
    scene = make_scene(SCENE, seed, height=HEIGHT, width=WIDTH, frames=frames)
    write_sintel(scene, out / "data", SCENE)
    sequence = open_sequence(out / "data" / "training" / "clean" / SCENE, "sintel")
    rows, paths = [], {}
    for method, name in METHODS.items():
        wanted = RunOptions(method=method, max_failed=1.0)
        options = Options(flow=FlowOptions(source="dis"), run=wanted)
        mode: Mode = "overwrite" if overwrite else "new"
        given: dict[str, Any] = {"mode": mode, "command": command, "quiet": quiet}
        summary, _ = run(sequence, out / method, options, **given)
        metrics = summary["metrics"]
        rows.append(
            {
                "method": name,
                "ate_cm": 100.0 * metrics["ate_rmse_origin"],
                "rpe_cm": 100.0 * metrics["rpe_trans_mean"],
                "rotation_deg": metrics["rot_err_deg_mean"],
                "epe_px": metrics["epe_l2_px"],
                "failed": summary["failed"],
                "frame_ms": summary["frame_ms_median"],
            }
        )
        paths[method] = read_trajectory(out / method / "trajectory.tum")
    moving = float(np.median([(scene.object_id(i) > 0).mean() for i in range(scene.frames)]))
    content: dict[str, Any] = {
        "command": list(command),
        "scene": {"kind": SCENE, "seed": seed, "frames": frames, "height": HEIGHT, "width": WIDTH},
        "moving_fraction": moving,
        "flow_source": "dis",
        "depth_source": "true",
        "alignment": "origin",
        "rows": rows,
        "image": os.fspath(out / "trajectory.png"),
    }
    drawn = {METHODS[method]: paths[method] for method in DRAWN}
    title = f"{100 * moving:.0f} % of the pixels move by themselves"
    truth = true_trajectory(sequence, range(frames))
    plot_trajectories(drawn, content["image"], truth=truth, alignment="origin", title=title)
    write_json(out / MARK, content)
    return content
