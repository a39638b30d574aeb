"""What each way of finding classical flow is worth to the motion, and what it costs.

    python tools/measure_flow.py --data ../shared/data --out runs/flow.json

OpenCV's DIS in its presets, with and without the backward flow, and with a second pass on the
picture that the first motion has warped (so that what is left to find is small). The same pairs
for all; errors of the refinement alone and after the polish; processor time of the flow.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from measured_pairs import REAL, pairs_parser, write_rows

KINDS = ("static", "light", "heavy_rigid", "heavy_two", "pair")
VARIANTS = ("ultrafast", "fast", "medium", "medium-forward", "medium-twice", "fast-twice")


def main(argv: list[str] | None = None) -> int:
    return write_rows(pairs_parser("measure_flow.py", __doc__, 2), argv, measure_all, table)


def measure_all(args: argparse.Namespace) -> list[dict[str, Any]]:
    groups = {"rendered": rendered(args)} | {
        name: real(args.data / name) for name in REAL if (args.data / name).exists()
    }
    return [row for name, pairs in groups.items() for row in measure(name, pairs)]


def rendered(args: argparse.Namespace) -> Iterator[tuple[Any, Any, np.ndarray]]:
    """(previous frame, current frame, true motion) of rendered scenes."""
    from hybridvo.geometry import invert
    from hybridvo.synthetic.render import SyntheticSequence, make_scene

    for kind in KINDS:
        for seed in range(args.seed, args.seed + args.scenes * (3 if kind == "pair" else 1)):
            sequence = SyntheticSequence(make_scene(kind, seed))
            for i in (0, 6, 12) if len(sequence) > 2 else (0,):
                T = invert(sequence.poses[i + 1]) @ sequence.poses[i]
                yield sequence.frame(i), sequence.frame(i + 1), T


def real(path: Path) -> Iterator[tuple[Any, Any, np.ndarray]]:
    """The same of a sequence on disk."""
    from hybridvo.data.sequence import open_sequence
    from hybridvo.geometry import invert

    sequence = open_sequence(path)
    assert sequence.poses is not None
    for i in range(len(sequence) - 1):
        T = invert(sequence.poses[i + 1]) @ sequence.poses[i]
        yield sequence.frame(i), sequence.frame(i + 1), T


def measure(name: str, pairs: Iterator[tuple[Any, Any, np.ndarray]]) -> list[dict[str, Any]]:
    """One row a variant."""
    from hybridvo.evaluation.pair_errors import pair_errors
    from hybridvo.flow import dis_flow
    from hybridvo.pipeline import refine
    from hybridvo.refinement.photometric import polish_photometric
    from hybridvo.types import FramePair

    errors: dict[str, list[list[float]]] = {variant: [] for variant in VARIANTS}
    spent: dict[str, list[float]] = {variant: [] for variant in VARIANTS}
    providers = {
        (preset, both): dis_flow(preset, both)
        for preset in ("ultrafast", "fast", "medium")
        for both in (True, False)
    }
    for prev, curr, T in pairs:
        for variant in VARIANTS:
            preset, _, extra = variant.partition("-")
            provider = providers[preset, extra != "forward"]
            started = time.process_time()
            field = provider(prev, curr)
            pair = FramePair(prev, curr, field.flow, field.variance, field.valid, "dis")
            if extra == "twice":
                pair = second_pass(pair, refine(pair).T_curr_prev, provider)
            spent[variant].append(1e3 * (time.process_time() - started))
            motion = refine(pair)
            row = []
            for found in (motion, polish_photometric(pair, motion)):
                e = pair_errors(found.T_curr_prev, T, prev.depth, prev.camera, curr.camera)
                row += [e["epe_l2_px"], e["rot_err_deg"], 100 * e["trans_err"]]
            errors[variant].append(row)
    out = []
    for variant in VARIANTS:
        values = np.array(errors[variant])
        median = np.median(values, axis=0)
        row = {"group": name, "flow": variant, "pairs": len(values)}
        for k, key in enumerate(("refine", "polished")):
            row[f"{key}_epe_px"], row[f"{key}_rot_deg"], row[f"{key}_trans_cm"] = (
                float(m) for m in median[3 * k : 3 * k + 3]
            )
            row[f"{key}_above_1_px"] = float(np.mean(values[:, 3 * k] > 1))
        row["flow_ms_processor"] = float(np.median(spent[variant]))
        out.append(row)
    return out


def second_pass(pair: Any, T: np.ndarray, provider: Any) -> Any:
    """The pair with the flow found again between the previous picture and the warped current one.

    The current picture is read along the first motion where depth is known, and along the first
    flow elsewhere; its residual flow is added to what it was read along.
    """
    from dataclasses import replace

    import cv2

    from hybridvo.geometry import ego_flow

    height, width = pair.prev.camera.shape
    known = ego_flow(pair.prev.depth, T, pair.prev.camera, pair.curr.camera)
    far = np.linalg.norm(known - pair.flow, axis=2) > 2.0  # another motion, or a wrong one
    base = np.where(np.isfinite(known) & ~far[..., None], known, pair.flow).astype(np.float32)
    # the pattern of a mixture has edges of its own, which DIS would follow
    base = cv2.GaussianBlur(base, (0, 0), 2.0)
    u = base[..., 0] + np.arange(width, dtype=np.float32)
    v = base[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    warped = cv2.remap(pair.curr.rgb, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    field = provider(pair.prev, replace(pair.curr, rgb=warped))
    if field.flow is None:
        return pair
    valid = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    if field.valid is not None:
        valid &= field.valid
    return replace(pair, flow=base + field.flow, flow_variance=field.variance, flow_valid=valid)


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown for people."""
    lines = [
        "| pairs | flow | EPE, px | > 1 px | after polish, px | > 1 px | ms |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        lines.append(
            f"| {row['group']} ({row['pairs']}) | {row['flow']} | {row['refine_epe_px']:.3g} | "
            f"{row['refine_above_1_px']:.2f} | {row['polished_epe_px']:.3g} | "
            f"{row['polished_above_1_px']:.2f} | {row['flow_ms_processor']:.0f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
