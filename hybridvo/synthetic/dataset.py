"""What training samples are drawn from: presets in YAML files, and samples drawn before on disk.

A folder of samples holds ``samples.json`` (what was drawn) and ``shard_0000/FIELD.npy`` with the
fields of :class:`~hybridvo.synthetic.layered.Sample` stacked; what others say already is left out.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, Protocol, Self, TypeVar, cast

import numpy as np

from hybridvo.errors import FormatError, InputError, OutputError
from hybridvo.files import make_folder, parse_yaml, read_text, write_json
from hybridvo.options import option_group
from hybridvo.synthetic.diverse import DiverseOptions
from hybridvo.synthetic.draws import STORED, sample_generator
from hybridvo.synthetic.layered import PaperOptions, Sample, camera_flow

MANIFEST = "samples.json"
PER_SHARD = 500
"""Samples of a shard: 270 MB at 128x256."""
REPEATS = {"depth_true": "depth_prev", "depth_target": "depth_curr"}
"""Field -> the one that it equals in data without noise; stored where it does not."""
FIELDS = [f.name for f in dataclasses.fields(Sample) if f.name != "ego_flow"]

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
        share = np.divide(self.weights, sum(self.weights))
        return self.presets[int(rng.choice(len(self.presets), p=share))].sample(rng)

    @property
    def record(self) -> list[dict[str, Any]]:
        """The presets as plain values, as :func:`make_preset` takes them."""
        return [dataclasses.asdict(cast(Any, preset)) for preset in self.presets]


# --- files of options -----------------------------------------------------------------------------


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Mapping that a YAML file holds, over the one of the file that it ``extends``."""
    try:
        mapping = parse_yaml(read_text(path), str(path))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; those of the project are in configs/.") from None
    if not isinstance(mapping, dict):
        raise FormatError(f"{path}: expected a mapping of keys, got {type(mapping).__name__}.")
    if "extends" in mapping:
        mapping = merged(read_yaml(Path(path).parent / str(mapping.pop("extends"))), mapping)
    return mapping


def merged(base: Any, changes: Any) -> Any:
    """Base with changes, mapping by mapping."""
    if not (isinstance(base, dict) and isinstance(changes, dict)):
        return changes
    return base | {key: merged(base.get(key), value) for key, value in changes.items()}


def build_options(cls: type[OptionsT], mapping: dict[str, Any], where: str) -> OptionsT:
    """Options of a class from plain values; what is wrong is named with its place."""
    try:
        return cls(**mapping)
    except (InputError, TypeError) as error:
        raise InputError(f"{where}: {error}") from None


def make_preset(mapping: dict[str, Any], where: str) -> Preset:
    """Generator from plain values; ``preset`` says which."""
    kind = mapping.get("preset")
    if kind not in PRESETS:
        raise InputError(f"{where}: preset: expected one of {', '.join(PRESETS)}, got {kind!r}.")
    return build_options(PRESETS[kind], mapping, where)


def load_preset(name: str | Path, size: Sequence[int] | None = None) -> Preset:
    """Generator of a preset's name, or of a file such as ``configs/data_paper.yaml``.

    ``size``: (height, width) instead of its own.
    """
    own = {} if size is None else dict(zip(("height", "width"), size, strict=True))
    mapping = {"preset": name} if name in PRESETS else read_yaml(name)
    return make_preset(mapping | own, str(name))


# --- samples on disk ------------------------------------------------------------------------------


def write_samples(
    preset: Preset, count: int, folder: str | Path, seed: int = 0, workers: int = 1
) -> Iterator[int]:
    """Draw samples into a folder; yields the number written so far, after each shard.

    The folder is made; it may hold an interrupted call of the same arguments, which goes on.

    Raises:
        InputError: a count below 1, or a folder with other samples.
        OutputError: a file that cannot be written.
    """
    if count < 1 or workers < 1:
        raise InputError(f"expected count and workers of at least 1, got {count} and {workers}.")
    folder = Path(folder)
    make_folder(folder)
    options = json.loads(json.dumps(dataclasses.asdict(cast(Any, preset))))
    manifest = {"options": options, "seed": seed, "count": count, "per_shard": PER_SHARD}
    if not (folder / MANIFEST).exists():
        write_json(folder / MANIFEST, manifest)
    elif _manifest(folder) != manifest:
        raise InputError(f"{folder}: holds other samples. Choose another folder.")
    firsts = range(0, count, PER_SHARD)
    jobs = [(preset, seed, range(k, min(k + PER_SHARD, count)), folder) for k in firsts]
    done = 0
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            for written in pool.map(_write_shard, jobs) if workers > 1 else map(_write_shard, jobs):
                done += written
                yield done
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}.") from error


def _write_shard(job: tuple[Preset, int, range, Path]) -> int:
    """Draw one shard under a hidden name and give it its own at the end."""
    preset, seed, indices, folder = job
    target = _shard(folder, indices[0] // PER_SHARD)
    if target.is_dir():
        return len(indices)
    partial = target.with_name(f".{target.name}")
    partial.mkdir(exist_ok=True)
    samples = [preset.sample(sample_generator(seed, i, STORED)) for i in indices]
    arrays = {name: np.stack([getattr(sample, name) for sample in samples]) for name in FIELDS}
    for name, array in arrays.items():
        if name not in REPEATS or not np.array_equal(array, arrays[REPEATS[name]]):
            np.save(partial / f"{name}.npy", array)
    partial.rename(target)
    return len(indices)


def _shard(folder: Path, number: int) -> Path:
    return folder / f"shard_{number:04d}"


@functools.cache
def _manifest(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(read_text(folder / MANIFEST)))
    except FileNotFoundError:
        raise InputError(
            f"{folder}: no {MANIFEST}; write samples with hybridvo generate."
        ) from None
    except ValueError as error:
        raise FormatError(f"{folder}: {MANIFEST} is damaged: {error}.") from None


@functools.cache
def _open_shard(path: Path) -> dict[str, np.ndarray]:
    """Memory-mapped fields of a shard."""
    try:
        arrays = {p.stem: np.load(p, mmap_mode="r") for p in path.glob("*.npy")}
        return {name: arrays.get(name, arrays[REPEATS.get(name, name)]) for name in FIELDS}
    except (OSError, ValueError, KeyError) as error:
        raise FormatError(f"{path}: damaged shard of samples: {error}.") from None


def read_sample(folder: str | Path, index: int) -> Sample:
    """Sample ``index`` of a folder that :func:`write_samples` filled."""
    folder = Path(folder)
    manifest = _manifest(folder)
    if not 0 <= index < manifest["count"]:
        raise InputError(f"{folder}: expected a sample 0 to {manifest['count'] - 1}, got {index}.")
    number, row = divmod(index, manifest["per_shard"])
    fields = {
        name: np.array(array[row]) for name, array in _open_shard(_shard(folder, number)).items()
    }
    ego_flow, _ = camera_flow(fields["K"], fields["depth_true"], fields["T_curr_prev"])
    return Sample(ego_flow=ego_flow, **fields)


@option_group
class StoredSamples:
    """Samples of a folder, named from the current one, as data of a training: ``preset: folder``.

    ``held_out``: a folder of another seed for evaluations; empty: none.
    """

    folder: str
    held_out: str = ""
    preset: Literal["folder"] = "folder"

    def sample(self, rng: np.random.Generator) -> Sample:
        """One of the samples."""
        return read_sample(self.folder, int(rng.integers(_manifest(Path(self.folder))["count"])))

    def for_evaluation(self) -> Self:
        """The same of the held-out folder."""
        if not self.held_out:
            raise InputError("held_out: no folder of held-out samples is named.")
        return dataclasses.replace(cast(Any, self), folder=self.held_out)


PRESETS = {"paper": PaperOptions, "diverse": DiverseOptions, "folder": StoredSamples}
"""Generators, and samples drawn before, by the name that a file gives under ``preset``."""
