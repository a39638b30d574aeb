"""One pair of a sequence as an estimate sees it: the paper's figures.

    python tools/visualize.py --sequence DIR --pair 12 --out pair.png
    python tools/visualize.py --sequence DIR --pair 12 --weights pwvo.safetensors --into runs/cmp

Draws the input flow, the ego flow and the object flow (input minus ego), the error of the estimated
motion, the weights of the refinement and, for each network, its uncertainty maps (rotation and
translation), its error maps, and its saliency by integrated gradients, with the share of it that
falls on pixels that move by themselves. Without ``--weights`` the shipped networks are looked at.
``--into`` adds the picture to the report of a comparison. Numbers go into a JSON file beside it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="visualize.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--sequence", required=True, metavar="DIR")
    parser.add_argument("--pair", type=int, required=True, metavar="K", help="its first frame")
    parser.add_argument(
        "--dataset", metavar="KIND", help="kind of the sequence (default: detected)"
    )
    parser.add_argument("--flow", choices=("auto", "file", "dis"), default="auto")
    parser.add_argument("--method", metavar="NAME", help="default: that of hybridvo run")
    parser.add_argument(
        "--weights",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="network of tools/train.py; may be repeated",
    )
    parser.add_argument("--steps", type=int, default=32, help="of the integrated gradients")
    parser.add_argument("--seed", type=int, default=0)
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("--out", type=Path, metavar="FILE", help="picture to write, .png")
    target.add_argument("--into", type=Path, metavar="DIR", help="folder of a comparison")
    parser.add_argument("--overwrite", action="store_true", help="replace what is there")
    return parser


def main(argv: list[str] | None = None) -> int:
    try:
        args = build_parser().parse_args(argv)
    except SystemExit as end:
        return int(end.code or 0)
    from hybridvo.errors import HybridVOError, OutputError
    from hybridvo.visualization import PictureOptions, visualize

    given = sys.argv[1:] if argv is None else argv
    try:
        options = PictureOptions(**{**vars(args), "weights": tuple(args.weights)})
        for path in visualize(options, ["tools/visualize.py", *given]):
            print(path)
    except HybridVOError as error:
        print(f"visualize.py: {error}", file=sys.stderr)
        return 5 if isinstance(error, OutputError) else 2
    except KeyboardInterrupt:
        print("visualize.py: interrupted.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
