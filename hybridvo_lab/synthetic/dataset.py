"""Sources of training samples: generators that YAML files
describe, and samples on disk.

A folder of samples holds ``samples.json``, which states how they were drawn, and
``0000000.npz`` etc. with the fields of
:class:`~hybridvo_lab.synthetic.paper_samples.Sample`.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, get_args
from zipfile import BadZipFile

import numpy as np

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import (
    atomic_write,
    make_folder,
    parse_yaml,
    read_text,
    write_json,
)
from hybridvo_lab.cluster import Workers
from hybridvo_lab.synthetic.draws import STORED, sample_generator
from hybridvo_lab.synthetic.paper_samples import PaperOptions, Sample
from hybridvo_lab.synthetic.training_scenes import DiverseOptions

MANIFEST = "samples.json"
"""The file of a folder of samples that states how they were drawn."""
CHUNK = 50
"""Samples of a task."""

OptionsT = TypeVar("OptionsT")


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Presets with a weight for each; the weights need not add up to one."""

    presets: tuple[Preset, ...]
    weights: tuple[float, ...]

    def sample(self, rng: np.random.Generator) -> Sample:
        """Draw a pair from one of the presets."""
        probability = np.divide(self.weights, sum(self.weights))
        chosen = int(rng.choice(len(self.presets), p=probability))
        return self.presets[chosen].sample(rng)


# --- files of options -------------------------------------------------------------


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read the mapping in a YAML file, laid over that of the
    file which it ``extends``.

    Raises:
        InputError: there is no such file.
        FormatError: the file holds no mapping.
    """
    try:
        mapping = parse_yaml(read_text(path), str(path))
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such file. The project's own are in configs/ of hybridvo's source; "
            f"an installed package has none."
        ) from None
    if not isinstance(mapping, dict):
        raise FormatError(
            f"{path}: expected a mapping of keys, got {type(mapping).__name__}."
        )
    if "extends" in mapping:
        base = Path(path).parent / str(mapping.pop("extends"))
        return merged(read_yaml(base), mapping)
    return mapping


def merged(base: Any, changes: Any) -> Any:
    """Return ``base`` with ``changes`` laid over it, mapping by mapping.

    >>> merged({"a": 1, "b": {"c": 2, "d": 3}}, {"b": {"d": 4}})
    {'a': 1, 'b': {'c': 2, 'd': 4}}
    """
    if not (isinstance(base, dict) and isinstance(changes, dict)):
        return changes
    result = dict(base)
    for key, value in changes.items():
        result[key] = merged(base.get(key), value)
    return result


def build_options(
    cls: type[OptionsT], mapping: dict[str, Any], where: str
) -> OptionsT:
    """Make options of a class from plain values.

    An InputError names key and ``where``.
    """
    try:
        return cls(**mapping)
    except (InputError, TypeError) as error:
        raise InputError(f"{where}: {error}") from None


def make_preset(mapping: dict[str, Any], where: str) -> Preset:
    """Make a generator from plain values.

    The value of ``preset`` names its kind.
    """
    kind = mapping.get("preset")
    if kind not in PRESETS:
        raise InputError(
            f"{where}: preset: expected one of {', '.join(PRESETS)}, got {kind!r}."
        )
    return build_options(PRESETS[kind], mapping, where)


def load_preset(name: str | Path, size: Sequence[int] | None = None) -> Preset:
    """Make a generator.

    Args:
        name: the name of a preset, or a file such as ``configs/data_paper.yaml``.
        size: (height, width) of the samples, in place of the preset's own.
    """
    if name in PRESETS:
        mapping: dict[str, Any] = {"preset": name}
    elif Path(name).is_file():
        mapping = read_yaml(name)
    else:
        expected = f"{', '.join(PRESETS)}, or a YAML file"
        raise InputError(f"preset {name}: no such file. Expected {expected}.")
    if size is not None:
        height, width = size
        mapping |= {"height": height, "width": width}
    return make_preset(mapping, str(name))


# --- samples on disk --------------------------------------------------------------


def write_samples(
    preset: Preset,
    count: int,
    folder: str | Path,
    seed: int = 0,
    workers: Workers | None = None,
) -> Iterator[int]:
    """Draw samples into a folder, and yield again and again how many are written.

    An interrupted call with the same arguments continues where it stopped.

    Raises:
        InputError: the count is below 1, or the folder holds other samples.
        RuntimeError: several workers died of some samples.
    """
    if count < 1:
        raise InputError(f"expected a count of at least 1, got {count}.")
    workers = workers or Workers()
    folder = Path(folder).absolute()
    make_folder(folder)
    # through JSON, so that tuples compare equal to the lists of a stored manifest
    options = json.loads(json.dumps(dataclasses.asdict(preset)))
    manifest = {"options": options, "seed": seed, "count": count}
    if not (folder / MANIFEST).exists():
        write_json(folder / MANIFEST, manifest)
    elif json.loads(read_text(folder / MANIFEST)) != manifest:
        raise InputError(f"{folder}: holds other samples. Choose another folder.")

    size = CHUNK if workers.are_elsewhere else 1
    tasks = [
        range(first, min(first + size, count)) for first in range(0, count, size)
    ]
    written = 0
    for done in workers.each(
        functools.partial(_write_some, preset, seed, folder), tasks
    ):
        if done.lost:
            raise RuntimeError(
                f"{folder}: samples {tasks[done.number]} {done.lost}"
            )
        written += len(tasks[done.number])
        yield written


def _write_some(preset: Preset, seed: int, folder: Path, indices: range) -> None:
    """Write the samples of some indices whose files do not exist."""
    for index in indices:
        _write_sample(preset, seed, folder, index)


def _write_sample(preset: Preset, seed: int, folder: Path, index: int) -> None:
    """Write one sample if its file does not exist."""
    path = folder / f"{index:07d}.npz"
    if not path.exists():
        sample = preset.sample(sample_generator(seed, index, STORED))
        with atomic_write(path, "wb") as file:
            np.savez(file, **vars(sample))


def read_sample(folder: str | Path, index: int) -> Sample:
    """Read one sample of a folder that :func:`write_samples` filled.

    Raises:
        FormatError: its file is damaged or absent.
    """
    path = Path(folder) / f"{index:07d}.npz"
    try:
        with np.load(path) as file:
            return Sample(**file)
    except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
        raise FormatError(f"{path}: damaged or absent sample: {error}.") from None


Preset: TypeAlias = PaperOptions | DiverseOptions
PRESETS: dict[Any, type[Preset]] = {kind.preset: kind for kind in get_args(Preset)}
"""The classes of presets by the name that a file gives under ``preset``."""
