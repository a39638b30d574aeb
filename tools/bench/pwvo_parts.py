"""What each part of PWVO's seed is worth: a row without each of them.

    python tools/benchmark.py pwvo_parts --out docs/results/pwvo_parts.json

PWVO in one sentence: the poses of patches, weighted by their uncertainty and selected, seed a
refinement on weighted pixels. The network looks at each pair once. Then the seed is made again
without one of these parts, and the refinement starts from it; the images are not consulted, and
no second flow is tried. The pairs are those of the heavy scenes and of clips by other makers.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from maker_pairs import clip_folders, clip_pairs, scene_pairs
from measuring import (
    add_workers,
    digits,
    ego_flow_error,
    measured,
    parser_of,
    proportion,
    provenance,
    store,
)
from scipy.stats import spearmanr

from bench.semi_real import StaticPart, static_part
from hybridvo import PWVO, PairBatch, refine
from hybridvo.core.geometry import pose_matrix
from hybridvo.core.results import StageFailed
from hybridvo.network.pair_maps import PairLook, look_at_pair
from hybridvo.network.selection import seed_weights
from hybridvo.solver.torch.patches import PatchPoses, patch_poses
from hybridvo.solver.torch.tools import PoseSeed
from hybridvo_lab.synthetic.paper_samples import KnownPair
from hybridvo_lab.synthetic.scenes import HEAVY
from hybridvo_lab.training.validation import allowed_error_px

CLIPS = {"clips, kitchen": "kitchen", "clips, box": "box"}
"""Sets of clips, and how their names begin; the numbers of the region were chosen on the box."""
HEAVY_SEEDS = range(9800, 9802)
MIN_SHARE = 1e-3
"""Share of the information below which a patch has no pose of its own."""


class Looked(NamedTuple):
    """A pair, and what PWVO states of it."""

    batch: PairBatch
    hypothesis: torch.Tensor  # (1, 4, 4)
    weights: torch.Tensor  # (1, H, W) P(static), over its largest
    evidence: torch.Tensor  # (1, 4) what speaks for the motion
    patches: PatchPoses
    # as if every pixel were as surely static
    unselected: PatchPoses


class Start(NamedTuple):
    """Where a refinement starts, and what it weighs pixels by."""

    T_curr_prev: torch.Tensor
    covariance: torch.Tensor | None
    weights: torch.Tensor


def whole(pair: Looked) -> Start:
    return Start(*pair.patches.fused, pair.weights)


def without_uncertainty(pair: Looked) -> Start:
    """The mean of the patches, within the region of the fused pose."""
    return Start(*pair.patches.patch_mean, pair.weights)


def surest_patch(pair: Looked) -> Start:
    """The patch of least uncertainty: the limit of the paper's selection."""
    return Start(*pair.patches.surest, pair.weights)


def without_selection(pair: Looked) -> Start:
    return Start(*pair.unselected.fused, pair.weights)


def without_pixel_poses(pair: Looked) -> Start:
    """The hypothesis, within the region of the fused pose."""
    return Start(pair.hypothesis, pair.patches.fused.covariance, pair.weights)


def without_region(pair: Looked) -> Start:
    return Start(pair.patches.fused.T_curr_prev, None, pair.weights)


def without_seed(pair: Looked) -> Start:
    """No motion, from where the solution is sought everywhere."""
    anywhere = 1e2 * torch.eye(6, dtype=torch.float64)[None]
    return Start(torch.eye(4)[None], anywhere, pair.weights)


def without_weights(pair: Looked) -> Start:
    return Start(*pair.patches.fused, torch.ones_like(pair.weights))


ROWS: dict[str, Callable[[Looked], Start]] = {
    "all parts": whole,
    "without uncertainty: mean of the patch poses": without_uncertainty,
    "the surest patch alone": surest_patch,
    "without selection: P(static) = 1 in the patches": without_selection,
    "without patch poses: the hypothesis": without_pixel_poses,
    "without the covariance of the seed": without_region,
    "without a seed: no motion": without_seed,
    "without weights in the refinement": without_weights,
}
"""What is left out, and the start without it."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    args.data = args.data.absolute()
    sources = sources_of(args.data)
    items = {source.name: source for source in sources}
    found = measured(args, "sources", rows_of, items)
    sets = {}
    for name in ("heavy", *CLIPS):
        pairs = [row for s in sources if s.set == name for row in found[s.name]]
        if not pairs:
            print(f"{name}: no data")
            continue
        sets[name] = summary_of(pairs)
        for row, values in sets[name]["rows"].items():
            print(name, row, values, flush=True)
        print(
            name, {k: v for k, v in sets[name].items() if k != "rows"}, flush=True
        )
    result = provenance("benchmark.py pwvo_parts", argv) | {"sets": sets}
    store(args.out, result)
    return 0


class Source(NamedTuple):
    """A part of a set: a clip, or a family of scenes."""

    set: str
    name: str
    folder: Path | None

    def pairs(self) -> Iterator[KnownPair]:
        """The pairs with known motion."""
        if self.folder is not None:
            return clip_pairs(self.folder)
        return scene_pairs(self.name, HEAVY_SEEDS, "dis")


def sources_of(data: Path) -> list[Source]:
    """Where the pairs come from; without clips in the data folder, the scenes alone."""
    sources = [Source("heavy", kind, None) for kind in HEAVY]
    for name, prefix in CLIPS.items():
        for folder in clip_folders(data, prefix):
            sources.append(Source(name, folder.name, folder))
    return sources


def rows_of(source: Source) -> list[dict[str, Any]]:
    """The errors of a source's pairs, of which PWVO finds any motion."""
    network = PWVO.from_pretrained()
    rows = []
    for known in source.pairs():
        if known.pair.flow is None:
            continue
        with contextlib.suppress(StageFailed):
            look = look_at_pair(network, known.pair)
            rows.append(errors_of(known, static_part(known), look))
    return rows


@torch.no_grad()
def errors_of(
    known: KnownPair, static: StaticPart, look: PairLook
) -> dict[str, Any]:
    """Errors of every start and of what it is refined to, px of the ego flow, static pixels."""
    pair = looked(known, look)

    def error(T: torch.Tensor) -> float:
        motion = T.double().numpy()
        return ego_flow_error(motion, known.T_curr_prev, static.depth, known.pair)

    starts = {}
    refined = {}
    for name, start_of in ROWS.items():
        start = start_of(pair)
        seed = PoseSeed(
            start.T_curr_prev, start.weights, pair.evidence, start.covariance
        )
        motion = refine(pair.batch, seed)
        starts[name] = error(start.T_curr_prev[0])
        refined[name] = error(motion.T_curr_prev[0])
    patches = pair.patches
    has_pose = (patches.share[0] > MIN_SHARE).numpy()
    of_patches = np.array([error(T) for T in patches.poses[0]])
    return {
        "limit": allowed_error_px(static.oracle_px),
        "starts": starts,
        "refined": refined,
        "hypothesis": error(pair.hypothesis[0]),
        "uncertainty": patches.uncertainty_px[0].numpy()[has_pose].tolist(),
        "errors": of_patches[has_pose].tolist(),
    }


def looked(known: KnownPair, look: PairLook) -> Looked:
    """What PWVO states of a pair by its look."""
    batch = PairBatch.from_pairs([known.pair])
    hypothesis = torch.from_numpy(pose_matrix(look.hypothesis.pose))[None]
    noise = torch.tensor([list(look.hypothesis.noise)])
    weights = seed_weights(look.prediction)
    assert look.prediction.evidence is not None
    return Looked(
        batch=batch,
        hypothesis=hypothesis,
        weights=weights,
        evidence=look.prediction.evidence,
        patches=patch_poses(batch, hypothesis, weights, noise),
        unselected=patch_poses(batch, hypothesis, None, noise),
    )


def summary_of(pairs: list[dict[str, Any]]) -> dict[str, Any]:
    """Median errors and wrong answers of every row, and figures of the patches."""
    limits = np.array([pair["limit"] for pair in pairs])
    rows = {}
    for name in ROWS:
        start = np.array([pair["starts"][name] for pair in pairs])
        refined = np.array([pair["refined"][name] for pair in pairs])
        rows[name] = {
            "start_px": digits(np.median(start)),
            "start_wrong": proportion(int((start > limits).sum()), len(pairs)),
            "median_px": digits(np.median(refined)),
            "wrong": proportion(int((refined > limits).sum()), len(pairs)),
        }
    fused = np.array([pair["starts"]["all parts"] for pair in pairs])
    hypothesis = np.array([pair["hypothesis"] for pair in pairs])
    ranks = [rank_correlation(pair) for pair in pairs]
    return {
        "rows": rows,
        "fused_nearer": proportion(int((fused < hypothesis).sum()), len(pairs)),
        "rank_correlation": digits(np.nanmedian(ranks)),
    }


def rank_correlation(pair: dict[str, Any]) -> float:
    """Of the stated uncertainty of a pair's patches with the error of their poses; NaN: too few."""
    return float(spearmanr(pair["uncertainty"], pair["errors"]).statistic)
