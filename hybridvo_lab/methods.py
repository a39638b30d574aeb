"""Methods to compare with: the paper's networks alone, and estimators of other libraries.

Each is an entry point of the group ``hybridvo.methods``, so that ``hybridvo`` knows it by name.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from hybridvo.core.results import Motion
from hybridvo.evidence.pair import PairEvidence
from hybridvo.pipeline import Context, Method, method_names
from hybridvo_lab import baselines

SELECTION = {
    "pwvo-paper": "softmax",
    **dict.fromkeys(
        ("pwvo-uncertain", "pwvo-naive", "pixelwise", "vonet", "vonet-attention"),
        "mean",
    ),
}
"""Networks of the paper, and how one motion is selected from the pixels of each."""


def in_order() -> tuple[str, ...]:
    """Every method, in the order of the tables."""
    ours = [name for name in method_names() if name not in OTHERS]
    return (*ours[:-1], *OTHERS, ours[-1])


def network_alone(
    name: str, evidence: PairEvidence, ctx: Context
) -> Iterator[Motion]:
    """A network of the paper alone, by the paper's selection."""
    from hybridvo_lab.paper.prediction import estimate_by_network

    pair = evidence.with_flow
    network = ctx.models.network(name)
    yield estimate_by_network(pair, SELECTION[name], network)


def baseline(name: str, evidence: PairEvidence, ctx: Context) -> Iterator[Motion]:
    """An estimator of another library, from the expected motion where it takes a start."""
    needs_flow = name not in baselines.WITHOUT_FLOW
    pair = evidence.with_flow if needs_flow else evidence.pair
    start = evidence.start
    if start is None and evidence.expected is not None:
        start = evidence.expected.T_curr_prev
    yield baselines.estimate(name, pair, ctx.seed, start=start)


def _row_of_paper(name: str) -> Method:
    """The method of a network of the paper."""
    answers = partial(network_alone, name)
    return Method(answers, networks=(name,), is_verified=False)


def _of_library(name: str) -> Method:
    """The method of another library."""
    answers = partial(baseline, name)
    missing = partial(baselines.missing, name)
    return Method(answers, is_verified=False, missing=missing)


pwvo_paper = _row_of_paper("pwvo-paper")
pwvo_uncertain = _row_of_paper("pwvo-uncertain")
pwvo_naive = _row_of_paper("pwvo-naive")
pixelwise = _row_of_paper("pixelwise")
vonet = _row_of_paper("vonet")
vonet_attention = _row_of_paper("vonet-attention")
pnp_ransac = _of_library("pnp-ransac")
pnp_ransac_tuned = _of_library("pnp-ransac-tuned")
usac_magsac = _of_library("usac-magsac")
poselib = _of_library("poselib")
opencv_rgbd = _of_library("opencv-rgbd")
open3d_rgbd = _of_library("open3d-rgbd")
small_gicp = _of_library("small-gicp")
kiss_icp = _of_library("kiss-icp")
sift_pnp = _of_library("sift-pnp")
OTHERS = (*SELECTION, *baselines.METHODS)
