"""Train a network: ``python tools/train.py --config configs/train_pwvo.yaml --out runs/pwvo``.

Started again with the same ``--out`` it goes on where it was. Several processes or machines:
``torchrun --nproc-per-node 8 tools/train.py ...``. Writes ``checkpoint.pt``, ``log.jsonl`` and
``options.json`` into the folder; ``--export FILE`` writes weights that users load.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

RECORD = "options.json"
"""Says what the training in a folder is."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns its exit code (2: bad input, 5: output that cannot be written)."""
    arguments = _parse(argv)
    from hybridvo.errors import HybridVOError, OutputError

    try:
        with _processes():
            return _train(arguments, list(sys.argv[1:] if argv is None else argv))
    except OutputError as error:
        sys.stderr.write(f"train: {error}\n")
        return 5
    except HybridVOError as error:
        sys.stderr.write(f"train: {error}\n")
        return 2


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="train.py", description="Train a network of hybridvo.")
    add = parser.add_argument
    add("--config", type=Path, required=True, help="configs/train_*.yaml")
    add("--out", type=Path, required=True, help="folder of the run; resumed if it has a checkpoint")
    add("--time-limit", type=float, metavar="MIN", help="minutes of training; ends cleanly")
    add("--steps", type=int, help="updates, instead of the configuration's")
    add("--batch-size", type=int, help="samples an update and process, instead of the file's")
    add("--learning-rate", type=float, help="peak rate, instead of the configuration's")
    add("--precision", choices=("float32", "bfloat16"), help="instead of the configuration's")
    add("--seed", type=int, help="instead of the configuration's")
    add("--threads", type=int, help="threads of torch; by default torch's own choice")
    add("--workers", type=int, default=0, help="processes that draw samples (0: this one)")
    add("--device", default="auto", help="auto, cpu or cuda")
    add("--init", type=Path, metavar="FILE", help="start from these weights: a file, or pwvo")
    add("--overwrite", action="store_true", help="start anew where --out has a training")
    add("--export", type=Path, metavar="FILE", help="write weights for users when done (float16)")
    add("--calibrate", type=int, default=0, metavar="N", help="shift s by N development pairs")
    add("--export-count", type=int, default=1000, help="held-out pairs of each preset in the card")
    add("--no-train", action="store_true", help="only --export from the checkpoint in --out")
    return parser.parse_args(argv)


@contextlib.contextmanager
def _processes() -> Iterator[None]:
    """The process group of torchrun, where it started us."""
    import torch
    import torch.distributed as dist

    if "RANK" not in os.environ or dist.is_initialized():
        yield
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def _train(arguments: argparse.Namespace, argv: list[str]) -> int:
    import cv2
    import torch

    from hybridvo.checks import make_folder
    from hybridvo.errors import InputError
    from hybridvo.evaluation.report import write_json
    from hybridvo.pipeline import torch_device
    from hybridvo.training.loop import Trainer
    from hybridvo.training.options import load_training_options
    from hybridvo.training.outputs import check_export, check_folder
    from hybridvo.training.provenance import source_commit
    from hybridvo.training.stream import check_batch_fits

    for name in ("threads", "time_limit"):
        value = getattr(arguments, name)
        if value is not None and not value > 0:
            raise InputError(f"--{name.replace('_', '-')}: expected a value above 0, got {value}.")
    if arguments.export_count < 1 or arguments.calibrate < 0:  # else said hours later
        raise InputError(
            f"expected --export-count >= 1 and --calibrate >= 0, got {arguments.export_count} and "
            f"{arguments.calibrate}."
        )
    if arguments.workers < 0:
        raise InputError(f"--workers: expected 0 or more, got {arguments.workers}.")
    if arguments.device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device: expected auto, cpu or cuda, got {arguments.device!r}.")
    torch_device(arguments.device)
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    # Samples are small: threads inside OpenCV cost more than they give.
    cv2.setNumThreads(0)
    options, mixture = load_training_options(arguments.config)
    changes: dict[str, Any] = {
        name: getattr(arguments, name)
        for name in ("steps", "batch_size", "precision", "seed")
        if getattr(arguments, name) is not None
    }
    if arguments.learning_rate is not None:
        changes["optimizer"] = dataclasses.replace(
            options.optimizer, learning_rate=arguments.learning_rate
        )
    options = dataclasses.replace(options, **changes)
    check_batch_fits(mixture, options.batch_size)
    out: Path = arguments.out
    if not arguments.no_train:
        check_folder(out, RECORD, ("command", "options"))
    if arguments.export is not None:
        check_export(arguments.export, out, RECORD)
    make_folder(out)
    device = arguments.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    trainer = Trainer(options, mixture, out, device, arguments.workers, report=_report)
    checkpoint = out / "checkpoint.pt"
    if checkpoint.exists() and (arguments.no_train or not arguments.overwrite):
        trainer.resume(checkpoint)
        _say(trainer.rank, f"resumed {checkpoint} at update {trainer.step}")
    elif arguments.init is not None:
        trainer.start_from(_weights(arguments.init))
        _say(trainer.rank, f"started from the weights of {arguments.init}")
    elif arguments.no_train:
        raise InputError(f"{checkpoint}: --no-train needs the checkpoint of a run.")
    command = "python tools/train.py " + shlex.join(argv)
    if not arguments.no_train:
        if trainer.rank == 0:
            record = {
                "command": command,
                "options": dataclasses.asdict(options),
                "data": [dataclasses.asdict(cast(Any, preset)) for preset in mixture.presets],
                "commit": source_commit(),
                "torch": torch.__version__,
            }
            write_json(out / RECORD, record)
        with _clean_stop(trainer):
            limit = arguments.time_limit
            why = trainer.run(math.inf if limit is None else 60 * limit)
        _say(trainer.rank, f"ended by {why} at update {trainer.step}, {trainer.samples} samples")
    if arguments.export is not None and trainer.rank == 0:
        _export(trainer, arguments, _record(out, {"command": command, "commit": source_commit()}))
    return 0


def _record(out: Path, default: dict[str, Any]) -> dict[str, Any]:
    """What the run wrote of itself when it trained: its command and commit, not the export's."""
    try:
        return default | json.loads((out / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return default


@contextlib.contextmanager
def _clean_stop(trainer: Any) -> Iterator[None]:
    """The signals that ask to stop end the run after the update at hand, with a checkpoint."""

    def request(number: int, frame: object) -> None:
        trainer.stop_requested = True

    try:
        before = {s: signal.signal(s, request) for s in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not the main thread: whoever started it must stop it
        before = {}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _export(trainer: Any, arguments: argparse.Namespace, record: dict[str, Any]) -> None:
    """Weights of the run with a model card that says where they come from and what they can do."""
    import torch

    from hybridvo.files import atomic_write
    from hybridvo.network.weights import load_weights, save_weights
    from hybridvo.training.held_out import PUBLISHED_SEED, calibrate_scales, evaluate_network

    options = trainer.options
    card: dict[str, Any] = {
        "preset": dict(zip(options.data, options.data_weights, strict=True)),
        "size": [trainer.mixture.presets[0].height, trainer.mixture.presets[0].width],
        "updates": trainer.step,
        "samples": trainer.samples,
        "skipped_updates": trainer.skipped,
        "training_hours": round(trainer.elapsed_s / 3600, 2),
        "seed": options.seed,
        "options": dataclasses.asdict(options),
        "command": record["command"],
        "commit": record["commit"],
        "torch": torch.__version__,
        "translation_scale": (
            "s of the translation is the log scale of a Laplace error in metres"
            if options.translation_loss == "laplace"
            else "s of the translation is the log scale of the paper's direction-and-length error"
        ),
    }
    path: Path = arguments.export
    save_weights(path, trainer.exported, options.network, card, "float16")
    if arguments.calibrate:
        preset = trainer.mixture.presets[_widest(options)]
        shifts = calibrate_scales(trainer.exported, preset, arguments.calibrate)
        card["calibration"] = {"pairs": arguments.calibrate, "seed": 0, "added_to_s": shifts}
        save_weights(path, trainer.exported, options.network, card, "float16")
    # The figures are those of the stored, rounded weights, as a user gets them.
    network, _ = load_weights(path)
    card["held_out"] = {
        Path(name).stem: evaluate_network(
            network, preset, PUBLISHED_SEED, arguments.export_count, selection=options.selection
        )
        for name, preset in zip(options.data, trainer.mixture.presets, strict=True)
    }
    save_weights(path, network, options.network, card, "float16")
    with atomic_write(path.with_suffix(".json")) as file:
        file.write(json.dumps(card, indent=1, sort_keys=True) + "\n")
    sys.stdout.write(json.dumps({"file": str(path), "held_out": card["held_out"]}, indent=2) + "\n")


def _weights(named: Path) -> Path:
    """The file of weights that --init names: a path, or the name of shipped ones."""
    from hybridvo.network.weights import pretrained, pretrained_names

    return pretrained(str(named)) if str(named) in pretrained_names() else named


def _widest(options: Any) -> int:
    """Index of the preset whose pixels the scales shall be right for."""
    names = [Path(name).stem for name in options.data]
    return names.index("data_wide") if "data_wide" in names else 0


def _report(entry: dict[str, Any]) -> None:
    """One line a log entry on stderr."""
    numbers = ((k, v) for k, v in entry.items() if isinstance(v, int | float))
    line = " ".join(f"{key}={value:.5g}" for key, value in numbers)
    for name, result in entry.get("results", {}).items():
        line += (
            f"\n  {name}: R_err {result['r_err_deg']:.3f} deg (zero motion "
            f"{result['zero_r_err_deg']:.3f}), T_err {result['t_err']:.4f} "
            f"({result['zero_t_err']:.4f}), EPE {result['epe']:.3f} px ({result['zero_epe']:.3f}), "
            f"AUROC {result['auroc'] or math.nan:.3f}"
        )
    sys.stderr.write(line + "\n")


def _say(rank: int, text: str) -> None:
    if rank == 0:
        sys.stderr.write(text + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
