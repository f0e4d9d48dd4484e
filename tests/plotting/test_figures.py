"""Figures: what is on them and that they are written; how they look is for the eye."""

import io
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from helpers import says
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.text import Text
from PIL import Image
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens import plotting
from lgsens.examples import (
    QuarterCar,
    SuspensionCurves,
    four_bar,
    linear_quarter_car,
    slider_crank,
    spatial_chain,
    spinning_top,
)

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def car():
    # Any free length: the preload, which would be computed else, is not drawn.
    return QuarterCar.load().model(free_length=1.0, free_radius=1.0)


def is_png(path):
    return path.read_bytes().startswith(PNG) and path.stat().st_size > 10_000  # an empty canvas has some 3 kB


def words(legend):
    return [text.get_text() for text in legend.get_texts()]


def test_time_histories(tmp_path):
    t = np.linspace(0, 2, 101)
    panels = [
        plotting.Panel("tyre force [kN]", {"before": np.cos(t), "after": np.sin(t)}, {"F_min": -0.5}),
        plotting.Panel("length [mm]", {"before": t}, {"l_min": 0.1, "l_max": 1.9}),
    ]
    fig = plotting.time_histories(t, panels, title="a title")
    top, bottom = fig.axes
    assert [axes.get_ylabel() for axes in fig.axes] == ["tyre force [kN]", "length [mm]"]
    assert bottom.get_xlabel() == "time [s]"
    assert fig.get_suptitle() == "a title"
    assert words(fig.legends[0]) == ["before", "after"]
    assert top.lines[0].get_color() == bottom.lines[0].get_color() != top.lines[1].get_color()  # a run looks the same
    np.testing.assert_array_equal(top.lines[1].get_ydata(), np.sin(t))
    assert {text.get_text() for text in bottom.texts} == {"l_min", "l_max"}
    assert all(text.get_bbox_patch().get_facecolor()[:3] == (1, 1, 1) for text in bottom.texts)  # over curves
    low, high = bottom.get_ylim()
    assert low < 0.1 and high > 1.9  # the limits are in sight
    assert is_png(plotting.save(fig, tmp_path / "a.png"))


@pytest.mark.parametrize("constrained", [True, False])
def test_convergence(constrained, tmp_path):
    worst = np.geomspace(1.0, 1e-4, 20) if constrained else np.full(20, -np.inf)
    history = SimpleNamespace(
        objective=np.linspace(3, 1, 20), worst_constraint=worst, gradient_norm=np.geomspace(1, 1e-3, 20)
    )
    fig = plotting.convergence(history, tolerance=1e-3, best=17, objective="cost [€]")
    assert fig.axes[0].get_ylabel() == "cost [€]"
    assert all("[" in axes.get_ylabel() for axes in fig.axes)  # each has a unit
    assert fig.axes[2].get_xlabel() == "step"
    marked = fig.axes[0].lines[-1]
    assert marked.get_label() == "design kept"
    assert (marked.get_xdata()[0], marked.get_ydata()[0]) == (17, history.objective[17])
    assert is_png(plotting.save(fig, tmp_path / "a.png"))


def test_errors_against_the_step_size(tmp_path):
    h = np.array([8e-3, 4e-3, 2e-3])
    left = plotting.ErrorPanel("left", "relative error [–]", {"one": (h, 3 * h**2), "two": (h, 2 * h**2)})
    right = plotting.ErrorPanel("right", "error [N]", {"two": (h, h), "three": (h[1:], 5 * h[1:])}, order=1)
    fig = plotting.errors([left, right], title="a title")
    assert [axes.get_title() for axes in fig.axes] == ["left", "right"]
    assert [axes.get_ylabel() for axes in fig.axes] == ["relative error [–]", "error [N]"]
    assert fig.get_suptitle() == "a title"
    for axes, panel in zip(fig.axes, (left, right)):
        assert (axes.get_xscale(), axes.get_yscale(), axes.get_xlabel()) == ("log", "log", "step size h [s]")
        *curves, slope = axes.lines
        for curve, (name, (x, error)) in zip(curves, panel.series.items(), strict=True):
            assert curve.get_label() == name
            np.testing.assert_array_equal(curve.get_data(), (x, error))
        # The line has the slope that it says, and is below all curves where h is least.
        rise = np.diff(np.log(slope.get_ydata())) / np.diff(np.log(slope.get_xdata()))
        np.testing.assert_allclose(rise, panel.order, rtol=1e-12)
        assert slope.get_ydata()[0] < min(curve.get_ydata()[-1] for curve in curves)
        assert [text.get_text() for text in axes.texts] == [f"slope {panel.order}"]
    assert [text.get_text() for text in fig.axes[0].get_xticklabels()] == ["0.002", "0.004", "0.008"]
    (legend,) = fig.legends
    assert [text.get_text() for text in legend.get_texts()] == ["one", "two", "three"]
    # A name looks the same everywhere, and names differ without colours.
    look = lambda line: (line.get_color(), line.get_marker(), line.get_markersize())
    assert look(fig.axes[0].lines[1]) == look(fig.axes[1].lines[0])
    markers = {style["marker"] for style in plotting.CURVES}
    assert len(markers) == len(plotting.CURVES)
    assert is_png(plotting.save(fig, tmp_path / "a.png"))


def test_many_errors_are_in_two_rows():
    panels = [plotting.ErrorPanel(f"{i}", "error [N]", {"one": ([1e-3, 2e-3], [1.0, 4.0])}) for i in range(5)]
    fig = plotting.errors(panels)
    assert [axes.get_title() for axes in fig.axes] == ["0", "1", "2", "3", "4"]
    columns = [axes.get_subplotspec().colspan.start for axes in fig.axes]
    assert columns == [0, 1, 2, 0, 1]


def test_errors_over_time():
    t = np.linspace(0, 20, 21)
    panel = plotting.ErrorPanel("start", "error [N]", {"one": (t, np.exp(-t))}, order=None, horizontal="time [ms]")
    (axes,) = plotting.errors([panel]).axes
    assert (axes.get_xscale(), axes.get_yscale(), axes.get_xlabel()) == ("linear", "log", "time [ms]")
    assert len(axes.lines) == 1 and not axes.texts


def test_mechanism_of_the_quarter_car(car, tmp_path):
    fig = plotting.mechanism({"the car": car}, title="five links", axes_names=("x, forward", "y, left", "z, up"))
    (axes,) = fig.axes
    assert (axes.get_xlabel(), axes.get_zlabel()) == ("x, forward [m]", "z, up [m]")
    assert words(fig.legends[0]) == [role for role in plotting.ROLES if role != "beam"]
    # Equal axes: a metre is as long along x, y and z.
    extents = [np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    metre = axes._box_aspect / extents  # matplotlib has no public getter of the aspect of a box in space
    np.testing.assert_allclose(metre, metre[0], rtol=1e-12)
    bars = [np.transpose(line.get_data_3d()) for line in axes.lines if len(line.get_data_3d()[0]) == 2]
    for name in ("wishbone", "track_strut"):
        ends = np.asarray([car.joints[f"{name}_chassis"].at, car.joints[f"{name}_knuckle"].at])
        assert any(np.allclose(bar, ends) for bar in bars), name
    assert is_png(plotting.save(fig, tmp_path / "a.png"))


def test_before_and_after_are_told_apart(car):
    fig = plotting.mechanism({"before": car, "after": car})
    (legend,) = fig.legends
    assert words(legend) == ["before", "after"]
    colours = [line.get_color() for line in legend.get_lines()]
    assert colours == [plotting.COLOURS[0], plotting.ROLES["link"]]


def stressed(section, preload=None):
    """An element of a beam that nothing has bent yet."""
    axes = {"axes_a": jnp.eye(3), "axes_b": jnp.eye(3)}
    arm = lg.BeamElement(None, "tip", at_a=[0, 0, 0], at_b=[1.0, 0, 0.2], section=section, preload=preload, **axes)
    return lg.Model({"tip": lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=[1.0, 0.0, 0.2])}, {}, {"arm": arm})


def test_beams_have_the_colour_of_their_stress():
    """In the reference configuration that of preloads, M c/I; the end of the scale is the largest."""
    section = lg.BeamSection.round(0.02, young=2e11, poisson=0.3, density=7850.0)
    modulus = np.pi * 0.02**3 / 32
    model = stressed(section, [0.0, 0.0, 0.0, 0.0, 50e6 * modulus, 0.0])
    fig = plotting.mechanism({"arm": model})
    axes, bar = fig.axes
    assert bar.get_ylabel() == "stress in beams (von Mises) [MPa]"
    np.testing.assert_allclose(bar.get_ylim(), (0.0, 50.0), rtol=1e-12)  # M c/I to round-off
    assert words(fig.legends[0]) == ["body"]  # beams are on the scale
    beam = max(axes.lines, key=lambda line: line.get_linewidth() if len(line.get_data_3d()[0]) == 9 else 0.0)
    assert to_hex(beam.get_color()) == plotting._stress.SCALE[-1]
    overlaid = plotting.mechanism({"after": model, "before": stressed(section)})
    assert len(overlaid.axes) == 1  # the last one has none, and those before are grey


@pytest.mark.parametrize(
    ("scene", "colour_beams"),
    [
        (lambda: stressed(lg.BeamSection.round(0.02, young=2e11, poisson=0.3, density=7850.0)), "stress"),
        (lambda: stressed(lg.BeamSection([1e7] * 6, 1.0, [1.0] * 3), [1e3] * 6), "stress"),
        (lambda: stressed(lg.BeamSection.round(0.02, young=2e11, poisson=0.3, density=7850.0), [1e3] * 6), None),
    ],
    ids=["without load", "without outline", "not asked for"],
)
def test_beams_without_stress_have_one_colour(scene, colour_beams):
    fig = plotting.mechanism({"arm": scene()}, colour_beams=colour_beams)
    assert len(fig.axes) == 1 and words(fig.legends[0]) == ["beam", "body"]
    assert plotting.ROLES["beam"] in {line.get_color() for line in fig.axes[0].lines}


def test_a_motion_is_drawn_as_it_ends(swinging):
    fig = plotting.mechanism({"end": swinging})
    axes, bar = fig.axes
    ends = [np.transpose(line.get_data_3d())[-1] for line in axes.lines if len(line.get_data_3d()[0]) == 9]
    np.testing.assert_allclose(ends, [swinging.body(f"b.{i}").position[-1] for i in (1, 2, 3)], rtol=0, atol=1e-14)
    largest = 1e-6 * float(swinging.force("b.0").stress[-1])  # at the clamp
    assert bar.get_ylim()[1] == pytest.approx(largest, rel=1e-12)  # the same numbers by two programs
    with pytest.raises(ValueError, match=says("`colour_beams` must be \"stress\" or None, got 'heat'")):
        plotting.mechanism({"end": swinging}, colour_beams="heat")


def test_one_scene_needs_no_name(swinging):
    fig = plotting.mechanism(swinging)
    assert words(fig.legends[0]) == words(plotting.mechanism({"end": swinging}).legends[0])
    with pytest.raises(ValueError, match=says("`models` must be a Model", "or a dict of such by name, got State")):
        plotting.mechanism(swinging.states)  # pyright: ignore[reportArgumentType]


def test_the_scale_of_stress_is_a_map_whose_steps_look_alike():
    plasma, own = matplotlib.colormaps["plasma"], plotting._stress._map()
    shares = np.linspace(0.0, 1.0, 33)
    # straight lines between nine of its colours; and it gets lighter all the way, also where colours are not seen
    np.testing.assert_allclose(own(shares), plasma(0.8 * shares), rtol=0, atol=0.02)
    assert np.all(np.diff(own(shares)[:, :3] @ [0.2126, 0.7152, 0.0722]) > 0)


def test_a_mechanism_in_a_plane_or_with_one_body_is_drawn():
    corners = jnp.asarray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    plate = lg.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.5, 0.5, 0.0))
    frame = lg.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0))
    joints = {f"corner{i}": lg.SphericalJoint("frame", "plate", at=at) for i, at in enumerate(corners)}
    fig = plotting.mechanism({"plate": lg.Model({"plate": plate, "frame": frame}, joints)})
    FigureCanvasAgg(fig).draw()
    (polygon, _) = fig.axes[0].collections[:2]
    assert polygon.get_facecolor().shape[0] == 1  # the hull of a plane would fail
    (axes,) = fig.axes
    assert words(fig.legends[0]) == ["body"]
    assert len(axes.get_zticks()) == 0 < len(axes.get_xticks())


SCENES = {
    "in a plane": four_bar,
    "long": lambda: spatial_chain(5),
    "upright": linear_quarter_car,
    "flat": slider_crank,
    "leaning": lambda: spinning_top(0.7),
    "wheel": lambda: QuarterCar.load().model(free_length=1.0, free_radius=1.0),
}


@pytest.mark.parametrize("scene", SCENES)
def test_labels_fit(scene, monkeypatch):
    """Words of a figure: none on another, none beyond it. Names of axes are slanted: where their middles are counts."""
    drawn, draw = {}, Text.draw

    def record(text, renderer):
        draw(text, renderer)
        if text.get_visible() and text.get_text():
            drawn[text.get_text(), text.get_window_extent(renderer).bounds] = text.get_window_extent(renderer)

    fig = plotting.mechanism({scene: SCENES[scene]()}, title=scene)
    monkeypatch.setattr(Text, "draw", record)
    FigureCanvasAgg(fig).draw()
    slanted = {word: box for word, box in drawn.items() if word[0].endswith(" [m]")}
    level = {word: box for word, box in drawn.items() if word not in slanted}
    assert len(level) > 4 and len(slanted) in (2, 3)
    for word, box in level.items():
        assert not [other for other, its in level.items() if other != word and box.overlaps(its)], word
        assert not [name for name, its in slanted.items() if box.contains(*((its.min + its.max) / 2))], word
    for word, box in drawn.items():
        assert fig.bbox.contains(*box.min) and fig.bbox.contains(*box.max), word


def test_a_plane_is_seen_from_the_front():
    """And a cuboid larger than the scene, of an inertia that no part of it has, is a small cube."""
    plane = plotting.mechanism({"four-bar": four_bar()}).axes[0]
    assert (plane.elev, plane.azim) == (90.0, -90.0)
    assert len(plane.get_zticks()) == 0 < len(plane.get_xticks())
    crank = plotting.mechanism({"slider-crank": slider_crank()}).axes[0]  # 1 kg and 1 kg m² in a scene of 1 m
    assert (crank.elev, crank.azim) != (90.0, -90.0)
    assert max(np.ptp(limits) for limits in (crank.get_xlim(), crank.get_ylim(), crank.get_zlim())) < 1.2


def test_work_precision():
    """The price of the target lies on a line in the logarithms between the settings around it."""
    second = plotting.WorkPrecision([4.0, 1.0, 2.0], [1e-4, 1.6e-3, 4e-4])  # error 1.6e-3/cost², not in order
    slow = plotting.WorkPrecision([3.0, 6.0], [1e-2, 5e-3])
    fig = plotting.work_precision({"second": second, "slow": slow}, target=1e-3, cost="time [s]", error="error [m]")
    (axes,) = fig.axes
    assert (axes.get_xscale(), axes.get_yscale(), axes.get_xlabel(), axes.get_ylabel()) == (
        "log",
        "log",
        "time [s]",
        "error [m]",
    )
    np.testing.assert_array_equal(axes.lines[0].get_data(), ([1.0, 2.0, 4.0], [1.6e-3, 4e-4, 1e-4]))
    np.testing.assert_array_equal(axes.lines[2].get_ydata(), [1e-3, 1e-3])
    labels = words(axes.get_legend())
    assert labels == [f"second: {np.sqrt(1.6):.3g} s", "slow: not reached"]
    assert second.cost_of(1e-3) == pytest.approx(np.sqrt(1.6), rel=1e-12)
    assert second.cost_of(0.1) == 1.0  # the cheapest setting is better already
    assert slow.cost_of(1e-3) is None
    assert plotting.WorkPrecision([1.0, 2.0], [1.0, 0.0]).cost_of(0.5) == 2.0  # no logarithm of an error of 0
    assert len(plotting.work_precision({"second": second}).axes[0].lines) == 1
    with pytest.raises(ValueError, match=r"`target` must be positive, got -1.0"):
        plotting.work_precision({"second": second}, target=-1.0)
    with pytest.raises(ValueError, match=r"`methods\['free'\]`: costs must be positive"):
        plotting.work_precision({"free": plotting.WorkPrecision([0.0], [1.0])})


@pytest.mark.slow
def test_sensitivities_along_a_trajectory():
    """w, v′ and λ′ of the top against differences of two simulations: w is the rotation from one to the other."""

    def motion(alpha):
        return lg.simulate(spinning_top(alpha), t1=0.3, num_steps=30)

    alpha, h = jnp.asarray(0.7), 3e-5
    run = jax.jit(lambda alpha: jax.jvp(motion, (alpha,), (jnp.ones(()),)))
    (trajectory, derivative), (ahead, _), (behind, _) = (run(alpha + s) for s in (0.0, h, -h))
    fig = plotting.sensitivities(trajectory, derivative, "α₀ [rad]")
    titles = [axes.get_title() for axes in fig.axes]
    assert titles == [
        "top: w, translation",
        "top: w, rotation",
        "top: v′, translation",
        "top: v′, rotation",
        "pivot: λ′",
    ]
    assert [axes.get_ylabel() for axes in fig.axes[:4]] == ["m per rad", "rad per rad", "m/s per rad", "rad/s per rad"]
    drawn = [np.stack([line.get_ydata() for line in axes.lines], axis=1) for axes in fig.axes]
    first, second = (m.body("top") for m in (behind, ahead))
    relative = np.einsum("nji,njk->nik", first.orientation, second.orientation)
    turn = Rotation.from_matrix(relative).as_rotvec() / (2 * h)
    # at the middle the body has turned half of it: R(α) = R(α − h) exp(h w), so w is the same to h²
    for found, expected in (
        (drawn[0], (second.position - first.position) / (2 * h)),
        (drawn[1], turn),
        (drawn[2], (second.velocity - first.velocity) / (2 * h)),
        (drawn[3], (second.angular_velocity - first.angular_velocity) / (2 * h)),
        (drawn[4], (ahead.multiplier("pivot") - behind.multiplier("pivot")) / (2 * h)),
    ):
        # h²/6 of the third derivative, and over h the round-off and what Newton leaves: 1e-10 of λ, 3e-6 over 3e-5
        np.testing.assert_allclose(found, expected, rtol=0, atol=3e-6 * max(1.0, np.abs(expected).max()))
    only = plotting.sensitivities(trajectory, derivative.states, bodies=[], joints=["pivot"])
    assert [axes.get_title() for axes in only.axes] == ["pivot: λ′"]
    assert only.axes[0].get_xlabel() == "time [s]"
    with pytest.raises(ValueError, match="`bodies`: 'topp' is not one of"):
        plotting.sensitivities(trajectory, derivative, bodies=["topp"])
    with pytest.raises(ValueError, match="are empty; name something to draw"):
        plotting.sensitivities(trajectory, derivative, bodies=[], joints=[])


def test_root_locus():
    """Of z'' + c z' + z = 0: one of each pair of conjugates, and its damped frequency over c."""
    damping = np.linspace(0.0, 1.0, 5)
    roots = -damping / 2 + 1j * np.sqrt(1 - damping**2 / 4)
    fig = plotting.root_locus(damping, np.stack([roots, roots.conj()], axis=1), "damping [N s/m]")
    points = np.asarray(fig.axes[0].collections[0].get_offsets())
    np.testing.assert_array_equal(points, np.stack([roots.real, roots.imag], axis=1))
    np.testing.assert_allclose(fig.axes[1].lines[0].get_ydata(), roots.imag / (2 * np.pi), rtol=1e-15)
    assert fig.axes[1].get_xlabel() == "damping [N s/m]"
    with pytest.raises(ValueError, match="shapes"):
        plotting.root_locus(damping, roots)


def test_suspension_curves():
    travel = np.linspace(-0.05, 0.05, 11)
    values = lambda factor: SuspensionCurves(travel, *(factor * i * travel for i in range(1, 9)))
    band = (travel[::5], np.full(3, -0.01), np.full(3, 0.02))
    fig = plotting.suspension_curves({"before": values(1.0), "after": values(2.0)}, {"camber": band}, title="mine")
    assert [axes.get_title() for axes in fig.axes] == [
        "camber",
        "toe",
        "track",
        "wheelbase",
        "motion ratio",
        "roll centre",
    ]
    members = ("camber", "toe", "track_change", "wheelbase_change", "spring_motion_ratio", "roll_centre_height")
    factors = (180 / np.pi, 180 / np.pi, 1e3, 1e3, 1.0, 1e3)
    for axes, member, factor in zip(fig.axes, members, factors):
        for line, curves in zip(axes.lines, (values(1.0), values(2.0))):
            np.testing.assert_allclose(line.get_xdata(), 1e3 * travel, rtol=1e-14)
            np.testing.assert_allclose(line.get_ydata(), factor * getattr(curves, member), rtol=1e-14)
    lower, upper = fig.axes[0].lines[2:4]
    np.testing.assert_allclose(lower.get_ydata(), -0.01 * 180 / np.pi, rtol=1e-14)
    np.testing.assert_allclose(upper.get_data(), (1e3 * band[0], 180 / np.pi * band[2]), rtol=1e-14)
    assert words(fig.legends[0]) == ["before", "after"]
    with pytest.raises(ValueError, match="`bounds`: 'cambre' is not one of"):
        plotting.suspension_curves({"a": values(1.0)}, {"cambre": band})


def test_a_figure_shows_itself_in_a_notebook():
    """Jupyter asks an object for this; without it there would be `<Figure size …>`."""
    with Image.open(io.BytesIO(plotting.figure(2.0, 1.5)._repr_png_())) as image:
        assert image.size == (160, 120)


def test_a_missing_matplotlib_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r'pip install "lgsens\[plot\]"'):
        plotting.time_histories(np.zeros(2), [])
