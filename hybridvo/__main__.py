"""``python -m hybridvo``: the command line."""

import sys

from hybridvo.run.cli import main

if __name__ == "__main__":
    sys.exit(main())
