"""``hybridvo demo``: a rendered scene in which objects move, and the methods compared on it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.commands.compare import WRITTEN, compare
from hybridvo.data.lists import shown
from hybridvo.errors import InputError
from hybridvo.files import LOCK
from hybridvo.options import FlowOptions, Options
from hybridvo.synthetic.render import write_sintel
from hybridvo.synthetic.scenes import make_scene

METHODS = {
    "hybrid": "hybridvo (hybrid)",
    "refine": "hybridvo (refine)",
    "pnp-ransac": "OpenCV PnP-RANSAC",
    "pnp-ransac-tuned": "OpenCV PnP-RANSAC, tuned",
    "identity": "identity (no motion)",
}
"""Methods of the demo and what its table calls them."""
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
    """Render a scene under ``out/data``, and compare on DIS flow and true depth; JSON-ready."""
    if frames < 2:
        raise InputError(f"demo: expected at least 2 frames, got {frames}.")
    out, name = Path(out), f"{SCENE}_{seed}_{frames}"
    present = {path.name for path in out.glob("*")}
    if present and not (overwrite and {"data"} <= present <= {"data", "runs", LOCK, *WRITTEN}):
        raise InputError(
            f"{out}: holds {shown(sorted(present))}; pass --overwrite to replace what a demo has "
            f"written, and nothing else, or another --out."
        )
    scene = make_scene(SCENE, seed, height=HEIGHT, width=WIDTH, frames=frames)
    write_sintel(scene, out / "data", name)
    compare(
        [out / "data" / "training" / "clean" / name],
        out,
        methods=tuple(METHODS),
        options=Options(flow=FlowOptions(source="dis")),
        mode="overwrite" if overwrite else "new",
        command=command,
        quiet=quiet,
    )
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    return {
        "scene": {"kind": SCENE, "seed": seed, "frames": frames, "height": HEIGHT, "width": WIDTH},
        "moving_fraction": float(
            np.median([(scene.object_id(i) > 0).mean() for i in range(scene.frames)])
        ),
        "rows": [
            {
                "method": METHODS[row["method"]],
                "ate_cm": 100.0 * row["ate_rmse_origin"],
                "rotation_deg": row["rot_err_deg_mean"],
                "epe_px": row["epe_l2_px"],
                "failed": row["failed"],
                "frame_ms": row["ms_per_pair_median"] + row["flow_ms_median"],
            }
            for row in results["rows"]
        ],
        "report": os.fspath(out / "report.html"),
    }
