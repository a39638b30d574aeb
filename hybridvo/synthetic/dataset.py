"""What training samples are drawn from: presets in YAML files, and samples drawn before on disk.

A folder of samples holds ``samples.json`` (what was drawn) and ``shard_0000/FIELD.npy`` with the
fields of :class:`~hybridvo.synthetic.layered.Sample` stacked; what others say already is left out.
The selector's samples (``*.npz``) serve as well: what DIS makes of a crowd of movers cannot be
imitated by a noise model.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, Self, TypeVar, cast

import numpy as np
from pydantic import Field

from hybridvo.errors import FormatError, InputError, OutputError
from hybridvo.files import make_folder, parse_yaml, read_text, write_json
from hybridvo.geometry import matrix_to_euler_deg
from hybridvo.options import option_group
from hybridvo.synthetic.diverse import DiverseOptions
from hybridvo.synthetic.draws import STORED, sample_generator
from hybridvo.synthetic.layered import Layers, PaperOptions, Sample

MANIFEST = "samples.json"
PER_SHARD = 500
"""Samples of a shard: 270 MB at 128x256."""
REPEATS = {"depth_true": "depth_prev", "depth_target": "depth_curr"}
"""Field -> the one that it equals in data without noise; stored where it does not."""
FIELDS = [f.name for f in dataclasses.fields(Sample) if f.name not in ("ego_flow", "rays")]
MOVING, STATIC, UNKNOWN = 0, 1, 255
"""Labels of the pixels in the selector's samples."""
SOURCES = ("diverse", "rendered", "dis", "semi-real")
"""Where these come from: the diverse preset, rendered scenes with true flow and with DIS, and
recordings with movers cut from others."""

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
        mapping = _merged(read_yaml(Path(path).parent / str(mapping.pop("extends"))), mapping)
    return mapping


def _merged(base: Any, changes: Any) -> Any:
    """Base with changes, mapping by mapping."""
    if not (isinstance(base, dict) and isinstance(changes, dict)):
        return changes
    return base | {key: _merged(base.get(key), value) for key, value in changes.items()}


def build_options(cls: type[OptionsT], mapping: dict[str, Any], where: str) -> OptionsT:
    """Options of a class from plain values; what is wrong is named with its place."""
    try:
        return cls(**mapping)
    except (InputError, TypeError) as error:
        raise InputError(f"{where}: {error}") from None


def make_preset(mapping: dict[str, Any], where: str) -> Preset:
    """Generator from plain values; ``preset`` says which."""
    kind = mapping.get("preset")
    if kind not in KINDS:
        raise InputError(f"{where}: preset: expected one of {', '.join(KINDS)}, got {kind!r}.")
    return build_options(KINDS[kind], mapping, where)


def load_preset(path: str | Path, size: tuple[int, int] | None = None) -> Preset:
    """Generator that a file such as ``configs/data_paper.yaml`` describes; ``size``: or its own."""
    changes = {} if size is None else dict(zip(("height", "width"), size, strict=True))
    return make_preset(read_yaml(path) | changes, str(path))


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
    shard = _open_shard(_shard(folder, number))
    try:
        fields = {name: np.array(array[row]) for name, array in shard.items()}
    except IndexError as error:
        raise FormatError(f"{_shard(folder, number)}: damaged shard of samples: {error}.") from None
    ego_flow, _ = _camera_flow(fields["K"], fields["depth_true"], fields["T_curr_prev"])
    return Sample(ego_flow=ego_flow, **fields)


def _camera_flow(K: np.ndarray, depth: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 2) flow of the camera motion alone, and (H, W) ratio of the new depth to the old."""
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0).astype(np.float32)
    return Layers(K, inverse).flows(T, added=False)[:2]


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


# --- samples of the selector ----------------------------------------------------------------------


def read_shards(paths: Iterable[Path], names: Sequence[str] = ()) -> list[dict[str, np.ndarray]]:
    """Samples of the selector's files, one stack for every shape of grid; ``names``: these arrays.

    Raises:
        FormatError: a file that holds no such samples.
    """
    by_shape: dict[tuple[int, ...], list[dict[str, np.ndarray]]] = {}
    for path in paths:
        try:
            with np.load(path) as file:
                shard = {name: file[name] for name in names or file.files}
            count, *shape = shard["label"].shape
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise FormatError(f"{path}: not a shard of samples ({error}).") from None
        if not names:  # where no network was asked
            shard.setdefault("proposal", np.full((count, 3, 4), np.nan))
            shard.setdefault("static", np.full((count, *shape), 0.5, np.float16))
        by_shape.setdefault(tuple(shape), []).append(shard)
    return [
        {name: np.concatenate([shard[name] for shard in some]) for name in some[0]}
        for some in by_shape.values()
    ]


@option_group
class RenderedOptions(StoredSamples):
    """Those of the selector's samples that are rendered, of one size, mirrored at random."""

    preset: Literal["rendered"] = "rendered"  # type: ignore[assignment]
    height: Annotated[int, Field(ge=2)] = 128
    width: Annotated[int, Field(ge=2)] = 256

    def sample(self, rng: np.random.Generator) -> Sample:
        """One sample, mirrored or not."""
        groups = _rendered(self.folder)
        sizes = np.cumsum([len(group["source"]) for group in groups])
        choice = int(rng.integers(sizes[-1]))
        number = int(np.searchsorted(sizes, choice, side="right"))
        index = choice - int(sizes[number - 1] if number else 0)
        arrays = {name: array[index] for name, array in groups[number].items()}
        sample = grid_sample(arrays, (self.height, self.width))
        for axis in np.flatnonzero(rng.random(2) < 0.5):
            sample = mirrored(sample, int(axis))
        return sample


@functools.cache
def _rendered(folder: str) -> list[dict[str, np.ndarray]]:
    names = "ray depth target usable log_depth_curr K stride depth_true label T source".split()
    groups = read_shards(sorted(Path(folder).glob("*.npz")), names)
    # the diverse preset is drawn afresh
    keep = [group["source"] != SOURCES.index("diverse") for group in groups]
    if not any(mask.any() for mask in keep):
        raise InputError(
            f"{folder or '(no folder)'}: no shards of rendered samples; make some with "
            f"hybridvo train selector-data."
        )
    return [
        {name: array[mask] for name, array in group.items()}
        for group, mask in zip(groups, keep, strict=True)
    ]


def grid_sample(p: Mapping[str, np.ndarray], size: tuple[int, int]) -> Sample:
    """A sample of a size (height, width) from the arrays of one of the selector's.

    The rays are those of the nearest pixels, which were taken, so that flow and depth stay exact;
    ground truth belongs to the sample's own pixels.
    """
    H, W = size
    h, w = p["label"].shape
    stride = int(p["stride"])
    fx, fy, cx, cy = (float(k) for k in p["K"])
    scale = np.array([W / (w * stride), H / (h * stride)])
    focal = scale * (fx, fy)
    centre = scale * (cx + 0.5, cy + 0.5) - 0.5
    rows = np.minimum((np.arange(H) + 0.5) * h / H, h - 1).astype(int)
    columns = np.minimum((np.arange(W) + 0.5) * w / W, w - 1).astype(int)

    def take(x: np.ndarray) -> np.ndarray:
        return x[..., rows[:, None], columns]

    z, usable, T = take(p["depth"]), take(p["usable"]), p["T"].astype(np.float64)
    ray, target = (np.moveaxis(take(p[name]), 0, -1) for name in ("ray", "target"))
    flow = ((target - (cx, cy)) / (fx, fy) - ray) * focal
    log_depth, depth_true = take(p["log_depth_curr"]), take(p["depth_true"]).astype(np.float32)
    depth_true = np.where(np.isfinite(depth_true), depth_true, 0.0)
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    ego_flow, ratio = _camera_flow(K, depth_true, T)
    return Sample(
        flow=np.where(usable[..., None], flow, np.nan).astype(np.float32),
        ego_flow=ego_flow,
        depth_prev=np.where(usable, z, 0.0).astype(np.float32),
        depth_curr=np.exp(np.nan_to_num(log_depth, nan=-np.inf)).astype(np.float32),
        depth_true=depth_true,
        depth_target=np.maximum(depth_true * ratio, 0.0).astype(np.float32),
        K=K.astype(np.float32),
        T_curr_prev=np.vstack([T, [0, 0, 0, 1]]).astype(np.float32),
        rotation_deg=matrix_to_euler_deg(T[:, :3]).astype(np.float32),
        translation=T[:, 3].astype(np.float32),
        moving=take(p["label"]) == MOVING,
        rays=ray.astype(np.float32),
    )


def mirrored(sample: Sample, axis: int) -> Sample:
    """The sample seen in a mirror: left to right (axis 0), or top to bottom (1)."""
    sign = np.ones(4, np.float32)
    sign[axis] = -1
    fields = dict(vars(sample))
    for name, x in fields.items():
        if x is not None and x.shape[:2] == sample.moving.shape:
            x = np.flip(x, 1 - axis)
            fields[name] = x * sign[:2] if x.ndim == 3 else x.copy()
    K = sample.K.copy()
    K[axis, 2] = sample.moving.shape[1 - axis] - 1 - K[axis, 2]
    return Sample(
        **fields
        | {
            "K": K,
            "T_curr_prev": sign[:, None] * sample.T_curr_prev * sign,
            "rotation_deg": -sign[:3] * sample.rotation_deg,
            "translation": sign[:3] * sample.translation,
        }
    )


PRESETS: dict[str, type] = {"paper": PaperOptions, "diverse": DiverseOptions}
"""Generators by the name that a file gives under ``preset``."""
KINDS: dict[str, type] = PRESETS | {"folder": StoredSamples, "rendered": RenderedOptions}
"""These, and samples drawn before."""
