"""What MuJoCo's parser made of a file, at one configuration."""

from pathlib import Path
from typing import Any

import numpy as np

HINGE, SLIDE, BALL, FREE = "hinge", "slide", "ball", "free"
# of MuJoCo's enumerations
_CODES = {
    "EQ": "mjtEq",
    "TRN": "mjtTrn",
    "DYN": "mjtDyn",
    "GAIN": "mjtGain",
    "BIAS": "mjtBias",
    "CNSTR": "mjtConstraint",
}
_PASSED_OVER = ("transmission", "gazebo", "safety_controller", "calibration")
_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 3, FREE: 6}


class Source:
    """A compiled model and its state, with names for everything; `notes` and `dropped` grow while it is read."""

    def __init__(self, mujoco: Any, source: str | Path, kind: str, qpos, qvel, ctrl, keyframe):
        self.mujoco = mujoco
        self.notes: list[str] = []
        self.dropped: list[str] = []
        self.model = self._compiled(source, kind)
        self.data = mujoco.MjData(self.model)
        if keyframe is not None:
            if any(given is not None for given in (qpos, qvel, ctrl)):
                raise ValueError("`keyframe`: give it, or `qpos`, `qvel` and `ctrl`, not both.")
            qpos, qvel, ctrl = self._keyframe(keyframe)
        for name, given in (("qpos", qpos), ("qvel", qvel), ("ctrl", ctrl)):
            own = getattr(self.data, name)
            if given is not None:
                own[:] = _vector(name, given, own.shape)
        if qpos is None:
            self._follow()
        mujoco.mj_normalizeQuat(self.model, self.data.qpos)
        self.qpos, self.qvel = self.data.qpos.copy(), self.data.qvel.copy()
        mujoco.mj_forward(self.model, self.data)

    def _compiled(self, source: str | Path, kind: str):
        text = str(source)
        is_text = not isinstance(source, Path) and "<" in text
        root = {"MJCF": "<mujoco", "URDF": "<robot"}[kind]
        if not isinstance(source, str | Path) or (not is_text and Path(source).is_dir()):
            raise ValueError(f"`source` must be the path of a file, or its text, got {source!r}.")
        self.name = f"the {kind} text" if is_text else text
        if not is_text:
            text = Path(source).read_text(encoding="utf-8")
        if root not in text:
            raise ValueError(f"{self.name} is no {kind}: it has no element {root}>.")
        # what the parser of URDF passes over
        self.dropped += [f"{text.count(f'<{tag}')} elements <{tag}>" for tag in _PASSED_OVER if f"<{tag}" in text]
        load = self.mujoco.MjModel.from_xml_string if is_text else self.mujoco.MjModel.from_xml_path
        try:
            return load(str(source))
        except ValueError as error:
            raise ValueError(f"{self.name}: MuJoCo cannot read it: {error}") from error

    def _keyframe(self, keyframe):
        model = self.model
        names = [self.named("key", i) for i in range(model.nkey)]
        number = names.index(keyframe) if keyframe in names else keyframe
        if not isinstance(number, int) or not 0 <= number < model.nkey:
            raise ValueError(f"`keyframe`: {keyframe!r} is not one of {names}.")
        return model.key_qpos[number], model.key_qvel[number], model.key_ctrl[number]

    def _follow(self):
        """Coordinates that `joint` equalities give, from the others: q₁ − q₁⁰ = p(q₂ − q₂⁰)."""
        model, equality = self.model, self.code("mjEQ_JOINT")
        for i in range(model.neq):
            if model.eq_type[i] == equality and model.eq_active0[i]:
                first, second = model.eq_obj1id[i], model.eq_obj2id[i]
                x = 0.0 if second < 0 else self._coordinate(second) - self.zero(second)
                value = np.polynomial.polynomial.polyval(x, model.eq_data[i, :5])
                self.data.qpos[model.jnt_qposadr[first]] = self.zero(first) + value

    def _coordinate(self, joint: int) -> float:
        return float(self.data.qpos[self.model.jnt_qposadr[joint]])

    def zero(self, joint: int) -> float:
        """The coordinate of a hinge or slide in the configuration in which the file describes its bodies."""
        return float(self.model.qpos0[self.model.jnt_qposadr[joint]])

    def turned(self, joint: int) -> float:
        """By how much a hinge or slide has moved from there."""
        return joint_value(self, joint) - self.zero(joint)

    def code(self, name: str) -> int:
        """The number of a member of one of MuJoCo's enumerations, mjEQ_WELD say."""
        kind = _CODES.get(name.removeprefix("mj").split("_")[0], "mjtObj")
        return int(getattr(getattr(self.mujoco, kind), name))

    def named(self, kind: str, number: int) -> str:
        of = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        return self.mujoco.mj_id2name(self.model, of, number) or f"{kind} {number}"

    def body_name(self, body: int) -> str:
        return self.named("body", body)

    def joint_name(self, joint: int) -> str:
        """Its own name, or that of its body, with a number where the body has several."""
        model = self.model
        if name := self.mujoco.mj_id2name(model, self.code("mjOBJ_JOINT"), joint):
            return name
        body = int(model.jnt_bodyid[joint])
        one = model.body_jntnum[body] == 1
        return f"{self.body_name(body)} joint" + ("" if one else f" {joint - model.body_jntadr[body] + 1}")

    def mover(self, body: int) -> str | None:
        """The name of the body of the model that moves a body of the file; None: the ground."""
        root = int(self.model.body_weldid[body])
        return self.body_name(root) if root else None

    def kind(self, joint: int) -> str:
        return {0: FREE, 1: BALL, 2: SLIDE, 3: HINGE}[int(self.model.jnt_type[joint])]

    def of_dofs(self, field: str, joint: int) -> float:
        """A number that all degrees of freedom of a joint have."""
        first = self.model.jnt_dofadr[joint]
        return float(getattr(self.model, field)[first : first + _WIDTH[self.kind(joint)]].max())

    def disabled(self, flag: str) -> bool:
        return bool(self.model.opt.disableflags & getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{flag}"))

    def velocity(self, body: int, point) -> tuple[np.ndarray, np.ndarray]:
        """The velocity of a point of a body, and its angular velocity, inertial frame."""
        by_point, by_turn = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        self.mujoco.mj_jac(self.model, self.data, by_point, by_turn, np.asarray(point), body)
        return by_point @ self.qvel, by_turn @ self.qvel

    def violation(self, equality: int) -> float:
        """By how much the configuration violates an equality [m or rad]."""
        data, rows = self.data, self.code("mjCNSTR_EQUALITY")
        own = (data.efc_type == rows) & (data.efc_id == equality)
        return float(np.abs(data.efc_pos[own]).max(initial=0.0))


def joint_value(read: Source, joint: int) -> float:
    """The coordinate of a hinge or slide."""
    return float(read.qpos[read.model.jnt_qposadr[joint]])


def _vector(name: str, given: Any, shape: tuple[int, ...]) -> np.ndarray:
    value = np.asarray(given, float)
    if value.shape != shape or not np.isfinite(value).all():
        raise ValueError(f"`{name}` must be {shape[0]} finite numbers, got {given!r}.")
    return value
