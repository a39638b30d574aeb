"""What a comparison works on: the sequences of a folder, the methods that run here."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence as Several
from pathlib import Path

import hybridvo
from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import HybridVOError, InputError
from hybridvo.evaluation.protocols import Protocol, check_protocol
from hybridvo.evaluation.sequence_job import ComparisonOptions, Job
from hybridvo.files import fingerprint
from hybridvo.network.models import Models
from hybridvo.pipeline import METHODS, check_method, weights_hash

SINTEL_FOLDERS = ("camdata_left", "depth", "flow", "clean", "final")
"""Folders of MPI Sintel that hold a folder per scene; the images of the last one are read."""


def methods_to_run(
    names: Several[str], models: Models | None = None
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Methods to run, and of those that ``all`` leaves out the reason with its remedy.

    Raises:
        InputError: no name, an unknown one, or one that cannot run here.
    """
    if not names:
        raise InputError(f"--methods: expected names, got none; known: {', '.join(METHODS)}.")
    is_all = list(names) == ["all"]
    runnable: dict[str, None] = {}
    missing: dict[str, str] = {}
    for name in METHODS if is_all else names:
        try:
            check_method(name, models)
            runnable[name] = None
        except InputError as error:
            if not is_all:
                raise
            missing[name] = str(error)
    return tuple(runnable), missing


def expand(path: str | os.PathLike[str], dataset: str | None = None) -> list[Path]:
    """Sequence folders that a path stands for: itself, or all sequences that it holds.

    A folder that is no sequence is searched one level down; MPI Sintel may be given as it was
    unpacked, as its folder ``training``, or as one of its passes.
    """
    folder = Path(path)
    if not folder.is_dir():
        return [folder]
    if dataset in (None, "sintel"):
        absolute = folder.absolute()
        if absolute.name in SINTEL_FOLDERS and (absolute.parent / "camdata_left").is_dir():
            return [child for child in sorted(absolute.iterdir()) if child.is_dir()]
        for base in (absolute, absolute / "training", *sorted(absolute.glob("*/training"))):
            if (base / "camdata_left").is_dir():
                scenes = {}
                for name in SINTEL_FOLDERS:
                    for child in sorted((base / name).glob("*/")):
                        scenes[child.name] = child
                return [scenes[name] for name in sorted(scenes)]
    if _opens(folder, dataset):
        return [folder]
    inside = [child for child in sorted(folder.iterdir()) if child.is_dir()]
    return [child for child in inside if _opens(child, dataset)] or [folder]


def _opens(folder: Path, dataset: str | None) -> bool:
    try:
        open_sequence(folder, dataset)
    except HybridVOError:
        return False
    return True


def plan(options: ComparisonOptions, methods: tuple[str, ...]) -> tuple[list[Job], Protocol | None]:
    """A job for each sequence, and the protocol; all are opened before the first hour is spent.

    Raises:
        InputError: sequences, frames or flow that are not there, or that no protocol knows.
    """
    if not options.sequences:
        raise InputError("compare: expected at least one folder of a sequence, got none.")
    paths = [path for given in options.sequences for path in expand(given, options.dataset)]
    opened = {path: open_sequence(path, options.dataset) for path in paths}
    protocol = None
    if options.protocol is not None:
        if options.stride != 1 or options.start or options.stop is not None:
            raise InputError(
                f"--protocol {options.protocol} is defined on whole sequences: leave out --start, "
                f"--stop and --stride."
            )
        protocol = check_protocol(options.protocol, list(opened.values()))
        opened = {path: s for path, s in opened.items() if s.name in protocol.sequences}
        if not opened:
            known = ", ".join(protocol.sequences)
            raise InputError(f"--protocol {protocol.name}: expected some of {known}, got none.")
    names = [sequence.name for sequence in opened.values()]
    models = Models(options.device, options.weights)
    hashes = {name: weights_hash(name, models) for name in methods}
    jobs: list[Job] = []
    for path, sequence in opened.items():
        name = sequence.name
        if names.count(name) > 1:
            name = f"{path.absolute().parent.name}/{name}"
        if name in [job.name for job in jobs]:
            raise InputError(f"--sequence: two sequences are called {name}; give each once.")
        frames = range(*slice(options.start, options.stop, options.stride).indices(len(sequence)))
        if not frames:
            raise InputError(f"{name}: no frames from {options.start} on: it has {len(sequence)}.")
        flows = _flows(sequence, options)
        same_camera_only = protocol is not None and protocol.same_camera_only
        deciding = [fingerprint(sequence.files()), list(frames), flows, options.seed]
        deciding += [same_camera_only, options.device, hashes, hybridvo.__version__]
        digest = hashlib.sha256(json.dumps(deciding).encode()).hexdigest()
        jobs.append(Job(str(path), name, options, flows, methods, frames, same_camera_only, digest))
    return jobs, protocol


def _flows(sequence: Sequence, options: ComparisonOptions) -> tuple[str, ...]:
    """Sources of flow: both side by side where the sequence has both."""
    usable = sequence.has_flow and options.stride == 1
    if options.flow == "file" and not usable:
        why = "a stride above 1" if sequence.has_flow else "no flow files"
        raise InputError(f"{sequence.name}: --flow file, but there are {why}; pass --flow dis.")
    if options.flow != "auto":
        return (options.flow,)
    images = any(path is not None for path in sequence.rgb_files)
    return (*(("dis",) if images or not usable else ()), *(("file",) if usable else ()))
