"""`python -m lgsens` is the console script `lgsens`."""

from lgsens.cli import console

if __name__ == "__main__":
    console()
