"""What a mechanism looks like, in the frames of its bodies: the one description that figures and animations draw.

Elements say what they are drawn as, and where (`AbstractElement`). A body is drawn from the points at which joints
hold it: two make a bar, more a solid. With one point (a pendulum, a top) it is a bar to the centre of mass and a box,
with none a box: the homogeneous cuboid of its mass and inertia, a small cube of a point mass, and of a body on a joint
where that would be larger than the scene. A body with a tyre is a wheel. Springs are coils, dampers tubes with a rod,
massless rods lines, elements of beams bent lines.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from lgsens.model import MultibodySystem

GROUND = -1
_TURNS, _RADIUS = 6, 0.12  # of a coil; the radius as a fraction of its length in the reference configuration
_PIECES = 8  # of a bent line; a straight one has as many
_POINT = 0.06  # side of the cube that stands for a point mass, as a fraction of the length of the scene


class Outline(NamedTuple):
    """A line or a closed polygon fixed to a body: points in its frame [m], shape (n, 3)."""

    body: int
    role: str
    points: np.ndarray
    filled: bool = False


class StrutShape(NamedTuple):
    """What stretches between two bodies: a coil ("spring"), a tube ("damper"), a rod ("link") or what bends ("beam");
    points [m], and of a beam its directions there, in the frames of the bodies; the name of the element."""

    role: str
    a: int
    at_a: np.ndarray
    b: int
    at_b: np.ndarray
    radius: float  # of the coil [m]
    owner: str
    along_a: np.ndarray | None = None
    along_b: np.ndarray | None = None


class CentreMark(NamedTuple):
    """A point of a body [m]: a joint, or a tyre's centre."""

    body: int
    at: np.ndarray


class Tyre(NamedTuple):
    """A wheel's centre, and the road under it."""

    centre: CentreMark
    road: Any  # t ↦ height [m]


class Shapes(NamedTuple):
    """The shapes of a scene; bodies are numbered as in its system, −1 is the ground."""

    outlines: list[Outline]
    struts: list[StrutShape]
    joints: list[CentreMark]
    tyres: list[Tyre]


def shapes(system: MultibodySystem) -> Shapes:
    """The shapes of a system with concrete numbers."""
    position, orientation = (np.asarray(array) for array in system.pose)
    held: list[list[np.ndarray]] = [[] for _ in system.body_names]
    struts, joints, tyres, axes, wheels = [], [], [], {}, {}
    for stack in (*system.constraints, *system.loads):
        for i, owner in enumerate(stack.owners):
            element: Any = jax.tree.map(lambda leaf, i=i: leaf[i], stack.elements)
            ends = {"a": GROUND if stack.a is None else stack.a[i], "b": GROUND if stack.b is None else stack.b[i]}
            marks = [CentreMark(ends[end], np.asarray(at)) for end in ends for at in element.fixed("point", end)]
            role = element.drawn if marks else None
            if not marks and element.fixed("axis", "b"):
                axes.setdefault(owner, []).append((*ends.values(), np.asarray(element.fixed("axis", "b")[0])))
            if role in ("joint", "link", "beam"):
                joints += {"joint": marks[:1], "link": marks, "beam": []}[role]
                for mark in marks:
                    if mark.body != GROUND:
                        held[mark.body].append(mark.at)
            if role in ("link", "beam", "spring", "damper") and len(marks) > 1:
                (a, at_a), (b, at_b) = marks[0], marks[-1]
                line = _world(position, orientation, b, at_b) - _world(position, orientation, a, at_a)
                struts.append(StrutShape(role, a, at_a, b, at_b, _RADIUS * float(np.linalg.norm(line)), owner))
                if role == "beam":
                    along_a, along_b = (np.asarray(element.fixed("axes", end)[0])[:, 0] for end in ends)
                    struts[-1] = struts[-1]._replace(along_a=along_a, along_b=along_b)
            if role == "wheel":
                tyres.append(Tyre(marks[-1], element.road))
            if role == "tyre":
                wheels[marks[-1].body] = marks[-1].at, float(element.radius), np.asarray(element.fixed("axis", "b")[0])
    if system.centre is not None:  # a body with a pivot has it in place of a joint
        for body, (own, centre) in enumerate(zip(held, np.asarray(system.centre))):
            if centre.any():
                own.append(np.zeros(3))
                joints.append(CentreMark(body, np.zeros(3)))
    for body, at in (tyre.centre for tyre in tyres):
        axis = _spin_axis(orientation, axes.values(), body)
        wheels[body] = *_disc(position, orientation, body, at, axis), axis
    outlines = []
    for body, points in enumerate(held):
        if body in wheels and wheels[body][1] > 0:
            centre, radius, axis = wheels[body]
            outlines.append(Outline(body, "wheel", centre + radius * _circle(axis, orientation[body]), True))
        else:
            outlines += _solid(system, body, _distinct(points))
    return Shapes(outlines, struts, joints, tyres)


def _world(position, orientation, body: int, at) -> np.ndarray:
    """Body-fixed points in the inertial frame, shape of `at`; the last axis holds coordinates."""
    return at if body == GROUND else position[body] + at @ orientation[body].T


def placed(shape: Outline | CentreMark, position, orientation) -> np.ndarray:
    """The points of an outline, or a mark, in the inertial frame, at the given poses of all bodies."""
    return _world(position, orientation, shape.body, shape.points if isinstance(shape, Outline) else shape.at)


def stretched(strut: StrutShape, position, orientation) -> list[np.ndarray]:
    """The lines that a strut is drawn with, in the inertial frame: a coil; a rod and its tube; a line, bent or not."""
    a = _world(position, orientation, strut.a, strut.at_a)
    b = _world(position, orientation, strut.b, strut.at_b)
    if strut.role == "spring":
        return [coil(a, b, strut.radius)]
    if strut.along_a is not None and strut.along_b is not None:
        directions = ((strut.a, strut.along_a), (strut.b, strut.along_b))
        return [bent(a, b, *(at if of == GROUND else orientation[of] @ at for of, at in directions))]
    line = np.stack([a, b])
    return [line, np.stack([a, a + 0.6 * (b - a)])] if strut.role == "damper" else [line]


def corners(scene: Shapes, position, orientation) -> np.ndarray:
    """The points of a scene that must be in sight, in the inertial frame, shape (n, 3); coils are their axes."""
    lines = ((strut.role, stretched(strut, position, orientation)[0]) for strut in scene.struts)
    ends = [line[[0, -1]] if role == "spring" else line for role, line in lines]
    return np.concatenate(
        [*(placed(shape, position, orientation).reshape(-1, 3) for shape in (*scene.outlines, *scene.joints)), *ends]
    )


def coil(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """A coil between two points, straight at both ends, shape (n, 3); a line where they meet."""
    length = np.linalg.norm(b - a)
    if length == 0:
        return np.stack([a, b])
    axis = (b - a) / length
    first = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    s = np.linspace(0, 1, 20 * _TURNS + 1)[:, None]
    wave = 2 * np.pi * _TURNS * s
    turns = a + (0.1 + 0.8 * s) * (b - a) + radius * (np.cos(wave) * first + np.sin(wave) * second)
    return np.concatenate([[a, a + 0.1 * (b - a)], turns, [b - 0.1 * (b - a), b]])


def bent(a: np.ndarray, b: np.ndarray, along_a: np.ndarray, along_b: np.ndarray) -> np.ndarray:
    """A curve between two points with these unit tangents, shape (n, 3): the cubic that of an arc has the middle too,
    and of a quarter of a circle is off by 3e-4 of the radius."""
    cosine = float(np.clip(along_a @ along_b, -1.0, 1.0))
    speed = 2.0 * np.linalg.norm(b - a) / (1.0 + np.sqrt((1.0 + cosine) / 2.0))
    s = np.linspace(0.0, 1.0, _PIECES + 1)[:, None]
    ends = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * a + s**2 * (3.0 - 2.0 * s) * b
    return ends + speed * (s * (1.0 - s) ** 2 * along_a - s**2 * (1.0 - s) * along_b)


def _distinct(points: list[np.ndarray]) -> np.ndarray:
    found: list[np.ndarray] = []
    for point in points:
        if all(np.abs(point - other).max() > 1e-9 for other in found):
            found.append(point)
    return np.array(found).reshape(-1, 3)


def _solid(system: MultibodySystem, body: int, points: np.ndarray) -> list[Outline]:
    """The outlines of a body that joints hold at some points of its frame."""
    if len(points) == 2:
        return [Outline(body, "link", points)]
    if len(points) > 2:
        return [Outline(body, "body", face, True) for face in _hull(points)]
    centre = np.zeros(3) if system.centre is None else np.asarray(system.centre[body])
    box = [Outline(body, "body", face, True) for face in _box(system, body, points, centre)]
    off = len(points) == 1 and np.abs(points[0] - centre).max() > 1e-9
    return [Outline(body, "link", np.stack([points[0], centre])), *box] if off else box


def _box(system: MultibodySystem, body: int, points: np.ndarray, centre: np.ndarray) -> list[np.ndarray]:
    """The faces of the homogeneous cuboid with a body's mass and inertia: J₁ = m (L₂² + L₃²)/12 and so on."""
    mass, inertia = float(system.mass[body]), np.asarray(system.inertia[body])
    inertia = inertia - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))  # about the centre of mass
    moments, axes = np.linalg.eigh(inertia)
    half = np.sqrt(np.maximum(6 * (moments.sum() - 2 * moments) / mass, 0.0)) / 2
    size = float(np.max(system.coordinate_scale()))
    if not inertia.any() or (len(points) and np.max(2 * half) > size):
        half = np.full(3, _POINT * size / 2)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half @ axes.T + centre
    faces = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    return [corners[list(face)] for face in faces]


def _spin_axis(orientation: np.ndarray, owners, wheel: int) -> np.ndarray:
    """The axis of the wheel's hinge, in its frame; without one y of its frame, if that points to the left, or of the
    inertial frame.

    A hinge and a sleeve have two orthogonalities, both with their axis in b; no other joint has two.
    """
    for elements in owners:
        a, b, axis = elements[0]
        if len(elements) == 2 and wheel in (a, b):
            inertial = axis if b == GROUND else orientation[b] @ axis
            return orientation[wheel].T @ inertial
    left = np.array([0.0, 1.0, 0.0])
    return left if orientation[wheel][1, 1] > 0.8 else orientation[wheel].T @ left


def _disc(position, orientation, wheel: int, at: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre of a wheel in its frame, and the radius with which it touches the road, z = 0: where its tyre acts, or, of
    one that leans, whose tyre acts over its contact centre, its centre of mass, which is as high."""
    tyre, centre = _world(position, orientation, wheel, at), position[wheel]
    if abs(tyre[2] - centre[2]) < 1e-6 * abs(tyre[2]) and np.linalg.norm(tyre - centre) < 0.4 * abs(tyre[2]):
        at = np.zeros(3)
    inclined = (orientation[wheel] @ axis)[2]
    return at, float(tyre[2] / np.sqrt(max(1.0 - inclined**2, 0.1)))


def _circle(axis: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """A circle of radius 1 about an axis of the body, closed; its first point is level with the centre."""
    first = np.cross(axis, orientation.T @ np.array([0.0, 0.0, 1.0]))
    first = first / np.linalg.norm(first)
    second = np.cross(axis, first)
    angle = np.linspace(0, 2 * np.pi, 73)[:, None]
    return np.cos(angle) * first + np.sin(angle) * second


def _hull(points: np.ndarray) -> np.ndarray:
    """The triangles of the convex hull, shape (m, 3, 3); of points in a plane, the polygon through them."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).simplices]
    except QhullError:
        return points[None]
