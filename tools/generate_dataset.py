"""Write rendered sequences with exact ground truth in the layout of a public data set.

python tools/generate_dataset.py --out DIR --scene light --seed 0 --seed 1
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

SINTEL_FOLDERS = ("clean", "flow", "depth", "camdata_left", "occlusions", "invalid", "moving")


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="generate_dataset.py", description=__doc__)
    parser.add_argument("--out", required=True, type=Path, help="folder to write into")
    parser.add_argument("--format", choices=["sintel"], default="sintel", help="file layout")
    parser.add_argument(
        "--scene", action="append", help="scene kind, repeatable (default: light); see README"
    )
    parser.add_argument("--seed", action="append", type=int, help="repeatable (default: 0)")
    parser.add_argument("--frames", type=int, help="frames per sequence (default: 20, pair 2)")
    parser.add_argument("--height", type=int, default=218, help="pixels (default: %(default)s)")
    parser.add_argument("--width", type=int, default=512, help="pixels (default: %(default)s)")
    parser.add_argument("--moving", type=float, help="median share of moving pixels (default: own)")
    parser.add_argument("--noise", type=float, default=0.0, help="sensor noise, grey levels")
    parser.add_argument("--zoom", type=float, default=0.0, help="relative change of focal length")
    parser.add_argument("--overwrite", action="store_true", help="replace sequences that exist")
    return parser


def main(argv: list[str] | None = None) -> int:
    options = build_parser().parse_args(argv)

    from hybridvo.errors import InputError, OutputError

    try:
        for summary in generate(options):
            print(json.dumps(summary))
    except InputError as error:
        print(f"generate_dataset.py: {error}", file=sys.stderr)
        return 2
    except OutputError as error:
        print(f"generate_dataset.py: {error}", file=sys.stderr)
        return 5
    except KeyboardInterrupt:
        print("generate_dataset.py: interrupted; the last sequence is incomplete", file=sys.stderr)
        return 130
    return 0


def generate(options: argparse.Namespace):
    """Yields one summary per sequence, after writing it."""
    from hybridvo.synthetic.render import make_scene, write_sintel

    settings = {
        key: getattr(options, key)
        for key in ("height", "width", "frames", "moving", "zoom", "noise")
    }
    jobs = [
        (kind, seed, f"{kind}_{seed:04d}")
        for kind in options.scene or ["light"]
        for seed in options.seed or [0]
    ]
    for _, _, name in jobs:
        check_free(options.out, name, options.overwrite)
    for kind, seed, name in jobs:
        scene = make_scene(kind, seed, **settings)
        if options.overwrite:
            remove_frames(options.out, name)
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


def sequence_folders(out: Path, name: str) -> list[Path]:
    return [out / "training" / part / name for part in SINTEL_FOLDERS]


def check_free(out: Path, name: str, overwrite: bool) -> None:
    from hybridvo.errors import InputError

    for folder in sequence_folders(out, name):
        if not overwrite and folder.exists() and any(folder.iterdir()):
            raise InputError(f"{folder}: exists and is not empty; add --overwrite to replace it.")


def remove_frames(out: Path, name: str) -> None:
    """Removes the frames of an older, maybe longer, sequence; nothing else in the folders."""
    for folder in sequence_folders(out, name):
        for path in folder.glob("frame_[0-9][0-9][0-9][0-9].*"):
            path.unlink()


if __name__ == "__main__":
    sys.exit(main())
