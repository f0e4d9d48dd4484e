"""The rows of the table of extremes are those of the benchmark, and asked for here."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
