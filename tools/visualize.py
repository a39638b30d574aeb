"""Draw the maps of one pair of a sequence: the same as ``hybridvo show``."""

import sys

from hybridvo.cli import main

if __name__ == "__main__":
    sys.exit(main(["show", *sys.argv[1:]]))
