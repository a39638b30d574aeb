"""What the pictures said over a sequence: systematic disagreement, in words, and trust in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.refinement.photometric_options import PolishReport
from hybridvo.refinement.registration import LARGEST_PX, OffsetCost, depth_offset_cost
from hybridvo.types import FramePair, RelativePose

__all__ = ["PhotometricMonitor"]

LEAST_PAIRS = 8
"""Before so many pairs nothing is said to be systematic."""
CHECK_EVERY = 10
"""Registration is looked at on every so many pairs; it costs as much as the polish."""
LEAST_CHECKS = 3
LEAST_OFFSET_PX = 1.0
LEAST_OFFSET_GAIN = 0.02
"""An offset counts from here on. Occlusion alone gives up to 0.7 px in registered worlds, with a
fall of the cost per pixel of up to 0.007; shifts of (-1, 2) and 4 px gave 0.014 to 0.19."""
LEAST_STEP = 0.15
"""Change of the gain between two pictures that is called a step of the exposure."""
REFUSED = ("no_match", "outside_flow", "higher_cost", "not_finite")
"""Reasons that speak against the pictures, not for want of them."""
MANY = 0.5
RARE = 0.1
LEAST_TRUST = 0.05


class PhotometricMonitor:
    """Watches the polish over the pairs of one sequence; constant memory.

    Hand every motion to :meth:`update`, and :attr:`trust` to the next polish.

    Args:
        window: pairs after which a pair counts 1 / e of a new one.

    Raises:
        InputError: a window shorter than the number of pairs that a judgement needs.
    """

    def __init__(self, window: int = 50) -> None:
        if window < LEAST_PAIRS:
            raise InputError(
                f"PhotometricMonitor.window: expected at least {LEAST_PAIRS}, got {window!r}."
            )
        self._keep = 1.0 - 1.0 / window
        self._keep_check = self._keep**CHECK_EVERY
        self._pairs, self._checks = 0, 0
        self._weight, self._refused, self._steps = 0.0, 0.0, 0.0
        self._offset = OffsetCost.nothing()

    def state(self) -> dict[str, Any]:
        """What :meth:`restore` needs to go on, JSON-ready."""
        return {
            "counts": [self._pairs, self._checks],
            "sums": [self._weight, self._refused, self._steps],
            "offset": self._offset.cost.ravel().tolist() if self._checks else [],
            "offset_pixels": self._offset.pixels,
        }

    def restore(self, state: Mapping[str, Any] | None) -> None:
        """Go on where another monitor stopped; None: from the beginning."""
        fresh = state is None or not state["counts"][1]
        self._pairs, self._checks = (0, 0) if state is None else state["counts"]
        self._weight, self._refused, self._steps = (0.0,) * 3 if state is None else state["sums"]
        self._offset = OffsetCost.nothing()
        if state is not None and not fresh:
            cost = np.array(state["offset"]).reshape(self._offset.cost.shape)
            self._offset = OffsetCost(cost, state["offset_pixels"])

    def update(self, pair: FramePair, motion: RelativePose) -> None:
        """Take note of one pair and what the polish made of it."""
        report = motion.polish
        if not isinstance(report, PolishReport) or report.reason in ("no_images", "no_estimate"):
            return
        step = abs(np.log(max(report.gain, 1e-6))) > LEAST_STEP
        self._weight = self._keep * self._weight + 1.0
        self._refused = self._keep * self._refused + float(report.reason in REFUSED)
        self._steps = self._keep * self._steps + float(step)
        if report.taken and self._pairs % CHECK_EVERY == 0:
            cost = depth_offset_cost(pair, motion)
            if cost.pixels:
                kept = OffsetCost(
                    self._keep_check * self._offset.cost, self._keep_check * self._offset.pixels
                )
                self._offset = kept + cost
                self._checks += 1
        self._pairs += 1

    @property
    def refused_share(self) -> float:
        """Share of the last pairs in which the guard refused the pictures."""
        return self._refused / self._weight if self._pairs >= LEAST_PAIRS else 0.0

    @property
    def depth_offset_px(self) -> np.ndarray | None:
        """(2,) right, down: the depth map against the picture; None where none is evident."""
        if self._checks < LEAST_CHECKS or self._offset.gain < LEAST_OFFSET_GAIN:
            return None
        offset = self._offset.offset_px
        return offset if np.linalg.norm(offset) >= LEAST_OFFSET_PX else None

    @property
    def trust(self) -> float:
        """Factor in (0, 1] on the information of the pictures of the next pair."""
        trust = 1.0
        offset = self.depth_offset_px
        if offset is not None:
            trust /= 1.0 + float(offset @ offset)
        if self.refused_share > MANY:
            trust *= 1.0 - self.refused_share
        return max(trust, LEAST_TRUST)

    @property
    def message(self) -> str:
        """What disagrees, for people; empty where nothing does."""
        parts = []
        offset = self.depth_offset_px
        if offset is not None:
            parts.append(
                f"the images disagree with depth by {_in_words(offset)}: colour and depth look "
                f"unregistered"
            )
        if self.refused_share > MANY:
            parts.append(
                f"the images did not confirm the motion in {100 * self.refused_share:.0f} % of the "
                f"pairs: look for rolling shutter, colour and depth of different times, or wrong "
                f"intrinsics"
            )
        stepped = self._steps / self._weight if self._pairs >= LEAST_PAIRS else 0.0
        if stepped > RARE:
            parts.append(f"the exposure changed by over 15 % in {100 * stepped:.0f} % of the pairs")
        return "; ".join(parts)


def _in_words(offset: np.ndarray) -> str:
    """``1.4 px to the left``, ``2.0 px to the right and 1.1 px down``."""
    parts = []
    for value, less, more in zip(
        offset, ("to the left", "up"), ("to the right", "down"), strict=True
    ):
        if abs(value) >= 0.5 * LEAST_OFFSET_PX:
            most = "at least " if abs(value) >= LARGEST_PX else ""
            parts.append(f"{most}{abs(value):.1f} px {less if value < 0 else more}")
    return " and ".join(parts)
