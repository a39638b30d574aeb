"""``hybridvo train``: PWVO and its baselines, and the selector.

    hybridvo train pwvo --config configs/train_paper.yaml --out runs/paper
    hybridvo train export --out runs/paper --export paper.safetensors
    hybridvo train selector-data --data runs/selector_data --first-seed 1000000 --seeds 4096
    hybridvo train selector-data --data runs/selector_data --recordings ../shared/data --seeds 2048
    hybridvo train selector --data runs/selector_data --out runs/selector --time-limit 50

Started again with the same ``--out`` a training goes on where it was. Seeds of selector-data below
1000 are for a folder ``DATA_held_out``; ``--propose`` asks PWVO about the samples.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

CHANGES = ("steps", "batch_size", "seed")
"""Options of a configuration that the command line changes."""


def add_train(
    train: argparse.ArgumentParser, common: argparse.ArgumentParser, call: Callable[..., Any]
) -> None:
    """Commands of ``hybridvo train`` and their options."""
    train.set_defaults(call=call)
    train.description = __doc__
    train.formatter_class = argparse.RawDescriptionHelpFormatter
    commands = train.add_subparsers(required=True, metavar="WHAT")

    def command(name: str, call: Callable[..., Any], help: str) -> Callable[..., Any]:
        made = commands.add_parser(name, help=help, parents=[common])
        made.set_defaults(train=call, workers=0, device="cpu")
        return made.add_argument

    pwvo = command("pwvo", _pwvo, "train a network of the paper")
    selector = command("selector", _selector, "train the selector")
    for add in (pwvo, selector):
        add("--out", type=Path, required=True, help="folder of the run; goes on where it was")
        add("--time-limit", type=float, default=math.inf, metavar="MIN", help="minutes in all")
        add("--threads", type=int, help="threads of torch; by default torch's own choice")
        add("--overwrite", action="store_true", help="start anew where --out has a training")
        add("--init", metavar="FILE", help="start from these weights: a file, or a pretrained name")
    pwvo("--config", type=Path, required=True, help="configs/train_*.yaml")
    pwvo("--workers", type=int, default=0, help="processes that draw samples")
    pwvo("--device", default="auto", choices=("auto", "cpu", "cuda"))
    for name in CHANGES:
        pwvo(f"--{name.replace('_', '-')}", type=int, help="instead of the configuration's")
    selector("--config", type=Path, default=Path("configs/train_selector.yaml"))
    selector("--data", type=Path, required=True, help="folder of the shards")
    export = command("export", _export, "write a network's weights for users (float16)")
    export("--out", type=Path, required=True, help="folder of the run")
    export("--export", type=Path, required=True, metavar="FILE", help="*.safetensors")
    export("--count", type=int, default=1000, help="held-out pairs of each preset")
    export("--calibrate", type=int, default=0, metavar="N", help="shift PWVO's s by N pairs")
    data = command("selector-data", _selector_data, "draw samples for the selector")
    data("--data", type=Path, required=True, help="folder of the shards")
    data("--first-seed", type=int, default=1_000_000, help="below 1000: held out")
    data("--seeds", type=int, default=0, help="about as many samples")
    recordings = "semi-real pairs of the recordings below it"
    data("--recordings", type=Path, metavar="DIR", help=recordings)
    data("--split", default="train", help="which of these recordings")
    data("--propose", metavar="NETWORK", help="ask these weights about the samples")


def train(args: argparse.Namespace, command: list[str]) -> tuple[Any, int]:
    """Run the command; what it gives, JSON-ready, and the exit code."""
    return args.train(args, shlex.join(command)), 0


def _pwvo(args: argparse.Namespace, command: str) -> dict[str, Any]:
    from hybridvo.network.models import torch_device
    from hybridvo.training.options import load_pwvo_options
    from hybridvo.training.pwvo_task import PwvoTask

    options, mixture = load_pwvo_options(args.config)
    changes = {n: getattr(args, n) for n in CHANGES if getattr(args, n) is not None}
    options = dataclasses.replace(options, **changes)
    args.device = torch_device(args.device)
    return {"updates": _train(args, command, PwvoTask(options, mixture)).step}


def _selector(args: argparse.Namespace, command: str) -> dict[str, Any]:
    from hybridvo.training.options import load_selector_options
    from hybridvo.training.selector_task import SelectorTask

    task = SelectorTask(load_selector_options(args.config), args.data)
    return {"updates": _train(args, command, task).step}


def _train(args: argparse.Namespace, command: str, task: Any) -> Any:
    import cv2
    import torch

    from hybridvo.files import write_json
    from hybridvo.network.models import load_weights
    from hybridvo.training.trainer import CHECKPOINT, LOG, RUN, Trainer, source_commit

    if args.threads is not None:
        torch.set_num_threads(max(1, args.threads))
    cv2.setNumThreads(0)  # samples are small: threads inside OpenCV cost more than they give
    args.out.mkdir(parents=True, exist_ok=True)
    if args.overwrite:
        for name in (CHECKPOINT, LOG, RUN):
            (args.out / name).unlink(missing_ok=True)
    trainer = Trainer(task, args.out, args.device, args.workers, report=_report)
    if trainer.resume():
        print(f"goes on at update {trainer.step}", file=sys.stderr)
    else:
        if args.init is not None:
            trainer.start_from(load_weights(args.init)[0].state_dict(), args.init)
        about = {"command": command, "commit": source_commit(), "torch": torch.__version__}
        write_json(args.out / RUN, about)
    for number in (signal.SIGINT, signal.SIGTERM):  # the update at hand ends, with a checkpoint
        signal.signal(number, lambda *_: setattr(trainer, "stop_requested", True))
    why = trainer.run(60 * args.time_limit)
    print(f"ended by {why} at update {trainer.step}", file=sys.stderr)
    return trainer


def _export(args: argparse.Namespace, command: str) -> dict[str, Any]:
    from hybridvo.training.trainer import export_run

    card = export_run(args.out, args.export, args.count, args.calibrate)
    return {"file": str(args.export), "held_out": card["held_out"]}


def _selector_data(args: argparse.Namespace, command: str) -> dict[str, Any]:
    from hybridvo.errors import InputError
    from hybridvo.network.models import load_weights
    from hybridvo.synthetic.semi_real import load_split
    from hybridvo.training.selector_data import PER_SHARD, write_shard

    if args.first_seed < 0 or args.seeds < 0:
        raise InputError(f"expected --first-seed and --seeds >= 0, got {args.first_seed}.")
    args.data.mkdir(parents=True, exist_ok=True)
    recordings = () if args.recordings is None else load_split(args.recordings, args.split)
    network = None if args.propose is None else load_weights(args.propose)[0]
    total = 0
    for seed in range(args.first_seed, args.first_seed + args.seeds, PER_SHARD):
        total += write_shard(args.data, seed, recordings=recordings, network=network)
        print(f"seeds to {seed + PER_SHARD}: {total} samples", file=sys.stderr, flush=True)
    return {"samples": total}


def _report(entry: dict[str, Any]) -> None:
    """One line a log entry on stderr."""
    numbers = {k: v for k, v in entry.items() if isinstance(v, int | float)}
    line = " ".join(f"{key}={value:.5g}" for key, value in numbers.items())
    print(line, entry.get("results", ""), file=sys.stderr)
