"""``python -m hybridvo``: the command line."""

import sys

from hybridvo.cli import main

if __name__ == "__main__":
    sys.exit(main())
