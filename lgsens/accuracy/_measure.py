"""Settings side by side: time, compile time, memory, errors of Ψ and dΨ/dp."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from lgsens._progress import progress_bar
from lgsens._validate import as_count
from lgsens.accuracy._balance import quality
from lgsens.accuracy._programs import Program, Study, crowded, failed, in_turns, make_room
from lgsens.accuracy._reference import MOST_RUNS, Reference, converge
from lgsens.accuracy._setting import Build, Function, Setting, ladder
from lgsens.accuracy._table import Row, Table
from lgsens.linear import tuned

_LEAST_ROUNDS = 5


def work_precision(
    fn: Function,
    build: Build,
    p: Any,
    settings: Iterable[Setting] | None = None,
    *,
    t0=0.0,
    t1,
    scale: Any = None,
    reference: Reference | None = None,
    rounds: int = _LEAST_ROUNDS,
    progress: bool = True,
    known: Table | None = None,
    keep: Callable[[Table], Any] | None = None,
) -> Table:
    """What each setting costs on a scene, and what it loses of a criterion Ψ and of its gradient.

        errors:  |Ψ − Ψ*| / |Ψ*|,     max_i |dΨ/dp_i − dΨ*/dp_i| s_i / max_i |dΨ*/dp_i| s_i

    Arguments:
        fn: the criterion, a function of a trajectory, or a `Criterion`. Integrals by
            `time_integral(t, f, order=trajectory.order)`, or better by a `Criterion`, do not lose what a scheme of high
            order gains; samples of a trajectory at times of one's own lose it.
        build: p ↦ model; the options `model` of a setting come as keyword arguments.
        p: the parameters, a pytree of floats.
        settings: what to measure; None: `ladder()`.
        t0, t1: initial and final time [s], shape ().
        scale: s, the size of a large change of each parameter, a pytree as `p` of numbers or of arrays of its shapes;
            None: the largest entry of each leaf, or 1 where it is zero.
        reference: Ψ* and dΨ*/dp; None: two routes converge one, from the fewest steps of the settings on, with the
            builder's default options.
        rounds: times are medians of so many calls, at least 5, after one that warms up; settings take turns, eight at
            a time.
        progress: show a bar that says what is compiled, where tqdm is installed.
        known: a table of the same scene that was not finished: its rows and its reference are not measured again.
        keep: called with the table so far after each eight settings.

    Settings that differ in their numbers only (steps, ρ∞, tolerance) share their programs. A setting that fails is a
    row that says why. Raises `ValueError` for bad arguments, and where no reference is found.
    """
    settings = tuple(ladder() if settings is None else settings)
    if not settings or not all(isinstance(setting, Setting) for setting in settings):
        raise ValueError("`settings` must be values of Setting, at least one; `ladder` and `grid` make them.")
    if as_count(rounds, "rounds") < _LEAST_ROUNDS:
        raise ValueError(f"`rounds` must be at least {_LEAST_ROUNDS}, got {rounds}: a median of fewer says little.")
    study = Study.of(fn, build, p, scale, t0, t1)
    study.require_number(settings[0])
    reference = known.reference if reference is None and known is not None else reference
    if reference is not None and np.shape(reference.gradient) != study.scale.shape:
        raise ValueError(
            f"`reference`: its gradient must have shape {study.scale.shape}, got {np.shape(reference.gradient)}."
        )
    with progress_bar(len(settings) + (MOST_RUNS if reference is None else 0), "program", progress) as bar:
        if reference is None:
            bar.set_postfix({"compiling": "the reference"})
            reference = converge(study, min(setting.num_steps for setting in settings), bar.update)
            bar.total = bar.n + len(settings)
        rows = {} if known is None else {(row.setting.label, row.setting.num_steps): row for row in known}
        of = lambda setting: (setting.label, setting.num_steps)
        found = lambda: Table(tuple(rows[of(each)] for each in settings if of(each) in rows), reference, rounds)
        rows = {of(each): dataclasses.replace(rows[of(each)], setting=each) for each in settings if of(each) in rows}
        bar.update(len(rows))
        missing = [setting for setting in settings if of(setting) not in rows]
        while missing:
            rows |= {of(row.setting): row for row in _measured(study, missing, reference, rounds, bar)}
            if keep is not None:
                keep(found())
    return found()


def _measured(study: Study, settings: list[Setting], reference: Reference, rounds: int, bar: Any) -> list[Row]:
    """The rows of a few settings, that take turns; they are taken from the list."""
    found = []
    make_room()
    while settings and len(found) < tuned.SETTINGS_TOGETHER and not (found and crowded()):
        setting = settings.pop(0)
        bar.set_postfix({"compiling": f"{setting.label}, {setting.num_steps} steps"})
        found.append(_evaluated(study, setting, reference))
        bar.update()
    rows = [row for row, _ in found]
    programs = {i: program for i, (row, program) in enumerate(found) if not row.failure}
    for i, (seconds, cpu_seconds) in in_turns(programs, rounds).items():
        rows[i] = dataclasses.replace(rows[i], seconds=seconds, cpu_seconds=cpu_seconds)
    return rows


def _evaluated(study: Study, setting: Setting, reference: Reference) -> tuple[Row, Program | None]:
    """A row without its times."""
    try:
        program = Program(study, setting)
        found, trajectory = program.evaluate()
        about = quality(trajectory)
    except Exception as error:  # whatever compiling and running the user's functions raises
        return Row(setting, failure=failed(study, error).failure), None
    value_error, gradient_error = found.relative(reference.evaluated)
    row = Row(
        setting,
        compile_seconds=program.compile_seconds,
        temporary_bytes=program.temporary_bytes,
        value_error=value_error,
        gradient_error=gradient_error,
        **found._asdict(),
        **about._asdict(),
    )
    return row, program
