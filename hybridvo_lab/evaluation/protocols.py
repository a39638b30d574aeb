"""Protocols of papers by name: which sequences and frames they take, and what is published."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.files import parse_yaml
from hybridvo.core.trajectory import Trajectory
from hybridvo.io.data.datasets import TumSequence, bonn_camera_poses
from hybridvo.io.data.lists import abbreviated, associate
from hybridvo.io.data.selected import SelectedSequence
from hybridvo.io.data.sequence import Sequence


@dataclass(frozen=True)
class Protocol:
    """How a paper, or a script that many papers use, scores a data set.

    Attributes:
        name: what ``--protocol`` takes.
        title: a line for people.
        kind: the reader of its data set.
        sequences: their names, with the number of frames where it is known.
        columns: key, label and factor of each published figure.
        published: lines of others, with ``inputs``, ``source`` and ``note``.
        image_pass: of MPI Sintel.
        pairs: of the complete set, where pairs are scored and no paths.
        area: to which images are scaled, px^2; None: they are not.
        every: step in the list of images that have a true pose.
        first: how many of these are taken; None: all.
        max_difference_s: of an image and its true pose, s; None: they belong together by number.
        one_to_one: whether a true pose has one image at most; else the nearest one counts.
        alignment: of the estimate before the absolute error.
        divided: whether lengths are in units of the distance from start to end.
        added_length: what is added to that distance, m.
        rpe: the relative error's span: one frame, in evo's order of the motions or in that
            of MegaSaM's script (``inverse``), or one second.
        by_sequence: short names of sequences whose figures are published one by one.
    """

    name: str
    title: str
    kind: str
    sequences: dict[str, int | None]
    columns: list[tuple[str, str, float]]
    published: list[dict[str, Any]]
    image_pass: str = ""
    pairs: int | None = None
    area: int | None = None
    every: int = 1
    first: int | None = None
    max_difference_s: float | None = None
    one_to_one: bool = True
    alignment: Literal["se3", "sim3"] = "se3"
    divided: bool = False
    added_length: float = 0.0
    rpe: Literal["frames", "inverse", "s", "none"] = "none"
    by_sequence: dict[str, str] = field(default_factory=dict)

    @property
    def scores_paths(self) -> bool:
        """Whether paths are scored; else pairs are."""
        return self.pairs is None

    @property
    def is_bonn(self) -> bool:
        """Whether the true poses of its files are those of markers on the camera."""
        return any("bonn" in name for name in self.sequences)


class Chosen(NamedTuple):
    """What a protocol takes of some sequences."""

    sequences: list[Sequence]
    left_out: list[str]  # names


@functools.cache
def protocols() -> dict[str, Protocol]:
    """Read all protocols by name."""
    path = Path(__file__).with_name("protocols.yaml")
    content = parse_yaml(path.read_text(encoding="utf-8"), path.name)
    return {name: Protocol(name, **fields) for name, fields in content.items()}


def check_protocol(name: str) -> Protocol:
    """Return a protocol by its name.

    Raises:
        InputError: There is none of that name.
    """
    known = protocols()
    if name not in known:
        expected = ", ".join(known)
        raise InputError(f"protocol: expected one of {expected}, got {name!r}.")
    return known[name]


# -- which sequences ---------------------------------------------------------------------


def choose(protocol: Protocol, found: Iterable[Sequence], is_named: bool) -> Chosen:
    """Choose the sequences of a protocol from those in a folder.

    Args:
        protocol: The protocol.
        found: The sequences.
        is_named: Whether the user named the sequence itself, and no folder of several.

    Raises:
        InputError: A sequence that was named is not of the protocol, the folder holds none
            that is, or the images are of another pass.
    """
    sequences = []
    left_out = []
    for sequence in found:
        is_known = sequence.name in protocol.sequences
        if sequence.kind == protocol.kind and is_known:
            _check_pass(protocol, sequence)
            sequences.append(sequence)
        else:
            left_out.append(sequence.name)
    if left_out and (is_named or not sequences):
        expected = f"sequences of {_described(protocol)}"
        got = abbreviated(left_out)
        raise InputError(
            f"--protocol {protocol.name}: expected {expected}, got {got}. "
            "Data sets and protocols do not mix: compare others without it."
        )
    return Chosen(sequences, left_out)


def _described(protocol: Protocol) -> str:
    """Name the sequences of a protocol, for a message."""
    if protocol.kind == "sintel":
        return f"MPI Sintel's training set ({abbreviated([*protocol.sequences])})"
    return f"kind '{protocol.kind}': {abbreviated([*protocol.sequences])}"


def _check_pass(protocol: Protocol, sequence: Sequence) -> None:
    """Refuse images of another pass of MPI Sintel where paths are scored."""
    used = image_pass(sequence)
    # the paper's networks see no image
    if not protocol.scores_paths or used in ("", protocol.image_pass):
        return
    if protocol.image_pass:
        raise InputError(
            f"--protocol {protocol.name}: expected the {protocol.image_pass} pass of "
            f"{sequence.name}, got {used}: name the folder training/{protocol.image_pass}."
        )


def image_pass(sequence: Sequence) -> str:
    """Return the pass of MPI Sintel that the images are of; empty for others."""
    if sequence.kind != "sintel":
        return ""
    files = [path for path in sequence.rgb_files if path is not None]
    return files[0].parent.parent.name if files else ""


def check_once(protocol: Protocol, sequences: Iterable[Sequence]) -> None:
    """Raise an InputError for a sequence that was given twice: it would count twice."""
    names = [sequence.name for sequence in sequences]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"--protocol {protocol.name}: expected each sequence once, "
            f"got {abbreviated(twice)} twice."
        )


# -- which frames ------------------------------------------------------------------------


def prepare(protocol: Protocol, sequence: Sequence) -> Sequence:
    """Return the frames that a protocol takes of a sequence, with their true poses.

    Args:
        protocol: The protocol.
        sequence: One of its sequences.

    Returns:
        The sequence itself where all frames are taken as they are.

    Raises:
        InputError: The sequence has no ground truth, or is not as its data set ships it.
    """
    if protocol.scores_paths and sequence.poses is None:
        raise InputError(
            f"{sequence.name}: no ground truth, which --protocol {protocol.name} needs."
        )
    if protocol.area is not None:
        size = _size_of_area(sequence, protocol.area)
        return SelectedSequence(sequence, range(len(sequence)), size=size)
    if protocol.max_difference_s is None:
        return sequence
    if not isinstance(sequence, TumSequence):
        raise InputError(
            f"--protocol {protocol.name}: {sequence.name}: expected a recording of TUM's layout "
            "as it is, without --depth, --mask onnx: or --readout-ms."
        )
    return _with_matched_poses(protocol, sequence)


def _size_of_area(sequence: Sequence, area: int) -> tuple[int, int]:
    """Return height and width, px, of images that are scaled to an area."""
    scale = np.sqrt(area / (sequence.height * sequence.width))
    return int(sequence.height * scale), int(sequence.width * scale)


def _with_matched_poses(protocol: Protocol, sequence: TumSequence) -> Sequence:
    """Return the frames of TUM's layout that are in the protocol's matched list.

    The list is of images and true poses. An image without depth keeps its place in it, so
    that every third image is the same as without a depth camera, but it cannot be tracked.
    """
    path = sequence.true_path
    assert path is not None
    matched = match_stamps(protocol, sequence.image_stamps, path.stamps)
    taken = matched[:: protocol.every][: protocol.first]
    place_of_stamp = {
        stamp: place for place, stamp in enumerate(sequence.timestamps.tolist())
    }
    places = []
    poses = []
    lost = 0
    for image, pose in taken:
        stamp = float(sequence.image_stamps[image])
        if stamp in place_of_stamp:
            places.append(place_of_stamp[stamp])
            poses.append(path.poses[pose])
        else:
            lost += 1
    if not places:
        raise InputError(
            f"{sequence.name}: no image has a true pose within "
            f"{protocol.max_difference_s} s, which --protocol {protocol.name} needs."
        )
    selected = SelectedSequence(sequence, places, poses=np.array(poses))
    if lost:
        selected.warnings.append(
            f"{sequence.name}: {lost} of {len(taken)} frames of the protocol have no "
            "depth, and are left out."
        )
    return selected


def match_stamps(
    protocol: Protocol, stamps: np.ndarray, true_stamps: np.ndarray
) -> list[tuple[int, int]]:
    """Match the stamps of images and of true poses as a protocol does, without interpolation.

    Args:
        protocol: The protocol.
        stamps: (N,) seconds.
        true_stamps: (M,) seconds, increasing.

    Returns:
        Pairs (i, j), sorted by i.

    Example:
        >>> bonn = check_protocol("bonn8")
        >>> match_stamps(bonn, np.array([0.0, 0.03]), np.array([0.02, 5.0]))
        [(0, 0), (1, 0)]
    """
    tolerance = protocol.max_difference_s
    assert tolerance is not None
    if protocol.one_to_one:
        return associate(stamps, true_stamps, tolerance)
    pairs = []
    for i, stamp in enumerate(stamps):
        differences = np.abs(true_stamps - stamp)
        j = int(np.argmin(differences))
        if differences[j] < tolerance:
            pairs.append((i, j))
    return pairs


def published_truth(protocol: Protocol, path: Trajectory) -> Trajectory:
    """Return the true path of a camera from the poses that a data set's file has.

    Bonn's are those of the markers, and are corrected; others are the camera's.
    """
    if not protocol.is_bonn:
        return path
    poses = bonn_camera_poses(path.T_world_cam)
    return Trajectory(path.timestamps, poses, path.has_timestamps, path.warnings)


# -- what results state of a protocol ----------------------------------------------------


def missing_sequences(protocol: Protocol, names: Iterable[str]) -> list[str]:
    """Return the sequences of a protocol that are not among some names."""
    there = set(names)
    return [name for name in protocol.sequences if name not in there]


def pairs_summary(
    protocol: Protocol,
    scored: list[dict[str, Any]],
    totals: Iterable[dict[str, Any]] = (),
) -> dict[str, Any]:
    """Return what ``results.json`` states of a protocol that scores pairs.

    Args:
        protocol: The protocol.
        scored: ``name`` and ``pairs_scored`` of each sequence.
        totals: The line of each method over all sequences, with ``inputs``.

    Returns:
        The protocol with its published lines, and what is missing of its pairs.
    """
    count = sum(sequence["pairs_scored"] for sequence in scored)
    names = [sequence["name"] for sequence in scored]
    missing = missing_sequences(protocol, names)
    note = ""
    if missing or count != protocol.pairs:
        note = (
            f"{count} pairs, the complete set has {protocol.pairs}: not those of the "
            f"published figures; missing: {', '.join(missing) or 'no sequence'}"
        )
    return asdict(protocol) | {
        "note": note,
        "missing_sequences": missing,
        "pairs": count,
        "rows": [],
        "totals": [_total_of_pairs(protocol, total) for total in totals],
    }


def _total_of_pairs(protocol: Protocol, total: dict[str, Any]) -> dict[str, Any]:
    """Return the line of a method with the figures of a protocol that scores pairs."""
    figures = {key: total.get(key) for key, _, _ in protocol.columns}
    reasons = {key: total["reasons"].get(key, "") for key in figures}
    return {
        "method": total["method"],
        "name": total["method"],
        "flow_source": total["flow_source"],
        "inputs": total["inputs"],
        "sequences": total["sequences"],
        **figures,
        "reasons": {key: why for key, why in reasons.items() if why},
    }


def beside_published(protocol: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the lines of our methods, then those of others, for one table.

    Args:
        protocol: What ``results.json`` states of a protocol.

    Returns:
        Lines with the keys of the protocol's columns, ``method``, ``inputs`` and ``source``.
    """
    ours = [
        total | {"method": total["method"], "source": "this comparison"}
        for total in protocol["totals"]
    ]
    others = [line | {"method": line["name"]} for line in protocol["published"]]
    return ours + others
