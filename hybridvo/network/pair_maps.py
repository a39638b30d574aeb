"""What PWVO predicts for whole pairs: its maps for the hypothesis of which it is surest."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from hybridvo.core.geometry import pose_matrix
from hybridvo.core.options import Options
from hybridvo.core.results import MotionPrior, PixelwisePrediction, StageFailed
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.select import (
    Candidate,
    Ranking,
    evidence_on_choice,
    rank_by_scorer,
    surest,
)
from hybridvo.network.hypothesis_inputs import HypothesisInputs
from hybridvo.network.hypothesis_maps import HypothesisNetwork
from hybridvo.network.scorer import PWVOScorer
from hybridvo.network.selection import EVIDENCE, INVALID_LOG_SCALE, seed_weights
from hybridvo.solver.noise_estimation import START_NOISE
from hybridvo.solver.pixels import grid_stride
from hybridvo.solver.torch.tools import has_torch_geometry, uncompiled


class PairLook(NamedTuple):
    """The surest hypothesis of a pair.

    Attributes:
        prediction: the maps for it, (1, 6, h, w), with what speaks for it.
        inputs: the pair, with this hypothesis alone.
        hypothesis: it and its noise.
    """

    prediction: PixelwisePrediction
    inputs: HypothesisInputs
    hypothesis: Candidate


@uncompiled
def predict_batch(
    network: HypothesisNetwork, batch: PairBatch
) -> PixelwisePrediction:
    """Predict pose and log scale at every pixel of a batch; see :meth:`PWVO.forward`."""
    return predict_pairs(network, batch.pairs(), batch=batch)


def predict_pairs(
    network: HypothesisNetwork,
    pairs: Sequence[FramePair],
    priors: Sequence[MotionPrior | None] | None = None,
    options: Options | None = None,
    seed: int = 0,
    starts: Sequence[Sequence[np.ndarray]] | None = None,
    batch: PairBatch | None = None,
) -> PixelwisePrediction:
    """Search the motions of pairs, look at each, and return the maps for the surest.

    Args:
        network: PWVO.
        pairs: of one size, with flow, and depth of the previous frame.
        priors: an expected motion for each pair, or None.
        options: the option tree.
        seed: of the search.
        starts: motions (4, 4) of each pair that the search tries beside the usual ones.
        batch: the same pairs as tensors, for the poses of patches; None: the maps have none.

    Returns:
        Maps on the grid of the search, with the gradient of the network's weights; the patches
        have that of the batch as well. A pair without any motion has no motion, of which every
        pixel is uncertain.
    """
    options = Options() if options is None else options
    priors = [None] * len(pairs) if priors is None else priors
    starts = [()] * len(pairs) if starts is None else starts
    camera = pairs[0].prev.camera
    stride = grid_stride(camera.shape, options.refine.coarse_pixels)
    rows = len(range(stride // 2, camera.height, stride))
    columns = len(range(stride // 2, camera.width, stride))
    shape = (rows, columns)
    looks = []
    parts = []
    for pair, prior, more in zip(pairs, priors, starts, strict=True):
        look = None
        with contextlib.suppress(StageFailed):
            look = look_at_pair(network, pair, prior, options, seed, more)
        prediction = _no_motion(network) if look is None else look.prediction
        looks.append(look)
        parts.append(_on_grid(prediction, shape))
    maps = PixelwisePrediction(
        motion=torch.cat([part.motion for part in parts]),
        log_scale=torch.cat([_log_scale(part) for part in parts]),
        image_size=camera.shape,
        evidence=torch.cat([_evidence(part) for part in parts]),
    )
    if batch is None:
        return maps
    hypotheses = [None if look is None else look.hypothesis for look in looks]
    return with_patches(maps, batch, hypotheses)


def look_at_pair(
    network: HypothesisNetwork,
    pair: FramePair,
    prior: MotionPrior | None = None,
    options: Options | None = None,
    seed: int = 0,
    starts: Sequence[np.ndarray] = (),
) -> PairLook:
    """Look at every hypothesis of a pair, and return the surest.

    Motions (4, 4) to start from are tried beside the identity and the prior.

    Raises:
        StageFailed: if flow, depth or usable pixels are missing, or determine no motion.
    """
    options = Options() if options is None else options
    tried = [np.eye(4)]
    if prior is not None:
        tried.append(prior.T_curr_prev)
    tried.extend(starts)
    found = generate(pair, np.stack(tried), options, seed)
    scorer = PWVOScorer(network, found, prior)
    ranking = rank_by_scorer(found, scorer, options)
    best = ranking.candidates[ranking.best]
    inputs = scorer.pair_inputs.with_hypotheses(
        best.pose[None], np.array([best.noise]), [0]
    )
    return PairLook(maps_of_best(scorer, [ranking]), inputs, best)


def maps_of_best(
    scorer: PWVOScorer, rankings: Sequence[Ranking]
) -> PixelwisePrediction:
    """Draw the maps of the motion that is selected from looks at all flows of a pair.

    Args:
        scorer: which took the surest look.
        rankings: all looks, in the order of the flows.

    Returns:
        Maps (1, 6, h, w) on the grid of the search; a pixel without flow or depth carries no
        information.
    """
    ranking = surest(rankings)
    maps = scorer.maps_of(ranking.best)
    usable = scorer.pair_inputs.usable[:, None]
    uncertain = maps.log_scale.clamp(min=INVALID_LOG_SCALE)
    log_scale = torch.where(usable, maps.log_scale, uncertain)
    evidence = maps.motion.new_tensor(
        [evidence_on_choice(rankings)], dtype=torch.float64
    )
    size = ranking.found.grid.size
    return PixelwisePrediction(maps.motion, log_scale, size, evidence)


def with_patches(
    maps: PixelwisePrediction,
    batch: PairBatch,
    hypotheses: Sequence[Candidate | None],
) -> PixelwisePrediction:
    """Return the maps of pairs with the poses of their patches, where these can be had.

    Args:
        maps: of the pairs.
        batch: the pairs.
        hypotheses: the motion of each pair of which the maps are; None: there is none.
    """
    if not has_torch_geometry():
        return maps
    from hybridvo.solver.torch.patches import patch_poses

    poses = []
    noise = []
    for each in hypotheses:
        T = np.eye(4) if each is None else pose_matrix(each.pose)
        poses.append(T)
        noise.append(START_NOISE if each is None else each.noise)
    is_known = torch.tensor([each is not None for each in hypotheses])
    weights = seed_weights(maps) * is_known.to(maps.motion)[:, None, None]
    device = batch.flow.device
    patches = patch_poses(
        batch,
        torch.as_tensor(np.stack(poses), device=device),
        weights.to(device),
        torch.as_tensor(np.array(noise), device=device),
    )
    return replace(maps, patches=patches)


def _no_motion(network: HypothesisNetwork) -> PixelwisePrediction:
    """No motion, of which every pixel is uncertain."""
    nothing = next(network.parameters()).new_zeros(1, 6, 1, 1)
    uncertain = nothing + INVALID_LOG_SCALE
    unknown = nothing.new_full((1, EVIDENCE), torch.nan, dtype=torch.float64)
    return PixelwisePrediction(nothing, uncertain, evidence=unknown)


def _on_grid(
    prediction: PixelwisePrediction, shape: tuple[int, int]
) -> PixelwisePrediction:
    """The maps on a grid of another shape: few usable pixels have a finer one."""
    if prediction.motion.shape[2:] == shape:
        return prediction
    motion = F.interpolate(prediction.motion, shape, mode="nearest")
    log_scale = F.interpolate(_log_scale(prediction), shape, mode="nearest")
    return replace(prediction, motion=motion, log_scale=log_scale)


def _log_scale(prediction: PixelwisePrediction) -> torch.Tensor:
    assert prediction.log_scale is not None
    return prediction.log_scale


def _evidence(prediction: PixelwisePrediction) -> torch.Tensor:
    assert prediction.evidence is not None
    return prediction.evidence
