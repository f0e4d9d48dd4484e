"""A suspension that its springs cannot hold."""

import equinox as eqx
import pytest

from lgsens.examples import QuarterCar


def test_spring_without_leverage():
    """A spring whose lower end is the link's pivot on the chassis never changes its length."""
    car = QuarterCar.load()
    pivot = car.links[car.spring.link].chassis
    car = eqx.tree_at(lambda car: car.spring.link_point, car, pivot)
    with pytest.raises(ValueError, match=r"cannot hold .* at its design position .*does the spring change its length"):
        car.model()
