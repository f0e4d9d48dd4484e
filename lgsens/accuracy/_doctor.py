"""`doctor`: which extremes a scene comes near to, in numbers, with what to do.

Of the tangents at the start, with columns of Z the motions that the joints allow (J Z = 0), M̂ = Zᵀ M Z, K̂ = Zᵀ K_t Z,
Ĉ = Zᵀ C_t Z, the rates of the scene are those of

    M̂ ẍ + Ĉ ẋ + K̂ x = 0,     ẋ = λ x,

Z's own rate left out, (Ω/λ)², and a step h resolves what has |λ| h well below 1. The rest is looked up in one run:
rotations per step, margins to singular configurations, kinks, growth; and in the numbers of the scene.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lgsens._validate import as_count
from lgsens.analysis import constraint_rank, sensitivity_growth
from lgsens.criteria import kinks, roughness
from lgsens.dynamics import RESULTS, full_jacobian
from lgsens.integrate import AbstractIntegrator, GeneralizedAlpha, singular_steps
from lgsens.model import Model
from lgsens.simulation import Trajectory, check_integrator, interval, simulate


@dataclasses.dataclass(frozen=True)
class Finding:
    """How near a scene is to an extreme.

    Attributes:
        extreme: what it is. number: of this scene. limit: from which on it matters; NaN is beyond every limit.
        where: bodies, joints or times. remedy: what to do beyond the limit.
        least: whether small numbers are the extreme ones.
    """

    extreme: str
    number: float
    limit: float
    where: str
    remedy: str
    least: bool = False

    @property
    def near(self) -> bool:
        """Whether the scene is beyond the limit."""
        return not (self.number >= self.limit if self.least else self.number <= self.limit)

    def __str__(self) -> str:
        mark, number = "!" if self.near else " ", f"{self.number:>9.2g}  limit {self.limit:<8.2g}"
        line = f"{mark} {self.extreme:52}{number} {self.where}".rstrip()
        return line + (f"\n      {self.remedy}" if self.near else "")


@dataclasses.dataclass(frozen=True, repr=False)
class Diagnosis:
    """What `doctor` found; printed, a line for each extreme, and a remedy below those that are near."""

    findings: tuple[Finding, ...]

    @property
    def near(self) -> tuple[Finding, ...]:
        """Those beyond their limits."""
        return tuple(finding for finding in self.findings if finding.near)

    def __str__(self) -> str:
        many = len(self.near)
        verdict = f"Extremes that are near: {many}." if many else "Nothing extreme."
        return "\n".join([*map(str, self.findings), verdict])

    __repr__ = __str__


def doctor(
    model: Model, *, t0=0.0, t1, num_steps: int, integrator: AbstractIntegrator = GeneralizedAlpha()
) -> Diagnosis:
    """Which extremes a scene comes near to: the rows of `benchmarks/extremes.py`, asked of a scene and a step.

    Arguments:
        model: the scene, its numbers known, not traced.
        t0, t1, num_steps, integrator: as in `simulate`.

    Costs a run, and one of `sensitivity_growth`. A run that fails is a finding. Raises `ValueError` for bad arguments.
    """
    if not isinstance(model, Model):
        raise ValueError(f"`model` must be a Model, got {type(model).__name__}.")
    num_steps = as_count(num_steps, "num_steps", " (it is static)")
    check_integrator(integrator, num_steps)
    t0, t1 = interval(t0, t1)
    h = float(t1 - t0) / num_steps
    settings = {"t0": t0, "t1": t1, "num_steps": num_steps, "integrator": integrator}
    found = list(of_numbers(model))
    rank = constraint_rank(model, t0=float(t0))
    joints = ", ".join(rank.joints)
    found.append(
        Finding(
            "redundant constraint equations",
            rank.redundant,
            0.0,
            joints,
            "Take a joint with fewer equations, or Model(redundant='remove').",
        )
    )
    trajectory = simulate(model, throw=False, **settings)
    failed = int(trajectory.result)
    found.append(
        Finding(
            "failed steps",
            float(failed != RESULTS.successful),
            0.0,
            RESULTS(failed).message if failed else "",
            "What follows is of the motion before. See notebooks/failures.md.",
        )
    )
    found += _of_run(trajectory, h, rank.reference_rank < rank.rank)
    if not failed:
        growth = sensitivity_growth(model, **settings)
        found.append(
            Finding(
                "exponential growth of small changes, ln g",
                float(np.log(growth.factor[-1])) if bool(growth.exponential) else 0.0,
                0.0,
                "",
                "The motion is unstable or chaotic: shorten the run, or average over many; see `sensitivity_growth`.",
            )
        )
    return Diagnosis(tuple(found))


def of_numbers(model: Model):
    """Masses, inertias, and units."""
    moving = {name: body for name, body in model.bodies.items() if body.free}
    mass = {name: float(body.mass) for name, body in moving.items()}
    light, heavy = min(mass, key=mass.__getitem__), max(mass, key=mass.__getitem__)
    yield Finding(
        "mass ratio",
        mass[heavy] / mass[light],
        1e6,
        f"{heavy!r} over {light!r}",
        "Let the light body be massless (lgsens.model.Rod), or hold it (Merged).",
    )
    system = model.system()
    length = float(jnp.max(system.coordinate_scale()))
    turning = {
        name: body for name, body in moving.items() if body.inertia is not None and {*body.free} & {"rx", "ry", "rz"}
    }
    if turning:
        moments = {name: np.linalg.eigvalsh(np.asarray(body.inertia_matrix)) for name, body in turning.items()}
        gyration = {name: np.sqrt(moments[name] / mass[name]) / length for name in turning}
        thin, wide = (pick(gyration, key=lambda name: gyration[name][end]) for pick, end in ((min, 0), (max, 2)))
        yield Finding(
            "least radius of gyration over the scene's length",
            float(gyration[thin][0]),
            1e-5,
            repr(thin),
            "A nearly zero inertia turns about that axis at once: give the inertia that the body has, make it a point "
            "mass (inertia=None), or a Rod.",
            least=True,
        )
        yield Finding(
            "largest radius of gyration over the scene's length",
            float(gyration[wide][2]),
            10.0,
            repr(wide),
            "No body is so much larger than its scene: inertia in kg mm² with lengths in m? lgsens wants SI.",
        )
    fields = (getattr(force, "acceleration", None) for force in model.forces.values())
    for field in filter(eqx.is_array, fields):
        yield Finding(
            "gravity [m/s²]",
            float(jnp.linalg.norm(field)),
            100.0,
            "",
            "That is mm/s²: lengths in mm give forces in mN and rates 1000 times too large. lgsens wants SI.",
        )


def _rates(trajectory: Trajectory) -> np.ndarray:
    """|λ| at the start [1/s], by size."""
    system, state = trajectory.system, trajectory.state(0)
    count = system.group.dim - system.num_states
    mass = np.asarray(system.mass_matrix())[:count, :count]
    tangents = system.tangents(state.q, state.v, state.vdot, state.lam, trajectory.t[0])
    stiffness, damping = (np.asarray(matrix)[:count, :count] for matrix in (tangents.stiffness, tangents.damping))
    # in coordinates of unit size, by masses
    size = 1.0 / np.sqrt(np.maximum(np.diag(mass), np.finfo(mass.dtype).tiny))
    jacobian = np.asarray(full_jacobian(system, state.q, trajectory.t[0]))[:, :count] * size
    _, values, right = np.linalg.svd(jacobian)
    z = size[:, None] * right[int(np.sum(values > 1e-9 * values.max(initial=0.0))) :].T
    m, c, k = (z.T @ matrix @ z for matrix in (mass, damping, stiffness))
    n = len(m)
    if not n:
        return np.zeros(1)
    first = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(m, k), -np.linalg.solve(m, c)]])
    return np.sort(np.abs(np.linalg.eigvals(first)))


def _of_run(trajectory: Trajectory, h: float, singular: bool):
    """Stiffness, spin, margins and kinks."""
    rates = _rates(trajectory)
    slow = rates[rates > 1e-6 * rates[-1]]
    yield Finding(
        "fastest mode at the start times the step, |λ| h",
        float(rates[-1] * h),
        1.0,
        f"{rates[-1]:.3g} 1/s",
        "Steps do not resolve it: Generalized-α damps it, explicit schemes fail. If it matters take smaller steps, "
        "else make a bushing a joint (lgsens.model.Joint), or ask `lgsens.accuracy.fidelity`.",
    )
    ratio = float(rates[-1] / slow[0]) if len(slow) else 1.0
    yield Finding(
        "fastest mode over the slowest",
        ratio,
        1e5,
        "",
        "Stiff: an implicit scheme (GeneralizedAlpha, RadauIIA), and what is fast as rigid.",
    )
    system = trajectory.of_bodies()[0]
    spins = {
        name: float(jnp.nanmax(jnp.linalg.norm(trajectory.body(name).angular_velocity, axis=1)))
        for name in system.body_names
    }
    fast = max(spins, key=spins.__getitem__)
    yield Finding(
        "largest rotation in a step [rad]",
        spins[fast] * h,
        0.5,
        repr(fast),
        "A step is good to (Ω h)²/12: take more steps, or `accuracy.work_precision`.",
    )
    margins = np.asarray(trajectory.stats.margin)
    known = margins[np.isfinite(margins)]
    least = float(known.min() / known.max()) if len(known) and known.max() > 0.0 else 1.0
    if singular or (len(known) and bool(jnp.any(singular_steps(trajectory.stats.margin)))):
        least = 0.0
    yield Finding(
        "least margin to a singular configuration",
        least,
        1e-3,
        "",
        "Branches of the motion meet there: avoid it by a stop, an offset or a shorter run.",
        least=True,
    )
    rough = roughness(trajectory)
    places = kinks(trajectory, rough)
    yield Finding(
        "kinks of forces inside of steps",
        float(len(places)),
        0.0,
        ", ".join(map(str, places[:3])),
        "Let a step end there (an edge of a road), or smooth the force over several steps; see `certify`.",
    )
    yield Finding(
        "share of steps that do not resolve accelerations",
        float(rough.unresolved),
        0.1,
        "",
        "Take many more steps, or model what is fast as rigid.",
    )
