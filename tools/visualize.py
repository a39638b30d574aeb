"""One pair of a sequence as an estimate sees it: the paper's figures.

    python tools/visualize.py --sequence DIR --pair 12 --out pair.png

Draws the input flow, the ego flow and the object flow (input minus ego), the error of the estimated
motion, the weights of the refinement and, for each network, its uncertainty maps, its error maps
and its saliency by integrated gradients, with the share of it that falls on pixels that move by
themselves. Numbers go into a JSON file beside the image.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def build_parser() -> argparse.ArgumentParser:
    text = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="visualize.py", description=text)
    add = parser.add_argument
    add("--sequence", required=True, metavar="DIR")
    add("--pair", type=int, required=True, metavar="K", help="its first frame")
    add("--out", type=Path, required=True, metavar="FILE", help="image to write, .png")
    add("--dataset", metavar="KIND", help="kind of the sequence (default: detected)")
    add("--flow", choices=("auto", "file", "dis"), default="auto")
    add("--method", metavar="NAME", help="default: that of hybridvo run")
    own = "network of tools/train.py instead of the pretrained ones; repeatable"
    add("--weights", type=Path, action="append", default=[], metavar="FILE", help=own)
    add("--steps", type=int, default=32, help="of the integrated gradients")
    add("--overwrite", action="store_true", help="replace what is there")
    return parser


def main(argv: list[str] | None = None) -> int:
    try:
        args = build_parser().parse_args(argv)
    except SystemExit as end:
        return int(end.code or 0)
    from hybridvo.errors import HybridVOError, OutputError
    from hybridvo.evaluation.drawing import draw

    try:
        print(*draw(**vars(args)), sep="\n")
    except HybridVOError as error:
        print(f"visualize.py: {error}", file=sys.stderr)
        return 5 if isinstance(error, OutputError) else 2
    except KeyboardInterrupt:
        print("visualize.py: interrupted.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
