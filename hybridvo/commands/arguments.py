"""Arguments of the commands. Loads nothing heavy: ``--help`` must be instant."""

from __future__ import annotations

import argparse
from typing import Any

METHODS = (
    *("hybrid", "hybrid-flow", "refine", "pwvo-refine"),
    *("pwvo", "pwvo-paper", "pwvo-uncertain", "pwvo-naive", "pixelwise"),
    *("vonet", "vonet-attention", "pnp-ransac", "pnp-ransac-tuned", "usac-magsac", "poselib"),
    *("opencv-rgbd", "open3d-rgbd", "identity"),
)
"""For the help alone, which must not load what the methods need."""
KINDS = ("sintel", "tartanair", "7scenes", "folder", "kitti", "tum")


def common() -> argparse.ArgumentParser:
    """Options of every command."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    loudness = common.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", action="store_true", help="more, and tracebacks")
    loudness.add_argument("-q", "--quiet", action="store_true", help="errors only")
    return common


def input(required: bool = True) -> argparse.ArgumentParser:
    """Which sequence, and what its folder does not say."""
    given = argparse.ArgumentParser(add_help=False)
    where = given.add_mutually_exclusive_group(required=required)
    where.add_argument("path", nargs="?", metavar="DIR", help="folder of the sequence")
    where.add_argument("--sequence", metavar="DIR", help="the same, by name")
    given.add_argument(
        "--dataset", metavar="KIND", help=f"one of {', '.join(KINDS)} (default: detected)"
    )
    given.add_argument(
        "--camera", metavar="FILE|fx,fy,cx,cy", help="camera.yaml, ROS camera_info, or numbers"
    )
    given.add_argument(
        "--depth-scale", type=float, metavar="N", help="depth units per metre, 1000: millimetres"
    )
    given.add_argument("--mask", metavar="DIR", help="images that are 0 where pixels do not count")
    return given


def add_run(run: argparse.ArgumentParser) -> None:
    """Options of ``hybridvo run``."""
    run.add_argument("--out", metavar="DIR", help="output folder (default: runs/NAME)")
    run.add_argument(
        "--method", metavar="NAME", help=f"one of {', '.join(METHODS)} (default: hybrid)"
    )
    run.add_argument(
        "--flow", metavar="WHAT", help="auto, file or dis (default: files where there are, or dis)"
    )
    run.add_argument("--start", type=int, metavar="N", help="first frame (default 0)")
    run.add_argument("--stop", type=int, metavar="N", help="the one after the last frame")
    run.add_argument("--stride", type=int, metavar="N", help="step between frames (default 1)")
    run.add_argument(
        "--weights",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="network weights instead of the pretrained ones, as in pwvo=mine.safetensors",
    )
    run.add_argument("--device", metavar="NAME", help="auto (default), cpu or cuda")
    run.add_argument("--config", metavar="FILE", help="YAML file of options")
    run.add_argument(
        "--set",
        action=_KeysInHelp,
        default=[],
        dest="assignments",
        metavar="KEY=VALUE",
        help="one option, as in refine.cutoff=2.5; may be repeated; --set help lists the keys",
    )
    exists = run.add_mutually_exclusive_group()
    exists.add_argument("--resume", action="store_true", help="go on with a run that was cut off")
    exists.add_argument("--overwrite", action="store_true", help="replace the results in --out")
    run.add_argument(
        "--max-failed", type=float, metavar="X", help="fraction of failed motions (default 0.2)"
    )
    run.add_argument(
        "--strict", action="store_true", default=None, help="a broken frame ends the run"
    )
    run.add_argument(
        "--rrd",
        nargs="?",
        const="",
        metavar="FILE",
        help="write a Rerun recording (extra 'viz'; default: recording.rrd in the output folder)",
    )


class _KeysInHelp(argparse.Action):
    """Collects assignments; ``--set help`` prints every key with its default."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        if values == "help":
            from hybridvo.commands.configuration import option_defaults

            print("\n".join(f"{key}={value}" for key, value in option_defaults().items()))
            parser.exit()
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), values])


def add_compare(compare: argparse.ArgumentParser) -> None:
    """Options of ``hybridvo compare``."""
    add = compare.add_argument
    many = "sequences, or folders of sequences (MPI Sintel as it was unpacked)"
    add("paths", nargs="*", metavar="DIR", help=many)
    named = "the same, by name; repeatable"
    add("--sequence", action="extend", nargs="+", default=[], metavar="DIR", help=named)
    add("--out", default="runs/compare", metavar="DIR", help="default: runs/compare")
    add("--methods", default="all", help="comma-separated; default: all that run here")
    flow = "auto: the sequence's flow files and DIS, side by side"
    add("--flow", choices=("auto", "file", "dis"), default="auto", help=flow)
    add("--dataset", help="kind of the sequences (default: detected)")
    add("--start", type=int, default=0)
    add("--stop", type=int)
    add("--stride", type=int, default=1)
    add("--seed", type=int, default=0)
    add("--device", choices=("auto", "cpu", "cuda"), default="auto")
    own = "network weights instead of the pretrained ones; repeatable"
    add("--weights", action="append", default=[], metavar="NAME=FILE", help=own)
    paper = "MPI Sintel as others score it: PWVO's 992 pairs, or fourteen trajectories"
    add("--protocol", choices=("paper", "trajectory14"), help=paper)
    add("--worst", type=int, default=3, help="worst pairs shown for each method")
    add("--jobs", type=int, default=1, metavar="N", help="sequences at a time, a process each")
    exists = compare.add_mutually_exclusive_group()
    exists.add_argument("--resume", action="store_true", help="keep the finished sequences")
    exists.add_argument("--overwrite", action="store_true", help="replace results in --out")


def add_show(show: argparse.ArgumentParser) -> None:
    """Options of ``hybridvo show``."""
    show.add_argument("--pair", type=int, default=0, metavar="N", help="first frame (default 0)")
    show.add_argument("--out", default="pair.png", metavar="FILE", help="default: pair.png")
    show.add_argument("--method", metavar="NAME", help="estimator (default: hybrid)")
    show.add_argument("--flow", choices=("auto", "file", "dis"), default="auto")
    show.add_argument("--weights", action="append", default=[], metavar="FILE", help="a network")
    show.add_argument("--steps", type=int, default=32, help="of the integrated gradients")
    show.add_argument("--overwrite", action="store_true", help="replace the image")


def add_evaluate(evaluate: argparse.ArgumentParser) -> None:
    """Options of ``hybridvo evaluate``."""
    evaluate.add_argument("estimate", metavar="EST", help="estimated trajectory")
    evaluate.add_argument("gt", metavar="GT", help="true trajectory")
    evaluate.add_argument(
        "--alignment", choices=("se3", "sim3", "origin", "none"), default="se3", help="of the ATE"
    )
    evaluate.add_argument(
        "--delta", type=float, default=1, metavar="X", help="span of the RPE (default 1)"
    )
    evaluate.add_argument(
        "--delta-unit", choices=("frames", "s"), default="frames", help="unit of --delta"
    )
    evaluate.add_argument("--max-diff", type=float, metavar="S", help="seconds between matches")
    formats = ("auto", "tum", "kitti", "tartanair")
    for name in ("est", "gt"):
        evaluate.add_argument(f"--format-{name}", choices=formats, default="auto")
        evaluate.add_argument(f"--axes-{name}", choices=("auto", "camera", "ned"), default="auto")
