"""A vocabulary of ORB features for ORB-SLAM3, whose own is fetched from the network.

A tree of clusters of binary descriptors, trained on images below a folder, in the text format of
DBoW2: ``branches levels scoring weighting``, then a line for each node: its parent, whether it is
a word, 32 bytes, the weight of a word. ORB-SLAM3 matches features by it, and finds places.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.files import make_folder

BRANCHES = 10
LEVELS = 6
ROUNDS = 8
"""Largest number of rounds of a clustering."""
FEW = 6
"""Descriptors that no longer split, from the second level on."""
IMAGES = 700
PER_FOLDER = 25
PER_IMAGE = 700
"""Numbers of images and descriptors."""
NO_IMAGES = ("depth", "mask", "mover", "flow", "seg", "dyn")
"""Parts of paths of files that show no scene."""
BITS = 256


class Descriptors(NamedTuple):
    """Descriptors of images."""

    data: np.ndarray  # (N, 32) uint8
    image: np.ndarray  # (N,) the number of each one's image
    images: int

    @property
    def signs(self) -> np.ndarray:
        """The bits (N, 256) as -1 and 1: their products count equal bits."""
        return np.unpackbits(self.data, axis=1).astype(np.float32) * 2 - 1


class Node(NamedTuple):
    """A cluster whose parts are still to be found."""

    number: int
    members: np.ndarray  # (N,) of the descriptors
    level: int


def write_vocabulary(data: Path, out: Path) -> None:
    """Train a vocabulary on the images below a folder."""
    images = images_below(data)
    descriptors = described(images)
    make_folder(out.parent)
    lines = [f"{BRANCHES} {LEVELS} 0 0", *tree(descriptors)]
    unfinished = out.with_suffix(".unfinished")
    unfinished.write_text("\n".join(lines), encoding="utf-8")
    unfinished.replace(out)
    print(f"{out}: {len(lines) - 1} nodes of {len(images)} images", flush=True)


def images_below(data: Path) -> list[Path]:
    """Images of every folder below one, evenly spread, in random order."""
    by_folder: dict[Path, list[Path]] = {}
    for path in sorted(data.rglob("*")):
        below = str(path.relative_to(data)).lower()
        is_image = path.suffix.lower() in (".png", ".jpg")
        if is_image and not any(word in below for word in NO_IMAGES):
            by_folder.setdefault(path.parent, []).append(path)
    chosen = []
    for paths in by_folder.values():
        count = min(len(paths), PER_FOLDER)
        chosen += [paths[int(k)] for k in np.linspace(0, len(paths) - 1, count)]
    random.Random(0).shuffle(chosen)
    return chosen[:IMAGES]


def described(images: list[Path]) -> Descriptors:
    """Descriptors of some images."""
    detector = cv2.ORB_create(1000, 1.2, 8, fastThreshold=7)
    data, image = [], []
    for number, path in enumerate(images):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found = None if grey is None else detector.detectAndCompute(grey, None)[1]
        if found is None:
            continue
        some = np.random.default_rng(number).permutation(len(found))[:PER_IMAGE]
        data.append(found[some])
        image.append(np.full(len(some), number))
    return Descriptors(np.concatenate(data), np.concatenate(image), len(images))


def tree(descriptors: Descriptors) -> Iterator[str]:
    """The lines of the nodes, parents before children."""
    signs = descriptors.signs
    rng = np.random.default_rng(1)
    waiting = deque([Node(0, np.arange(len(signs)), 0)])
    number = 0
    while waiting:
        parent = waiting.popleft()
        centres, nearest = clustered(signs[parent.members], rng)
        for k, centre in enumerate(centres):
            members = parent.members[nearest == k]
            if not len(members):
                continue
            number += 1
            level = parent.level + 1
            is_small = level > 1 and len(members) <= FEW
            is_word = level >= LEVELS or is_small or is_one(descriptors, members)
            weight = 0.0
            if is_word:
                seen = len(np.unique(descriptors.image[members]))
                weight = np.log(descriptors.images / seen)
            code = " ".join(map(str, np.packbits(centre > 0)))
            yield f"{parent.number} {int(is_word)} {code} {weight:.6g}"
            if not is_word:
                waiting.append(Node(number, members, level))


def is_one(descriptors: Descriptors, members: np.ndarray) -> bool:
    """Whether some descriptors are equal."""
    return len(np.unique(descriptors.data[members], axis=0)) == 1


def clustered(
    signs: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Up to ten centres, and for each descriptor the number of the nearest: k-majority."""
    if len(signs) <= BRANCHES:
        return signs, np.arange(len(signs))
    centres = seeds(signs, rng)
    nearest = (signs @ centres.T).argmax(1)
    for _ in range(ROUNDS):
        for k in range(len(centres)):
            members = nearest == k
            if members.any():
                centres[k] = np.where(signs[members].sum(0) >= 0, 1, -1)
        before = nearest
        nearest = (signs @ centres.T).argmax(1)
        if (nearest == before).all():
            break
    return centres, nearest


def seeds(signs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """First centres, far from each other (k-means++)."""
    chosen = [signs[rng.integers(len(signs))]]
    apart = np.full(len(signs), np.inf)
    while len(chosen) < BRANCHES:
        apart = np.minimum(apart, (BITS - signs @ chosen[-1]) / 2)
        chance = apart.astype(np.float64) ** 2
        if not chance.any():
            break
        chosen.append(signs[rng.choice(len(signs), p=chance / chance.sum())])
    return np.stack(chosen)
