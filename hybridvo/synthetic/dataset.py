"""What training samples are drawn from: presets in YAML files, and samples drawn before on disk.

A folder of samples holds ``samples.json`` (what was drawn) and ``shard_0000/FIELD.npy`` with the
fields of :class:`~hybridvo.synthetic.layered.Sample` stacked. The ego flow is left out: it follows
from depth, intrinsics and motion; so are fields that repeat another one.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar, cast

import numpy as np

from hybridvo.errors import FormatError, InputError, OutputError
from hybridvo.files import make_folder, parse_yaml, read_text, write_json
from hybridvo.options import option_group
from hybridvo.synthetic.diverse import DiverseOptions
from hybridvo.synthetic.draws import STORED, sample_generator
from hybridvo.synthetic.layered import Layers, PaperOptions, Sample

PRESETS: dict[str, type] = {"paper": PaperOptions, "diverse": DiverseOptions}
"""Generators by the name that a file gives under ``preset``."""

MANIFEST = "samples.json"
PER_SHARD = 500
"""Samples of a shard: 270 MB at 128x256."""
REPEATS = {"depth_true": "depth_prev", "depth_target": "depth_curr"}
"""Field -> the one that it equals in data without noise; stored where it does not."""
FIELDS = [f.name for f in dataclasses.fields(Sample) if f.name not in ("ego_flow", "rays")]

OptionsT = TypeVar("OptionsT")


class Preset(Protocol):
    """What training samples are drawn from."""

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair; depends on the generator alone."""


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Presets with the share of each; shares need not add up to one."""

    presets: tuple[Preset, ...]
    weights: tuple[float, ...]

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair of one of the presets."""
        limits = np.cumsum(self.weights)
        choice = int(np.searchsorted(limits, rng.random() * limits[-1], side="right"))
        return self.presets[min(choice, len(self.presets) - 1)].sample(rng)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Mapping that a YAML file holds, over the one of the file that it ``extends``."""
    try:
        mapping = parse_yaml(read_text(path), str(path))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; those of the project are in configs/.") from None
    if not isinstance(mapping, dict):
        raise FormatError(f"{path}: expected a mapping of keys, got {type(mapping).__name__}.")
    if "extends" in mapping:
        base = read_yaml(Path(path).parent / str(mapping.pop("extends")))
        mapping = _merged(base, mapping)
    return mapping


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Base with changes, mapping by mapping."""
    inner = {
        key: _merged(base[key], value)
        for key, value in changes.items()
        if isinstance(value, dict) and isinstance(base.get(key), dict)
    }
    return base | changes | inner


def build_options(cls: type[OptionsT], mapping: dict[str, Any], where: str) -> OptionsT:
    """Options of a class from plain values; what is wrong is named with its place."""
    try:
        return cls(**mapping)
    except (InputError, TypeError) as error:
        raise InputError(f"{where}: {error}") from None


def load_preset(
    path: str | Path,
    kinds: dict[str, type] = PRESETS,
    size: tuple[int, int] | None = None,
) -> Preset:
    """Generator that a file such as ``configs/data_paper.yaml`` describes; ``size``: or its own."""
    mapping = read_yaml(path)
    kind = mapping.pop("preset", None)
    if kind not in kinds:
        raise InputError(f"{path}: preset: expected one of {', '.join(kinds)}, got {kind!r}.")
    if size is not None:
        mapping |= dict(zip(("height", "width"), size, strict=True))
    return build_options(kinds[kind], mapping, str(path))


def write_samples(
    preset: Preset, count: int, folder: str | Path, seed: int = 0, workers: int = 1
) -> Iterator[int]:
    """Draw samples into a folder; yields the number written so far, after each shard.

    The folder is made; it may hold an interrupted call of the same arguments, which goes on.

    Raises:
        InputError: a count below 1, or a folder with other samples.
        OutputError: a file that cannot be written.
    """
    if count < 1 or workers < 1 or not 0 <= seed < 1 << 32:
        raise InputError(
            f"write_samples: expected count >= 1, workers >= 1 and 0 <= seed < 2^32, got {count}, "
            f"{workers} and {seed}."
        )
    folder = Path(folder)
    make_folder(folder)
    manifest = {
        "preset": type(preset).__name__,
        "options": json.loads(json.dumps(dataclasses.asdict(cast(Any, preset)))),
        "seed": seed,
        "count": count,
        "per_shard": PER_SHARD,
    }
    if not (folder / MANIFEST).exists():
        write_json(folder / MANIFEST, manifest)
    elif _manifest(folder) != manifest:
        raise InputError(f"{folder}: holds other samples. Choose another folder.")
    try:
        shards = range(-(-count // PER_SHARD))
        jobs = [(preset, seed, count, folder, number) for number in shards]
        done = 0
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            for written in pool.map(_write_shard, jobs) if workers > 1 else map(_write_shard, jobs):
                done += written
                yield done
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}.") from error


def _write_shard(job: tuple[Preset, int, int, Path, int]) -> int:
    """Draw one shard under a hidden name and give it its own at the end."""
    preset, seed, count, folder, number = job
    indices = range(number * PER_SHARD, min((number + 1) * PER_SHARD, count))
    target = _shard(folder, number)
    if target.is_dir():
        return len(indices)
    partial = target.with_name(f".{target.name}")
    partial.mkdir(exist_ok=True)
    samples = [preset.sample(sample_generator(seed, i, STORED)) for i in indices]
    for name in FIELDS:
        array = np.stack([getattr(sample, name) for sample in samples])
        twin = REPEATS.get(name)
        if twin and all(np.array_equal(getattr(s, name), getattr(s, twin)) for s in samples):
            continue
        np.save(partial / f"{name}.npy", array)
    partial.rename(target)
    return len(indices)


def _shard(folder: Path, number: int) -> Path:
    return folder / f"shard_{number:04d}"


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        if not manifest["count"] > 0 or not manifest["per_shard"] > 0:
            raise ValueError("no samples")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; write samples with hybridvo generate.") from None
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path}: not a description of samples: {error}.") from None
    return manifest


_read_manifest = functools.cache(_manifest)


@functools.cache
def _open_shard(path: Path) -> dict[str, np.ndarray]:
    """Memory-mapped fields of a shard."""
    try:
        names = [name for name in FIELDS if (path / f"{name}.npy").exists()]
        return {name: np.load(path / f"{name}.npy", mmap_mode="r") for name in names}
    except (OSError, ValueError) as error:
        raise FormatError(f"{path}: not a shard of samples: {error}.") from None


def read_sample(folder: str | Path, index: int) -> Sample:
    """Sample ``index`` of a folder that :func:`write_samples` filled."""
    folder = Path(folder)
    manifest = _read_manifest(folder)
    if not 0 <= index < manifest["count"]:
        raise InputError(f"{folder}: expected a sample 0 to {manifest['count'] - 1}, got {index}.")
    number, row = divmod(index, manifest["per_shard"])
    shard = _open_shard(_shard(folder, number))
    try:
        fields = {name: np.array(array[row]) for name, array in shard.items()}
        for name, twin in REPEATS.items():
            fields.setdefault(name, fields[twin])
        return Sample(ego_flow=_ego_flow(fields), **fields)
    except (KeyError, IndexError, TypeError) as error:
        raise FormatError(f"{_shard(folder, number)}: damaged shard of samples: {error}.") from None


def _ego_flow(fields: dict[str, np.ndarray]) -> np.ndarray:
    """(H, W, 2) flow of the camera motion alone."""
    depth = fields["depth_true"]
    rho = np.where(depth > 0, 1.0 / np.where(depth > 0, depth, 1.0), 0.0).astype(np.float32)
    return Layers(fields["K"], rho).flows(fields["T_curr_prev"], added=False)[0]


@option_group
class StoredSamples:
    """Samples of a folder, named from the current one, as data of a training: ``preset: folder``.

    ``held_out``: a folder of another seed for evaluations; empty: none.
    """

    folder: str
    held_out: str = ""

    def sample(self, rng: np.random.Generator) -> Sample:
        """One of the samples."""
        count = _read_manifest(Path(self.folder))["count"]
        return read_sample(self.folder, int(rng.integers(count)))

    def for_evaluation(self) -> Self:
        """The same of the held-out folder."""
        if not self.held_out:
            raise InputError("held_out: no folder of held-out samples is named.")
        return dataclasses.replace(cast(Any, self), folder=self.held_out)
