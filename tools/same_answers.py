"""Whether two trees of the project give the same answers, to the bit.

    python tools/same_answers.py BEFORE                  # a commit, against the files here
    python tools/same_answers.py BEFORE --only corridor,fr1_rpy

Each tree is imported in a process of its own. A recording is tracked from its first frame; pose,
motion, covariance, status, probability and edge of every step are compared. A recording that is
not the same is named with its first step that differs; the exit code is 1 then. A change that
restructures must print "the same" everywhere. Figures of different machines do not compare: other
kernels, other rounding. It takes three minutes, and one more for a commit that it has not seen.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
TREES = ROOT / "runs" / "trees"
"""Where commits are checked out; their kernels are compiled once."""


class Recording(NamedTuple):
    """What is tracked of a folder of ``--data``."""

    folder: str
    frames: int
    method: str = "hybrid"


RECORDINGS = {
    "corridor": Recording("tripod/corridor", 16),
    "fruit": Recording("tripod/fruit", 12),
    "fr1_rpy": Recording("tum/rgbd_dataset_freiburg1_rpy_100", 30),
    "rooms": Recording("real_static/rooms_110", 14),
    "d435_quiet": Recording("devices/d435_quiet", 16),
    "d435_fast": Recording("devices/d435_fast", 30),
    "xtion_hands": Recording("devices/xtion_hands", 14),
    "kitchen_big": Recording("semi_real_clips/kitchen_big", 9),
    "kitchen_crowd": Recording("semi_real_clips/kitchen_crowd", 9),
    "box_crowd": Recording("semi_real_clips/box_crowd", 6),
    "kitti02": Recording("real_dynamic/kitti02_stereo", 4),
    "box_big_flow": Recording("semi_real_clips/box_big", 5, "hybrid-flow"),
    "kitchen_wave": Recording("semi_real_clips/kitchen_wave", 5, "classical"),
    "box_behind": Recording("semi_real_clips/box_behind", 4, "pwvo-refine"),
}


def main(argv: list[str] | None = None) -> int:
    """Compare; 1 where something differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    add = parser.add_argument
    add("before", help="a commit")
    add("--data", type=Path, default=ROOT.parent / "shared" / "data", metavar="DIR")
    add("--only", metavar="NAME,NAME", help=f"of {', '.join(RECORDINGS)}")
    add("--answers-of", type=Path, metavar="TREE", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    names = args.only.split(",") if args.only else list(RECORDINGS)
    if args.answers_of:
        print(json.dumps(answers(args.data, names)))
        return 0
    before = answers_of(checked_out(args.before), args)
    after = answers_of(ROOT, args)
    lines = [compared(name, before[name], after[name]) for name in names]
    print("\n".join(lines))
    return int(any("differ" in line for line in lines))


def checked_out(commit: str) -> Path:
    """The folder of a commit."""

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", *words], cwd=ROOT, check=True, text=True, stdout=subprocess.PIPE
        )
        return done.stdout.strip()

    tree = TREES / git("rev-parse", "--verify", "--short", f"{commit}^{{commit}}")
    if not tree.exists():
        git("worktree", "prune")
        git("worktree", "add", "--detach", "--quiet", str(tree), commit)
    return tree


def answers_of(tree: Path, args: argparse.Namespace) -> dict[str, Any]:
    """The answers by the package of a tree."""
    words = [
        args.before,
        "--data",
        str(args.data.resolve()),
        "--answers-of",
        str(tree),
    ]
    if args.only:
        words += ["--only", args.only]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(tree)}
    # a kernel rounds otherwise in the process that has compiled it than where it was read
    compile_all = [sys.executable, "-m", "hybridvo.compiled"]
    subprocess.run(compile_all, cwd=tree, env=environment, check=True)
    done = subprocess.run(
        [sys.executable, __file__, *words],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    if done.returncode:
        sys.exit(f"same_answers.py: {tree} gave no answers, see above")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def answers(data: Path, names: list[str]) -> dict[str, Any]:
    """The steps of every recording, by the package that this process imports."""
    import cv2
    import numpy as np

    import hybridvo

    # the flow depends on how many threads compute it
    cv2.setNumThreads(1)
    found = {}
    for name in names:
        recording = RECORDINGS[name]
        sequence = hybridvo.open_sequence(data / recording.folder)
        tracker = hybridvo.Odometry(method=recording.method)
        steps = []
        for index in range(min(recording.frames, len(sequence))):
            step = tracker.track(sequence[index])
            numbers = [step.T_world_cam, step.motion.T_curr_prev, step.covariance]
            if step.edge is not None:
                numbers += [step.edge.T_curr_start, step.edge.covariance]
            digest = hashlib.sha256()
            for each in numbers:
                digest.update(np.ascontiguousarray(each, np.float64).tobytes())
            # the wording of a message may change
            status = (step.status.state.value, step.status.reason.value)
            stated = (*status, step.motion.probability, step.prev_index)
            digest.update(repr(stated).encode())
            steps.append(
                {
                    "hash": digest.hexdigest(),
                    "T": np.asarray(step.T_world_cam).ravel().tolist(),
                    "status": "/".join(status),
                    "p": float(step.motion.probability),
                }
            )
        found[name] = steps
        print(f"{name} tracked", file=sys.stderr, flush=True)
    return found


def compared(name: str, before: list[Any], after: list[Any]) -> str:
    """One line on a recording."""
    pairs = list(zip(before, after, strict=True))
    different = [
        index for index, (a, b) in enumerate(pairs) if a["hash"] != b["hash"]
    ]
    if not different:
        return f"{name}: {len(pairs)} steps, the same"
    first = different[0]
    a, b = pairs[first]
    apart = max(abs(x - y) for x, y in zip(a["T"], b["T"], strict=True))
    return (
        f"{name}: {len(different)} of {len(pairs)} steps differ, first {first}: pose by "
        f"{apart:.2g}, {a['status']} p {a['p']:.4f} -> {b['status']} p {b['p']:.4f}"
    )


if __name__ == "__main__":
    sys.exit(main())
