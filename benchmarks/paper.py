"""Figures 2 and 4 of the paper: `python benchmarks/paper.py --out DIR` is `lgsens paper --out DIR`."""

import sys

from lgsens.cli._main import main

if __name__ == "__main__":
    sys.exit(main(["paper", *sys.argv[1:]]))
