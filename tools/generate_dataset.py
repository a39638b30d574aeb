"""Write rendered sequences with exact ground truth in the layout of MPI Sintel.

python tools/generate_dataset.py --out DIR --scene light --seed 0 --seed 1
python tools/generate_dataset.py --out DIR --scene heavy_two --seeds 0 10000 --jobs 16 --resume

A line of JSON is printed for each sequence as it is finished; it is also kept in finished/,
by which a run that was stopped goes on.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from measuring import add_workers, workers_of

from hybridvo.core.errors import HybridVOError, InputError
from hybridvo.core.files import make_folder, read_text, write_json
from hybridvo_lab.synthetic.render import write_sintel
from hybridvo_lab.synthetic.scenes import make_scene


class Wanted(NamedTuple):
    """A sequence to write."""

    kind: str  # of scene
    seed: int
    frames: int
    height: int
    width: int

    @property
    def name(self) -> str:
        """The name of its folders."""
        return f"{self.kind}_{self.seed:04d}"


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="generate_dataset.py", description=__doc__
    )
    add = parser.add_argument
    add("--out", required=True, type=Path, help="folder to write into")
    add("--scene", action="append", help="scene kind, repeatable (default: light)")
    add("--seed", action="append", type=int, help="repeatable (default: 0)")
    add(
        "--seeds",
        type=int,
        nargs=2,
        metavar=("FIRST", "COUNT"),
        help="further seeds: COUNT from FIRST on",
    )
    add(
        "--frames",
        type=int,
        default=20,
        help="of a sequence (default: %(default)s)",
    )
    add("--height", type=int, default=218, help="pixels (default: %(default)s)")
    add("--width", type=int, default=512, help="pixels (default: %(default)s)")
    add("--overwrite", action="store_true", help="replace sequences that exist")
    add("--resume", action="store_true", help="keep sequences that are finished")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    try:
        wanted = wanted_sequences(args)
        if not args.resume and not args.overwrite:
            refuse_existing(args.out, wanted)
        workers = workers_of(args)
        work = partial(generate, args.out.absolute(), args.resume)
        for done in workers.each(work, wanted):
            if done.lost:
                print(f"{wanted[done.number].name}: {done.lost}", file=sys.stderr)
                return 1
            print(json.dumps(done.result), flush=True)
    except HybridVOError as error:
        print(f"generate_dataset.py: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def wanted_sequences(args: argparse.Namespace) -> list[Wanted]:
    """The sequences that the arguments name, each once."""
    seeds = list(args.seed or [])
    if args.seeds is not None:
        first, count = args.seeds
        seeds += range(first, first + count)
    pairs = itertools.product(args.scene or ["light"], seeds or [0])
    return [
        Wanted(kind, seed, args.frames, args.height, args.width)
        for kind, seed in dict.fromkeys(pairs)
    ]


def frames_of(out: Path, name: str) -> list[Path]:
    """The files of a sequence that are there."""
    return list(out.glob(f"training/*/{name}/frame_*"))


def refuse_existing(out: Path, wanted: list[Wanted]) -> None:
    """Raise an InputError where a sequence is there already."""
    for sequence in wanted:
        old = frames_of(out, sequence.name)
        if old:
            raise InputError(
                f"{old[0].parent}: is not empty; add --overwrite to replace it, or --resume."
            )


def generate(out: Path, resume: bool, wanted: Wanted) -> dict[str, Any]:
    """Write one sequence, and return where it is and what it shows."""
    report = out / "finished" / f"{wanted.name}.json"
    size = {"height": wanted.height, "width": wanted.width}
    if resume and report.exists():
        row = json.loads(read_text(report))
        if row["frames"] == wanted.frames and size.items() <= row.items():
            return row
    scene = make_scene(wanted.kind, wanted.seed, **size, frames=wanted.frames)
    if report.exists():
        report.unlink()
    for path in frames_of(out, wanted.name):
        path.unlink()
    write_sintel(scene, out, wanted.name)
    fractions = [
        float((scene.object_id(i) > 0).mean()) for i in range(scene.frames - 1)
    ]
    row = {
        "sequence": str(out / "training" / "clean" / wanted.name),
        "scene": wanted.kind,
        "seed": wanted.seed,
        "frames": scene.frames,
        **size,
        "moving_share_min": round(min(fractions), 4),
        "moving_share_max": round(max(fractions), 4),
    }
    make_folder(report.parent)
    write_json(report, row)
    return row


if __name__ == "__main__":
    sys.exit(main())
