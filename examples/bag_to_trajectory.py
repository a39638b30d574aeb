"""Turn a recording into a trajectory, and print its errors where ground truth is known.

    python examples/bag_to_trajectory.py drive.bag path.tum

Bags need the extra: pip install "hybridvo[bags]". Any other recording does as well.
"""

from __future__ import annotations

import sys

import hybridvo as hvo
from hybridvo.io.data.sequence import Sequence


def track(sequence: Sequence) -> hvo.Trajectory:
    """Track a recording; frames whose motion failed are left out."""
    tracker = hvo.Odometry()
    stamps = []
    poses = []
    for index in range(len(sequence)):
        step = tracker.track(sequence[index])
        if step.usable:
            stamps.append(step.timestamp)
            poses.append(step.T_world_cam)
    return hvo.Trajectory(stamps, poses)


def main(arguments: list[str]) -> int:
    """Track a recording and write its trajectory in TUM's form."""
    if len(arguments) != 2:
        print("usage: bag_to_trajectory.py RECORDING PATH.tum", file=sys.stderr)
        return 2
    recording, path = arguments
    try:
        sequence = hvo.open_sequence(recording)
    except hvo.InputError as error:
        print(error, file=sys.stderr)
        return 2
    trajectory = track(sequence)
    trajectory.save(path)
    print(f"{path}: {len(trajectory)} of {len(sequence)} frames")
    if sequence.poses is not None:
        truth = hvo.Trajectory(sequence.timestamps, sequence.poses)
        errors = hvo.evaluate(trajectory, truth)
        if errors["ate_rmse"] is None:
            print(f"no ATE: {errors['reasons']['ate_rmse']}")
        else:
            print(f"ATE {100 * errors['ate_rmse']:.2f} cm")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
