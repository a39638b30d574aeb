"""The tracker of a run: made from the options, its state as arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from hybridvo.flow import FlowProvider
from hybridvo.odometry import Odometry
from hybridvo.options import Options
from hybridvo.refinement.photometric import PhotometricOptions
from hybridvo.refinement.refine import RefinementOptions
from hybridvo.tracking.anchor import dump_anchor, load_anchor
from hybridvo.tracking.window import WindowOptions
from hybridvo.types import Step


def make_tracker(options: Options, flow: FlowProvider, network: str | None = None) -> Odometry:
    """Tracker with these options; ``network`` is a file of one's own weights."""
    refine, photometric, track = options.refine, options.photometric, options.track
    return Odometry(
        flow=flow,
        method=options.run.method,
        polish=photometric.mode,
        window=track.window,
        window_options=WindowOptions(inflation=track.inflation),
        history=track.motion_prior,
        policy=track.on_failure,
        options=RefinementOptions(cutoff=refine.cutoff, tiles=refine.tiles),
        photometric=PhotometricOptions(
            iterations=photometric.iterations,
            pixels=photometric.pixels,
        ),
        seed=options.run.seed,
    )


def state_arrays(vo: Odometry) -> dict[str, np.ndarray]:
    """State after the last frame, for an ``.npz`` file."""
    stored = dump_anchor(vo.anchor)
    plain = {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in stored.items()
        if key != "place"
    }
    place = stored["place"]
    plain["place"] = None if place is None else [part.tolist() for part in place]
    return {"anchor": np.array(json.dumps(plain))}


def resume(vo: Odometry, arrays: Mapping[str, np.ndarray], sequence: Any) -> None:
    """Put the tracker where :func:`state_arrays` was called."""
    stored = json.loads(str(arrays["anchor"]))
    vo.resume(load_anchor(stored, stored["keys"], sequence.frame))


def probability(step: Step) -> float:
    """Probability of the motion being the camera's."""
    state = step.status.state.value
    return float(getattr(step.motion, "probability", 0.0 if state == "failed" else 1.0))
