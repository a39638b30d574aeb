"""``hybridvo show``: the maps of one pair of a sequence in one picture."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from hybridvo.visualization import PictureOptions, visualize


def show(sequence: Any, args: argparse.Namespace) -> list[str]:
    """Draw flow factors, uncertainty and saliency of a pair; paths of what was written."""
    options = PictureOptions(
        sequence=os.fspath(sequence.root),
        pair=args.pair,
        dataset=args.dataset,
        flow=args.flow,
        method=args.method,
        weights=tuple(Path(name) for name in args.weights),
        out=Path(args.out),
        overwrite=args.overwrite,
    )
    return [os.fspath(path) for path in visualize(options, ["hybridvo", "show"])]
