"""The heavy top of Brüls, Cardona & Arnold (2012): order of q, v and λ, with and without the second-order start.

`python benchmarks/heavy_top.py [--out DIR]` prints the tables and writes heavy_top.json and heavy_top.png.

The special start is that of Arnold, Brüls & Cardona (Numerische Mathematik 129, 2015). The exact motion is that of
Euler's equations about the fixed point, by scipy's DOP853: no constraint, no multiplier and nothing of lgsens in it.
"""

import argparse
import json
import os
import platform
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens import plotting
from lgsens.cli._report import version
from lgsens.examples import PROBLEMS, heavy_top

STATES = Path(__file__).parents[1] / "tests" / "data" / "heavy_top_bruls2012.json"
T1 = 0.2
NUM_STEPS = (200, 400, 800, 1600, 3200)
FIRST = 20  # steps that count as the start
SHOWN = 800  # steps of the run whose start is drawn
RHO_INF = 0.9
RTOL = 1e-13
STARTS = {"second-order start": True, "a_0 = vdot_0": False}
UNITS = {"position": "m", "rotation": "rad", "velocity": "m/s", "angular velocity": "rad/s", "multiplier": "N"}


class Motion(NamedTuple):
    """The top over time; arrays with a leading axis over the times."""

    position: np.ndarray  # of the centre of mass, inertial frame
    rotation: np.ndarray  # body to inertial frame
    velocity: np.ndarray
    angular_velocity: np.ndarray  # body frame
    multiplier: np.ndarray  # force of the top on the ground, inertial frame


def exact_motion(t: np.ndarray) -> Motion:
    """J_O Ω̇ = J_O Ω × Ω + X × Rᵀ m g and Ṙ = R Ω̃ about the fixed point; then x = R X and λ = m (g − ẍ)."""
    p = PROBLEMS["heavy_top_bruls2012.to_1s"].parameters
    arm, gravity = np.array([0.0, p["l"], 0.0]), np.array([0.0, 0.0, -p["g"]])
    steiner = p["m"] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    inertia = np.diag([p["J11"], p["J22"], p["J33"]]) + steiner

    def angular_acceleration(rotation, omega):
        moment = np.cross(arm, p["m"] * np.swapaxes(rotation, -1, -2) @ gravity)
        return np.linalg.solve(inertia, (moment + np.cross(omega @ inertia, omega))[..., None])[..., 0]

    def slope(_, y):
        rotation, omega = y[:9].reshape(3, 3), y[9:]
        return np.concatenate([np.cross(rotation, omega).ravel(), angular_acceleration(rotation, omega)])

    start = np.concatenate([np.eye(3).ravel(), [0.0, p["Om2"], p["Om3"]]])
    # Interpolation between steps is of lower order than the steps, which are kept short for it.
    found = solve_ivp(slope, (0.0, t[-1]), start, "DOP853", t, rtol=RTOL, atol=RTOL, max_step=1e-4)
    rotation, omega = found.y[:9].T.reshape(-1, 3, 3), found.y[9:].T
    local = np.cross(omega, np.cross(omega, arm)) + np.cross(angular_acceleration(rotation, omega), arm)
    turned = lambda vector: np.einsum("nij,nj->ni", rotation, vector)
    return Motion(
        position=rotation @ arm,
        rotation=rotation,
        velocity=turned(np.cross(omega, arm)),
        angular_velocity=omega,
        multiplier=p["m"] * (gravity - turned(local)),
    )


def published_states() -> tuple[np.ndarray, Motion]:
    """Times and states of the reference file: another integrator, on quaternions in 80 bits."""
    states = [s for s in json.loads(STATES.read_text(encoding="utf-8"))["states"] if 0 < s["t"] <= T1]
    column = lambda name: np.array([state[name] for state in states], float)
    rotation = Rotation.from_quat(np.roll(column("quat_wxyz"), -1, axis=1)).as_matrix()
    return column("t"), Motion(column("x"), rotation, column("xdot"), column("Omega"), column("lam"))


def simulated(num_steps: int, second_order_start: bool) -> Motion:
    scheme = lg.GeneralizedAlpha(RHO_INF, second_order_start=second_order_start)
    return motion_of(lg.simulate(heavy_top(), t1=T1, num_steps=num_steps, integrator=scheme))


def motion_of(trajectory: lg.Trajectory) -> Motion:
    body = trajectory.body("top")
    motion = (body.position, body.orientation, body.velocity, body.angular_velocity, trajectory.multiplier("pivot"))
    return Motion(*map(np.asarray, motion))


def errors(motion: Motion, exact: Motion) -> dict[str, np.ndarray]:
    """Length of the error of each quantity at each time: of vectors, and of the rotation between the orientations."""
    length = lambda a, b: np.linalg.norm(a - b, axis=1)
    between = np.swapaxes(exact.rotation, 1, 2) @ motion.rotation
    return {
        "position": length(motion.position, exact.position),
        "rotation": Rotation.from_matrix(between).magnitude(),
        "velocity": length(motion.velocity, exact.velocity),
        "angular velocity": length(motion.angular_velocity, exact.angular_velocity),
        "multiplier": length(motion.multiplier, exact.multiplier),
    }


def measure() -> dict:
    """All numbers, as for JSON."""
    fine = np.arange(NUM_STEPS[-1] + 1) * (T1 / NUM_STEPS[-1])
    exact = exact_motion(fine)
    t, published = published_states()
    at = np.array([int(np.abs(fine - time).argmin()) for time in t])
    np.testing.assert_allclose(fine[at], t, rtol=1e-12)
    difference = errors(Motion(*(array[at] for array in exact)), published)
    found = {
        "t1": T1,
        "rho_inf": RHO_INF,
        "h": [T1 / n for n in NUM_STEPS],
        "units": UNITS,
        "reference": {
            "route": f"scipy DOP853 on Euler's equations about the fixed point, rtol {RTOL:g}",
            "largest": {
                name: float(np.linalg.norm(getattr(exact, name), axis=1).max()) for name in ("velocity", "multiplier")
            },
            "difference_from_published": {name: float(values.max()) for name, values in difference.items()},
            "published_at": t.tolist(),
            "source": "tests/data/heavy_top_bruls2012.json: Bulirsch-Stoer of order 18 on quaternions in 80 bits",
        },
        "starts": {},
    }
    for name, second_order in STARTS.items():
        rows: dict[str, list[float]] = {}
        first = {}
        for n in NUM_STEPS:
            every = NUM_STEPS[-1] // n
            of_run = errors(simulated(n, second_order), Motion(*(array[::every] for array in exact)))
            of_lam = of_run["multiplier"]
            maxima = {quantity: values.max() for quantity, values in of_run.items()}
            maxima |= {f"multiplier, {FIRST} steps": of_lam[: FIRST + 1].max(), "multiplier, first step": of_lam[1]}
            maxima |= {"multiplier, at the end": of_lam[-1]}
            for quantity, value in maxima.items():
                rows.setdefault(quantity, []).append(float(value))
            first[str(n)] = {"t": fine[::every][: FIRST + 1].tolist(), "error": of_lam[: FIRST + 1].tolist()}
        slopes = {quantity: np.log2(np.divide(e[:-1], e[1:])).tolist() for quantity, e in rows.items()}
        found["starts"][name] = {"largest_error": rows, "slopes_between": slopes, "multiplier_of_first_steps": first}
    return found


def table(found: dict) -> str:
    reference = found["reference"]
    differences = ", ".join(
        f"{name} {value:.1e} {UNITS[name]}" for name, value in reference["difference_from_published"].items()
    )
    times = " and ".join(f"{t:g}" for t in reference["published_at"])
    lines = [
        f"Heavy top, t = 0..{T1:g} s, rho_inf = {RHO_INF}; largest error over all steps against {reference['route']}",
        f"which differs from {reference['source']}, at t = {times} s by: {differences}",
        "largest: " + ", ".join(f"{name} {value:.4g} {UNITS[name]}" for name, value in reference["largest"].items()),
    ]
    for name, start in found["starts"].items():
        lines += ["", f"{name + ', h [s] =':<34}" + "".join(f"{h:>11.4g}" for h in found["h"]) + "   slopes"]
        for quantity, row in start["largest_error"].items():
            unit = UNITS[quantity.partition(",")[0]]
            slopes = "".join(f"{slope:>7.3f}" for slope in start["slopes_between"][quantity])
            lines.append(f"{f'{quantity} [{unit}]':<34}" + "".join(f"{error:>11.3e}" for error in row) + slopes)
    shown = {name: start["multiplier_of_first_steps"][str(SHOWN)] for name, start in found["starts"].items()}
    lines += ["", f"{f'error of multiplier [N], h = {T1 / SHOWN:g} s':<34}" + "".join(f"{name:>22}" for name in shown)]
    for i, t in enumerate(shown["second-order start"]["t"]):
        lines.append(
            f"{f't = {1e3 * t:.2f} ms':<34}" + "".join(f"{start['error'][i]:>22.3e}" for start in shown.values())
        )
    return "\n".join(lines)


def drawn(found: dict):
    """q, v and λ against the step size, and λ over the first steps."""
    panels = []
    for quantity, symbol in (("position", "x"), ("velocity", r"\dot x"), ("multiplier", r"\lambda")):
        series = {name: (found["h"], start["largest_error"][quantity]) for name, start in found["starts"].items()}
        panels.append(plotting.ErrorPanel(f"{quantity} ${symbol}$", f"largest error [{UNITS[quantity]}]", series))
    first = {name: start["multiplier_of_first_steps"][str(SHOWN)] for name, start in found["starts"].items()}
    # The start itself is exact, and zero is not on a logarithmic axis.
    series = {name: (1e3 * np.array(run["t"][1:]), run["error"][1:]) for name, run in first.items()}
    title = rf"$\lambda$ in the first {FIRST} steps, h = {T1 / SHOWN:g} s"
    panels.append(plotting.ErrorPanel(title, "error [N]", series, order=None, horizontal="time [ms]"))
    return plotting.errors(panels, title=f"Heavy top, {T1:g} s, $\\rho_\\infty$ = {RHO_INF}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="folder to write into")
    out: Path = parser.parse_args().out
    jax.config.update("jax_enable_x64", True)
    out.mkdir(parents=True, exist_ok=True)
    found = measure()
    print(table(found))
    found["cores"] = os.cpu_count()
    found["versions"] = {"python": platform.python_version()} | {
        name: version(name) for name in ("lgsens", "jax", "jaxlib", "numpy", "scipy")
    }
    (out / "heavy_top.json").write_text(json.dumps(found, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    plotting.save(drawn(found), out / "heavy_top.png")


if __name__ == "__main__":
    main()
