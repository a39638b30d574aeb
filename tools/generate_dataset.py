"""Write rendered sequences with exact ground truth in the layout of MPI Sintel.

python tools/generate_dataset.py --out DIR --scene light --seed 0 --seed 1
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from pathlib import Path

from hybridvo.errors import HybridVOError, InputError
from hybridvo.synthetic.render import write_sintel
from hybridvo.synthetic.scenes import make_scene


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="generate_dataset.py", description=__doc__
    )
    add = parser.add_argument
    add("--out", required=True, type=Path, help="folder to write into")
    add("--scene", action="append", help="scene kind, repeatable (default: light)")
    add("--seed", action="append", type=int, help="repeatable (default: 0)")
    add(
        "--frames",
        type=int,
        default=20,
        help="of a sequence (default: %(default)s)",
    )
    add("--height", type=int, default=218, help="pixels (default: %(default)s)")
    add("--width", type=int, default=512, help="pixels (default: %(default)s)")
    add("--overwrite", action="store_true", help="replace sequences that exist")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    kinds = args.scene or ["light"]
    seeds = args.seed or [0]
    try:
        for kind, seed in itertools.product(kinds, seeds):
            print(json.dumps(generate(args, kind, seed)))
    except HybridVOError as error:
        print(f"generate_dataset.py: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def generate(args: argparse.Namespace, kind: str, seed: int) -> dict[str, object]:
    """Write one sequence, and return where it is and what it shows."""
    name = f"{kind}_{seed:04d}"
    old = list(args.out.glob(f"training/*/{name}/frame_*"))
    if old and not args.overwrite:
        raise InputError(
            f"{old[0].parent}: is not empty; add --overwrite to replace it."
        )
    scene = make_scene(
        kind, seed, height=args.height, width=args.width, frames=args.frames
    )
    for path in old:
        path.unlink()
    write_sintel(scene, args.out, name)
    fractions = [
        float((scene.object_id(i) > 0).mean()) for i in range(scene.frames - 1)
    ]
    return {
        "sequence": str(args.out / "training" / "clean" / name),
        "scene": kind,
        "seed": seed,
        "frames": scene.frames,
        "moving_share_min": round(min(fractions), 4),
        "moving_share_max": round(max(fractions), 4),
    }


if __name__ == "__main__":
    sys.exit(main())
