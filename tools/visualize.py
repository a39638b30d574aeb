"""``hybridvo show`` under its old path: the maps of one pair of a sequence in one image."""

import sys

from hybridvo.cli import main

if __name__ == "__main__":
    sys.exit(main(["show", *sys.argv[1:]]))
