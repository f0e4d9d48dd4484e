"""A minimization that is killed and goes on: the same numbers, bit by bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgsens.optimize import minimize


def problem(x):
    """Two variables and three constraints, one of them active at the optimum."""
    f = (x["a"] - 2.0) ** 2 + jnp.exp(0.3 * x["b"])
    return f, jnp.stack([x["a"] ** 2 + x["b"] ** 2 - 1.0, -x["a"] - 1.0, x["b"] - 3.0])


def search(num_steps, checkpoint=None, fun=problem, start=0.5, callback=None, forward=None):
    bounds = {"lower": {"a": -2.0, "b": -2.0}, "upper": {"a": 2.0, "b": 2.0}}
    return minimize(
        fun,
        {"a": -1.0, "b": start},
        **bounds,
        num_steps=num_steps,
        tolerance=1e-10,
        progress=False,
        callback=callback,
        checkpoint=checkpoint,
        forward=forward,
    )


def same(one, other):
    assert one.reason == other.reason
    timeless = {"compile_seconds": 0.0, "run_seconds": 0.0, "reason": None}
    one, other = one._replace(**timeless), other._replace(**timeless)
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.fixture(scope="module")
def whole():
    return search(60)


@pytest.mark.parametrize("killed_after", [0, 7])
def test_a_killed_search_goes_on_bit_by_bit(tmp_path, whole, killed_after):
    path = tmp_path / "new" / "search.npz"
    # it ends by itself, at the limit of precision: which word it has for that is said by the last bits
    assert whole.reason in ("converged", "stalled") and len(whole.history.objective) > 8

    def kill(step, *_):
        if step == killed_after:
            raise SystemExit

    with pytest.raises(SystemExit):
        search(60, path, callback=kill)
    steps = []
    resumed = search(60, path, callback=lambda step, *_: steps.append(step))
    assert steps == list(range(killed_after + 1, len(whole.history.objective)))
    same(resumed, whole)
    again = search(60, path, callback=lambda *_: pytest.fail("there is nothing left to do"))
    same(again, whole)


def test_more_steps_go_on_from_where_they_ran_out(tmp_path, whole):
    path = tmp_path / "search.npz"
    assert search(5, path).reason == "steps"
    same(search(60, path), whole)


def test_in_reverse_mode_too(tmp_path):
    path = tmp_path / "search.npz"
    assert search(5, path, forward=False).reason == "steps"
    same(search(60, path, forward=False), search(60, forward=False))
    with pytest.raises(ValueError, match="or another mode; name another file"):
        search(60, path, forward=True)


def test_a_half_written_file_does_not_replace_the_last(tmp_path, whole, monkeypatch):
    path = tmp_path / "search.npz"
    search(3, path)

    def dies(*_, **__):
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", dies)
        with pytest.raises(OSError, match="no space"):
            search(60, path)
    same(search(60, path), whole)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": 0.6}, "belongs to another start, other bounds or tolerances, another"),
        ({"fun": lambda x: (problem(x)[0], problem(x)[1][:2])}, "number of constraints or another mode"),
        ({"fun": lambda x: (2 * problem(x)[0], problem(x)[1])}, "belongs to another `fun`: objective at `x0`"),
    ],
)
def test_the_file_of_another_problem_is_refused(tmp_path, options, message):
    path = tmp_path / "search.npz"
    search(3, path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=message):
        search(3, path, **options)
    assert path.read_bytes() == before


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("not a search")
    with pytest.raises(ValueError, match=r"notes.txt' holds no minimization; name another file"):
        search(3, path)


def test_an_interrupt_loses_nothing(tmp_path, whole):
    """Ctrl-C after an evaluation returns the best so far; the file goes on to the same end."""

    def stop(step, *_):
        if step == 3:
            raise KeyboardInterrupt

    file = tmp_path / "search.npz"
    found = search(60, file, callback=stop)
    assert found.reason == "interrupted" and len(found.history.objective) == 4
    np.testing.assert_array_equal(found.history.objective, whole.history.objective[:4])
    assert found.objective == found.history.objective[found.step]
    same(search(60, file), whole)
