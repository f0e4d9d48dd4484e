"""Inputs of a linearization: what signals and prescribed numbers of elements have beside their own values."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from lgsens._validate import suggestion
from lgsens.model import AbstractSignal, Model


class _Beside(AbstractSignal):
    """s(t) + u + u̇ (t − t₀) + ü (t − t₀)²/2."""

    own: Float[Array, ""] | AbstractSignal | None
    more: Float[Array, "3"]
    t0: Float[Array, ""]

    def __call__(self, t):
        own = self.own(t) if isinstance(self.own, AbstractSignal) else self.own
        since = t - self.t0
        more = self.more[0] + since * (self.more[1] + since * self.more[2] / 2.0)
        return more if own is None else own + more


def _with(element: Any, more: Any, t0) -> tuple[Any, int]:
    """The element with `more` beside each of its signals (None: as it is), and how many these are."""
    found, count = {}, 0
    for field in dataclasses.fields(element):
        own, number = getattr(element, field.name), 0
        if isinstance(own, AbstractSignal) or field.metadata.get("prescribed"):
            found[field.name], number = _Beside(own, more, t0), 1
        elif isinstance(own, eqx.Module):
            found[field.name], number = _with(own, more, t0)
        count += number
    return (dataclasses.replace(element, **found) if more is not None and count else element), count


def with_inputs(model: Model, names: Sequence[str], inputs: Float[Array, "p 3"], t0) -> Model:
    """The model with u, u̇, ü of each input beside the signals of the joint or force of its name."""
    joints, forces = dict(model.joints), dict(model.forces)
    for name, more in zip(names, inputs):
        of = joints if name in joints else forces
        of[name] = _with(of[name], more, t0)[0]
    return eqx.tree_at(lambda model: (model.joints, model.forces), model, (joints, forces))


def check_inputs(model: Any, names: Sequence[str]) -> None:
    """Raise `ValueError` for names that no joint or force with a signal has."""
    if isinstance(names, str):
        raise ValueError(
            f"`inputs` must be a sequence of names, ({names!r},) or [{names!r}], got the string {names!r}."
        )
    if not isinstance(model, Model):
        if names:
            raise ValueError(f"`inputs` are joints and forces of a Model, and `model` is a {type(model).__name__}.")
        return
    elements = model.joints | model.forces
    known = [name for name, element in elements.items() if _with(element, None, None)[1]]
    for name in names:
        if name not in known:
            raise ValueError(
                f"`inputs`: {suggestion(name, known)}, the joints and forces with a signal. A force of one's own as "
                "input is an `AppliedForce` whose signal is FlatRoad()."
            )
        if name in model.joints and name in model.forces:
            raise ValueError(f"`inputs`: {name!r} is a joint and a force; rename one of them.")
    if len(set(names)) < len(names):
        raise ValueError(f"`inputs` has a name twice: {list(names)}.")
