"""``hybridvo train`` as a file: trains the networks."""

import sys

from hybridvo.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
