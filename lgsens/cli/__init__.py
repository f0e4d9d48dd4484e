"""The console script `lgsens`."""

from lgsens.cli._main import main as main
