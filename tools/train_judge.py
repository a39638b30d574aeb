"""Train the judge: make pictures, train on them, export weights.

``python tools/train_judge.py make --data DIR --first-seed 1000000 --seeds 4096`` makes pictures and
may run several times at once, and beside a training (held-out seeds are those below 1000);
``... propose --data DIR`` asks the shipped PWVO about them (of the held-out ones as well);
``... train --data DIR --out runs/judge --time-limit 50`` trains, or goes on with what stands in
``--out``; ``... export --out runs/judge --held-out DIR --export FILE`` writes weights that users
load, with figures on held-out pictures in their model card.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

RECORD, RECORDED = "run.json", ("command", "commit")
"""Says what the training in a folder is, and what it says."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns its exit code (2: bad input, 5: output that cannot be written)."""
    arguments = _parse(argv)
    from hybridvo.errors import HybridVOError, OutputError

    try:
        commands = {"make": _make, "propose": _propose, "train": _train, "export": _export}
        return commands[arguments.command](arguments)
    except OutputError as error:
        sys.stderr.write(f"train_judge: {error}\n")
        return 5
    except HybridVOError as error:
        sys.stderr.write(f"train_judge: {error}\n")
        return 2


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="train_judge.py", description="Train the judge.")
    commands = parser.add_subparsers(dest="command", required=True)
    config = ROOT / "configs" / "train_judge.yaml"
    make = commands.add_parser("make", help="draw pictures")
    make.add_argument("--data", type=Path, required=True, help="folder of the shards")
    make.add_argument("--first-seed", type=int, required=True, help="below 1000: held out")
    make.add_argument("--seeds", type=int, required=True, help="about as many pictures")
    propose = commands.add_parser("propose", help="ask a PWVO about the pictures")
    propose.add_argument("--data", type=Path, required=True, help="folder of the shards")
    propose.add_argument("--network", type=Path, help="weights; the shipped ones by default")
    train = commands.add_parser("train", help="train on them")
    train.add_argument("--data", type=Path, required=True, help="folder of the shards")
    train.add_argument("--time-limit", type=float, metavar="MIN", required=True, help="minutes")
    train.add_argument("--threads", type=int, help="threads of torch; by default torch's own")
    train.add_argument("--init", type=Path, metavar="FILE", help="start from these weights")
    export = commands.add_parser("export", help="write weights for users")
    export.add_argument("--held-out", type=Path, required=True, help="shards of held-out pictures")
    export.add_argument("--export", type=Path, required=True, metavar="FILE", help="*.safetensors")
    for part in (train, export):
        part.add_argument("--config", type=Path, default=config, help="configs/train_judge.yaml")
        part.add_argument("--out", type=Path, required=True, help="folder of the run")
    return parser.parse_args(argv)


def _make(arguments: argparse.Namespace) -> int:
    from hybridvo.checks import make_folder
    from hybridvo.errors import InputError
    from hybridvo.training.judge_data import PER_SHARD, write_shard

    if arguments.first_seed < 0 or arguments.seeds < 1:
        raise InputError(
            f"expected --first-seed >= 0 and --seeds >= 1, got {arguments.first_seed} and "
            f"{arguments.seeds}."
        )
    make_folder(arguments.data)
    last = arguments.first_seed + arguments.seeds
    for seed in range(arguments.first_seed, last, PER_SHARD):
        count = write_shard(arguments.data, seed)
        print(f"seeds {seed} to {seed + PER_SHARD - 1}: {count} pictures", flush=True)
    return 0


def _propose(arguments: argparse.Namespace) -> int:
    from hybridvo.learned import shipped_network
    from hybridvo.network.weights import load_weights
    from hybridvo.training.judge_proposals import write_proposals

    path = arguments.network
    network = shipped_network("pwvo") if path is None else load_weights(path)[0]
    print(f"{write_proposals(arguments.data, network)} pictures")
    return 0


def _trainer(arguments: argparse.Namespace, data: Path):
    from hybridvo.checks import make_folder
    from hybridvo.data.presets import build_options, read_yaml
    from hybridvo.training.judge_loop import JudgeTrainer, JudgeTrainingOptions

    options = build_options(
        JudgeTrainingOptions, read_yaml(arguments.config), str(arguments.config)
    )
    make_folder(arguments.out)
    return JudgeTrainer(options, data, arguments.out)


def _train(arguments: argparse.Namespace) -> int:
    import torch

    from hybridvo.evaluation.report import write_json
    from hybridvo.training.outputs import check_folder
    from hybridvo.training.provenance import source_commit

    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    check_folder(arguments.out, RECORD, RECORDED)
    trainer = _trainer(arguments, arguments.data)
    if trainer.resume():
        print(f"going on after {trainer.elapsed:.1f} min, {trainer.pictures} pictures")
    elif arguments.init is not None:
        trainer.start_from(arguments.init)
    record = {"command": "python tools/train_judge.py " + shlex.join(sys.argv[1:])}
    record["commit"] = source_commit()
    write_json(arguments.out / RECORD, record)
    trainer.run(arguments.time_limit)
    print(f"{arguments.out / 'checkpoint.pt'}: {trainer.pictures} pictures seen")
    return 0


def _export(arguments: argparse.Namespace) -> int:
    from hybridvo.errors import InputError
    from hybridvo.files import atomic_write
    from hybridvo.network.weights import save_weights
    from hybridvo.training.judge_evaluation import evaluate_judge
    from hybridvo.training.outputs import check_export

    check_export(arguments.export, arguments.out, RECORD)
    trainer = _trainer(arguments, arguments.held_out)
    if not trainer.resume():
        raise InputError(f"{arguments.out}: no checkpoint; train first.")
    files = sorted(arguments.held_out.glob("*.npz"))
    if not files:
        raise InputError(f"{arguments.held_out}: no shards; make some with seeds below 1000.")
    network = trainer.exported()
    card = {
        "name": arguments.export.stem,
        "what": "chooses the world among candidate motions, and where the world is",
        "data": "hybridvo.training.judge_data: wide preset and rendered scenes, seeds >= 1000000",
        "options": {k: v for k, v in asdict(trainer.options).items() if k != "network"},
        "updates": trainer.step,
        "pictures": trainer.pictures,
        "minutes": round(trainer.elapsed, 1),
        **_record(arguments.out),
        "held_out": evaluate_judge(network, files),
        "held_out_with_proposals": evaluate_judge(network, files, asked=True),
        "licence": "the package's own",
    }
    save_weights(arguments.export, network, trainer.options.network, card, dtype="float16")
    # the same card for people, beside the weights
    with atomic_write(arguments.export.with_suffix(".json")) as file:
        file.write(json.dumps(card, indent=1, sort_keys=True) + "\n")
    print(json.dumps(card["held_out"], indent=1))
    print(f"{arguments.export}: {arguments.export.stat().st_size / 1e6:.1f} MB")
    return 0


def _record(out: Path) -> dict[str, str]:
    """Command and commit of the training that stands in a folder."""
    from hybridvo.errors import InputError

    try:
        stored = json.loads((out / RECORD).read_text(encoding="utf-8"))
        return {key: str(stored[key]) for key in RECORDED}
    except (OSError, ValueError, LookupError) as error:
        raise InputError(f"{out / RECORD}: not the record of a training: {error}.") from error


if __name__ == "__main__":
    raise SystemExit(main())
