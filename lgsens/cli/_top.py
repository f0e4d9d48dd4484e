"""`lgsens top`: the sensitivity of the paper's spinning top by every method, beside its reference value."""

import argparse
import math
import time

import jax
import jax.numpy as jnp

from lgsens._progress import compiling
from lgsens.criteria import time_integral
from lgsens.examples import spinning_top
from lgsens.sensitivity import AbstractSensitivity, AdjointVariable, DirectDifferentiation
from lgsens.simulation import simulate

# Converged, l = 1 m and α₀ = π/4; the paper prints the value at α₀ = 0.785398, and l = 0.5 m by mistake.
REFERENCE = -0.0021318254254500
PAPER = -0.002131825283595
# The difference formula is of fourth order like the paper's: its error at this step is below 1e-9.
PERTURBATION = 2e-3


def run(arguments: argparse.Namespace) -> int:
    """Print Ψ and dΨ/dα₀ by DDM, AVM, the explicit AVM and differences."""
    if arguments.h > 0.1:
        raise ValueError(f"argument --h: must be at most 0.1 s, a tenth of the simulated second, got {arguments.h}")
    num_steps = max(1, round(1.0 / arguments.h))
    alpha0 = jnp.asarray(math.pi / 4)

    def psi(alpha0, sensitivity: AbstractSensitivity = DirectDifferentiation()):
        trajectory = simulate(spinning_top(alpha0), t1=1.0, num_steps=num_steps, sensitivity=sensitivity)
        return time_integral(trajectory.t, trajectory.body("top").position[:, 0] ** 2)

    value_and_grad = jax.jit(jax.value_and_grad(psi))  # compiled once for its value, too

    def differences(alpha0):
        p = PERTURBATION
        inner, outer = (value_and_grad(alpha0 + d)[0] - value_and_grad(alpha0 - d)[0] for d in (p, 2 * p))
        return (8 * inner - outer) / (12 * p)

    methods = {
        "DDM, jax.jacfwd": jax.jit(jax.jacfwd(psi)),
        "AVM, jax.grad": lambda alpha0: value_and_grad(alpha0)[1],
        "AVM, AdjointVariable()": jax.jit(jax.grad(lambda alpha0: psi(alpha0, AdjointVariable()))),
        "finite differences": differences,
    }
    print(f"Spinning top, l = 1 m, alpha_0 = pi/4, t = 0..1 s, h = {1 / num_steps:g} s, rho_inf = 0.9")
    with compiling("value and gradient"):
        psi_there = float(value_and_grad(alpha0)[0])
    print(f"Psi = {psi_there:.16f}\n")
    print(f"{'dPsi/dalpha_0':<28}{'value':>22}{'relative error':>17}{'time [ms]':>12}")
    for name, derivative in methods.items():
        with compiling(name):
            jax.block_until_ready(derivative(alpha0))
        started = time.perf_counter()
        value = float(derivative(alpha0))
        milliseconds = 1e3 * (time.perf_counter() - started)
        print(f"{name:<28}{value:>22.16f}{abs(value / REFERENCE - 1):>17.2e}{milliseconds:>12.1f}")
    print(f"{'reference, converged':<28}{REFERENCE:>22.16f}")
    print(f"{'paper, alpha_0 = 0.785398':<28}{PAPER:>22.15f}{abs(PAPER / REFERENCE - 1):>17.2e}")
    return 0
