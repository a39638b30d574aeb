"""Runs Rerun's page for a browser until stdin is closed: it ends with the run, however that ends.

Started by :mod:`hybridvo.io.viewer.program` as ``python -m hybridvo.io.viewer.page WORDS``.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Sequence

from hybridvo.io.viewer.program import VIEWER_POLL_S


def main(words: Sequence[str]) -> int:
    """Run ``rerun WORDS`` until stdin is closed; returns its exit code if it ends before."""
    page = subprocess.Popen(
        [sys.executable, "-m", "rerun_cli", *words], stdin=subprocess.DEVNULL
    )
    while page.poll() is None:
        is_closed, _, _ = select.select([sys.stdin], [], [], VIEWER_POLL_S)
        if is_closed:
            # the program that was started here has a child of its own
            os.killpg(os.getpgrp(), signal.SIGTERM)
    return page.returncode or 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
