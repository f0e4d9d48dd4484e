"""Thousands of designs: batches, devices, processes, a folder of results."""

from lgsens.sweeps._sweep import SweepResult as SweepResult, as_designs as as_designs, sweep as sweep
