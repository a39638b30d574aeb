"""What the refinement of a batch returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from hybridvo.core.results import RelativePose, Status, Term

if TYPE_CHECKING:
    from hybridvo.core.torch_geometry import pp


@dataclass(frozen=True, eq=False)
class BatchedPose:
    """Camera motions of a batch of B pairs, as in :class:`hybridvo.core.results.RelativePose`.

    Attributes:
        SE3: pypose SE3 (B, 7) of T_curr_prev, metres; the identity where failed. It carries the
            gradient.
        covariance: (B, 6, 6) of the left perturbation (translation, rotation) in the current
            camera; m^2, m rad, rad^2. Positive definite, in float64: single precision cannot hold
            that of a motion whose rotation is known a million times as well.
        converged: (B,) bool.
        failed: (B,) bool.
        status: of every sample.
        probability: (B,) that this is the camera's motion; 0 where failed. Calibrated where the
            start is that of ``select``. With other weights it states how little of their sum
            follows another motion, which is as right as the weights; NaN without weights, or where
            all are alike.
        iterations: (B,) Newton steps on all pixels.
        cost: (B,) robust cost per unit of weight, dimensionless.
        weights: (B, H, W) robust weights without the external ones, 0 where unusable.
        noise: (B, 2) standard deviations of flow, px, and of log depth.
        inlier_ratio: (B,) fraction of the external weight within the kernel's cutoff.
        evidence: (B, 3) of which the calibrated probability is a function; None without it.

    >>> import hybridvo as hvo
    >>> prev, curr, _ = hvo.example_frames()
    >>> pair = hvo.FramePair(prev, curr, hvo.dis_flow()(prev, curr).flow)
    >>> batch = hvo.PairBatch.from_pairs([pair, pair])
    >>> motion = hvo.refine(batch, noise=(0.5, 0.02))
    >>> motion.SE3.shape, motion.covariance.shape
    (torch.Size([2, 7]), torch.Size([2, 6, 6]))
    >>> motion.one(0).T_curr_prev.shape
    (4, 4)
    """

    SE3: pp.LieTensor
    covariance: torch.Tensor
    converged: torch.Tensor
    failed: torch.Tensor
    status: list[Status]
    probability: torch.Tensor
    iterations: torch.Tensor
    cost: torch.Tensor
    weights: torch.Tensor
    noise: torch.Tensor
    inlier_ratio: torch.Tensor
    evidence: torch.Tensor | None = None

    @property
    def T_curr_prev(self) -> torch.Tensor:
        """Transforms (B, 4, 4) of points of the previous camera into the current one, metres."""
        return self.SE3.matrix().to(self.weights.dtype)

    def one(self, index: int) -> RelativePose:
        """Return the motion of one sample as every other estimator does, in numpy.

        Args:
            index: number of the sample.

        Returns:
            The motion; its method is ``classical``, its weights do not carry gradients.
        """
        status = self.status[index]
        evidence: tuple[float, ...] = ()
        if self.evidence is not None and status.usable:
            evidence = tuple(self.evidence[index].tolist())
        T = self.SE3[index].detach().matrix().double().cpu().numpy()
        return RelativePose(
            T_curr_prev=np.ascontiguousarray(T),
            covariance=self.covariance[index].cpu().numpy(),
            status=status,
            inlier_ratio=min(1.0, float(self.inlier_ratio[index])),
            iterations=int(self.iterations[index]),
            cost=float(self.cost[index]),
            residual_scale_px=float(self.noise[index, 0]),
            depth_noise=float(self.noise[index, 1]),
            weights=self.weights[index].detach().float().cpu().numpy(),
            probability=float(self.probability[index]),
            evidence=evidence,
            method="classical",
            terms=(Term.FLOW,),
        )
