"""The console script `lgsens`."""

from lgsens.cli._main import console as console, main as main
