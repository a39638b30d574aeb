"""hybridvo in an environment from which some libraries are missing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = """
import sys
class Environment:
    # finds packages as usual, but for those that are hidden
    def __init__(self, finder, hidden):
        self.finder = finder
        self.hidden = hidden
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, *where):
        if name.partition(".")[0] in self.hidden:
            return None
        return self.finder.find_spec(name, *where)
hidden = sys.argv[1].split(",")
sys.meta_path[:] = [Environment(finder, hidden) for finder in sys.meta_path]
from hybridvo.run.cli import main
sys.exit(main(sys.argv[2:]))
"""


def run_without(
    libraries: str, *arguments: object
) -> subprocess.CompletedProcess[str]:
    """Run the command line where some libraries, separated by commas, are not installed."""
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, libraries, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.fspath(ROOT)},
    )
