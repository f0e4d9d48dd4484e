"""From a suspension back to its file: what a design found is a file, and numbers are those in the file's axes."""

import jax
import numpy as np
import pytest
from helpers import says

from lgsens import plotting, rigs
from lgsens.cli._main import main
from lgsens.cli._search import band_row, point_row
from lgsens.examples import Axle, AxleNumbers, Band, QuarterCar, SuspensionDesign, shipped, suspension_document

CURVED = "with curves"


def document_of(name):
    """Of a shipped suspension; or one with curves in place of rates."""
    document = suspension_document("multi_link" if name == CURVED else name)
    if name == CURVED:
        for key, rate in (("spring", "stiffness"), ("damper", "damping")):
            slope = document[key].pop(rate)
            shape = [(-0.2, -0.3), (-0.1, -0.1), (0.0, 0.0), (0.1, 0.1), (0.2, 0.4)]
            document[key]["curve"] = [[x, slope * y] for x, y in shape]
    return document


def close(found, expected):
    """Round-off of points over the road, of curves over their slopes."""
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14), found, expected)


@pytest.mark.parametrize("name", [*shipped(), CURVED])
def test_an_axle_with_other_numbers_is_a_file(name, load):
    """All numbers that can be varied moved at random, written and read again: that axle. And written as it is, its own
    file, in all that is compared."""
    document = document_of(name)
    axle, rng = load(document, Axle), np.random.default_rng(0)
    numbers = AxleNumbers.select(axle, {"*": 0.1})
    x = numbers.of(axle)
    moved = {
        "hardpoints": x["hardpoints"] + 1e-4 * rng.normal(size=x["hardpoints"].shape),
        "rates": x["rates"] * (1 + 1e-3 * rng.normal(size=x["rates"].shape)),
        "angles": x["angles"] + 0.1 * rng.normal(size=x["angles"].shape),
    }
    close(load(numbers.document(document, axle, moved), Axle), numbers.replaced(axle, moved))
    close(numbers.replaced(axle, x), axle)


@pytest.mark.parametrize("name", [name for name in (*shipped(), CURVED) if name != "leaf_springs"])
def test_a_corner_with_another_design_is_a_file(name, load):
    document = document_of(name)
    load(document, QuarterCar)  # writes it
    car, rng = load(document, QuarterCar), np.random.default_rng(0)
    if not car.hardpoint_names:
        return
    limits = SuspensionDesign.load().limits
    problem = SuspensionDesign(car, limits, parameters="k,c,hardpoints")
    x = {key: value * (1 + 1e-3 * rng.normal()) for key, value in problem.start.items()}
    x["hardpoints"] = problem.start["hardpoints"] + 1e-4 * rng.normal(size=problem.start["hardpoints"].shape)
    close(load(problem.document(document, x), QuarterCar), problem.with_design(x))


def test_numbers_are_those_of_a_file_of_the_right_side_with_its_own_origin(load):
    """The five-link suspension's: what is varied has the file's y and z, and so do derivatives."""
    document = suspension_document()
    assert document["wheel"]["centre"][1] < 0
    document["road"] = {"height": -3.0}
    axle, metre = load(document, Axle), document["units"]["length"]
    numbers = AxleNumbers.select(axle, {"links.*.chassis": 0.01})
    names = numbers.names["hardpoints"]
    x = numbers.of(axle)["hardpoints"]
    for name, value in zip(names, x.tolist()):
        _, link, _, axis = name.split(".")
        assert value == pytest.approx(metre * document["links"][link]["chassis"]["xyz".index(axis)], rel=1e-12)
    # A step in the file's y is one against it on the left side.
    i = next(i for i, name in enumerate(names) if name.endswith(".y"))
    link = names[i].split(".")[1]
    moved = numbers.replaced(axle, {"hardpoints": x.at[i].add(0.01)})
    change = moved.left.links[link].chassis - axle.left.links[link].chassis
    np.testing.assert_allclose(change, [0.0, -0.01, 0.0], atol=1e-15)
    np.testing.assert_array_equal(axle.hardpoint_signs, np.tile([1.0, -1.0, 1.0], (len(axle.hardpoint_names), 1)))
    np.testing.assert_array_equal(Axle.load("multi_link").hardpoint_signs, 1.0)


def test_rows_say_values_and_bounds():
    """Of what has bounds its value and these; of a curve near the start how far it strays; of a point both sides."""
    row = band_row(
        "wheel_rate", Band(np.array([30e3]), np.array([32e3])), {"before": [29e3], "after": [31e3]}, "N/mm", 1e-3
    )
    assert row["name"] == "wheel_rate" and row["limit"] == [30.0, 32.0]
    assert [row[label]["worst_value"] for label in ("before", "after")] == pytest.approx([29.0, 31.0])
    start = np.array([0.01, 0.02])
    row = band_row("toe", Band(start - 1e-3, start + 1e-3), {"before": start, "after": start + np.array([0.0, 1e-3])})
    assert row["name"] == "change of toe" and row["limit"] == pytest.approx(1e-3)
    assert row["after"]["worst_value"] == pytest.approx(1e-3) and row["active"]
    assert point_row("x", 5.0, 6.0, -5.0, 15.0)[3] == "+-10 mm"
    assert point_row("x", 5.0, 20.0, 0.0, 20.0)[3] == "0 .. 20, at the bound"


@pytest.mark.slow  # the programs of a whole axle
def test_what_is_kept_is_of_the_car_that_is_said():
    """Of a front axle anti-dive; a rack goes as far as its file says, and has its ratio."""
    axle = Axle.load("push_rod")
    vehicle = rigs.vehicle_of(axle, rear=False)
    assert float(vehicle.rack_ratio) == float(axle.rack.ratio)
    design = rigs.AxleDesign.of(axle, {"spring.stiffness": 0.3}, {"steering_ratio": 1.0}, points=3, vehicle=vehicle)
    ((_, sweep),) = design.sweeps
    assert sweep.amplitude == rigs.rack_way(axle) == (0.06 if axle.rack.travel is None else float(axle.rack.travel))
    band = design.bands["steering_ratio"]
    assert 5 < float(band.lower[0]) + 1.0 < 50
    with pytest.raises(ValueError, match="the axle has no 'anti_squat'"):
        rigs.AxleDesign.of(axle, {"spring.stiffness": 0.3}, {"anti_squat": 1.0}, points=3, vehicle=vehicle)


@pytest.mark.parametrize(
    ("table", "key", "value", "parts"),
    [
        ("wheel", "camber", -1.0, ("'wheel.camber'", "no key of this table", "centre")),
        ("knuckle", "mas", 1.0, ("'knuckle.mas'", "no key")),
        ("tyre", "radius", 0.3, ("'tyre.radius'", "no key")),
        ("bump", "lenght", 0.3, ("'bump.lenght'", "no key")),
        ("units", "lenght", 0.3, ("'units.lenght'", "no key")),
        ("spring", "stiffness", 60.0, ("'spring.stiffness'", "pressed by", "did you mean 60000?")),
        ("tyre", "stiffness", 200.0, ("'tyre.stiffness'", "pressed by", "did you mean 200000?")),
        ("wheel", "centre", [0.0, 0.0, 0.0], ("'wheel.centre'", "middle of the car")),
    ],
)
def test_bad_files_say_what_is_wrong(table, key, value, parts, load):
    document = suspension_document("multi_link")
    if key == "centre":
        value = [document["wheel"]["centre"][0], 0.0, document["wheel"]["centre"][2]]
    document[table][key] = value
    with pytest.raises(ValueError, match=says(*parts)):
        load(document, Axle)


def test_a_file_says_of_which_car_it_is(load):
    """And what is said besides goes before that."""
    document = suspension_document("multi_link")
    assert rigs.vehicle_of(load(document, Axle)) == rigs.Vehicle()
    car = {"wheelbase": 3.1, "centre_height": 0.6, "braking_share": 0.7, "traction_share": 0.4}
    axle = load({**document, "vehicle": {"axle": "front", **car}}, Axle)
    assert rigs.vehicle_of(axle) == rigs.Vehicle(**car, rear=False)
    assert rigs.vehicle_of(axle, wheelbase=2.5, rear=True) == rigs.Vehicle(**{**car, "wheelbase": 2.5})
    for wrong, parts in (
        ({"wheelbase": 3100.0}, ("vehicle.wheelbase", "did you mean 3.1?")),
        ({"axle": "middle"}, ("vehicle.axle", "['front', 'rear']")),
        ({"track": 1.5}, ("vehicle.track", "no key")),
    ):
        with pytest.raises(ValueError, match=says(*parts)):
            load({**document, "vehicle": wrong}, Axle)


def test_hardpoints_of_another_shape_and_files_that_are_not_there():
    axle = Axle.load("solid_axle")
    with pytest.raises(ValueError, match=says("`points` must have shape (3, 3)", "(2, 3)")):
        axle.with_hardpoints(axle.hardpoints[:2])
    with pytest.raises(ValueError, match=says("'nowhere.toml' cannot be read", "those that ship")):
        suspension_document("nowhere.toml")
    with pytest.raises(ValueError, match="Vehicle: `centre_height` must be within"):
        rigs.vehicle_of(axle, centre_height=550.0)


def test_impossible_racks_beams_and_cars(load):
    document = suspension_document("push_rod")
    document["rack"] = {key: value for key, value in document["rack"].items() if key != "ratio"}
    with pytest.raises(ValueError, match=says("'rack.c_factor'", "in metres", "did you mean 0.06?")):
        load({**document, "rack": {**document["rack"], "c_factor": 60.0}}, Axle)
    for numbers, name in (({"wheelbase": 2700.0}, "wheelbase"), ({"braking_share": 60.0}, "braking_share")):
        with pytest.raises(ValueError, match=f"Vehicle: `{name}` must be within"):
            rigs.Vehicle(**numbers)
    document = suspension_document("multi_link")
    link = document["links"]["tie_rod"]
    del link["mass"]
    steel = {"young": 2.1e11, "poisson": 0.3, "density": 7850.0}
    link["beam"] = {"tube": {"diameter": 20.0, "thickness": 2.0}, **steel}
    with pytest.raises(ValueError, match=says("beam.tube.diameter", "did you mean 0.02?")):
        load(document, Axle)
    link["beam"] = {"tube": {"diameter": 0.02, "thickness": 0.002}, **steel, "young": 2.1e5}
    with pytest.raises(ValueError, match=says("beam.young", "did you mean 2.1e+11?")):
        load(document, Axle)


def test_curves_without_a_number_are_drawn():
    """Of a rack that hardly moves: Ackermann's share is not determined anywhere, and the ratio of wheels that do not
    steer is infinite."""
    one, two = np.zeros(3), np.zeros((3, 2))
    wheels = rigs.WheelCurves(*[two] * len(rigs.WheelCurves._fields))
    needed = set(rigs.AxleCurves._fields) - set(rigs.AxleCurves._field_defaults) - {"wheels", "rates"}
    curves = rigs.AxleCurves(wheels=wheels, rates=wheels, **dict.fromkeys(needed, one))
    curves = curves._replace(wheel_rate=two, ackermann=np.full(3, np.nan), steering_ratio=np.full(3, np.inf))
    figure = plotting.kc_curves(curves, title="", along="rack [mm]", factor=1e3)
    drawn = [line.get_ydata() for axes in figure.axes for line in axes.lines if len(line.get_xdata()) == 3]
    assert any(np.isnan(y).all() for y in drawn) and not any(np.isinf(y).any() for y in drawn)


def test_cars_are_of_axles(tmp_path, capsys):
    assert main(["optimize", "multi_link", "--axle", "front", "--out", str(tmp_path / "new")]) == 2
    assert "--axle is of an axle, with --vary" in capsys.readouterr().err


@pytest.mark.slow  # the programs of a whole axle
def test_the_command_says_what_the_axle_has_not(tmp_path, capsys):
    """A characteristic of another axle, in words, and before its gradient is compiled; blanks in lists are none."""
    out = tmp_path / "new"
    asked = [
        "kc",
        "multi_link",
        "--rigid",
        "--points",
        "3",
        "--out",
        str(out),
        "--quiet",
        "--sweeps",
        "parallel, braking",
    ]
    assert main([*asked, "--axle", "front", "--gradient", "anti_lift"]) == 2
    assert "this axle has no 'anti_lift'; it has" in capsys.readouterr().err
    assert not out.exists()
