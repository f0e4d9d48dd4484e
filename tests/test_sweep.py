"""`sweep`: the numbers of single runs, whatever the batches, devices, processes, failures and interruptions."""

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import on_a_cpu, says, some_quick
from sweep_job import BATCH, COUNT, designs, psi

import lgsens as lg
from lgsens.examples import spinning_top
from lgsens.sweeps import _batches

# Batched and single programs round differently: 1e-15 per step × condition of a step, 5e2 of the top, × 5 steps
RTOL = 1e-12


@pytest.fixture(scope="module")
def single():
    """Ψ of every design by itself."""
    compiled, all_designs = jax.jit(psi), designs()
    return np.array([compiled(jax.tree.map(lambda leaf, i=i: leaf[i], all_designs)) for i in range(COUNT)])


def job(*arguments, flags=""):
    """`sweep_job.py` as a process."""
    folder = Path(__file__).parent
    paths = [str(folder.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    environment["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(jax.config.values["jax_disable_most_optimizations"])
    return subprocess.Popen(
        [sys.executable, str(folder / "sweep_job.py"), *map(str, arguments)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process, code=0):
    output, _ = process.communicate(timeout=300)
    assert process.returncode == code, output


@pytest.mark.slow
@on_a_cpu  # one batch of as many elsewhere
def test_thousands_of_designs_are_single_runs_in_one_compilation(single):
    compilations, traces = [], []
    listener = lambda event, duration, **_: compilations.append(event) if "backend_compile" in event else None

    def counted(design):
        traces.append(1)
        return psi(design)

    jax.monitoring.register_event_duration_secs_listener(listener)
    try:
        found = lg.sweep(counted, designs(), progress=False)
    finally:
        jax.monitoring.unregister_event_duration_listener(listener)
    assert (len(traces), len(compilations)) == (1, 1)
    assert found.batch_size < COUNT
    assert found.ok.all()
    assert found.ok.shape == (COUNT,)
    np.testing.assert_allclose(found.values, single, rtol=RTOL)


def test_a_sweep_that_is_killed_goes_on_where_it_stopped(tmp_path, single):
    """SIGKILL in the 17th of 32 batches, on eight devices each, with a part of it written."""
    folder = tmp_path / "sweep"
    arguments = ("--folder", folder, "--out", tmp_path / "never.npz", "--die-in-batch", 17)
    finish(job(*arguments, flags="--xla_force_host_platform_device_count=8"), -signal.SIGKILL)
    done = np.load(folder / "done.npy")
    np.testing.assert_array_equal(done, np.arange(COUNT) < 16 * BATCH)
    kept = np.load(folder / "value_0.npy", mmap_mode="r+")
    np.testing.assert_allclose(kept[done], single[done], rtol=RTOL)
    kept[5] = 123.0  # what is done is not done again, so this stays

    found = lg.sweep(psi, designs(), batch_size=BATCH, folder=folder, progress=False)
    assert isinstance(found.values, np.memmap)
    assert found.values[5] == 123.0
    others = np.arange(COUNT) != 5
    np.testing.assert_allclose(found.values[others], single[others], rtol=RTOL)
    assert found.ok.all()
    assert np.load(folder / "done.npy").all()


def test_a_folder_knows_its_sweep(tmp_path):
    """Whatever is computed: here no motion."""
    fn = lambda d: d["mass"] * jnp.sin(d["stiffness"])
    folder, own = tmp_path / "sweep", designs(4)
    first = lg.sweep(fn, own, folder=folder, progress=False)
    again = lg.sweep(fn, own, folder=folder, progress=False)
    np.testing.assert_array_equal(again.values, first.values)
    others = {"stiffness": own["stiffness"], "mass": own["mass"] + 1e-9}
    for other, wanted, message in (
        (fn, others, "belongs to other designs"),
        (lambda d: {"fn": fn(d)}, own, "holds the results of another `fn`"),
        (lambda d: 1.001 * fn(d), own, "holds the results of another `fn`: design 0 has other values"),
    ):
        with pytest.raises(ValueError, match=says("`folder`", message, "Name another folder, or delete this one")):
            lg.sweep(other, wanted, folder=folder, progress=False)
    (tmp_path / "letters").mkdir()
    with pytest.raises(ValueError, match=says("`folder`", "is there and holds no sweep")):
        lg.sweep(fn, own, folder=tmp_path / "letters", progress=False)
    np.testing.assert_array_equal(lg.sweep(fn, own, folder=folder, progress=False).values, first.values)


@pytest.mark.slow  # the sweep that is killed, above, is on eight devices; uneven batches: `test_batches_are_even`
def test_eight_devices(tmp_path):
    """1001 designs fill neither the last batch nor its devices."""
    out = tmp_path / "out.npz"
    finish(job("--out", out, "--count", 1001, flags="--xla_force_host_platform_device_count=8"))
    with np.load(out) as found:
        assert found["devices"] == 8
        np.testing.assert_allclose(found["values"], designs_of(1001), rtol=RTOL)
        assert found["ok"].all()


def designs_of(count):
    """Ψ of `designs(count)`, whose masses are drawn after `count` angles."""
    compiled, own = jax.jit(psi), designs(count)
    return np.array([compiled(jax.tree.map(lambda leaf, i=i: leaf[i], own)) for i in range(count)])


@pytest.mark.slow
def test_two_processes(tmp_path, single):
    """Both get everything, the first one writes the folder; a part of it is there when they start."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    folder = tmp_path / "sweep"
    outs = [tmp_path / f"{i}.npz" for i in range(2)]
    finish(job("--folder", folder, "--out", outs[0], "--die-in-batch", 17), -signal.SIGKILL)
    flags = "--xla_force_host_platform_device_count=2"
    shared = ("--folder", folder, "--port", port)
    processes = [job(*shared, "--out", out, "--process", i, flags=flags) for i, out in enumerate(outs)]
    for process in processes:
        finish(process)
    for out in outs:
        with np.load(out) as found:
            assert found["devices"] == 4
            np.testing.assert_allclose(found["values"], single, rtol=RTOL)
            assert found["ok"].all()
    np.testing.assert_allclose(np.load(folder / "value_0.npy"), single, rtol=RTOL)


# One iteration of Newton suffices while the mass hangs at rest, and does not once it is pushed.
IMPATIENT = lg.GeneralizedAlpha(max_iterations=1, factor_every=0)


def hanging(push, throw=True):
    body = lg.RigidBody(15.0, None, position=(0.0, 0.0, -1.0), free="x z")
    rod = lg.DistanceJoint(None, "mass", at_a=(0.0, 0.0, 0.0), at_b=body.position)
    force = push * jnp.array([1.0, 0.0, 0.0])
    forces = {"gravity": lg.Gravity((0.0, 0.0, -9.81)), "push": lg.AppliedForce("mass", force=force)}
    model = lg.Model({"mass": body}, {"rod": rod}, forces)
    return lg.simulate(model, t1=0.1, num_steps=3, integrator=IMPATIENT, throw=throw)


def height(push):
    return hanging(push).body("mass").position[-1, 2]


PUSHES = np.array([0.0, 100.0, 0.0, -200.0])


@pytest.mark.parametrize(
    "kind",
    [
        "value",
        *(pytest.param(k, marks=pytest.mark.slow) for k in ("gradient only", "value and gradient", "forward mode")),
    ],
)
def test_failed_designs_are_marked_and_the_others_kept(kind):
    fn = {
        "value": height,
        "value and gradient": jax.value_and_grad(height),
        "gradient only": jax.grad(height),
        "forward mode": jax.jacfwd(height),
    }[kind]
    found = lg.sweep(jax.jit(fn), PUSHES, progress=False)
    np.testing.assert_array_equal(found.ok, PUSHES == 0.0)
    alone = fn(jnp.asarray(0.0))
    for leaf, expected in zip(jax.tree.leaves(found.values), jax.tree.leaves(alone)):
        assert np.isnan(leaf[~found.ok]).all()
        # positions of 1 m; the gradient vanishes there
        np.testing.assert_allclose(leaf[found.ok], expected, rtol=RTOL, atol=1e-13)
    with pytest.raises(lg.SimulationError, match="Newton's iteration did not converge"):
        height(found.design(1))


def test_trajectories_say_whether_they_succeeded():
    found = lg.sweep(lambda push: hanging(push, throw=False), PUSHES, progress=False)
    np.testing.assert_array_equal(found.values.result, np.where(PUSHES == 0.0, 0, lg.RESULTS.newton_failed))
    np.testing.assert_array_equal(found.ok, PUSHES == 0.0)
    assert found.values.states.v.shape == (4, 4, 2)


@pytest.mark.slow  # `test_failed_designs_are_marked_and_the_others_kept` is in the quick run
@pytest.mark.parametrize("save", some_quick([None, lambda s: s.body("top").position[2]]), ids=["trajectory", "saved"])
def test_what_was_not_looked_at_in_a_run_is_no_failure(save):
    """Modified Newton makes no matrix in most steps, and knows no margin there."""
    run = lambda angle: lg.simulate(spinning_top(angle), t1=0.02, num_steps=10, save=save)
    found = lg.sweep(run, jnp.asarray([0.5, jnp.nan]), progress=False)
    np.testing.assert_array_equal(found.ok, [True, False])
    assert not np.isfinite(found.values.stats.margin[0]).all()


@pytest.mark.slow
def test_gradients_and_models():
    """A stack of models as designs; the gradient is a stack of models. A list of models is the same."""
    angles = jnp.linspace(0.5, 0.9, 5)
    value = lambda model: lg.simulate(model, t1=0.05, num_steps=2).body("top").position[-1, 0]
    models = jax.vmap(spinning_top)(angles)
    found = lg.sweep(jax.value_and_grad(value), models, batch_size=2, progress=False)
    assert found.batch_size == 2
    gradient = jax.jit(jax.grad(value))
    for i, angle in enumerate(angles):
        expected = gradient(spinning_top(angle))
        for one, all_of_them in zip(jax.tree.leaves(expected), jax.tree.leaves(found.values[1])):
            # 1e-12 of the largest derivative, that by the pivot, of order 1
            np.testing.assert_allclose(all_of_them[i], one, rtol=0, atol=1e-12)
    by_list = lg.sweep(value, [spinning_top(angle) for angle in angles], progress=False)
    np.testing.assert_allclose(by_list.values, found.values[0], rtol=RTOL)


@pytest.mark.parametrize(("count", "largest", "devices", "size"), [(100, 64, 1, 50), (1, 64, 8, 8), (65, 64, 8, 40)])
def test_batches_are_even(count, largest, devices, size):
    assert _batches.even(count, largest, devices) == size


@on_a_cpu
def test_batches_fit_into_caches():
    """A loop that carries 100 kB, reads 8 B of what it scans, and has a smaller one in it."""

    def fn(x):
        inner = lambda total: jax.lax.fori_loop(0, 3, lambda _, y: jnp.sqrt(1.0 + y), total)
        turn = lambda carry, add: (carry + inner(add), None)
        return jnp.sum(jax.lax.scan(turn, x * jnp.ones(12_500), jnp.ones(1000))[0])

    bytes_per_turn = _batches.trace(fn, np.ones(1)).bytes_per_turn
    assert 100_000 < bytes_per_turn < 100_100
    found = lg.sweep(fn, np.ones(30), progress=False)
    assert found.batch_size == 15  # two batches of at most 2 MiB/100 kB = 20


@on_a_cpu
def test_batches_fit_into_memory(monkeypatch):
    """A program for 256 lanes of 8 kB and more, and a machine with 200 kB, half of which a batch may take."""
    free = 200e3
    monkeypatch.setattr(_batches, "free_memory", lambda devices: free)
    needed = []
    memory = _batches.memory
    monkeypatch.setattr(_batches, "memory", lambda program: needed.append(memory(program)) or needed[-1])
    fn = lambda x: jnp.sum(jnp.sort(x * jnp.arange(1000.0)))
    found = lg.sweep(fn, np.ones(1280), progress=False)
    assert needed[0] > free / 2
    assert 1 <= found.batch_size <= 256 * free / 2 / needed[0]
    np.testing.assert_array_equal(found.values, 499500.0)


@on_a_cpu
def test_free_memory_is_shared_by_the_devices_of_a_machine():
    device = jax.devices()[0]
    one, four = _batches.free_memory([device]), _batches.free_memory([device] * 4)
    assert 2**20 < one < 2**50  # bytes: more than a megabyte, less than a petabyte
    assert 0.1 < four / one < 0.5  # a quarter; other programs allocate too


def test_integers_and_flags_pass_through():
    found = lg.sweep(lambda d: {"twice": 2 * d["n"], "even": d["n"] % 2 == 0}, {"n": np.arange(3)}, progress=False)
    np.testing.assert_array_equal(found.values["twice"], [0, 2, 4])
    np.testing.assert_array_equal(found.values["even"], [True, False, True])
    assert found.ok.all()


def test_variables_for_xarray(monkeypatch):
    own = {"mass": np.ones(3), "at": np.zeros((3, 2))}
    found = lg.sweep(lambda d: {"mass": d["mass"], "path": jnp.broadcast_to(d["at"], (5, 2))}, own, progress=False)
    data = found.variables()
    assert {name: v["dims"] for name, v in data["coords"].items()} == {
        "design.mass": ("design",),
        "at": ("design", "at_0"),
    }
    assert {name: v["dims"] for name, v in data["data_vars"].items()} == {
        "mass": ("design",),
        "path": ("design", "path_0", "path_1"),
        "ok": ("design",),
    }
    assert data["data_vars"]["path"]["data"].shape == (3, 5, 2)
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=re.escape('pip install "lgsens[data]"')):
        found.to_xarray()


MISTAKES = {
    "no arrays": ({}, "`designs` has no arrays"),
    "an empty list": ([], "`designs` has no arrays"),
    "no designs": (np.zeros((0, 3)), "`designs` is empty"),
    "a number": ({"mass": 3.0}, says("mass must have a leading axis", "got the number 3.0")),
    "lengths": ({"a": np.ones(3), "b": np.ones(2)}, says("one leading axis", "{'a': 3, 'b': 2}")),
    "text": ({"a": ["steel", "wood"]}, says("a.0 must be an array of numbers", "'steel'")),
    "structures": ([{"a": 1.0}, {"b": 1.0}], says("`designs[1]` must be a pytree like the first")),
    "shapes": ([np.ones(2), np.ones(3)], says("`designs` must have arrays of the same shapes")),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_bad_designs(mistake):
    wrong, message = MISTAKES[mistake]
    with pytest.raises(ValueError, match=message):
        lg.sweep(lambda d: d, wrong, progress=False)


def test_other_bad_arguments():
    with pytest.raises(ValueError, match=says("`batch_size` must be at least 1", "got 0")):
        lg.sweep(jnp.sin, np.ones(3), batch_size=0)
    with pytest.raises(ValueError, match=says("`fn` must return at least one array")):
        lg.sweep(lambda x: None, np.ones(3))
    with pytest.raises(ValueError, match="`devices` is empty"):
        lg.sweep(jnp.sin, np.ones(3), devices=[])
    with pytest.raises(ValueError, match=says("`devices` must be some of", "got 4")):
        lg.sweep(jnp.sin, np.ones(3), devices=4)


@pytest.mark.parametrize("progress", [True, False])
def test_bar(progress, capsys):
    lg.sweep(jnp.sin, np.ones(3), batch_size=1, progress=progress)
    shown = capsys.readouterr().err
    assert ("3/3" in shown) is ("compiling a batch of designs … " in shown) is progress
