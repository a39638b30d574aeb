"""``hybridvo show``: the maps of one pair of a sequence in one image."""

from __future__ import annotations

import argparse
import os

from hybridvo.evaluation.drawing import draw


def show(args: argparse.Namespace) -> list[str]:
    """Draw flow factors, uncertainty and saliency of a pair; paths of what was written."""
    written = draw(
        args.path or args.sequence,
        args.pair,
        args.out,
        dataset=args.dataset,
        flow=args.flow,
        method=args.method,
        weights=args.weights,
        steps=args.steps,
        overwrite=args.overwrite,
    )
    return [os.fspath(path) for path in written]
