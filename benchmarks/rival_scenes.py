"""The scenes of `rivals.py`: what lgsens is given, and the same numbers as plain arrays for everyone else.

A scene has a vector p of design parameters. `model(p)` is its lgsens model; `numbers(p)` builds the arrays of the same
mechanism without lgsens: bodies, the basic constraints of the joints stacked by type, springs, the tyre. Both can be
traced, so every program differentiates the same function of p. Only the data file of the suspension is shared.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lgsens as lg
from lgsens.examples import QuarterCar, spatial_chain, spinning_top

GRAVITY = 9.81


class Numbers(NamedTuple):
    """All numbers of a mechanism; every orientation is the identity at first. Points and axes are body-fixed."""

    mass: Any  # (n,)
    inertia: Any  # (n, 3, 3)
    position: Any  # (n, 3)
    velocity: Any  # (n, 3)
    spin: Any  # (n, 3)
    gravity: Any  # (3,)
    coincident: Any  # (points on a, points on b), (c, 3) each: they coincide
    orthogonal: Any  # (axes in a, axes in b), (o, 3) each: they stay orthogonal
    in_plane: Any  # (points on a, points on b, axes in a), (i, 3) each: the line between the points ⟂ the axis
    springs: Any  # (points on a, points on b, stiffness, damping, free length, preload), (s, 3) and (s,)
    tyre: Any  # (stiffness, free radius, preload, bump height, bump duration), () each; () if there is none
    bushings: Any = ()  # (points on a, points on b, stiffness, damping, preload along the axes of a), (b, 3) each


_NO_ELEMENTS = np.zeros((0, 2), int)


class Topology(NamedTuple):
    """Which bodies the elements connect, (elements, 2) each; the ground is body n."""

    coincident: np.ndarray
    orthogonal: np.ndarray
    in_plane: np.ndarray
    springs: np.ndarray
    wheel: int | None  # the body on whose centre of mass the tyre acts
    bushings: np.ndarray = _NO_ELEMENTS


class Scene(NamedTuple):
    """One scene; the criterion is Ψ = ∫ f dt, f the square of one entry of position or acceleration of a body."""

    name: str
    t1: float
    num_steps: int
    start: np.ndarray  # p
    names: tuple[str, ...]  # of p
    model: Callable[..., lg.Model]  # of p, and of the settings of `QuarterCar.model`
    numbers: Callable[[Any], Numbers]
    topology: Topology
    bodies: tuple[str, ...]
    observed: tuple[str, str, int]  # body, "position" or "acceleration", axis
    breaks: tuple[float, ...] = ()  # where forces are not smooth
    subsets: tuple[tuple[str, tuple[int, ...]], ...] = ()  # entries of p for forward mode
    batch: int = 0  # designs in a batch, if batches are measured
    all_numbers: bool = True  # whether the gradient with respect to all numbers is measured
    reduced: dict[str, str] | None = None  # settings of a model with fewer unknowns
    reference_steps: int | None = None  # equal steps of the reference, where error control would take too long
    reference_route: str = "index-reduced"  # with those steps; or "extrapolation"
    of_system: bool = False  # programs of the equations; what makes them of p is too long to be compiled with them

    def arrays(self) -> Numbers:
        """The numbers at the start, as NumPy arrays."""
        return jax.tree.map(np.asarray, jax.jit(self.numbers)(jnp.asarray(self.start)))

    @property
    def scale(self) -> np.ndarray:
        """The size of a change of p: itself, 10 mm for coordinates near 0."""
        return np.maximum(np.abs(self.start), 0.01)


def _none(width: int) -> tuple:
    return tuple(jnp.zeros((0, 3)) for _ in range(width))


def _no_springs() -> tuple:
    return (*_none(2), *(jnp.zeros(0) for _ in range(4)))


def top() -> Scene:
    """The spinning top: 6 coordinates, 3 constraints; Ψ = ∫ x² dt."""

    def numbers(p):
        alpha0, mass, length, spin = p
        axis = jnp.stack([jnp.zeros_like(alpha0), jnp.cos(alpha0), jnp.sin(alpha0)])
        return Numbers(
            mass=mass[None],
            inertia=jnp.diag(jnp.array([0.2, 0.4, 0.2]))[None],
            position=(length * axis)[None],
            velocity=jnp.zeros((1, 3)),
            spin=(spin * axis)[None],
            gravity=jnp.array([0.0, 0.0, -GRAVITY]),
            coincident=(jnp.zeros((1, 3)), (-length * axis)[None]),
            orthogonal=_none(2),
            in_plane=_none(3),
            springs=_no_springs(),
            tyre=(),
        )

    return Scene(
        name="top",
        t1=1.0,
        num_steps=1000,
        start=np.array([np.pi / 4, 15.0, 1.0, 10.0]),
        names=("alpha0", "mass", "length", "spin"),
        model=lambda p: spinning_top(p[0], p[1], length=p[2], spin=p[3]),
        numbers=numbers,
        topology=Topology(np.array([[1, 0]]), _NO_ELEMENTS, _NO_ELEMENTS, _NO_ELEMENTS, None),
        bodies=("top",),
        observed=("top", "position", 0),
        subsets=(("2 parameters", (0, 1)),),
        batch=64,
    )


def _normals(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    unit = axis / np.linalg.norm(axis)
    first = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    first /= np.linalg.norm(first)
    return unit, first, np.cross(unit, first)


def quarter_car(bushings: Sequence[str] = ()) -> Scene:
    """The five-link quarter-car, wheel locked: 48 coordinates, 46 constraints; Ψ₀ = ∫ z̈² dt of the chassis.

    p: stiffness, damping, the chassis ends and the knuckle ends of the five links. Spring and tyre are preloaded so
    that the car rests at the design position, whatever p. `bushings`: the links held by one at the knuckle, of
    1e8 N/m and 1e4 N s/m in every direction, preloaded like the spring.
    """
    car = QuarterCar.load()
    links = sorted(car.links)
    ends = [np.stack([np.asarray(getattr(car.links[n], end)) for n in links]) for end in ("chassis", "knuckle")]
    start = np.concatenate([[float(car.spring.rate), float(car.damper.rate)], ends[0].ravel(), ends[1].ravel()])
    bodies = ("chassis", "knuckle", "wheel", *links)
    chassis, knuckle, wheel, ground = 0, 1, 2, len(bodies)
    number = {name: i for i, name in enumerate(bodies)}
    # hub; the links at the chassis; the links at the knuckle
    arms = [number[n] for n in links]
    soft = [n in bushings for n in links]
    firm = [i for i, is_soft in zip(arms, soft) if not is_soft]
    rubber = np.array([[knuckle, i] for i, is_soft in zip(arms, soft) if is_soft]).reshape(-1, 2)
    coincident = np.array([[knuckle, wheel], *([chassis, i] for i in arms), *([knuckle, i] for i in firm)])
    orthogonal = np.array([[ground, chassis]] * 3 + [[knuckle, wheel]] * 3 + [[chassis, i] for i in arms])
    struts = np.array([[number[strut.link], chassis] for strut in (car.spring, car.damper)])
    topology = Topology(coincident, orthogonal, np.array([[ground, chassis]] * 2), struts, wheel, rubber)
    up, side, across = _normals(np.array([0.0, 0.0, 1.0]))
    x, y, z = np.eye(3)
    parts = [getattr(car, name) for name in bodies[:3]]

    def model(p, **settings):
        ends = lambda c: [getattr(c.links[n], end) for end in ("chassis", "knuckle") for n in links]
        where = lambda c: [c.spring.rate, c.damper.rate, *ends(c)]
        moved = eqx.tree_at(where, car, [p[0], p[1], *p[2:].reshape(10, 3)])
        return moved.model(wheel="locked", bushings=bushings, **settings)

    def numbers(p):
        inner, outer = p[2:17].reshape(5, 3), p[17:].reshape(5, 3)
        along = outer - inner
        square = jnp.sum(along**2, axis=1)[:, None, None]
        projection = along[:, :, None] * along[:, None, :] / square
        masses = jnp.stack([car.links[n].mass for n in links])
        radius = car.link_radius
        bars = masses[:, None, None] * (
            radius**2 / 2 * projection + (square / 12 + radius**2 / 4) * (jnp.eye(3) - projection)
        )
        position = jnp.concatenate([jnp.stack([part.centre for part in parts]), (inner + outer) / 2])
        position_of = jnp.concatenate([position, jnp.zeros((1, 3))])

        def local(points, pairs):
            return tuple(points[i] - position_of[pairs[:, i]] for i in (0, 1))

        held = outer[np.array(soft)]
        joints = jnp.concatenate([car.bearing[None], inner, outer[~np.array(soft)]])
        every_way = jnp.ones((len(rubber), 3))
        arm = jnp.cross(x, along)
        arm = arm - (arm @ x)[:, None] * x
        arm = arm / jnp.linalg.norm(arm, axis=1, keepdims=True)
        elements = (car.spring, car.damper)
        ends = [jnp.stack([getattr(s, end) for s in elements]) for end in ("link_point", "chassis_point")]
        found = Numbers(
            mass=jnp.concatenate([jnp.stack([part.mass for part in parts]), masses]),
            inertia=jnp.concatenate([jnp.stack([jnp.diag(part.inertia) for part in parts]), bars]),
            position=position,
            velocity=jnp.zeros((len(bodies), 3)),
            spin=jnp.zeros((len(bodies), 3)),
            gravity=jnp.array([0.0, 0.0, -GRAVITY]),
            coincident=local((joints, joints), coincident),
            orthogonal=(
                jnp.concatenate([jnp.stack([up, side, across, x, y, z]), jnp.tile(x, (5, 1))]),
                jnp.concatenate([jnp.stack([side, across, up, y, z, x]), arm]),
            ),
            in_plane=(*(jnp.tile(q, (2, 1)) for q in (car.chassis.centre, jnp.zeros(3))), jnp.stack([side, across])),
            springs=(
                *local(ends, struts),
                jnp.stack([p[0], jnp.zeros_like(p[0])]),
                jnp.stack([jnp.zeros_like(p[1]), p[1]]),
                jnp.linalg.norm(ends[1] - ends[0], axis=1),
                jnp.zeros(2),
            ),
            tyre=(car.tyre_stiffness, car.wheel.centre[2], jnp.zeros(()), car.bump_height, car.bump_duration),
            bushings=(
                (*local((held, held), rubber), 1e8 * every_way, 1e4 * every_way, 0.0 * every_way) if bushings else ()
            ),
        )
        return preloaded(found, topology)

    return Scene(
        name="stiff_quarter_car" if bushings else "quarter_car",
        t1=1.0,
        num_steps=1000,
        start=start,
        names=(
            "stiffness",
            "damping",
            *(f"{n}.{end}.{axis}" for end in ("chassis", "knuckle") for n in links for axis in "xyz"),
        ),
        model=model,
        numbers=numbers,
        topology=topology,
        bodies=bodies,
        observed=("chassis", "acceleration", 2),
        breaks=(0.25,),
        subsets=(("2 parameters", (0, 1)), ("30 hardpoint coordinates", tuple(range(2, 32)))),
        reduced=None if bushings else {"chassis": "heave", "links": "rods"},
        reference_steps=10_000 if bushings else None,
    )


def preloaded(numbers: Numbers, topology: Topology) -> Numbers:
    """The first spring, the tyre and the bushings hold the mechanism at rest: A [λ; F] = weight, by least squares."""
    from rival_equations import bushing_gradient, constraint_jacobian, separation_rows

    n = numbers.mass.shape[0]
    eye = jnp.broadcast_to(jnp.eye(3), (n + 1, 3, 3))
    position = jnp.concatenate([numbers.position, jnp.zeros((1, 3))])
    jacobian = constraint_jacobian(numbers, topology, position, eye)
    ends = topology.springs[:1]
    d, rows = separation_rows(position, eye, ends, numbers.springs[0][:1], numbers.springs[1][:1])
    pull = (d[0] / jnp.linalg.norm(d[0])) @ rows[0]
    columns = (ends[0][:, None] * 6 + np.arange(6)).ravel()
    spring = jnp.zeros(6 * (n + 1)).at[columns].add(pull)[: 6 * n]
    tyre = jnp.zeros(6 * n).at[6 * topology.wheel + 2].add(-1.0)
    pulls = [spring[:, None], tyre[:, None]]
    for i, (body_a, body_b) in enumerate(topology.bushings):
        _, rows = bushing_gradient(position[body_a], eye[body_a], position[body_b], eye[body_b], numbers.bushings[1][i])
        columns = np.concatenate([body * 6 + np.arange(6) for body in (body_a, body_b)])
        pulls.append(jnp.zeros((6 * (n + 1), 3)).at[columns].add(rows.T)[: 6 * n])
    a = jnp.concatenate([jacobian.T, *pulls], axis=1)
    weight = jnp.zeros((n, 6)).at[:, :3].set(numbers.mass[:, None] * numbers.gravity).ravel()
    m = a.shape[1]
    matrix = jnp.block([[jnp.eye(6 * n), a], [a.T, jnp.zeros((m, m))]])
    force = jnp.linalg.solve(matrix, jnp.concatenate([weight, jnp.zeros(m)]))[6 * n + jacobian.shape[0] :]
    if numbers.bushings:
        numbers = numbers._replace(bushings=(*numbers.bushings[:4], force[2:].reshape(-1, 3)))
    springs = (*numbers.springs[:5], jnp.stack([force[0], jnp.zeros(())]))
    return numbers._replace(springs=springs, tyre=(*numbers.tyre[:2], force[1], *numbers.tyre[3:]))


def chain(num_links: int) -> Scene:
    """A spatial chain of hinged links: 6 N coordinates, 5 N constraints; Ψ = ∫ z² dt of the middle one."""

    def numbers(p):
        length, mass, tilt, spin = p
        i = np.arange(num_links)
        axis = jnp.stack([jnp.zeros(num_links), jnp.cos(tilt * i), jnp.sin(tilt * i)], axis=1)
        across = jnp.stack([jnp.zeros(num_links), -jnp.sin(tilt * i), jnp.cos(tilt * i)], axis=1)
        along = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (num_links, 1))
        width = 0.1 * length
        moments = mass / 12 * jnp.stack([2 * width**2, length**2 + width**2, length**2 + width**2])
        rate = jnp.tile(spin * axis[:1], (num_links, 1))
        position = (i + 0.5)[:, None] * length * along
        half = 0.5 * length * along
        return Numbers(
            mass=jnp.full(num_links, mass),
            inertia=jnp.tile(jnp.diag(moments), (num_links, 1, 1)),
            position=position,
            velocity=jnp.cross(rate, position),
            spin=rate,
            gravity=jnp.array([0.0, 0.0, -GRAVITY]),
            coincident=(half.at[0].set(0.0), -half),
            orthogonal=(jnp.concatenate([along, across]), jnp.concatenate([axis, axis])),
            in_plane=_none(3),
            springs=_no_springs(),
            tyre=(),
        )

    pairs = np.stack([np.r_[num_links, np.arange(num_links - 1)], np.arange(num_links)], axis=1)
    return Scene(
        name=f"chain_{num_links}",
        t1=0.1,
        num_steps=100,
        start=np.array([0.3, 0.5, 1.0, min(3.0, 24.0 / num_links)]),  # the end no faster than 8 m/s
        names=("length", "mass", "tilt", "spin"),
        model=lambda p: spatial_chain(num_links, p[0], p[1], p[2], p[3]),
        numbers=numbers,
        topology=Topology(pairs, np.concatenate([pairs, pairs]), _NO_ELEMENTS, _NO_ELEMENTS, None),
        bodies=tuple(f"link{i}" for i in range(num_links)),
        observed=(f"link{num_links // 2}", "position", 2),
        all_numbers=False,
        reference_steps=4 * 100,
        reference_route="extrapolation",
        of_system=True,
    )


SCENES: dict[str, Callable[[], Scene]] = {
    "top": top,
    "quarter_car": quarter_car,
    "stiff_quarter_car": lambda: quarter_car(("wishbone", "guide_link")),
} | {f"chain_{n}": (lambda n=n: chain(n)) for n in (2, 8, 32, 128, 512)}
