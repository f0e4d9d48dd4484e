"""Rigid bodies and joints in plain JAX, elements stacked by type: what a good engineer would write without lgsens.

Coordinates of a body: [x, θ], θ in the body frame. `position` and `rotation` carry the ground as their last row. B has
its closed form; stiffness and damping come from `jax.jacfwd` of the force of one element, under `vmap`.
"""

import jax
import jax.numpy as jnp
import numpy as np

DIM = 6


def skew(v):
    """v× for a stack of vectors."""
    zero = jnp.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape[:-1], 3, 3)


def _point_rows(ra, rb, pa, pb):
    """The gradient of the vector from a point of a to a point of b, (3, 12)."""
    eye = jnp.eye(3)
    return jnp.concatenate([-eye, ra @ skew(pa), eye, -rb @ skew(pb)], axis=1)


def _coincident_rows(xa, ra, xb, rb, pa, pb):
    return _point_rows(ra, rb, pa, pb)


def _orthogonal_rows(xa, ra, xb, rb, ea, eb):
    zero = jnp.zeros(3)
    return jnp.concatenate([zero, jnp.cross(ea, ra.T @ (rb @ eb)), zero, jnp.cross(eb, rb.T @ (ra @ ea))])[None]


def _in_plane_rows(xa, ra, xb, rb, pa, pb, ea):
    d = xb + rb @ pb - xa - ra @ pa
    zero = jnp.zeros(3)
    turning = jnp.concatenate([zero, jnp.cross(ea, ra.T @ d), zero, zero])
    return ((ra @ ea) @ _point_rows(ra, rb, pa, pb) + turning)[None]


_CONSTRAINTS = (
    ("coincident", _coincident_rows, lambda xa, ra, xb, rb, pa, pb: xb + rb @ pb - xa - ra @ pa),
    ("orthogonal", _orthogonal_rows, lambda xa, ra, xb, rb, ea, eb: (ra @ ea) @ (rb @ eb)[:, None]),
    (
        "in_plane",
        _in_plane_rows,
        lambda xa, ra, xb, rb, pa, pb, ea: (ra @ ea) @ (xb + rb @ pb - xa - ra @ pa)[:, None],
    ),
)


def _elements(numbers, topology, position, rotation):
    """(rows, value, ends, arguments of all elements) of each kind of constraint that the scene has."""
    for name, rows, value in _CONSTRAINTS:
        ends = getattr(topology, name)
        if len(ends):
            a, b = ends[:, 0], ends[:, 1]
            yield rows, value, ends, (position[a], rotation[a], position[b], rotation[b], *getattr(numbers, name))


def _coordinates(ends):
    """The 12 coordinates of each element, (elements, 12)."""
    return (ends[:, :, None] * DIM + np.arange(DIM)).reshape(len(ends), 2 * DIM)


def separation_rows(position, rotation, ends, points_a, points_b):
    """The vectors between pairs of points, and their gradients."""
    a, b = ends[:, 0], ends[:, 1]
    d = position[b] + jnp.einsum("eij,ej->ei", rotation[b], points_b)
    d = d - position[a] - jnp.einsum("eij,ej->ei", rotation[a], points_a)
    return d, jax.vmap(_point_rows)(rotation[a], rotation[b], points_a, points_b)


def constraint(numbers, topology, position, rotation):
    """Φ."""
    elements = _elements(numbers, topology, position, rotation)
    return jnp.concatenate([jax.vmap(value)(*arguments).ravel() for _, value, _, arguments in elements])


def constraint_jacobian(numbers, topology, position, rotation):
    """B."""
    width = DIM * rotation.shape[0]
    blocks = []
    for rows, _, ends, arguments in _elements(numbers, topology, position, rotation):
        block = jax.vmap(rows)(*arguments)
        e, r, _ = block.shape
        columns = np.broadcast_to(_coordinates(ends)[:, None], block.shape).reshape(e * r, -1)
        full = jnp.zeros((e * r, width)).at[np.arange(e * r)[:, None], columns].add(block.reshape(e * r, -1))
        blocks.append(full)
    return jnp.concatenate(blocks)[:, : width - DIM]


def _moved(x, r, w):
    """A pose moved by w to first order, which is all that a derivative at w = 0 sees."""
    return x + w[:3], r @ (jnp.eye(3) + skew(w[3:]))


def _joint_stiffness(rows, lam, xa, ra, xb, rb, *rest):
    """D(Bᵀλ) of one element, (12, 12)."""
    force = lambda w: lam @ rows(*_moved(xa, ra, w[:DIM]), *_moved(xb, rb, w[DIM:]), *rest)
    return jax.jacfwd(force)(jnp.zeros(2 * DIM))


def _spring_force(xa, ra, xb, rb, va, vb, pa, pb, stiffness, damping, free_length, preload):
    """What a spring and damper adds to the residual, (12,)."""
    d = xb + rb @ pb - xa - ra @ pa
    rows = _point_rows(ra, rb, pa, pb)
    length = jnp.sqrt(d @ d)
    along = (d / length) @ rows
    return (preload + stiffness * (length - free_length) + damping * (along @ jnp.concatenate([va, vb]))) * along


def bushing_gradient(xa, ra, xb, rb, pb):
    """The point of b in the frame of a, and its gradient, (3, 12)."""
    r = ra.T @ (xb + rb @ pb - xa)
    return r, ra.T @ _point_rows(ra, rb, r, pb)


def _bushing_force(xa, ra, xb, rb, va, vb, pa, pb, stiffness, damping, preload):
    """What springs and dampers along the axes of a add to the residual, (12,)."""
    r, rows = bushing_gradient(xa, ra, xb, rb, pb)
    return (preload + stiffness * (r - pa) + damping * (rows @ jnp.concatenate([va, vb]))) @ rows


def bump(tyre, t):
    """The height of the road at t."""
    phase = t / tyre[4]
    return jnp.where((phase >= 0) & (phase <= 1), tyre[3] * jnp.sin(jnp.pi * phase) ** 2, 0.0)


def forces(numbers, topology, position, rotation, v, t):
    """Gyroscopic terms, weight, springs and tyre, as they enter the residual, (6 n,)."""
    n = numbers.mass.shape[0]
    spin = v.reshape(n, DIM)[:, 3:]
    turning = jnp.cross(spin, jnp.einsum("nij,nj->ni", numbers.inertia, spin))
    found = jnp.concatenate([-numbers.mass[:, None] * numbers.gravity, turning], axis=1)
    found = jnp.concatenate([found.ravel(), jnp.zeros(DIM)])
    for force, ends, arguments in _force_elements(numbers, topology, position, rotation, v):
        found = found.at[_coordinates(ends)].add(jax.vmap(force)(*arguments))
    if topology.wheel is not None:
        stiffness, radius, preload, *_ = numbers.tyre
        push = preload + stiffness * (bump(numbers.tyre, t) + radius - position[topology.wheel, 2])
        found = found.at[topology.wheel * DIM + 2].add(-push)
    return found[: n * DIM]


def _force_elements(numbers, topology, position, rotation, v):
    """(force, ends, arguments of all elements) of each kind of force between bodies that the scene has."""
    twist = jnp.concatenate([v.reshape(-1, DIM), jnp.zeros((1, DIM))])
    for name, force in (("springs", _spring_force), ("bushings", _bushing_force)):
        ends = getattr(topology, name)
        if len(ends):
            a, b = ends[:, 0], ends[:, 1]
            own = getattr(numbers, name)
            yield force, ends, (position[a], rotation[a], position[b], rotation[b], twist[a], twist[b], *own)


def tangents(numbers, topology, position, rotation, v, lam):
    """K and C of the residual, (6 n, 6 n) each."""
    n = numbers.mass.shape[0]
    width = DIM * (n + 1)
    stiffness, damping = jnp.zeros((width, width)), jnp.zeros((width, width))
    start = 0
    for rows, _, ends, arguments in _elements(numbers, topology, position, rotation):
        r = jax.eval_shape(jax.vmap(rows), *arguments).shape[1]
        mine = lam[start : start + r * len(ends)].reshape(len(ends), r)
        block = jax.vmap(lambda *arguments, rows=rows: _joint_stiffness(rows, *arguments))(mine, *arguments)
        where = _coordinates(ends)
        stiffness = stiffness.at[where[:, :, None], where[:, None, :]].add(block)
        start += r * len(ends)
    for force, ends, arguments in _force_elements(numbers, topology, position, rotation, v):
        where = _coordinates(ends)
        zero = jnp.zeros(2 * DIM)

        def of_position(xa, ra, xb, rb, *rest, force=force, zero=zero):
            moved = lambda w: force(*_moved(xa, ra, w[:DIM]), *_moved(xb, rb, w[DIM:]), *rest)
            return jax.jacfwd(moved)(zero)

        def of_velocity(xa, ra, xb, rb, va, vb, *rest, force=force, zero=zero):
            moving = lambda w: force(xa, ra, xb, rb, va + w[:DIM], vb + w[DIM:], *rest)
            return jax.jacfwd(moving)(zero)

        stiffness = stiffness.at[where[:, :, None], where[:, None, :]].add(jax.vmap(of_position)(*arguments))
        damping = damping.at[where[:, :, None], where[:, None, :]].add(jax.vmap(of_velocity)(*arguments))
    if topology.wheel is not None:
        height = topology.wheel * DIM + 2
        stiffness = stiffness.at[height, height].add(numbers.tyre[0])
    spin = v.reshape(n, DIM)[:, 3:]
    momentum = jnp.einsum("nij,nj->ni", numbers.inertia, spin)
    turn = np.arange(n)[:, None] * DIM + np.arange(3, DIM)
    gyroscopic = skew(spin) @ numbers.inertia - skew(momentum)
    damping = damping.at[turn[:, :, None], turn[:, None, :]].add(gyroscopic)
    return stiffness[: n * DIM, : n * DIM], damping[: n * DIM, : n * DIM]


def mass_matrix(numbers):
    """M, (6 n, 6 n)."""
    n = numbers.mass.shape[0]
    blocks = jnp.zeros((n, DIM, DIM)).at[:, :3, :3].set(numbers.mass[:, None, None] * jnp.eye(3))
    blocks = blocks.at[:, 3:, 3:].set(numbers.inertia)
    where = np.arange(n * DIM).reshape(n, DIM)
    return jnp.zeros((n * DIM, n * DIM)).at[where[:, :, None], where[:, None, :]].set(blocks)
