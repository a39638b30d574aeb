"""Options of the refinement."""

from __future__ import annotations

from dataclasses import dataclass

from hybridvo.errors import InputError


@dataclass(frozen=True)
class RefinementOptions:
    """Options of :func:`refine`.

    Args:
        cutoff: c of the Geman-McClure kernel, in standard deviations. The influence of a pixel
            falls from c / sqrt(3), 1.7 standard deviations, on.
        search_pixels: pixels of the grid on which starts are made and scored.
        coarse_pixels: pixels of the grid on which motions are fitted before the full one.
        full_steps: most Newton steps on the full grid (0: the coarse result stands).
        decisive_share: share of the usable pixels above which the first motion stands alone.
        least_share: smallest share of a further motion.
        hypotheses: largest number of motions.
        minimum_pixels: fewer usable pixels are a failure.
        second_depth: use the current frame's depth as a third residual: ``on``, ``off``, or
            ``auto``, where it adds more than half of what the flow knows in some direction.
        tiles: about how many tiles (of 8 to 64 px) the picture is cut into for the sandwich
            covariance; errors may be correlated over two of them, and beyond where it shows.
    """

    cutoff: float = 3.0
    search_pixels: int = 1800
    coarse_pixels: int = 7500
    full_steps: int = 4
    decisive_share: float = 0.85
    least_share: float = 0.08
    hypotheses: int = 5
    minimum_pixels: int = 24
    second_depth: str = "auto"
    tiles: int = 110

    def __post_init__(self) -> None:
        for name in ("cutoff", "search_pixels", "coarse_pixels", "minimum_pixels", "tiles"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(
                    f"RefinementOptions.{name}: expected a positive, finite number, "
                    f"got {getattr(self, name)!r}."
                )
        if self.second_depth not in ("auto", "on", "off"):
            raise InputError(
                f"RefinementOptions.second_depth: expected auto, on or off, "
                f"got {self.second_depth!r}."
            )
        if not 1 <= self.hypotheses <= 16:
            raise InputError(
                f"RefinementOptions.hypotheses: expected 1 to 16, got {self.hypotheses}."
            )
