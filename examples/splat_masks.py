"""Poses and masks for a splat pipeline: what moves is masked, and the rest is trained on.

    python examples/splat_masks.py [RECORDING] [OUT]

Writes images, masks and ``transforms.json``, as nerfstudio and most splat trainers read.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2

from hybridvo.run.cli import main as hybridvo
from hybridvo_lab.synthetic.render import write_sintel
from hybridvo_lab.synthetic.scenes import make_scene


def export(recording: Path, out: Path) -> Path:
    """Track a recording; returns the folder for the trainer."""
    words = ["run", recording, "--out", out, "--export", "transforms,colmap", "-q"]
    exit_code = hybridvo([str(word) for word in words])
    if exit_code:
        raise SystemExit(exit_code)
    return out / "export"


def masked_fractions(folder: Path) -> dict[str, float]:
    """The fraction of every image that a trainer must not use."""
    fractions = {}
    for path in sorted((folder / "masks").iterdir()):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        fractions[path.name] = float((mask == 0).mean())
    return fractions


def rendered(folder: Path, frames: int = 5) -> Path:
    """A room in which things move, in MPI Sintel's layout."""
    scene = make_scene("light", 0, height=109, width=256, frames=frames)
    write_sintel(scene, folder, "room")
    return folder / "training" / "clean" / "room"


if __name__ == "__main__":
    words = sys.argv[1:]
    folder = Path(tempfile.mkdtemp())
    recording = Path(words[0]) if words else rendered(folder)
    out = Path(words[1]) if len(words) > 1 else folder / "run"
    for name, fraction in masked_fractions(export(recording, out)).items():
        print(f"{name}: {100 * fraction:.0f} % masked")
    print(out / "export")
