"""``hybridvo demo``: a rendered scene with moving objects, and what methods make of it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hybridvo.core.errors import InputError
from hybridvo.core.files import LOCK
from hybridvo.core.options import FlowOptions, Options
from hybridvo.core.types import Frame
from hybridvo.io.data.lists import abbreviated
from hybridvo.run.commands.advice import advice_on
from hybridvo_lab.commands.compare import WRITTEN, compare
from hybridvo_lab.synthetic.render import Scene, write_sintel
from hybridvo_lab.synthetic.scenes import make_scene

SCENE = "light"
HEIGHT = 218
WIDTH = 512
METHODS = {
    "hybrid": "hybridvo (hybrid)",
    "classical": "hybridvo (classical)",
    "pnp-ransac": "OpenCV PnP-RANSAC",
    "pnp-ransac-tuned": "OpenCV PnP-RANSAC, tuned",
    "identity": "identity (no motion)",
}
"""The methods of the demo, and what its table calls them."""
OWN_METHODS = ("hybrid", "classical")
"""The methods that state when they are uncertain."""


def demo(
    out: str | Path,
    *,
    frames: int = 20,
    seed: int = 0,
    overwrite: bool = False,
    command: Iterable[str] = (),
    quiet: bool = False,
) -> dict[str, Any]:
    """Render a scene into ``out/data`` and compare methods on it, with DIS flow and true depth.

    Args:
        out: The output folder.
        frames: Frames of the scene.
        seed: Seed of the scene.
        overwrite: Whether the results of an earlier demo are replaced.
        command: The words of the command line, which are kept with the results.
        quiet: Whether no progress is shown.

    Returns:
        A summary, JSON-ready.

    Raises:
        InputError: There are too few frames, or the folder holds something else.
    """
    if frames < 2:
        raise InputError(f"demo: expected at least 2 frames, got {frames}.")
    out = Path(out)
    _check_folder(out, overwrite)
    scene = make_scene(SCENE, seed, height=HEIGHT, width=WIDTH, frames=frames)
    name = f"{SCENE}_{seed}_{frames}"
    write_sintel(scene, out / "data", name)
    done = compare(
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
        "scene": {
            "kind": SCENE,
            "seed": seed,
            "frames": frames,
            "height": HEIGHT,
            "width": WIDTH,
        },
        "moving_fraction": _moving_fraction(scene),
        "rows": [_row(row) for row in results["rows"]],
        "doubts": _warnings(out / "pairs.csv"),
        "report": _report(done["files"]),
    }


def demo_frames(frames: int, seed: int = 0) -> list[Frame]:
    """Draw frames of the demo's scene."""
    scene = make_scene(SCENE, seed, height=HEIGHT, width=WIDTH, frames=frames)
    return [scene.render(index) for index in range(scene.frames)]


def _report(files: list[str]) -> str:
    """Return the report that people read: the one for browsers, or else the table."""
    for suffix in (".html", ".md"):
        for name in files:
            if name.endswith(suffix):
                return name
    return files[0]


def _check_folder(out: Path, overwrite: bool) -> None:
    """Refuse a folder that holds anything but a demo, or a demo that must not be replaced."""
    present = {path.name for path in out.glob("*")}
    allowed = {"data", "runs", LOCK, *WRITTEN}
    is_demo = "data" in present and present <= allowed
    if not present or (overwrite and is_demo):
        return
    choices = (
        "another --out, or --overwrite to replace what a demo has written alone"
    )
    names = abbreviated(sorted(present))
    raise InputError(f"{out}: holds {names}; pass {choices}.")


def _moving_fraction(scene: Scene) -> float:
    """Return the median fraction of the pixels that move by themselves."""
    fractions = [(scene.object_id(i) > 0).mean() for i in range(scene.frames)]
    return float(np.median(fractions))


def _row(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of the demo's table from a row of ``results.json``."""
    return {
        "method": METHODS[row["method"]],
        "ate_cm": 100.0 * row["ate_rmse_origin"],
        "rotation_deg": row["rot_err_deg_mean"],
        "epe_px": row["epe_l2_px"],
        "failed": row["failed"],
        "degraded": row["degraded"],
        "frame_ms": row["ms_per_pair_median"] + row["flow_ms_median"],
    }


def _warnings(path: Path) -> list[str]:
    """State which motions are uncertain, from ``pairs.csv``."""
    # pandas would expand a "~" in a name.
    with open(path, encoding="utf-8") as file:
        pairs = pd.read_csv(file)
    warnings = []
    for method in OWN_METHODS:
        statuses = pairs[pairs["method"] == method]["status"]
        # a status such as degraded(ambiguous_motion)
        outcomes = statuses.str.extract(r"(\w+)(?:\((\w+)\))?").fillna("")
        for sentence in advice_on(outcomes.itertuples(index=False)):
            warnings.append(f"{METHODS[method]}: {sentence}")
    return warnings
