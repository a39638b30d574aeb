"""What the photometric polish adds to the refinement: rendered scenes and the real sequences.

    python tools/measure_polish.py --data ../shared/data --out runs/polish.json

The same pairs and the same DIS flow, refined alone and then polished: end-point error of the ego
flow, rotation, translation, end-point drift of the real sequences, reasons, milliseconds. With
``--degraded`` the rendered pictures are spoilt in many ways, and their flow with them.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from measured_pairs import REAL, pairs_parser, write_rows

KINDS = ("static", "light", "heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten", "pair")
PAIRS = (0, 4, 8, 12, 16)
"""Pairs of a rendered sequence that are measured."""


def main(argv: list[str] | None = None) -> int:
    parser = pairs_parser("measure_polish.py", __doc__, 4)
    parser.add_argument("--degraded", action="store_true", help="spoilt pictures instead")
    return write_rows(parser, argv, measure_all)


def measure_all(args: argparse.Namespace) -> list[dict[str, Any]]:
    source = spoilt(args) if args.degraded else groups(args)
    return [measure(name, pairs) for name, pairs in source]


def groups(args: argparse.Namespace) -> Iterator[tuple[str, Iterator[tuple[Any, np.ndarray]]]]:
    """(name, its pairs with their true motions)."""
    from hybridvo.data.sequence import open_sequence
    from hybridvo.synthetic.render import SyntheticSequence, make_scene

    def rendered(kind: str) -> Iterator[tuple[Any, np.ndarray]]:
        for seed in range(args.seed, args.seed + args.scenes * (5 if kind == "pair" else 1)):
            sequence = SyntheticSequence(make_scene(kind, seed))
            yield from pairs_of(sequence, PAIRS if len(sequence) > 2 else (0,))

    for kind in KINDS:
        yield kind, rendered(kind)
    for name in REAL:
        if (args.data / name).exists():
            sequence = open_sequence(args.data / name)
            yield name, pairs_of(sequence, range(len(sequence) - 1))


def spoilt(args: argparse.Namespace) -> Iterator[tuple[str, Iterator[tuple[Any, np.ndarray]]]]:
    """(name of what was done to the pictures, pairs with the flow of those pictures)."""
    from dataclasses import replace

    from hybridvo.geometry import invert
    from hybridvo.synthetic.render import SyntheticSequence, make_scene

    frames = []
    for kind in ("static", "light", "pair"):
        for seed in range(args.seed, args.seed + args.scenes):
            sequence = SyntheticSequence(make_scene(kind, seed))
            for i in (0, 8) if len(sequence) > 2 else (0,):
                T = invert(sequence.poses[i + 1]) @ sequence.poses[i]
                following = min(i + 1, len(sequence) - 2)
                flows = sequence.flow(i)[0], sequence.flow(following)[0]
                frames.append((sequence.frame(i), sequence.frame(i + 1), T, flows))

    def made(name: str) -> Iterator[tuple[Any, np.ndarray]]:
        for k, (prev, curr, T, flows) in enumerate(frames):
            rng = np.random.default_rng([args.seed, k])
            other = frames[(k + 3) % len(frames)][1].rgb
            first, second = spoil(name, (prev.rgb, curr.rgb), flows, rng, other)
            pair = replace(prev, rgb=first), replace(curr, rgb=second)
            yield from pairs_of(_Two(pair, T), (0,))

    for name in SPOILT:
        yield name, made(name)


class _Two:
    """Two frames as a sequence."""

    def __init__(self, frames: tuple[Any, Any], T_curr_prev: np.ndarray) -> None:
        from hybridvo.geometry import invert

        self._frames = frames
        self.poses = [np.eye(4), invert(T_curr_prev)]

    def frame(self, index: int) -> Any:
        return self._frames[index]


SPOILT = (
    *("nothing", "one black", "foreign", "blur of one", "blur of both", "motion blur of one"),
    *("noise 10", "noise 30", "darker", "gamma", "overexposed", "vignette", "strong vignette"),
    *("lamp", "rolling shutter 0.3", "rolling shutter 0.8", "colour shifted by 3 px"),
)


def spoil(
    name: str,
    images: tuple[np.ndarray, np.ndarray],
    flows: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
    other: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Both pictures after something was done to them; ``flows`` are the true ones from each."""
    import cv2

    a, b = images
    height, width = a.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float32)

    def clipped(image: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def noisy(image: np.ndarray, deviation: float) -> np.ndarray:
        return clipped(image + deviation * rng.standard_normal(image.shape))

    def vignette(image: np.ndarray, strength: float) -> np.ndarray:
        r2 = ((u - width / 2) ** 2 + (v - height / 2) ** 2) * 4 / (width**2 + height**2)
        return clipped(image / (1 + strength * r2[..., None]) ** 2)

    def rolled(image: np.ndarray, flow: np.ndarray, share: float) -> np.ndarray:
        late = (share * (v / height - 0.5))[..., None] * np.nan_to_num(flow)
        return cv2.remap(
            image, u - late[..., 0], v - late[..., 1], cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip

    def smeared(image: np.ndarray) -> np.ndarray:
        kernel = np.zeros((11, 11), np.float32)
        angle = rng.uniform(0, np.pi)
        for t in np.linspace(-5, 5, 44):
            kernel[round(5 + t * np.sin(angle)), round(5 + t * np.cos(angle))] = 1
        return cv2.filter2D(image, -1, kernel / kernel.sum())

    glow = 60 * np.exp(-((u - 0.3 * width) ** 2 + (v - 0.5 * height) ** 2) / (0.125 * width**2))
    made = {
        "nothing": lambda: (a, b),
        "one black": lambda: (a, np.zeros_like(b)),
        "foreign": lambda: (a, other),
        "blur of one": lambda: (a, cv2.GaussianBlur(b, (0, 0), 2.5)),
        "blur of both": lambda: tuple(cv2.GaussianBlur(x, (0, 0), 3) for x in (a, b)),
        "motion blur of one": lambda: (a, smeared(b)),
        "noise 10": lambda: (noisy(a, 10), noisy(b, 10)),
        "noise 30": lambda: (noisy(a, 30), noisy(b, 30)),
        "darker": lambda: (a, clipped(0.6 * b + 20)),
        "gamma": lambda: (a, clipped(255 * (b / 255) ** 0.6)),
        "overexposed": lambda: (a, clipped(1.8 * b.astype(float) + 20)),
        "vignette": lambda: (vignette(a, 0.5), vignette(b, 0.5)),
        "strong vignette": lambda: (vignette(a, 1.5), vignette(b, 1.5)),
        "lamp": lambda: (a, clipped(b + glow[..., None])),
        "rolling shutter 0.3": lambda: (rolled(a, flows[0], 0.3), rolled(b, flows[1], 0.3)),
        "rolling shutter 0.8": lambda: (rolled(a, flows[0], 0.8), rolled(b, flows[1], 0.8)),
        "colour shifted by 3 px": lambda: tuple(np.roll(x, 3, axis=1) for x in (a, b)),
    }
    return made[name]()  # type: ignore[no-any-return]


def pairs_of(sequence: Any, indices: Any) -> Iterator[tuple[Any, np.ndarray]]:
    """Pairs with DIS flow."""
    from hybridvo.flow import dis_flow
    from hybridvo.geometry import invert
    from hybridvo.types import FramePair

    provider = dis_flow()
    for i in indices:
        prev, curr = sequence.frame(i), sequence.frame(i + 1)
        f = provider(prev, curr)
        pair = FramePair(prev, curr, f.flow, f.variance, f.valid, "dis")
        yield pair, invert(sequence.poses[i + 1]) @ sequence.poses[i]


def measure(name: str, pairs: Iterator[tuple[Any, np.ndarray]]) -> dict[str, Any]:
    """Errors before and after."""
    from hybridvo.evaluation.pair_errors import pair_errors
    from hybridvo.pipeline import refine
    from hybridvo.refinement.photometric import polish_photometric

    errors: dict[str, list[list[float]]] = {"refine": [], "polished": []}
    end = {key: np.eye(4) for key in ("refine", "polished", "truth")}
    reasons: Counter[str] = Counter()
    wall, work, said = [], [], 0
    for pair, T in pairs:
        motion = refine(pair)
        started = time.perf_counter(), time.process_time()
        polished = polish_photometric(pair, motion)
        wall.append(1e3 * (time.perf_counter() - started[0]))
        work.append(1e3 * (time.process_time() - started[1]))
        reasons[polished.polish.reason or "taken"] += 1
        said += "images" in polished.status.message
        end["truth"] = T @ end["truth"]
        for key, found in (("refine", motion), ("polished", polished)):
            end[key] = found.T_curr_prev @ end[key]
            e = pair_errors(
                found.T_curr_prev, T, pair.prev.depth, pair.prev.camera, pair.curr.camera
            )
            errors[key].append([e["epe_l2_px"], e["rot_err_deg"], 100 * e["trans_err"]])
    row: dict[str, Any] = {"name": name, "pairs": len(wall), "reasons": dict(reasons)}
    for key, values in errors.items():
        table = np.array(values)
        row[key] = {
            "epe_px_median": float(np.median(table[:, 0])),
            "epe_px_above_1": float(np.mean(table[:, 0] > 1)),
            "rot_deg_median": float(np.median(table[:, 1])),
            "trans_cm_median": float(np.median(table[:, 2])),
        }
        if "/" in name:
            drift = np.linalg.norm(end[key][:3, 3] - end["truth"][:3, 3])
            row[key]["end_trans_cm"] = 100 * float(drift)
    before, after = (np.array(errors[key])[:, 0] for key in ("refine", "polished"))
    ratio = after / before
    row["epe_ratio_median"], row["epe_ratio_worst"] = float(np.median(ratio)), float(ratio.max())
    row["epe_ratio_mean_log"] = float(np.exp(np.log(np.maximum(ratio, 1e-6)).mean()))
    row["epe_rise_worst_px"] = float((after - before).max())
    row["said"] = said
    row["epe_ratio_above_1.05"] = float(np.mean(ratio > 1.05))
    row["ms_wall_min"], row["ms_processor_median"] = min(wall), float(np.median(work))
    return row


if __name__ == "__main__":
    sys.exit(main())
