"""CasADi: the index-reduced equations as scalar expressions, fixed-step RK4, as generated C; gradient by its adjoint.

State of n bodies: positions, unit quaternions, velocities, t and Ψ. Accelerations come from the Schur complement
B M⁻¹ Bᵀ, factorized by CasADi's sparse LDLᵀ as scalar code. CasADi's adjoint of the loop over time is the
gradient with respect to all numbers of the mechanism, from which the one with respect to p follows by a vector-Jacobian
product of the map from p to them. gcc -O1 -march=native compiles: of the
quarter-car's 30,000 scalar operations a higher level makes minutes of compilation.
"""

import importlib
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rival_plain_jax import common_entries
from rival_scenes import Numbers, Scene
from rival_timing import Program

FLAGS = ("-O1", "-march=native", "-fPIC", "-shared")
COARSE = {"top": 140, "quarter_car": 160}  # steps with the accuracy of generalized-α at 1000, or better


def casadi() -> Any:
    return importlib.import_module("casadi")


def version() -> str:
    return casadi().__version__


def _leaves(numbers: Numbers) -> list[tuple[str, Any]]:
    """The numbers of the equations of motion, in the order of θ; inertias with their inverses."""
    found = [("mass", numbers.mass), ("inertia", numbers.inertia), ("inverse", jnp.linalg.inv(numbers.inertia))]
    found.append(("gravity", numbers.gravity))
    for name in ("coincident", "orthogonal", "in_plane", "springs", "tyre", "bushings"):
        found += [(f"{name}{i}", leaf) for i, leaf in enumerate(getattr(numbers, name))]
    return found


def parameters(numbers: Numbers):
    """θ, a vector."""
    return jnp.concatenate([jnp.ravel(leaf) for _, leaf in _leaves(numbers)])


def initial(numbers: Numbers):
    """The initial state, a vector."""
    n = numbers.mass.shape[0]
    quaternions = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), n)
    v = jnp.concatenate([numbers.velocity, numbers.spin], axis=1)
    return jnp.concatenate([numbers.position.ravel(), quaternions, v.ravel(), jnp.zeros(2)])


class Equations:
    """The equations as SX expressions of the state and θ."""

    def __init__(self, scene: Scene):
        ca = self.ca = casadi()
        self.scene = scene
        numbers = scene.arrays()
        sizes = [(name, np.shape(leaf)) for name, leaf in _leaves(numbers)]
        self.n = n = len(scene.bodies)
        self.theta = ca.SX.sym("theta", sum(int(np.prod(shape)) for _, shape in sizes))
        self.offset, start = {}, 0
        for name, shape in sizes:
            self.offset[name] = start
            start += int(np.prod(shape))
        self.state = ca.SX.sym("y", 13 * n + 2)
        x, quaternion, self.v = self.state[: 3 * n], self.state[3 * n : 7 * n], self.state[7 * n : 13 * n]
        self.t = self.state[13 * n]
        self.configuration = ca.vertcat(x, quaternion)
        self.x = [x[3 * i : 3 * i + 3] for i in range(n)] + [ca.SX(3, 1)]
        self.quaternion = [quaternion[4 * i : 4 * i + 4] for i in range(n)]
        self.r = [self._rotation(q) for q in self.quaternion] + [ca.SX.eye(3)]

    def number(self, name: str, i: int = 0):
        return self.theta[self.offset[name] + i]

    def vector(self, name: str, i: int = 0):
        start = self.offset[name] + 3 * i
        return self.theta[start : start + 3]

    def matrix(self, name: str, i: int):
        start = self.offset[name] + 9 * i
        return self.ca.reshape(self.theta[start : start + 9], 3, 3)  # symmetric

    def _rotation(self, q):
        w, x, y, z = q[0], q[1], q[2], q[3]
        rows = (
            (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
        )
        return self.ca.vertcat(*(self.ca.horzcat(*row) for row in rows))

    def _row(self, count: int, parts: dict[int, tuple[Any, Any]]):
        """Rows of B from the (3-column) blocks of translation and rotation of some bodies; the ground has none."""
        rows = self.ca.SX(count, 6 * self.n)
        for body, (translation, rotation) in parts.items():
            if body < self.n:
                if translation is not None:
                    rows[:, 6 * body : 6 * body + 3] = translation
                rows[:, 6 * body + 3 : 6 * body + 6] = rotation
        return rows

    def _jacobian(self):
        ca, topology = self.ca, self.scene.topology
        rows = []
        for i, (a, b) in enumerate(topology.coincident):
            turns = [self.r[k] @ ca.skew(self.vector(f"coincident{j}", i)) for j, k in enumerate((a, b))]
            rows.append(self._row(3, {a: (-ca.SX.eye(3), turns[0]), b: (ca.SX.eye(3), -turns[1])}))
        for i, (a, b) in enumerate(topology.orthogonal):
            ea, eb = self.vector("orthogonal0", i), self.vector("orthogonal1", i)
            turn_a = ca.cross(ea, self.r[a].T @ (self.r[b] @ eb)).T
            turn_b = ca.cross(eb, self.r[b].T @ (self.r[a] @ ea)).T
            rows.append(self._row(1, {a: (None, turn_a), b: (None, turn_b)}))
        for i, (a, b) in enumerate(topology.in_plane):
            pa, pb, ea = (self.vector(f"in_plane{j}", i) for j in range(3))
            axis = self.r[a] @ ea
            d = self.x[b] + self.r[b] @ pb - self.x[a] - self.r[a] @ pa
            turn_a = axis.T @ self.r[a] @ ca.skew(pa) + ca.cross(ea, self.r[a].T @ d).T
            turn_b = -axis.T @ self.r[b] @ ca.skew(pb)
            rows.append(self._row(1, {a: (-axis.T, turn_a), b: (axis.T, turn_b)}))
        return ca.sparsify(ca.vertcat(*rows))

    def _forces(self):
        """The applied and gyroscopic forces, on the right-hand side, (6 n,)."""
        ca, topology = self.ca, self.scene.topology
        spins = [self.v[6 * i + 3 : 6 * i + 6] for i in range(self.n)]
        force = [self.number("mass", i) * self.vector("gravity") for i in range(self.n)]
        moment = [-ca.cross(spins[i], self.matrix("inertia", i) @ spins[i]) for i in range(self.n)]
        for i, (a, b) in enumerate(topology.springs):
            points = [self.vector(f"springs{j}", i) for j in (0, 1)]
            stiffness, damping, free_length, preload = (self.number(f"springs{j}", i) for j in range(2, 6))
            d = self.x[b] + self.r[b] @ points[1] - self.x[a] - self.r[a] @ points[0]
            length = ca.norm_2(d)
            speeds = [self.v[6 * k : 6 * k + 3] + self.r[k] @ ca.cross(spins[k], p) for k, p in zip((a, b), points)]
            rate = ca.dot(d, speeds[1] - speeds[0]) / length
            pull = (preload + stiffness * (length - free_length) + damping * rate) * d / length
            for body, point, sign in ((a, points[0], 1.0), (b, points[1], -1.0)):
                force[body] = force[body] + sign * pull
                moment[body] = moment[body] + sign * ca.cross(point, self.r[body].T @ pull)
        for i, (a, b) in enumerate(topology.bushings):
            pa, pb, stiffness, damping, preload = (self.vector(f"bushings{j}", i) for j in range(5))
            back = self.r[a].T
            place = back @ (self.x[b] + self.r[b] @ pb - self.x[a])
            speed = self.v[6 * b : 6 * b + 3] + self.r[b] @ ca.cross(spins[b], pb) - self.v[6 * a : 6 * a + 3]
            pull = preload + stiffness * (place - pa) + damping * (back @ speed + ca.cross(place, spins[a]))
            force[a], force[b] = force[a] + self.r[a] @ pull, force[b] - self.r[a] @ pull
            moment[a] = moment[a] + ca.cross(place, pull)
            moment[b] = moment[b] - ca.cross(pb, self.r[b].T @ (self.r[a] @ pull))
        if topology.wheel is not None:
            stiffness, radius, preload, height, duration = (self.number(f"tyre{j}") for j in range(5))
            phase = self.t / duration
            road = ca.if_else(phase <= 1, height * ca.sin(np.pi * phase) ** 2, 0)
            push = preload + stiffness * (road + radius - self.x[topology.wheel][2])
            force[topology.wheel] = force[topology.wheel] + ca.vertcat(0, 0, push)
        return ca.vertcat(*(part for pair in zip(force, moment) for part in pair))

    def _solved(self, given=None):
        """(velocities of the configuration, v̇, λ's equation): λ solved for by LDLᵀ, or as given."""
        ca, n = self.ca, self.n
        blocks = [
            block for i in range(n) for block in (ca.SX.eye(3) / self.number("mass", i), self.matrix("inverse", i))
        ]
        inverse = ca.diagcat(*blocks)
        jacobian, force = self._jacobian(), self._forces()
        turning = []
        for i, q in enumerate(self.quaternion):
            w, u, spin = q[0], q[1:], self.v[6 * i + 3 : 6 * i + 6]
            turning.append(ca.vertcat(-ca.dot(u, spin), w * spin + ca.cross(u, spin)) / 2)
        speeds = ca.vertcat(*(self.v[6 * i : 6 * i + 3] for i in range(n)), *turning)
        bias = ca.jtimes(jacobian @ self.v, self.configuration, speeds)
        free = jacobian @ (inverse @ force) + bias
        light = jacobian @ inverse @ jacobian.T
        lam = ca.ldl_solve(free, *ca.ldl(light)) if given is None else given
        return speeds, inverse @ (force - jacobian.T @ lam), free - light @ lam

    def _observed(self, vdot):
        """Ψ̇."""
        body, quantity, axis = self.scene.observed
        index = self.scene.bodies.index(body)
        observed = self.x[index][axis] if quantity == "position" else vdot[6 * index + axis]
        return observed**2

    def function(self):
        """ẏ(y, θ)."""
        speeds, vdot, _ = self._solved()
        rate = self.ca.vertcat(speeds, vdot, 1, self._observed(vdot))
        return self.ca.Function("rate", [self.state, self.theta], [rate])

    def algebraic(self):
        """The same with λ as algebraic variables: what `casadi.integrator` calls a DAE, of index 1.

        ẏ is that of `function`, and 0 = B M⁻¹ (f − Bᵀλ) + Ḃ v.
        """
        ca = self.ca
        lam = ca.SX.sym("lam", self._jacobian().size1())
        speeds, vdot, equation = self._solved(lam)
        rate = ca.vertcat(speeds, vdot, 1, self._observed(vdot))
        return {"x": self.state, "z": lam, "p": self.theta, "ode": rate, "alg": equation}


def arguments(scene: Scene, p):
    """(y₀, θ)."""
    numbers = scene.numbers(p)
    return initial(numbers), parameters(numbers)


def pulled_back(scene: Scene, p, bars):
    """dΨ/dp of dΨ/dy₀ and dΨ/dθ."""
    return jax.vjp(partial(arguments, scene), p)[1](bars)[0]


def puller(scene: Scene):
    """The function that makes dΨ/dp of dΨ/dy₀ and dΨ/dθ, at the start."""
    p = jnp.asarray(scene.start)
    pull_back = jax.jit(partial(pulled_back, scene))
    return lambda bars: np.asarray(pull_back(p, tuple(jnp.asarray(np.asarray(bar).ravel()) for bar in bars)))


def _simulation(rate, num_steps: int, t1: float, name: str):
    """Ψ(y₀, θ) by RK4, an MX function."""
    ca = casadi()
    h = t1 / num_steps
    y, theta = ca.MX.sym("y", rate.size1_in(0)), ca.MX.sym("theta", rate.size1_in(1))
    k1 = rate(y, theta)
    k2 = rate(y + h / 2 * k1, theta)
    k3 = rate(y + h / 2 * k2, theta)
    k4 = rate(y + h * k3, theta)
    step = ca.Function("step", [y, theta], [y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    # two levels: the adjoint keeps the states of the outer loop, and those of one inner loop at a time
    inner = max(n for n in range(1, int(num_steps**0.5) + 1) if num_steps % n == 0)
    outer = _repeated(_repeated(step, inner, "inner"), num_steps // inner, "outer")
    return ca.Function(name, [y, theta], [outer(y, theta)[-1]])


def _repeated(function, count: int, name: str):
    """y ↦ f(f(… f(y, θ) …, θ), θ)."""
    ca = casadi()
    y, theta = (ca.MX.sym(s, function.size1_in(i)) for i, s in enumerate(("y", "theta")))
    last = y
    for _ in range(count):
        last = function(last, theta)
    return ca.Function(name, [y, theta], [last])


def functions(scene: Scene, rate, counts: Iterable[int]) -> list[Any]:
    """For each number of steps Ψ(y₀, θ), and (Ψ, dΨ/dy₀, dΨ/dθ)."""
    ca, found = casadi(), []
    for num_steps in counts:
        psi = _simulation(rate, num_steps, scene.t1, f"psi_{num_steps}")
        y, theta = ca.MX.sym("y", rate.size1_in(0)), ca.MX.sym("theta", rate.size1_in(1))
        value = psi(y, theta)
        outputs = [value, *psi.reverse(1)(y, theta, value, 1)]
        found += [psi, ca.Function(f"gradient_{num_steps}", [y, theta], outputs)]
    return found


def built(functions, folder: Path) -> tuple[list[Callable[..., Any]], float, float]:
    """The functions as compiled C, the seconds that took, and the size of the C source in MB."""
    ca = casadi()
    started = time.perf_counter()
    generator = ca.CodeGenerator("generated.c")
    for function in functions:
        generator.add(function)
    generator.generate(str(folder) + os.sep)
    source, library = folder / "generated.c", folder / "generated.so"
    subprocess.run(["gcc", *FLAGS, str(source), "-o", str(library), "-lm"], check=True)
    found = [ca.external(function.name(), str(library)) for function in functions]
    return found, time.perf_counter() - started, source.stat().st_size / 1e6


def programs(scene: Scene, counts: Mapping[int, str] | None = None) -> list[Program]:
    """Ψ and its gradient at given numbers of steps, the basis of comparison being named with each.

    None: the step of the others, and the step that gives their accuracy.
    """
    if counts is None and scene.name not in COARSE:
        return []
    counts = {scene.num_steps: "equal step", COARSE[scene.name]: "equal accuracy"} if counts is None else counts
    rate = Equations(scene).function()
    numbers = scene.arrays()
    y0, theta = (np.asarray(f(numbers)) for f in (initial, parameters))
    pull_back = puller(scene)
    entries = np.asarray(_entries(numbers)).astype(int)
    with tempfile.TemporaryDirectory() as folder:
        compiled, seconds, size = built(functions(scene, rate, counts), Path(folder))
    details = {"source_megabytes": size, "operations_of_one_evaluation": rate.n_instructions()}
    found = []
    for (num_steps, basis), forward, reverse in zip(counts.items(), compiled[::2], compiled[1::2]):

        def run(forward=forward):
            return float(forward(y0, theta)), None

        def run_all(reverse=reverse):
            value, _, bar = reverse(y0, theta)
            return float(value), np.asarray(bar).ravel()[entries]

        def run_p(reverse=reverse):
            value, *bars = reverse(y0, theta)
            return float(value), pull_back(bars)

        for kind, program, call in (
            ("forward", "generated C, RK4", run),
            ("gradient, all numbers", "generated C, adjoint of RK4", run_all),
            ("gradient, p", "generated C, adjoint of RK4", run_p),
        ):
            found.append(
                Program("CasADi", program, kind, num_steps, basis, call, build_seconds=seconds, details=dict(details))
            )
    return found


def _entries(numbers: Numbers):
    """Where in θ the entries are that are compared with other programs."""
    theta = parameters(numbers)
    count = np.arange(theta.size, dtype=float)
    leaves, start, members = _leaves(numbers), 0, {}
    for name, leaf in leaves:
        members[name] = count[start : start + np.size(leaf)].reshape(np.shape(leaf))
        start += np.size(leaf)
    width = {name: len(getattr(numbers, name)) for name in ("springs", "tyre")}
    groups = {name: tuple(members[f"{name}{i}"] for i in range(size)) for name, size in width.items()}
    return common_entries(numbers._replace(mass=members["mass"], **groups))
