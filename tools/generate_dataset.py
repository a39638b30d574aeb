"""Write rendered sequences with exact ground truth in the layout of MPI Sintel.

python tools/generate_dataset.py --out DIR --scene light --seed 0 --seed 1
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="generate_dataset.py", description=__doc__)
    add = parser.add_argument
    add("--out", required=True, type=Path, help="folder to write into")
    add("--scene", action="append", help="scene kind, repeatable (default: light)")
    add("--seed", action="append", type=int, help="repeatable (default: 0)")
    add("--frames", type=int, default=20, help="of a sequence (default: %(default)s)")
    add("--height", type=int, default=218, help="pixels (default: %(default)s)")
    add("--width", type=int, default=512, help="pixels (default: %(default)s)")
    add("--noise", type=float, default=0.0, help="sensor noise, grey levels")
    add("--zoom", type=float, default=0.0, help="relative change of focal length")
    add("--overwrite", action="store_true", help="replace sequences that exist")
    return parser


def main(argv: list[str] | None = None) -> int:
    options = build_parser().parse_args(argv)
    from hybridvo.errors import HybridVOError

    try:
        for summary in generate(options):
            print(json.dumps(summary))
    except HybridVOError as error:
        print(f"generate_dataset.py: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def generate(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One summary per sequence, after writing it."""
    from hybridvo.errors import InputError
    from hybridvo.synthetic.render import write_sintel
    from hybridvo.synthetic.scenes import make_scene

    names = ("height", "width", "frames", "zoom", "noise")
    settings = {name: getattr(options, name) for name in names}
    jobs = [
        (kind, seed, f"{kind}_{seed:04d}")
        for kind in options.scene or ["light"]
        for seed in options.seed or [0]
    ]
    old = [p for *_, name in jobs for p in options.out.glob(f"training/*/{name}/frame_*")]
    if old and not options.overwrite:
        raise InputError(f"{old[0].parent}: is not empty; add --overwrite to replace it.")
    for kind, seed, name in jobs:
        scene = make_scene(kind, seed, **settings)
        for path in options.out.glob(f"training/*/{name}/frame_*"):
            path.unlink()
        print(f"{name}: {scene.frames} frames", file=sys.stderr)
        write_sintel(scene, options.out, name)
        shares = [float((scene.object_id(i) > 0).mean()) for i in range(scene.frames - 1)]
        yield {
            "sequence": str(options.out / "training" / "clean" / name),
            "scene": kind,
            "seed": seed,
            "frames": scene.frames,
            "moving_share_min": round(min(shares), 4),
            "moving_share_max": round(max(shares), 4),
        }


if __name__ == "__main__":
    sys.exit(main())
