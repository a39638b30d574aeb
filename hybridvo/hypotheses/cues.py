"""Which of the strong motions is the world? A question of prior, not of consensus.

One rigid object on 60 % of the picture out-votes the world, so the share alone decides wrongly.
:class:`CueGrid` measures what tells the world from an object; :func:`default_judge` weighs it. A
judge is any callable ``(cues of each motion) -> scores``; a learned one comes in at the same place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hybridvo.geometry import rotation_angle

Judge = Callable[[Sequence[dict[str, float]]], np.ndarray]

BORDER = 0.06
"""Width of the border band, as a share of the picture's shorter side (at least one cell)."""


SMOOTH_JUMP = 0.01
"""Change of motion, rad of the picture, at which the smoothness cue has fallen to a half."""
SMALL = 0.2
"""Share of the picture up to which a motion's size says nothing against it."""
DOMINANT = 0.8
"""Share of the picture above which a motion is the world whatever its cues."""


class CueGrid:
    """What the cues of every motion of a picture share, on the (h, w) grid of the search.

    Args:
        usable: (h, w) bool, pixels with depth and flow.
        depth: (h, w) metres.
    """

    def __init__(self, usable: np.ndarray, depth: np.ndarray) -> None:
        h, w = usable.shape
        self.usable = usable.ravel()
        self.count = max(float(np.count_nonzero(usable)), 1.0)
        self.log_depth = np.log(np.where(usable, depth, 1.0)).ravel()
        self.mean_log_depth = float(self.log_depth.sum()) / self.count
        band = max(1, round(BORDER * min(h, w)))
        frame = np.ones((h, w), np.bool_)
        frame[band : h - band, band : w - band] = False
        self.border = np.flatnonzero(usable & frame)
        rows = np.minimum(np.arange(h) * 4 // h, 3)
        columns = np.minimum(np.arange(w) * 4 // w, 3)
        self.cell = (rows[:, None] * 4 + columns[None, :]).ravel()
        self.available = np.bincount(self.cell, usable.ravel(), minlength=16)

    def cues(
        self,
        support: np.ndarray,
        T_curr_prev: np.ndarray,
        T_last: np.ndarray | None,
        flow_noise: float,
    ) -> dict[str, float]:
        """Cues of one motion.

        Args:
            support: (h, w) robust weight in [0, 1] of each pixel under this motion.
            T_curr_prev: (4, 4) the motion.
            T_last: (4, 4) the last motion of the camera, or None.
            flow_noise: px, standard deviation of the flow about this motion.

        Returns:
            ``share`` of the usable pixels; ``border``, share of those in the border band;
            ``log_depth``, mean log depth of the support relative to that of all usable pixels;
            ``spread``, how evenly the support covers a 4 x 4 grid (1 = every cell);
            ``smoothness``, 1 for the same motion as the last one, towards 0 for a jump (0 where
            none is known); ``flow_noise``.
        """
        weight = np.where(self.usable, support.ravel(), 0.0)
        total = float(weight.sum())
        mass = max(total, 1e-9)
        log_depth = float(weight @ self.log_depth) / mass
        filled = np.bincount(self.cell, weight, minlength=16)
        covered = filled[self.available > 0] / self.available[self.available > 0]
        smoothness = 0.0
        if T_last is not None:
            step = T_curr_prev @ np.linalg.inv(T_last)
            shift = float(np.linalg.norm(step[:3, 3])) / float(np.exp(log_depth))
            jump = float(rotation_angle(step[:3, :3])) + shift
            smoothness = 1.0 / (1.0 + (jump / SMOOTH_JUMP) ** 2)
        return {
            "share": total / self.count,
            "border": float(weight[self.border].sum()) / max(len(self.border), 1),
            "log_depth": log_depth - self.mean_log_depth,
            "spread": float(np.minimum(covered / 0.25, 1.0).mean()) if covered.size else 0.0,
            "smoothness": smoothness,
            "flow_noise": float(flow_noise),
        }


def default_judge(motions: Sequence[dict[str, float]]) -> np.ndarray:
    """Score of each motion: who holds more of the border than of the picture is the world.

    Movers are compact and mostly inside the picture, so their share exceeds their hold of the
    border and they leave cells of the picture empty; the world is behind, reaches the border
    everywhere and is as sharply rigid as the flow allows (a compromise between two motions is not).
    A motion that holds four fifths of the picture is the world whatever its cues. The weights were
    chosen on development seeds of the synthetic world and of the benchmark's ``one60`` cell;
    figures on other seeds are in the results.
    """
    sharpest = min(max(cue["flow_noise"], 0.05) for cue in motions)
    scores = np.empty(len(motions))
    for k, cue in enumerate(motions):
        scores[k] = (
            1.2 * cue["border"]
            - 1.5 * max(cue["share"] - SMALL, 0.0)
            + 0.7 * cue["spread"]
            + 0.15 * cue["log_depth"]
            - 0.2 * np.log(max(cue["flow_noise"], 0.05) / sharpest)
            + 0.3 * cue["smoothness"]
        )
        if cue["share"] > DOMINANT:
            scores[k] += 2.0
    return scores
