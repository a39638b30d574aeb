"""Camera poses for robot learning: columns of a table, and UMI's camera_trajectory.csv.

hybridvo run demo.bag --mask hands --out runs/demo    # hands/: 0 where hand and gripper are
python examples/robot_learning.py runs/demo           # writes runs/demo/camera_trajectory.csv
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd

POSE = ("x", "y", "z", "q_x", "q_y", "q_z", "q_w")


def columns(run: Path) -> pd.DataFrame:
    """A row for each frame: pose, whether it may be trained on, how sure it is.

    ``camera_pose`` and the columns behind it are what a LeRobot data set keeps beside its images.
    """
    steps = pd.read_csv(run / "steps.csv")
    poses = np.loadtxt(run / "trajectory.tum", comments="#", ndmin=2)[:, 1:]
    table = steps[["index", "timestamp", "status", "probability"]].copy()
    table["camera_pose"] = list(poses.astype(np.float32))
    table["pose_ok"] = steps["status"] == "ok"
    # the path is broken here: train on windows that hold no such frame
    table["pose_lost"] = steps["status"] == "failed"
    return table


def umi(table: pd.DataFrame) -> pd.DataFrame:
    """The same as UMI reads it, which leaves lost frames out."""
    poses = pd.DataFrame(table["camera_pose"].tolist(), columns=list(POSE))
    lost = table["pose_lost"].map({True: "true", False: "false"})
    state = table["pose_lost"].map({True: 1, False: 2})
    first = table["timestamp"].iloc[0]
    head = {
        "frame_idx": table["index"],
        "timestamp": (table["timestamp"] - first).round(6),
        "state": state,
        "is_lost": lost,
        "is_keyframe": "false",
    }
    return pd.DataFrame(head).join(poses)


def main(run: Path) -> None:
    """Write the poses of a run for UMI."""
    table = columns(run)
    umi(table).to_csv(run / "camera_trajectory.csv", index=False)
    print(table["status"].value_counts().to_dict())


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: robot_learning.py FOLDER_OF_A_RUN")
    main(Path(sys.argv[1]))
