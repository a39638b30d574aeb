"""``hybridvo generate``: draw training samples into a folder, and show some of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from hybridvo.evaluation.plots import Panel, draw_panels, flow_colours, longest_flow
from hybridvo.files import atomic_write
from hybridvo.synthetic.dataset import load_preset, read_sample, write_samples
from hybridvo.synthetic.layered import Sample


def generate(
    preset: str,
    count: int,
    out: str | Path,
    *,
    seed: int = 0,
    size: Sequence[int] | None = None,
    workers: int = 1,
    quiet: bool = True,
) -> Path:
    """Draw samples, and a contact sheet of the first; goes on where it was interrupted."""
    with Progress(console=Console(stderr=True, quiet=quiet)) as bar:
        task = bar.add_task("samples", total=count)
        for done in write_samples(load_preset(preset, size), count, out, seed, workers):
            bar.update(task, completed=done)
    sheet = Path(out) / "contact_sheet.png"
    write_sheet([read_sample(out, i) for i in range(min(6, count))], sheet)
    return sheet


def write_sheet(samples: Sequence[Sample], path: str | Path) -> None:
    """Write a PNG with the five steps of each sample in a row; depth is bright where near."""
    panels = [panel for sample in samples for panel in _steps(sample)]
    height, width = samples[0].moving.shape
    with atomic_write(path, "wb") as file:
        file.write(draw_panels(panels, "", width / height, columns=7, inches=2.0))


def _steps(sample: Sample) -> list[Panel]:
    """Images of the five steps."""
    height, width = sample.moving.shape
    x = (np.arange(width) - sample.K[0, 2]) / sample.K[0, 0]
    y = (np.arange(height) - sample.K[1, 2]) / sample.K[1, 1]
    rays = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
    longest = longest_flow(sample.flow)
    depths = (sample.depth_prev, sample.depth_curr)
    near = [np.where(z > 0, 1 / np.maximum(z, 1e-9), np.nan) for z in depths]
    return [
        Panel("1 rays of K", flow_colours(rays, 1.0)),
        Panel("2 inverse depth of t", near[0], "1/m"),
        Panel("3 what moves", sample.moving.astype(float), "", 1.0),
        Panel("4 camera's flow", flow_colours(sample.ego_flow, longest)),
        Panel("4 objects' flow", flow_colours(sample.flow - sample.ego_flow, longest)),
        Panel("5 total flow", flow_colours(sample.flow, longest)),
        Panel("5 inverse depth of t+1", near[1], "1/m"),
    ]
