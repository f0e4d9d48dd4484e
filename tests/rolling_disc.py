"""A disc that rolls without slip on the plane z = 0, without multipliers.

With the contact at r from the centre, ẋ = −ω × r, so ẍ = −ω̇ × r − ω × ṙ, and ṙ follows from ė = ω × e. The force at the
contact is F = m (ẍ − g), and I ω̇ + ω × I ω = r × F determines ω̇: I ω̇ + m r × (ω̇ × r) = −ω × I ω − m r × (ω × ṙ + g).
"""

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lgsens as lg

MASS, RADIUS, MOMENTS, G = 2.0, 0.3, np.array([0.05, 0.09, 0.05]), np.array([0.0, 0.0, -9.81])  # axle: body axis y
N = np.array([0.0, 0.0, 1.0])
TILT, SPIN = 0.35, np.array([0.4, 6.0, 0.5])  # of the reference: about x; and Ω in the body frame


def scene(tilt=TILT, spin=SPIN, radius=RADIUS, mass=MASS) -> lg.Model:
    """The disc at rest of centre, of which the joint makes a rolling one."""
    c, s = jnp.cos(tilt), jnp.sin(tilt)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    turn = jnp.stack([jnp.stack([one, zero, zero]), jnp.stack([zero, c, -s]), jnp.stack([zero, s, c])])
    height = jnp.stack([zero, zero, radius * c])
    disc = lg.RigidBody(mass, MOMENTS, position=height, orientation=turn, angular_velocity=spin)
    rolling = lg.Rolling("disc", at=height, axis=turn[:, 1], radius=radius)
    return lg.Model({"disc": disc}, {"rolling": rolling}, {"weight": lg.Gravity(tuple(G))})


def contact(orientation, omega):
    """r and ṙ."""
    e = orientation[:, 1]
    u = N - (N @ e) * e
    de = np.cross(omega, e)
    du = -(N @ de) * e - (N @ e) * de
    length = np.linalg.norm(u)
    return -RADIUS * u / length, -RADIUS * (du / length - u * (u @ du) / length**3)


def accelerations(orientation, omega):
    """ẍ and ω̇ in the inertial frame, and the force of the ground on the disc."""
    r, dr = contact(orientation, omega)
    inertia = orientation @ np.diag(MOMENTS) @ orientation.T
    cross = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    rhs = -np.cross(omega, inertia @ omega) - MASS * np.cross(r, np.cross(omega, dr) + G)
    turning = np.linalg.solve(inertia - MASS * cross @ cross, rhs)
    linear = -np.cross(turning, r) - np.cross(omega, dr)
    return linear, turning, MASS * (linear - G)


def motion(orientation, omega, times):
    """Position of the centre from the origin, orientation and ω at the times, to 1e-12."""

    def rate(t, y):
        orientation, omega = y[3:12].reshape(3, 3), y[12:]
        r, _ = contact(orientation, omega)
        _, turning, _ = accelerations(orientation, omega)
        turn = np.cross(omega, orientation.T).T
        return np.concatenate([-np.cross(omega, r), turn.ravel(), turning])

    start = np.concatenate([np.zeros(3), np.ravel(orientation), omega])
    y = solve_ivp(rate, (times[0], times[-1]), start, method="DOP853", t_eval=times, rtol=1e-12, atol=1e-13).y.T
    return y[:, :3], y[:, 3:12].reshape(-1, 3, 3), y[:, 12:]


def turned(tilt):
    """The orientation of `scene`."""
    c, s = np.cos(tilt), np.sin(tilt)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def flow(y):
    """Rates of the tilt and of ω in axes that head where the disc does, x forward, z up."""
    tilt, omega = y[0], y[1:]
    orientation = turned(tilt)
    axle = orientation[:, 1]
    change, level = np.cross(omega, axle), axle * (1.0 - N)
    heading = N @ np.cross(level, change) / (level @ level)
    _, turning, _ = accelerations(orientation, omega)
    return np.concatenate([[N @ change / np.cos(tilt)], turning - heading * np.cross(N, omega)])
