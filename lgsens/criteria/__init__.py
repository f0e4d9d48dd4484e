"""Criteria of a trajectory (paper, §5), their derivatives by every method, and what these cost."""

from lgsens.criteria._advice import Advice as Advice, Costs as Costs, direct_or_adjoint as direct_or_adjoint
from lgsens.criteria._by_parts import Task as Task, reverse_by_parts as reverse_by_parts
from lgsens.criteria._certificate import Certificate as Certificate
from lgsens.criteria._certify import certify as certify, grows_exponentially as grows_exponentially
from lgsens.criteria._cost import measure_costs as measure_costs
from lgsens.criteria._criterion import (
    Criterion as Criterion,
    soft_maximum as soft_maximum,
    time_integral as time_integral,
)
from lgsens.criteria._differentiate import (
    Method as Method,
    Sensitivities as Sensitivities,
    differentiate as differentiate,
)
from lgsens.criteria._error_estimate import corrected as corrected, error_estimate as error_estimate
from lgsens.criteria._kinks import (
    Kink as Kink,
    jumps_of as jumps_of,
    kinks as kinks,
    roughness as roughness,
)
from lgsens.criteria._reference_methods import FiniteDifferences as FiniteDifferences, IndexReduced as IndexReduced
from lgsens.criteria._steps_for import PlacedSteps as PlacedSteps, steps_for as steps_for
from lgsens.criteria._to_accuracy import differentiate_to as differentiate_to
