"""`python -m lgsens` is the console script `lgsens`."""

import sys

from lgsens.cli import main

if __name__ == "__main__":
    sys.exit(main())
